"""What every reader gives, and the checks that all of them share."""

from __future__ import annotations

import posixpath
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float64, Int, UInt8

from tidefield.errors import SceneError
from tidefield.geometry.lenses import Lens

_NAMED_AT_MOST = 5


@dataclass(frozen=True)
class Observations:
    """Sparse points as they are on disk.

    Attributes:
        xyz_world: positions.
        point_index: for each observation, the point.
        photograph_index: for each observation, the photograph.
        uv_px: for each observation, the pixel in the photograph as it was taken (distorted), at the lens's size.
        rgb: the points' colours, where the format has them.
    """

    xyz_world: Float64[np.ndarray, "P 3"]
    point_index: Int[np.ndarray, " O"]
    photograph_index: Int[np.ndarray, " O"]
    uv_px: Float64[np.ndarray, "O 2"]
    rgb: UInt8[np.ndarray, "P 3"] | None = None

    def by_photograph(self, photographs: int) -> list[Int[np.ndarray, " _"]]:
        """For each photograph, the indices of its observations."""
        order = np.argsort(self.photograph_index, kind="stable")
        starts = np.searchsorted(self.photograph_index[order], np.arange(1, photographs))
        return np.split(order, starts)


@dataclass(frozen=True)
class Reference:
    """Where on Earth the origin of a world is whose axes are east, north and up there, in metres.

    Attributes:
        latitude_deg, longitude_deg: WGS 84.
        height_m: above whatever the heights of the project's cameras count from; projects do not say.
    """

    latitude_deg: float
    longitude_deg: float
    height_m: float


@dataclass(frozen=True)
class PosedPhotographs:
    """A folder of posed photographs, as read: distorted, at their own size, in the coordinates on disk.

    Attributes:
        names: relative to the image folder, in no particular order.
        paths: the files; all exist.
        lenses: one per photograph. A photograph's file may have another size of the same aspect.
        T_world_camera: OpenCV axes (+x right, +y down, +z forward).
        points: sparse points and who saw them, where the format has them.
        cloud_world: points without observations, where the format has only those.
        cloud_rgb: their colours, where the format has them.
        near_far: z-depths, where the format states them.
        split: names of the photographs to learn from and of those held out, where the format has a split.
        background_rgb: what photographs with alpha are meant to be seen against, where the format says so.
        reference: where the world is, where the format says so.
    """

    names: tuple[str, ...]
    paths: tuple[Path, ...]
    lenses: tuple[Lens, ...]
    T_world_camera: Float64[np.ndarray, "V 3 4"]
    points: Observations | None = None
    cloud_world: Float64[np.ndarray, "P 3"] | None = None
    cloud_rgb: UInt8[np.ndarray, "P 3"] | None = None
    near_far: Float64[np.ndarray, "V 2"] | None = None
    split: tuple[frozenset[str], frozenset[str]] | None = None
    background_rgb: tuple[float, float, float] | None = None
    reference: Reference | None = None


def bounded_bytes(path: Path, megabytes: int) -> bytes:
    """A file's content, refused when it is larger than what it claims to be could be."""
    with _readable(path, megabytes):
        return path.read_bytes()


def bounded_lines(path: Path, megabytes: int) -> Iterator[str]:
    """A text's lines, one after the other, refused like `bounded_bytes`; UnicodeDecodeError where it is not UTF-8."""
    with _readable(path, megabytes), path.open(encoding="utf-8") as lines:
        yield from lines


@contextmanager
def _readable(path: Path, megabytes: int) -> Iterator[None]:
    try:
        if path.stat().st_size > megabytes * 1_000_000:
            raise SceneError(
                f"{path} has {path.stat().st_size / 1e6:.0f} MB: expected at most {megabytes} MB of a file of this kind"
            )
        yield
    except OSError as error:
        raise SceneError(f"{path} cannot be read: {error.strerror}; make it a readable file") from error


def inside(root: Path, name: str, named_by: Path) -> Path:
    """The path of a file that a scene's description names, held inside the scene.

    `name` must be relative, must not lead out of `root` by "..", and must not do so by links either, except that a
    folder directly in `root` may itself be a link (photographs kept on another disk): then the file must lie inside
    the folder that it links to.
    """
    relative = Path(posixpath.normpath(name.replace("\\", "/")))
    path = root / relative
    lexically = not relative.anchor and ".." not in relative.parts and "\0" not in name and relative.parts
    homes = [(root / first).resolve() for first in ("", *relative.parts[:-1][:1])] if lexically else []
    try:
        real = path.resolve() if homes else path
        outside = not any(real.is_relative_to(home) for home in homes)
        path.is_file()
    except (OSError, RuntimeError):  # a name too long for the system; links in a circle
        outside = True
    if outside:
        raise SceneError(
            f"{named_by} names the file {name!r}, which is outside of the scene's folder {root}: expected paths "
            "relative to that folder; move the photographs into it and correct the paths"
        )
    return path


def keep_present(paths: Sequence[Path], named_by: Path, allow_missing: bool) -> list[int]:
    """Indices of the files that exist.

    Raises:
        SceneError: when some are missing and that is not allowed.
    """
    present = [i for i, path in enumerate(paths) if path.is_file()]
    missing = [path for path in paths if not path.is_file()]
    if missing and not allow_missing:
        some = ", ".join(str(path) for path in missing[:_NAMED_AT_MOST])
        more = f" and {len(missing) - _NAMED_AT_MOST} more" if len(missing) > _NAMED_AT_MOST else ""
        raise SceneError(
            f"{len(missing)} of the {len(paths)} photographs that {named_by} names are missing: {some}{more}; put them "
            "there, or go on without them with --allow-missing"
        )
    return present


def proper_rotations(
    T_world_camera: Float[np.ndarray, "V 3 4"], names: Sequence[str], named_by: Path
) -> Float64[np.ndarray, "V 3 4"]:
    """Poses with their rotations made orthonormal to float64's precision.

    Raises:
        SceneError: for a pose that is not finite, or whose rotation is none (R^T R = I within 1e-3, det R = +1).
    """
    rotation = T_world_camera[:, :, :3]
    finite = np.isfinite(T_world_camera.reshape(-1, 12)).all(axis=1)
    _refuse(np.flatnonzero(~finite), names, named_by, "the pose of {} has numbers that are not finite")
    off = np.abs(rotation.transpose(0, 2, 1) @ rotation - np.eye(3)).max(axis=(1, 2))
    _refuse(
        np.flatnonzero((off > 1e-3) | (np.linalg.det(rotation) < 0)),
        names,
        named_by,
        "the pose of {} is no rotation and position (its 3x3 part is scaled, skewed or mirrored)",
    )
    u, _, vt = np.linalg.svd(rotation)
    return np.concatenate([u @ vt, T_world_camera[:, :, 3:]], axis=2).astype(np.float64)


def _refuse(wrong: Int[np.ndarray, " W"], names: Sequence[str], named_by: Path, what: str) -> None:
    if len(wrong) == 0:
        return
    first, count = names[int(wrong[0])], len(wrong)
    others = f" (and {count - 1} more)" if count > 1 else ""
    raise SceneError(
        f"{named_by}: {what.format(first + others)}: expected a finite position and a right-handed rotation, "
        "R^T R = I within 0.001; make the poses again, or take the photograph out"
    )
