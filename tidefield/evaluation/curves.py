"""Measure quality against training time: a few held-out views, rendered small while a method trains."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import fmean
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, UInt8
from torch import Tensor
from torch.nn import functional as F

from tidefield.data.scene import Scene
from tidefield.errors import RunError, SceneError
from tidefield.evaluation.metrics import psnr
from tidefield.files import read_json, write_json
from tidefield.geometry.cameras import Cameras
from tidefield.model.rendering import Rendering, to_8_bit

SHARES = (1 / 32, 1 / 16, 1 / 8, 1 / 4, 1 / 2, 1.0)
"""Shares of the training budget after which the views are rendered."""
SMALLER = 4
"""Factor by which the views are smaller than the photographs; at full size, some methods render for minutes."""
CURVE_FILE = "curve.json"


@runtime_checkable
class TrainerLike(Protocol):
    """What a curve needs of a `tidefield.train.loop.Trainer`; `progress.seconds` is the training time so far."""

    progress: Any

    def views(self, cameras: Sequence[Cameras]) -> list[Rendering]: ...


@dataclass
class QualityCurve:
    """Views to render while a method trains, and their PSNR so far."""

    cameras: tuple[Cameras, ...]
    """Of the first held-out photograph and of the middle one, at a smaller size; wholly masked ones do not count."""
    truths: tuple[UInt8[Tensor, "_ _ 3"], ...]
    """The photographs, as means over the pixels' areas."""
    used: tuple[Bool[Tensor, "_ _"], ...]
    """Their pixels that hold no masked one."""
    points: list[tuple[float, float]] = field(default_factory=list)
    """(seconds of training, mean PSNR in dB)."""

    def add(self, seconds: float, renderings: Sequence[Rendering]) -> None:
        """Add the point of one round of renderings."""
        views = zip(renderings, self.truths, self.used, strict=True)
        self.points.append((seconds, fmean(psnr(to_8_bit(view.colour), *truth) for view, *truth in views)))

    def resume(self, folder: Path, seconds: float) -> None:
        """Keep the points of RUN/curve.json that are of the first seconds of training."""
        self.points = [point for point in read_curve(folder) if point[0] <= seconds]

    def watch(self, folder: Path, used: float) -> Callable[[TrainerLike, float], None]:
        """Return a callback of (trainer, share of the budget) that adds and writes a point at each of `SHARES`.

        `used` is the share that an earlier part of the training has used; its points are not repeated.
        """
        due = [share for share in SHARES if share > used]

        def add_if_due(trainer: TrainerLike, share: float) -> None:
            if due and share >= due[0]:
                due[:] = [later for later in due if later > share]
                self.add(trainer.progress.seconds, trainer.views(self.cameras))
                self.write(folder)

        return add_if_due

    def write(self, folder: Path) -> None:
        """Write RUN/curve.json."""
        write_json(folder / CURVE_FILE, self.points)


def read_curve(folder: Path) -> list[tuple[float, float]]:
    """Read the points of RUN/curve.json; none where there is no such file.

    Raises:
        RunError: it is damaged.
    """
    path = folder / CURVE_FILE
    try:
        return [(float(x), float(y)) for x, y in read_json(path) or ()]
    except (TypeError, ValueError, OverflowError) as error:
        raise RunError(f"{path} is damaged: expected what this program wrote; delete it and repeat") from error


def make_curve(scene: Scene, smaller: int = SMALLER) -> QualityCurve:
    """Make the curve of a scene that holds photographs out, with views `smaller` times as small as these.

    Raises:
        SceneError: the scene holds no photograph out, or wholly masked ones only.
    """
    masked = bool(scene.photographs.masks)
    test = [index for index in scene.test if not masked or _used(scene, index, _small(scene, index, smaller)).any()]
    if not test:
        raise SceneError(
            f"{scene.root} holds no photograph out, or wholly masked ones only: expected one for --curve; leave "
            "--curve out"
        )
    cameras, truths, used = [], [], []
    for index in sorted({test[0], test[len(test) // 2]}):
        small = _small(scene, index, smaller)
        cameras.append(small)
        truths.append(reduced_photograph(scene, index, small))
        used.append(_used(scene, index, small))
    return QualityCurve(tuple(cameras), tuple(truths), tuple(used))


def _small(scene: Scene, index: int, smaller: int) -> Cameras:
    camera = scene.cameras[index]
    return camera.resized(max(1, camera.width // smaller), max(1, camera.height // smaller))


def reduced_photograph(scene: Scene, index: int, small: Cameras) -> UInt8[Tensor, "h w 3"]:
    """A photograph at the size of a smaller camera, as means over the pixels' areas."""
    photograph = scene.photographs[index].permute(2, 0, 1)[None].float()
    mean = F.interpolate(photograph, size=(small.height, small.width), mode="area")
    return mean[0].permute(1, 2, 0).round().to(torch.uint8)


def _used(scene: Scene, index: int, small: Cameras) -> Bool[Tensor, "h w"]:
    """Pixels of a smaller photograph that hold no masked one."""
    share = scene.photographs.used(index)[None, None].float()
    return F.interpolate(share, size=(small.height, small.width), mode="area")[0, 0] == 1
