"""The result of every reader: posed photographs with lenses and, if the format has them, sparse points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float64, Int, UInt8

from tidefield.errors import SceneError
from tidefield.geometry.lenses import Lens


@dataclass(frozen=True)
class Observations:
    """Sparse points and their observations, as on disk.

    Attributes:
        xyz_world: positions.
        point_index: for each observation, the point.
        photograph_index: for each observation, the photograph.
        uv_px: for each observation, the pixel in the original (distorted) photograph, at the lens's size.
        rgb: the points' colours, where the format has them.
    """

    xyz_world: Float64[np.ndarray, "P 3"]
    point_index: Int[np.ndarray, " O"]
    photograph_index: Int[np.ndarray, " O"]
    uv_px: Float64[np.ndarray, "O 2"]
    rgb: UInt8[np.ndarray, "P 3"] | None = None

    def by_photograph(self, photographs: int) -> list[Int[np.ndarray, " _"]]:
        """Group the indices of the observations by photograph."""
        order = np.argsort(self.photograph_index, kind="stable")
        starts = np.searchsorted(self.photograph_index[order], np.arange(1, photographs))
        return np.split(order, starts)


@dataclass(frozen=True)
class Reference:
    """Geographic origin of a world whose axes are east, north and up there, in metres.

    Attributes:
        latitude_deg, longitude_deg: WGS 84.
        height_m: in the vertical datum of the project's cameras, which projects do not state.
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
        points: sparse points with observations, where the format has them.
        cloud_world: points without observations, where the format has only those.
        cloud_rgb: their colours, where the format has them.
        near_far: z-depths, where the format states them.
        split: names of the training and the held-out photographs, where the format has a split.
        background_rgb: the background of photographs with alpha, where the format states it.
        reference: the geographic origin, where the format states it.
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


def proper_rotations(
    T_world_camera: Float[np.ndarray, "V 3 4"], names: Sequence[str], named_by: Path
) -> Float64[np.ndarray, "V 3 4"]:
    """Orthonormalise the rotations of poses to float64's precision.

    Raises:
        SceneError: a pose is not finite, or not a rotation (R^T R = I within 1e-3, det R = +1).
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
        "R^T R = I within 0.001; estimate the poses again, or remove the photograph"
    )
