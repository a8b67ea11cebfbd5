"""The paper's Figures 4 and 5 (ground truth and methods side by side, with crops), and quality against time."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, UInt8
from PIL import Image, ImageDraw
from scipy.ndimage import uniform_filter

from tidefield.compare.results import Results
from tidefield.data.readers.files import open_picture
from tidefield.data.scene import Scene
from tidefield.data.surface import doubly_seen
from tidefield.errors import RunError, SceneError
from tidefield.evaluation import EVALUATION_FILE
from tidefield.evaluation.evaluate import picture_names
from tidefield.evaluation.panels import GAP_PX, PAPER, STRIP_PX, strip

PANEL_PX = 320
"""Width of a panel."""
CROPS, SHARE = 2, 5
"""How many crops of each picture, and which part of its width they show: a fifth."""
_COLOURS = ((214, 39, 40), (31, 119, 180))


def side_by_side(results: Results, name: str, scene: Scene) -> Image.Image | None:
    """Ground truth and every method on one held-out photograph; None where no method has been there, or all is masked.

    The photograph is the one whose PSNR is the middle one of the first method's; wholly masked ones have none. Crops
    are where methods differ most about what at least two training photographs see: what none sees can only be guessed.
    """
    methods = [method for method in results.methods if (name, method) in results.by]
    if not methods:
        return None
    photographs = results.by[name, methods[0]].evaluation["per_photograph"]
    measured = [photograph for photograph, one in photographs.items() if one["psnr"] is not None]
    if not measured:
        return None
    ranked = sorted(measured, key=lambda photograph: photographs[photograph]["psnr"])
    chosen = ranked[len(ranked) // 2]
    index = scene.index(chosen)
    truth = scene.photographs[index].numpy()
    seen = (doubly_seen(scene, scene.cameras[index]) & scene.photographs.used(index)).numpy()
    held_out = [scene.names[i] for i in scene.test]
    file = picture_names(held_out)[held_out.index(chosen)]
    pictures = {"ground truth": truth}
    for method in methods:
        folder = results.by[name, method].folder
        assert folder is not None, "figures are made where the pictures are"
        pictures[method] = _rendering(folder / "renderings" / file, truth.shape)
    corners = most_different(truth, [pictures[method] for method in methods], seen, truth.shape[1] // SHARE)
    columns = []
    for title, picture in pictures.items():
        if title in methods:
            title += f"  {results.by[name, title].evaluation['per_photograph'][chosen]['psnr']:.2f} dB"
        columns.append(_column(title, picture, corners, truth.shape[1] // SHARE))
    whole = Image.new("RGB", (sum(c.width + GAP_PX for c in columns) - GAP_PX, columns[0].height), PAPER)
    for k, column in enumerate(columns):
        whole.paste(column, (k * (column.width + GAP_PX), 0))
    return whole


def _rendering(file: Path, shape: tuple[int, ...]) -> UInt8[np.ndarray, "H W 3"]:
    """Read a rendering of an evaluation, which has the shape of its photograph.

    Raises:
        RunError: it is missing, damaged, or of another shape.
    """
    try:
        with open_picture(file) as picture:
            found = np.asarray(picture.convert("RGB"))
        fault = None if found.shape == shape else f"it has {found.shape[1]} x {found.shape[0]} pixels"
    except SceneError as error:
        found, fault = np.empty(0, np.uint8), str(error.__cause__ or error)
    if fault:
        raise RunError(
            f"{file} cannot be shown ({fault}): expected the picture that `tidefield evaluate` wrote; delete "
            f"{file.parents[1] / EVALUATION_FILE} and repeat the command"
        )
    return found


def most_different(
    truth: UInt8[np.ndarray, "H W 3"],
    renderings: list[UInt8[np.ndarray, "H W 3"]],
    counted: Bool[np.ndarray, "H W"],
    side: int,
) -> list[tuple[int, int]]:
    """Upper left corners (u, v) of the squares in which the methods' errors at the counted pixels differ most, or of
    one method are largest; squares do not overlap."""
    errors = [uniform_filter(((r.astype(np.float64) - truth) ** 2).mean(2) * counted, side) for r in renderings]
    spread: Float[np.ndarray, "H W"] = (
        np.std(errors, axis=0) if len(errors) > 1 else errors[0]
    ) + 1e-6  # so that what is set to zero below is never chosen
    half, corners = side // 2, []
    height, width = spread.shape
    spread[:half], spread[height - half :], spread[:, :half], spread[:, width - half :] = 0, 0, 0, 0
    for _ in range(CROPS):
        v, u = (int(x) for x in np.unravel_index(np.argmax(spread), spread.shape))
        corners.append((min(max(u - half, 0), width - side), min(max(v - half, 0), height - side)))
        spread[max(v - side, 0) : v + side, max(u - side, 0) : u + side] = 0
    return corners


def _column(title: str, picture: np.ndarray, corners: list[tuple[int, int]], side: int) -> Image.Image:
    """A titled picture with its crops marked, and these below it."""
    image = Image.fromarray(picture)
    scale = PANEL_PX / image.width
    panel = image.resize((PANEL_PX, round(image.height * scale)), Image.Resampling.LANCZOS)
    zoomed = (PANEL_PX - GAP_PX * (CROPS - 1)) // CROPS
    whole = Image.new("RGB", (PANEL_PX, STRIP_PX + panel.height + GAP_PX + zoomed), PAPER)
    draw = ImageDraw.Draw(panel)
    for k, (u, v) in enumerate(corners):
        box = [round(x * scale) for x in (u, v, u + side, v + side)]
        draw.rectangle(box, outline=_COLOURS[k], width=2)
        crop = image.crop((u, v, u + side, v + side)).resize((zoomed, zoomed), Image.Resampling.NEAREST)
        ImageDraw.Draw(crop).rectangle((0, 0, zoomed - 1, zoomed - 1), outline=_COLOURS[k], width=3)
        whole.paste(crop, (k * (zoomed + GAP_PX), STRIP_PX + panel.height + GAP_PX))
    whole.paste(panel, (0, STRIP_PX))
    whole.paste(strip(PANEL_PX, title), (0, 0))
    return whole


def write_curves(results: Results, path: Path) -> None:
    """Draw PSNR against seconds of training, a panel for each scene that has a curve; at least one has."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator, NullFormatter, ScalarFormatter

    with_curves = {scene for (scene, _), result in results.by.items() if result.curve}
    scenes = [scene for scene in results.scenes if scene in with_curves]
    columns = min(3, len(scenes))
    rows = -(-len(scenes) // columns)
    figure = Figure(figsize=(4.2 * columns, 3.2 * rows), layout="constrained")
    FigureCanvasAgg(figure)
    axes = np.atleast_1d(figure.subplots(rows, columns)).ravel()
    for axis, scene in zip(axes, scenes, strict=False):
        for k, method in enumerate(results.methods):
            result = results.by.get((scene, method))
            if result is not None and result.curve:
                seconds, psnr = zip(*result.curve, strict=True)
                axis.plot(seconds, psnr, marker="o", markersize=3, color=f"C{k}", label=method)
        axis.set_xscale("log")
        axis.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.xaxis.set_major_formatter(ScalarFormatter())
        axis.xaxis.set_minor_formatter(NullFormatter())
        axis.set_title(scene, fontsize=10)
        axis.set_xlabel("seconds of training")
        axis.set_ylabel("PSNR, dB (two small views)")
        axis.grid(alpha=0.3)
    for axis in axes[len(scenes) :]:
        axis.set_visible(False)
    lines = {line.get_label(): line for axis in axes for line in axis.get_lines()}
    methods = [method for method in results.methods if method in lines]
    figure.legend([lines[method] for method in methods], methods, loc="outside lower center", ncols=len(methods))
    figure.savefig(path, dpi=150)
