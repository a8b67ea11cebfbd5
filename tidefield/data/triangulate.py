"""Sparse points from posed photographs: SIFT, matches near epipolar lines, COLMAP's triangulation with poses held.

Photographs are matched with neighbours by position, near ones for many matches and farther ones for wide angles.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt8

from tidefield.data.cache import POINTS_SUFFIX, Arrays, cache_folder, identity, kept_arrays, key
from tidefield.data.images import Progress
from tidefield.data.pictures import read_mask
from tidefield.data.readers.files import open_picture, quiet_pillow
from tidefield.data.readers.posed import Observations, PosedPhotographs
from tidefield.data.sift import MAX_ANGLE_RAD, MAX_RATIO, find_features
from tidefield.geometry.cameras import project_with_slopes
from tidefield.geometry.lenses import LensModel
from tidefield.machine import cores
from tidefield.processes import worker_processes

if TYPE_CHECKING:
    import pycolmap

SIDE_PX = 1600
"""Photographs are reduced to this longer side before features are found in them."""
FEATURES = 4096
"""Largest number of features of a photograph; the largest are kept."""
RANKS = (0, 1, 2, 3, 5, 7, 11, 15, 23, 31)
"""Which of the photographs nearest to each it is matched with, by rank."""
WIDEST_AXES_DEG = 60.0
"""Between the viewing directions of photographs that are matched."""
OFF_LINE = 1 / 400
"""Of a match from its epipolar line, as a share of the longer side: poses of phones are good to some pixels."""
WORTH_PROCESSES_PX = 5_000_000
"""Pixels of all photographs above which it pays to start processes for them, which takes some seconds."""
LEAST_ANGLE_DEG = 0.5
"""Between the rays of a point, whose depth is otherwise a guess."""
_STEPS = 5
"""Of Gauss-Newton, which from the point nearest to the rays has then converged."""
_AT_ONCE = 200_000
"""Observations that are placed together: each takes some 600 bytes meanwhile."""
FEWEST = 100
"""Fewer points do not tell where a scene's surface is."""

_VERSION = 2
"""Part of the key of kept points: to be raised when the same photographs would give others."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Features:
    """The K features of one photograph.

    Attributes:
        uv_px: pixels of the photograph at its lens's size.
        xy: on the plane z = 1 of the camera, without distortion.
        rgb: colours of the photograph there.
        descriptors: RootSIFT, as pycolmap rounds it: a quarter of the memory that it takes at unit length.
    """

    uv_px: Float64[np.ndarray, "K 2"]
    xy: Float64[np.ndarray, "K 2"]
    rgb: UInt8[np.ndarray, "K 3"]
    descriptors: UInt8[np.ndarray, "K 128"]


def find_photograph_features(path: Path, lens: LensModel, mask: Path | None = None) -> Features:
    """Find the features of a photograph, but for those where it is masked, transparent, or its lens images nothing."""
    import pycolmap

    with quiet_pillow(), open_picture(path) as picture:
        rgba = np.asarray(picture.convert("RGBA"))
    used = read_mask(mask, (rgba.shape[1], rgba.shape[0]), path) & (rgba[..., 3] > 0)
    scale = min(1.0, SIDE_PX / max(rgba.shape[:2]))
    if scale < 1:
        rgba = cv2.resize(rgba, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    height, width = rgba.shape[:2]
    grey = cv2.cvtColor(np.ascontiguousarray(rgba[..., :3]), cv2.COLOR_RGB2GRAY)
    keypoints, descriptors = find_features(grey, FEATURES, pycolmap.Device.cpu, used)
    uv = keypoints[:, :2].astype(np.float64)
    column, row = np.floor(uv).astype(int).T.clip(0, [[width - 1], [height - 1]])
    uv *= lens.width / width, lens.height / height
    xy = lens.unproject(uv)
    kept = np.isfinite(xy).all(axis=1)
    return Features(uv[kept], xy[kept], rgba[row[kept], column[kept], :3], descriptors[kept])


def neighbouring_pairs(T_world_camera: Float64[np.ndarray, "V 3 4"]) -> list[tuple[int, int]]:
    """Choose pairs of photographs to match: each with others near it (`RANKS`) that look in a similar direction."""
    position, forward = T_world_camera[:, :, 3], T_world_camera[:, :, 2]
    limit = np.cos(np.deg2rad(WIDEST_AXES_DEG))
    pairs = set()
    for i in range(len(position)):
        distance = np.linalg.norm(position - position[i], axis=1)
        others = np.flatnonzero((forward @ forward[i] > limit) & (distance > 0))
        nearest = others[np.argsort(distance[others], kind="stable")]
        pairs |= {(min(i, j), max(i, j)) for j in nearest[[rank for rank in RANKS if rank < len(nearest)]].tolist()}
    return sorted(pairs)


def match_along_lines(
    first: Features,
    second: Features,
    T_second_first: Float64[np.ndarray, "3 4"],
    off_line: float,
) -> Int64[np.ndarray, "M 2"]:
    """Match features that are each other's nearest, by Lowe's ratio test, and near the epipolar line.

    With a rotation R and a translation t from the first camera to the second, x2^T [t]x R x1 = 0 (Hartley and
    Zisserman, Multiple View Geometry, 2nd ed., eq. 9.12). The line only judges matches: looked for along it, many wrong
    ones would be found, too, and two photographs cannot tell.

    Args:
        off_line: how far from the line a match may be, on the second camera's plane z = 1.
    """
    if not (len(first.xy) and len(second.xy)):
        return np.zeros((0, 2), dtype=np.int64)
    cosine = _unit(first.descriptors) @ _unit(second.descriptors).T
    best, rows = cosine.argmax(axis=1), np.arange(len(first.xy))
    mutual = cosine.argmax(axis=0)[best] == rows
    nearest = cosine[rows, best]
    cosine[rows, best] = -1
    angle, next_angle = (np.arccos(c.clip(-1, 1)) for c in (nearest, cosine.max(axis=1)))
    good = mutual & (angle <= MAX_ANGLE_RAD) & (angle < MAX_RATIO * next_angle)
    rows, best = rows[good], best[good]
    R, (x, y, z) = T_second_first[:, :3], T_second_first[:, 3]
    E = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ R
    line = np.column_stack([first.xy[rows], np.ones(len(rows))]) @ E.T
    off = (line[:, :2] * second.xy[best]).sum(axis=1) + line[:, 2]
    on_line = np.abs(off) <= off_line * np.linalg.norm(line[:, :2], axis=1)
    return np.column_stack([rows, best])[on_line]


def _unit(descriptors: UInt8[np.ndarray, "K 128"]) -> Float32[np.ndarray, "K 128"]:
    rows = descriptors.astype(np.float32)
    return rows / np.linalg.norm(rows, axis=1, keepdims=True).clip(1e-6)


def triangulate(posed: PosedPhotographs, used: Sequence[int], progress: Progress | None = None) -> Observations | None:
    """Find sparse points of posed photographs, whose poses and lenses are held.

    Args:
        posed: the photographs; their own points are not read.
        used: the photographs that may contribute.
        progress: called with (done, all) photographs.

    Returns:
        The points, observed by the photographs used; None where there are fewer than `FEWEST`.
    """
    if len(used) < 2:
        return None
    with _quiet_pycolmap():
        features = _find_features(posed, used, progress)
        return _triangulate(posed, used, features)


def _find_features(posed: PosedPhotographs, used: Sequence[int], progress: Progress | None) -> list[Features]:
    """The features of the photographs used."""
    paths, lenses = [posed.paths[i] for i in used], [posed.lenses[i] for i in used]
    masks = [posed.masks[i] if posed.masks else None for i in used]
    features: list[Features] = []
    with ExitStack() as stack:
        run = map
        if sum(lens.width * lens.height for lens in lenses) > WORTH_PROCESSES_PX:
            run = stack.enter_context(worker_processes(min(cores(), len(used)), _quiet)).map
        for found in run(find_photograph_features, paths, lenses, masks):
            features.append(found)
            if progress:
                progress(len(features), len(used))
    return features


def _triangulate(posed: PosedPhotographs, used: Sequence[int], features: list[Features]) -> Observations | None:
    """Match the features of the photographs used, and triangulate what matches."""
    import pycolmap

    lenses = [posed.lenses[i] for i in used]
    poses = posed.T_world_camera[list(used)]
    T_camera_world = [_inverse(pose) for pose in poses]

    def match(pair: tuple[int, int]) -> Int64[np.ndarray, "M 2"]:
        i, j = pair
        lens = lenses[j]
        off_line = OFF_LINE * max(lens.width, lens.height) / min(lens.fx, lens.fy)
        relative = T_camera_world[j][:, :3] @ poses[i] + np.column_stack([np.zeros((3, 3)), T_camera_world[j][:, 3]])
        return match_along_lines(features[i], features[j], relative, off_line)

    pairs = neighbouring_pairs(poses)
    with ThreadPoolExecutor(cores()) as pool:
        matches = list(pool.map(match, pairs))
    with TemporaryDirectory() as folder:
        model = _model(lenses, T_camera_world, features)
        _write_database(Path(folder) / "database.db", model, dict(zip(pairs, matches, strict=True)))
        options = pycolmap.IncrementalPipelineOptions()
        options.num_threads = 1  # then the same photographs give the same points
        model = pycolmap.triangulate_points(model, Path(folder) / "database.db", folder, folder, options=options)
    points = [model.points3D[key] for key in sorted(model.points3D)]
    if len(points) < FEWEST:
        return None
    seen = [(k, e.image_id - 1, e.point2D_idx) for k, point in enumerate(points) for e in point.track.elements]
    point, image, keypoint = np.array(seen, dtype=np.int64).T
    first = np.unique(point, return_index=True)[1]
    return Observations(
        xyz_world=np.array([p.xyz for p in points]),
        point_index=point,
        photograph_index=np.array(used, dtype=np.int64)[image],
        uv_px=np.array([features[i].uv_px[k] for i, k in zip(image, keypoint, strict=True)]),
        rgb=np.array([features[image[o]].rgb[keypoint[o]] for o in first], dtype=np.uint8),
    )


def find_points(
    posed: PosedPhotographs,
    used: Sequence[int],
    root: Path,
    progress: Progress | None = None,
    cache: Path | None = None,
) -> Observations | None:
    """Triangulate the points of a scene that has none, and say so; what is found, or that nothing is, is kept.

    Args:
        posed, used, progress: see `triangulate`.
        root: of the scene, for messages.
        cache: a folder; the user's if not given.
    """

    def found() -> Arrays:
        _log.info("%s has no sparse points: triangulating them from its photographs and poses", root)
        points = triangulate(posed, used, progress)
        if points is None:
            return {}
        count, seen = len(points.xyz_world), len(points.uv_px)
        _log.info("%s: found %s points, each seen by %.1f photographs", root, f"{count:,}", seen / count)
        return {field.name: getattr(points, field.name) for field in fields(points)}

    arrays = kept_arrays(f"{_key(posed, used)}{POINTS_SUFFIX}", cache or cache_folder(), found)
    if arrays:
        return Observations(**arrays)
    _log.warning(
        "%s has no sparse points, and fewer than %d could be triangulated: the surface is searched everywhere between "
        "near and far, and views may be blurred or torn; check the poses and lenses, or make a scene with `tidefield "
        "prepare`",
        root,
        FEWEST,
    )
    return None


def _key(posed: PosedPhotographs, used: Sequence[int]) -> str:
    """What the points depend on, as a file's name."""
    # Nones tell which photographs the masks belong to.
    files = [None if path is None else identity(path) for path in (*posed.paths, *posed.masks)]
    lenses = [asdict(lens) for lens in posed.lenses]
    return key([_VERSION, files, lenses, posed.T_world_camera.tolist(), list(used)])


def triangulate_again(
    points: Observations, T_world_camera: Float64[np.ndarray, "V 3 4"], lenses: Sequence[LensModel], used: Sequence[int]
) -> Observations:
    """Place points by the observations of some photographs alone, so that nothing of the others is left in them.

    The point nearest to the rays of its observations, then Gauss-Newton steps to the least squares of their
    reprojection errors. Points with fewer than two observations, or whose rays are nearly parallel, are dropped.

    Args:
        points: with observations; where they are at first does not matter.
        used: the photographs whose observations count, such as those that are not held out.
    """
    point, photograph, uv = points.point_index, points.photograph_index, points.uv_px
    xy, focal = np.full(uv.shape, np.nan), np.ones(len(uv))  # of other photographs, none is good below
    rows = points.by_photograph(len(lenses))
    for i in used:
        xy[rows[i]], focal[rows[i]] = lenses[i].unproject(uv[rows[i]]), (lenses[i].fx + lenses[i].fy) / 2
    good = np.isfinite(xy).all(axis=1)
    good &= (np.bincount(point[good], minlength=len(points.xyz_world)) >= 2)[point]
    point, photograph, uv, xy, focal = point[good], photograph[good], uv[good], xy[good], focal[good]
    kept, point = np.unique(point, return_inverse=True)
    xyz, wide = np.empty((len(kept), 3)), np.empty(len(kept), dtype=bool)
    order = np.argsort(point, kind="stable")
    ends = np.cumsum(np.bincount(point, minlength=len(kept)))
    first = 0
    while first < len(kept):
        start = int(ends[first - 1]) if first else 0
        last = max(first + 1, int(np.searchsorted(ends, start + _AT_ONCE, side="right")))
        part = order[start : ends[last - 1]]
        T, some = T_world_camera[photograph[part]], slice(first, last)
        xyz[some], wide[some] = _placed(point[part] - first, last - first, T, xy[part], focal[part])
        first = last
    seen = wide[point]
    return Observations(
        xyz_world=xyz[wide],
        point_index=(np.cumsum(wide) - 1)[point[seen]],
        photograph_index=photograph[seen],
        uv_px=uv[seen],
        rgb=None if points.rgb is None else points.rgb[kept][wide],
    )


def _placed(
    point: Int64[np.ndarray, " O"],
    count: int,
    T_world_camera: Float64[np.ndarray, "O 3 4"],
    xy: Float64[np.ndarray, "O 2"],
    focal: Float64[np.ndarray, " O"],
) -> tuple[Float64[np.ndarray, "P 3"], Bool[np.ndarray, " P"]]:
    """Place points by all of their observations; returns the places, and whether their rays are far from parallel."""
    R, centre = T_world_camera[:, :, :3], T_world_camera[:, :, 3]

    def total(values: Float64[np.ndarray, "O *D"]) -> Float64[np.ndarray, "P *D"]:
        """Sums over the observations of each point."""
        flat = values.reshape(len(values), math.prod(values.shape[1:]))
        sums = [np.bincount(point, weights=column, minlength=count) for column in flat.T]
        return np.stack(sums, axis=1).reshape(count, *values.shape[1:]).astype(np.float64)

    ray = np.einsum("oij,oj->oi", R, np.column_stack([xy, np.ones(len(xy))]))
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    across = np.eye(3) - ray[:, :, None] * ray[:, None, :]
    normal = total(across)
    # Of two rays at an angle a, the smallest eigenvalue is 1 - cos a, about a^2 / 2.
    angle = 2 * np.sqrt(np.linalg.eigvalsh(normal)[:, 0].clip(0) / np.bincount(point, minlength=count))
    wide = angle > np.deg2rad(LEAST_ANGLE_DEG)
    normal[~wide] = np.eye(3)
    xyz = np.linalg.solve(normal, total(np.einsum("oij,oj->oi", across, centre))[..., None])[..., 0]
    for _ in range(_STEPS):
        projected, slope = project_with_slopes(T_world_camera, xyz[point])
        slope = slope * focal[:, None, None]
        error = (projected - xy) * focal[:, None]
        normal = total(slope @ slope.transpose(0, 2, 1))
        normal += 1e-9 * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(3)
        normal[~wide] = np.eye(3)
        xyz -= np.linalg.solve(normal, total(np.einsum("oij,oj->oi", slope, error))[..., None])[..., 0]
    return xyz, wide & np.isfinite(xyz).all(axis=1)


def _quiet() -> None:
    """pycolmap's log would mix with the progress bar."""
    import pycolmap

    pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL)


@contextmanager
def _quiet_pycolmap() -> Iterator[None]:
    """Its log would mix with the progress bar, and it warns of photographs that it finds no colours in."""
    import pycolmap

    level = pycolmap.logging.minloglevel
    _quiet()
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = level


def _inverse(pose: Float64[np.ndarray, "3 4"]) -> Float64[np.ndarray, "3 4"]:
    return np.column_stack([pose[:, :3].T, -pose[:, :3].T @ pose[:, 3]])


def _model(
    lenses: Sequence[LensModel], T_camera_world: Sequence[Float64[np.ndarray, "3 4"]], features: Sequence[Features]
) -> pycolmap.Reconstruction:
    """A COLMAP model of pinhole cameras, image k + 1 with camera k + 1, whose keypoints are undistorted."""
    import pycolmap

    model = pycolmap.Reconstruction()
    for number, (lens, pose, found) in enumerate(zip(lenses, T_camera_world, features, strict=True), start=1):
        parameters = [lens.fx, lens.fy, lens.cx, lens.cy]
        size = {"width": lens.width, "height": lens.height}
        model.add_camera_with_trivial_rig(pycolmap.Camera(camera_id=number, model="PINHOLE", params=parameters, **size))
        uv = found.xy * (lens.fx, lens.fy) + (lens.cx, lens.cy)
        image = pycolmap.Image(name=str(number), keypoints=uv, camera_id=number, image_id=number)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose))
    return model


def _write_database(
    path: Path, model: pycolmap.Reconstruction, matches: Mapping[tuple[int, int], Int64[np.ndarray, "M 2"]]
) -> None:
    """Write a model's cameras, images and keypoints, and the matches of pairs of its images, counted from 0."""
    import pycolmap

    with pycolmap.Database.open(path) as db, pycolmap.DatabaseTransaction(db):
        for camera in model.cameras.values():
            db.write_camera(camera, use_camera_id=True)
        for rig in model.rigs.values():
            db.write_rig(rig, use_rig_id=True)
        for number, image in sorted(model.images.items()):
            db.write_frame(model.frames[image.frame_id], use_frame_id=True)
            db.write_image(image, use_image_id=True)
            db.write_keypoints(number, np.array([p.xy for p in image.points2D], dtype=np.float32).reshape(-1, 2))
        for (i, j), found in matches.items():
            geometry = pycolmap.TwoViewGeometry(
                config=pycolmap.TwoViewGeometryConfiguration.CALIBRATED, inlier_matches=found.astype(np.uint32)
            )
            db.write_two_view_geometry(i + 1, j + 1, geometry)
