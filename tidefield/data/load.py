"""Load a Scene from a folder in one of several layouts."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from tidefield.data.cache import ESTIMATES_SUFFIX, Arrays, array_hash, cache_folder, code_hash, kept_arrays, key
from tidefield.data.calibrate import calibrate_lenses
from tidefield.data.exif import read_exposures
from tidefield.data.exposure import estimate_gains, observe
from tidefield.data.holdout import read_holdout
from tidefield.data.hull import Hull, is_background, visual_hull
from tidefield.data.images import PhotographFile, Photographs, Progress, is_used, open_photographs, photographs_key
from tidefield.data.near_far import estimate_near_far
from tidefield.data.pictures import read_header
from tidefield.data.readers.colmap import find_colmap, read_colmap
from tidefield.data.readers.files import naming, read_json, reading
from tidefield.data.readers.llff import SUFFIXES, read_llff
from tidefield.data.readers.opensfm import find_opensfm, read_opensfm
from tidefield.data.readers.posed import Observations, PosedPhotographs, proper_rotations
from tidefield.data.readers.transforms import find_listed, read_blender, read_split, read_transforms
from tidefield.data.scene import Scene, SparsePoints
from tidefield.data.shading import directional_shading, estimate_shading
from tidefield.data.triangulate import find_points, triangulate_again
from tidefield.errors import SceneError, list_names
from tidefield.files import read_json as read_own_json
from tidefield.geometry.cameras import Cameras
from tidefield.geometry.lenses import Lens, LensModel

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Layout:
    """One way to lay out a scene in a folder.

    Attributes:
        files: by which it is recognised.
        program: whose layout it is.
        find: what of it a folder holds, such as the folder of the model; None where it does not have this layout.
        read: (root, what was found, allow_missing) to the posed photographs.
    """

    files: str
    program: str
    find: Callable[[Path], Path | None]
    read: Callable[[Path, Path, bool], PosedPhotographs]


def _file(name: str) -> Callable[[Path], Path | None]:
    return lambda root: root / name if (root / name).is_file() else None


LAYOUTS = (
    Layout(
        "images/ and sparse/0/ with cameras, images, points3D (.bin or .txt)",
        "a COLMAP model",
        lambda root: find_colmap(root, "sparse/0", "sparse"),
        read_colmap,
    ),
    Layout(
        "transforms.json and the photographs that it names",
        "nerfstudio, instant-ngp",
        _file("transforms.json"),
        lambda root, _, allow_missing: read_transforms(root, allow_missing),
    ),
    Layout(
        "transforms_train.json, transforms_test.json and their pictures",
        "a Blender scene",
        _file("transforms_train.json"),
        lambda root, _, allow_missing: read_blender(root, allow_missing),
    ),
    Layout("images/ and poses_bounds.npy", "LLFF", _file("poses_bounds.npy"), lambda root, *_: read_llff(root)),
    Layout(
        "reconstruction.json or opensfm/reconstruction.json, and images/", "OpenSfM, ODM", find_opensfm, read_opensfm
    ),
    Layout(
        "images/ and colmap/sparse/0/",
        "a COLMAP model of nerfstudio",
        lambda root: find_colmap(root, "colmap/sparse/0"),
        read_colmap,
    ),
)
"""In this order; the first one found is read. A new layout is a line here and its reader in data/readers/."""
_FEWEST = 3
_SMALLEST_WIDTH = 16
_WHITE = (1.0, 1.0, 1.0)
DOUBLED_BYTES = 4e9
"""Of photographs that are opened at twice their size: disk of the cache, and memory that is read through it."""


def load_scene(
    root: str | Path,
    *,
    width: int | None = None,
    allow_missing: bool = False,
    hold_out: bool = True,
    calibrate: bool = True,
    progress: Progress | None = None,
    cache: Path | None = None,
    unfinished: bool = False,
) -> Scene:
    """Load a scene: poses, sparse points, and undistorted photographs at the working resolution.

    Args:
        root: a folder in one of `LAYOUTS`, which is recognised by its files.
        width: of every photograph in pixels, with its aspect kept; photographs are never enlarged. None keeps their
            own widths.
        allow_missing: leave out photographs whose files are missing, instead of raising an error.
        hold_out: otherwise all photographs are training photographs.
        calibrate: estimate what is left of the lens and the shading of the photographs (docs/method.md, sections 12
            and 14).
        progress: called with (ready, all) while photographs are decoded; not called when they are cached.
        cache: folder for decoded photographs; the user's if not given.
        unfinished: open a scene that `tidefield prepare` has not finished.

    Raises:
        SceneError: the folder is not a scene, is damaged, or has not been prepared to its end.
    """
    root = Path(root)
    require_width(width)
    posed = read_posed(root, allow_missing, unfinished)
    files = []
    masks = posed.masks or (None,) * len(posed.names)
    for path, lens, mask in zip(posed.paths, posed.lenses, masks, strict=True):
        own, has_alpha = own_lens(path, lens)
        files.append(PhotographFile(path, own, own.width, own.height, has_alpha, mask).at_width(width))
    train, test = posed.train_and_test if hold_out else (tuple(range(len(posed.names))), ())
    if posed.points is None or not len(posed.points.uv_px):
        posed = replace(posed, points=find_points(posed, train, root, progress, cache) or posed.points)
    T_world_camera, origin = posed.centred
    pinholes = tuple(_pinhole(file) for file in files)
    background = posed.background_rgb or _WHITE
    photographs = open_photographs(files, background, progress, cache)
    transparent = [alpha is not None and bool((alpha < 255).any()) for alpha in photographs.alphas]
    # An object before a background is cut out in every photograph: others have pixels that are not to be used.
    cut_out = any(transparent) and (posed.background_rgb is not None or all(transparent[i] for i in train))
    if cut_out and posed.background_rgb is None and posed.points is not None and len(posed.points.uv_px):
        cut_out = is_background(posed.points, posed.T_world_camera, pinholes, photographs, train)
    if any(transparent) and not cut_out:
        some = [path.name for path, own in zip(posed.paths, transparent, strict=True) if own]
        _log.info(f"transparent pixels of {list_names(some)} are not used, as if they were masked")
        files = [
            replace(file, has_alpha=False, alpha_is_mask=True) if own else file
            for file, own in zip(files, transparent, strict=True)
        ]
        photographs = open_photographs(files, background, progress, cache)
    points = [] if posed.points is None else [getattr(posed.points, field.name) for field in fields(posed.points)]
    read = [T_world_camera, posed.near_far, posed.divided_by, *points]
    hashes = [None if array is None else array_hash(array) for array in read]
    lenses = [asdict(lens) for lens in posed.lenses]
    depends_on = [code_hash(), photographs_key(files, background), lenses, hashes, train, calibrate]

    def estimated() -> Arrays:
        cameras, sparse = _estimate(posed, T_world_camera, origin, pinholes, photographs, train, calibrate)
        return _arrays(cameras, sparse, visual_hull(cameras, photographs, train) if cut_out else None)

    arrays = kept_arrays(f"{key(depends_on)}{ESTIMATES_SUFFIX}", cache or cache_folder(), estimated)
    cameras, sparse, hull = _from_arrays(arrays)
    return Scene(
        root=root,
        names=posed.names,
        cameras=cameras,
        photographs=photographs,
        points=sparse,
        train=train,
        test=test,
        origin_world=torch.from_numpy(origin),
        background_rgb=posed.background_rgb or (_WHITE if cut_out else None),
        hull=hull,
        reference=posed.reference,
    )


def _estimate(
    posed: PosedPhotographs,
    T_world_camera: Float64[np.ndarray, "V 3 4"],
    origin: Float64[np.ndarray, "3"],
    pinholes: tuple[Lens, ...],
    photographs: Photographs,
    train: tuple[int, ...],
    calibrate: bool,
) -> tuple[Cameras, SparsePoints | None]:
    """Estimate what a scene needs beyond what its files state, from its training photographs.

    Args:
        posed: as read.
        T_world_camera, origin: its poses around their mean position, and that.
        pinholes: the cameras of its photographs.
        photographs: at their size.
        train: indices of the training photographs.
        calibrate: see `load_scene`.

    Returns:
        The cameras with near and far, gains, shading and what is left of the lens, and the points that are left.
    """
    points = posed.points and replace(posed.points, xyz_world=posed.points.xyz_world - origin)
    if points is not None and len(points.uv_px):
        if photographs.masks:
            points = _of_used_pixels(points, posed.lenses, pinholes, photographs)
        points = triangulate_again(points, T_world_camera, posed.lenses, train)
    sparse = points and _sparse_points(points, T_world_camera, posed.lenses, pinholes)
    near_far = posed.near_far
    if near_far is None or points is not None:
        near_far = estimate_near_far(T_world_camera, pinholes, points)
    cameras = Cameras(
        T_world_camera=_float32(T_world_camera),
        focal_px=_float32([(lens.fx, lens.fy) for lens in pinholes]),
        principal_px=_float32([(lens.cx, lens.cy) for lens in pinholes]),
        size_px=torch.tensor([(lens.width, lens.height) for lens in pinholes]),
        near_far=_float32(near_far),
        gain=torch.ones(len(pinholes), 3),
    )
    if calibrate and sparse is not None:
        cameras, sparse = calibrate_lenses(cameras, sparse, posed.lenses, train)
    seen = None if sparse is None else observe(photographs, cameras, sparse, train)
    exposures = read_exposures(posed.paths)
    gain, by_direction = estimate_gains(seen, cameras, train, exposures, posed.divided_by)
    cameras = replace(cameras, gain=gain)
    if by_direction.any():
        cameras = replace(cameras, shading=directional_shading(cameras, train, by_direction))
    if calibrate and seen is not None and sparse is not None:
        own = estimate_shading(seen, cameras, sparse, posed.lenses, train, exposures)
        if own is not None:
            cameras = replace(cameras, shading=own if cameras.shading is None else cameras.shading + own)
    return cameras, sparse


def _arrays(cameras: Cameras, points: SparsePoints | None, hull: Hull | None) -> Arrays:
    """What was estimated, as arrays for the cache; `_from_arrays` is the inverse."""
    return {
        f"{name}.{field.name}": value.numpy()
        for name, own in (("cameras", cameras), ("points", points), ("hull", hull))
        if own is not None
        for field in fields(own)
        if isinstance(value := getattr(own, field.name), Tensor)
    }


def _from_arrays(arrays: Arrays) -> tuple[Cameras, SparsePoints | None, Hull | None]:
    parts: dict[str, dict[str, Tensor]] = {"cameras": {}, "points": {}, "hull": {}}
    for name, array in arrays.items():
        part, _, field = name.partition(".")
        parts[part][field] = torch.from_numpy(array)
    cameras, points, hull = parts.values()
    return (
        Cameras(**cameras),  # type: ignore[arg-type]
        SparsePoints(**points) if points else None,
        Hull(**hull) if hull else None,
    )


def at_width(scene: Scene, width: int, progress: Progress | None = None, cache: Path | None = None) -> Scene:
    """Open a scene's photographs at another width; everything else stays as it is, in other pixels.

    Args:
        scene: from `load_scene`.
        width, progress, cache: see `load_scene`.
    """
    require_width(width)
    return _reopened(scene, [file.at_width(width) for file in scene.photographs.files], progress, cache)


def at_twice_the_size(scene: Scene, progress: Progress | None = None, cache: Path | None = None) -> Scene | None:
    """Open a scene's photographs at exactly twice their size, to read means over their pixels between them.

    Args:
        scene: from `load_scene`.
        progress, cache: see `load_scene`.

    Returns:
        None where a file has less than that, where there are no files, or where it is more than `DOUBLED_BYTES`.
    """
    photographs = scene.photographs
    files = [replace(file, width=2 * file.width, height=2 * file.height) for file in photographs.files]
    if not files or sum(file.bytes for file in files) > DOUBLED_BYTES:
        return None
    if not all(photographs.reaches(index, file.width) for index, file in enumerate(files)):
        return None
    return _reopened(scene, files, progress, cache)


def _reopened(scene: Scene, files: list[PhotographFile], progress: Progress | None, cache: Path | None) -> Scene:
    size = torch.tensor([(file.width, file.height) for file in files])
    ratio, points = size / scene.cameras.size_px, scene.points
    if points is not None:
        scale = ratio[points.camera_index.long()]
        error = points.error_px * ratio.mean()
        points = replace(points, uv_px=points.uv_px * scale.to(points.uv_px), error_px=error.to(points.error_px))
    return replace(
        scene,
        cameras=scene.cameras.resized_each(size),
        photographs=open_photographs(files, scene.photographs.background_rgb, progress, cache),
        points=points,
    )


def _require_finished(root: Path) -> None:
    """Raises: SceneError when `tidefield prepare` was interrupted, and photographs may have several exposures."""
    stages = read_own_json(root / "prepare" / "stages.json")
    if isinstance(stages, dict) and stages and not (stages.get("images") or {}).get("done"):
        raise SceneError(
            f"{root} is not prepared to its end: expected a whole scene; let `tidefield prepare` end, or repeat the "
            "same command, which continues"
        )


def require_width(width: int | None) -> None:
    """Raises: SceneError when photographs of a width in pixels are too small."""
    if width is not None and width < _SMALLEST_WIDTH:
        raise SceneError(f"the width is {width} pixels: expected at least {_SMALLEST_WIDTH}; choose a larger --width")


def read_posed(root: Path, allow_missing: bool, unfinished: bool = False) -> PosedPhotographs:
    """Read the poses and lenses of a folder's photographs, sorted by their names, without decoding them.

    Args:
        root: a folder in one of `LAYOUTS`; a COLMAP model is preferred where there are several, with the split of a
            transforms.json next to it.
        allow_missing: leave out photographs whose files are missing, instead of raising an error.
        unfinished: read a scene that `tidefield prepare` has not finished.

    Raises:
        SceneError: the folder is not a scene, is damaged, has not been prepared to its end, names a photograph twice,
            or has fewer than three.
    """
    if not unfinished:
        _require_finished(root)
    with reading(root):
        posed = _read(root, allow_missing)
        _refuse_repeated(posed, root)
    if len(posed.names) < _FEWEST:
        raise SceneError(
            f"{root} has {len(posed.names)} posed photographs: expected at least {_FEWEST}; add photographs"
        )
    T_world_camera = proper_rotations(posed.T_world_camera, posed.names, root)
    order = sorted(range(len(posed.names)), key=lambda i: posed.names[i])
    points = posed.points
    if points is not None:
        points = replace(points, photograph_index=np.argsort(order)[points.photograph_index])
    names = tuple(posed.names[i] for i in order)
    holdout = read_holdout(root, names, allow_missing)
    return replace(
        posed,
        names=names,
        paths=tuple(posed.paths[i] for i in order),
        lenses=tuple(posed.lenses[i] for i in order),
        T_world_camera=T_world_camera[order],
        near_far=None if posed.near_far is None else posed.near_far[order],
        points=points,
        masks=tuple(posed.masks[i] for i in order) if posed.masks else (),
        split=holdout.split(names) if holdout else posed.split or _split_beside(root, names),
        divided_by=holdout.gains(names) if holdout else None,
    )


def _split_beside(root: Path, names: tuple[str, ...]) -> tuple[frozenset[str], frozenset[str]] | None:
    """Read the split that transforms.json lists next to a COLMAP model, for the model's photographs."""
    file = root / "transforms.json"
    if not file.is_file():
        return None
    split = read_split(read_json(file), file)
    if split is None:
        return None
    found = find_listed(split[0] | split[1], names)
    train, test = (frozenset(name for path in part if (name := found[path]) is not None) for part in split)
    if train and test and len(train) + len(test) == len(names):
        return train, test
    _log.warning(f"{file} has a split of other photographs than the COLMAP model next to it: every eighth is held out")
    return None


def own_lens(path: Path, lens: LensModel) -> tuple[LensModel, bool]:
    """Resize a lens to its photograph's own size; also return whether the photograph has alpha.

    Raises:
        SceneError: the file cannot be read, or its aspect differs from the lens's.
    """
    own_width, own_height, has_alpha = read_header(path)
    # One pixel of the smaller size, where a half may have been rounded.
    if abs(own_height - lens.height * own_width / lens.width) > max(1.0, own_width / lens.width):
        turned = " (is it stored rotated? EXIF orientation is not applied)" if own_width < own_height else ""
        raise SceneError(
            f"{path} has {own_width} x {own_height} pixels, but its camera has {lens.width} x {lens.height}: expected "
            f"the same size or the same aspect{turned}; use the photographs that the poses were estimated from"
        )
    return lens.resized(own_width, own_height), has_alpha


def _read(root: Path, allow_missing: bool) -> PosedPhotographs:
    """Read the layout that the folder's files show."""
    if not root.is_dir():
        raise SceneError(f"{root} is {'a file' if root.exists() else 'missing'}: {_expected('PHOTOGRAPHS')}")
    for layout in LAYOUTS:
        if (found := layout.find(root)) is not None:
            return layout.read(root, found, allow_missing)
    paths = sorted(root.iterdir())
    if (root / "run.json").is_file():
        raise SceneError(f"{root} is a run, not a scene: expected the scene that it was trained on; name that")
    if any(path.suffix.lower() in SUFFIXES for path in paths):
        raise SceneError(
            f"{root} has photographs without poses: expected a scene; make one with `tidefield prepare {root} SCENE`, "
            "and name SCENE instead"
        )
    names = [path.name + "/" * path.is_dir() for path in paths]
    raise SceneError(f"{root} has no posed photographs (found: {list_names(names, 8) or 'nothing'}): {_expected(root)}")


def is_scene(root: Path) -> bool:
    """Whether a folder has the files of one of `LAYOUTS`."""
    with reading(root):
        return any(layout.find(root) is not None for layout in LAYOUTS)


def _refuse_repeated(posed: PosedPhotographs, root: Path) -> None:
    """Refuse a photograph with two poses, of which one could be held out and the other be trained on."""
    names: dict[tuple[int, int] | Path, str] = {}
    for path, name in zip(posed.paths, posed.names, strict=True):
        status = path.stat()
        # The number is the same for all names and links of a file, but 0 where a file system has none.
        file = (status.st_dev, status.st_ino) if status.st_ino else path.resolve()
        if file in names:
            raise SceneError(
                f"{root} has two poses for one photograph ({names[file]} and {name}): expected each photograph once; "
                "remove one of them from the scene's description"
            )
        names[file] = name


def _expected(photographs: Path | str) -> str:
    lines = "\n".join(f"  {layout.files:<70} {layout.program}" for layout in LAYOUTS)
    return (
        f"expected one of\n{lines}\n; estimate poses of the photographs first (`tidefield prepare {photographs} "
        "SCENE`, or COLMAP), or give the folder that holds these"
    )


def _pinhole(file: PhotographFile) -> Lens:
    """The distortion-free camera of a photograph, at the size that it is read at."""
    with naming(file.path):
        return file.lens.pinhole().resized(file.width, file.height)


def _sparse_points(
    points: Observations,
    T_world_camera: Float64[np.ndarray, "V 3 4"],
    lenses: tuple[LensModel, ...],
    pinholes: tuple[Lens, ...],
) -> SparsePoints | None:
    """Undistort the observations of sparse points; leave out those that then lie outside their photographs."""
    uv_px = np.full((len(points.uv_px), 2), np.nan)
    off_px = np.full(len(points.uv_px), np.nan)
    observations = points.by_photograph(len(pinholes))
    for lens, pinhole, pose, mine in zip(lenses, pinholes, T_world_camera, observations, strict=True):
        xyz = (points.xyz_world[points.point_index[mine]] - pose[:, 3]) @ pose[:, :3]
        uv = lens.to_pinhole(points.uv_px[mine], pinhole)
        with np.errstate(all="ignore"):  # points in the camera's plane, which are left out
            off = np.linalg.norm(pinhole.project(xyz) - uv, axis=1)
        good = (xyz[:, 2] > 0) & np.isfinite(off)
        uv_px[mine[good]], off_px[mine[good]] = uv[good], off[good]
    good = np.isfinite(off_px)
    seen, point_index = np.unique(points.point_index[good], return_inverse=True)
    if len(seen) == 0:
        return None
    views = np.bincount(point_index)
    return SparsePoints(
        xyz_world=_float32(points.xyz_world[seen]),
        error_px=_float32(np.bincount(point_index, weights=off_px[good]) / views),
        point_index=torch.from_numpy(point_index.astype(np.int64)),
        camera_index=torch.from_numpy(points.photograph_index[good].astype(np.int64)),
        uv_px=_float32(uv_px[good]),
    )


def _of_used_pixels(
    points: Observations, lenses: tuple[LensModel, ...], pinholes: tuple[Lens, ...], photographs: Photographs
) -> Observations:
    """Leave out observations in masked pixels; all points stay."""
    kept = np.ones(len(points.uv_px), dtype=bool)
    observations = points.by_photograph(len(pinholes))
    for lens, pinhole, mask, mine in zip(lenses, pinholes, photographs.masks, observations, strict=True):
        if mask is not None:
            # NaN where the lens images nothing, whatever the mask says there: `triangulate_again` leaves these out.
            uv = lens.unproject(points.uv_px[mine]) * (pinhole.fx, pinhole.fy) + (pinhole.cx, pinhole.cy)
            kept[mine] = is_used(mask, torch.from_numpy(uv)).numpy()
    return replace(
        points,
        point_index=points.point_index[kept],
        photograph_index=points.photograph_index[kept],
        uv_px=points.uv_px[kept],
    )


def _float32(values: np.ndarray | Sequence[tuple[float, float]]) -> Tensor:
    return torch.from_numpy(np.array(values, dtype=np.float32))
