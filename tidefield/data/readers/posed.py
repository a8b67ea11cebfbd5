"""The result of every reader: posed photographs with lenses and, if the format has them, sparse points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float64, Int, UInt8

from tidefield.data.readers.files import LARGEST, in_range
from tidefield.errors import SceneError
from tidefield.geometry.lenses import LensModel


def _no_indices() -> Int[np.ndarray, " O"]:
    return np.zeros(0, dtype=np.int64)


@dataclass(frozen=True)
class Observations:
    """Sparse points as on disk, and their observations; a cloud of points has none.

    Attributes:
        xyz_world: positions.
        point_index: for each observation, the point.
        photograph_index: for each observation, the photograph.
        uv_px: for each observation, the pixel in the original (distorted) photograph, at the lens's size.
        rgb: the points' colours, where the format has them.
    """

    xyz_world: Float64[np.ndarray, "P 3"]
    point_index: Int[np.ndarray, " O"] = field(default_factory=_no_indices)
    photograph_index: Int[np.ndarray, " O"] = field(default_factory=_no_indices)
    uv_px: Float64[np.ndarray, "O 2"] = field(default_factory=lambda: np.zeros((0, 2)))
    rgb: UInt8[np.ndarray, "P 3"] | None = None

    def by_photograph(self, photographs: int) -> list[Int[np.ndarray, " _"]]:
        """Group the indices of the observations by photograph."""
        order = np.argsort(self.photograph_index, kind="stable")
        ends = np.searchsorted(self.photograph_index[order], np.arange(photographs), side="right")
        return np.split(order, ends)[:photographs]


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
        points: sparse points, where the format has them; without observations, where it has only a cloud.
        near_far: z-depths, where the format states them.
        split: names of the training and the held-out photographs, where the format has a split.
        divided_by: the gains that the photographs' files were divided by, where `prepare --holdout` did so.
        background_rgb: the background of photographs with alpha, where the format states it.
        reference: the geographic origin, where the format states it.
        masks: of each photograph (`PhotographFile.mask`), or None; empty if no photograph has one.
    """

    names: tuple[str, ...]
    paths: tuple[Path, ...]
    lenses: tuple[LensModel, ...]
    T_world_camera: Float64[np.ndarray, "V 3 4"]
    points: Observations | None = None
    near_far: Float64[np.ndarray, "V 2"] | None = None
    split: tuple[frozenset[str], frozenset[str]] | None = None
    divided_by: Float64[np.ndarray, "V 3"] | None = None
    background_rgb: tuple[float, float, float] | None = None
    reference: Reference | None = None
    masks: tuple[Path | None, ...] = ()

    @property
    def train_and_test(self) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Indices of the training and the held-out photographs: every eighth where the format has no split."""
        if self.split is None:
            return every_eighth(len(self.names))
        train, test = (tuple(i for i, name in enumerate(self.names) if name in part) for part in self.split)
        return train, test

    @property
    def centred(self) -> tuple[Float64[np.ndarray, "V 3 4"], Float64[np.ndarray, "3"]]:
        """The poses around their mean position, and that position."""
        origin = self.T_world_camera[:, :, 3].mean(axis=0)
        T_world_camera = self.T_world_camera.copy()
        T_world_camera[:, :, 3] -= origin
        return T_world_camera, origin


def every_eighth(count: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Split photographs as LLFF and NeRF do: 0, 8, 16, ... of the sorted names are held out. Returns train and test."""
    test = tuple(range(0, count, 8))
    train = tuple(i for i in range(count) if i % 8)
    return train, test


def proper_rotations(
    T_world_camera: Float[np.ndarray, "V 3 4"], names: Sequence[str], named_by: Path
) -> Float64[np.ndarray, "V 3 4"]:
    """Orthonormalise the rotations of poses to float64's precision.

    Raises:
        SceneError: a pose is not finite, too far away, or not a rotation (R^T R = I within 1e-3, det R = +1).
    """
    rotation = T_world_camera[:, :, :3]
    wrong, what = ~in_range(T_world_camera).all(axis=(1, 2)), f"has numbers that are not finite, or over {LARGEST:g}"
    if not wrong.any():
        off = np.abs(rotation.transpose(0, 2, 1) @ rotation - np.eye(3)).max(axis=(1, 2))
        wrong = (off > 1e-3) | (np.linalg.det(rotation) < 0)
        what = "is no rotation and position (its 3x3 part is scaled, skewed or mirrored)"
    if wrong.any():
        others = f" (and {wrong.sum() - 1} more)" if wrong.sum() > 1 else ""
        raise SceneError(
            f"{named_by}: the pose of {names[int(wrong.argmax())]}{others} {what}: expected a finite position and a "
            "right-handed rotation, R^T R = I within 0.001; estimate the poses again, or remove the photograph"
        )
    u, _, vt = np.linalg.svd(rotation)
    return np.concatenate([u @ vt, T_world_camera[:, :, 3:]], axis=2).astype(np.float64)
