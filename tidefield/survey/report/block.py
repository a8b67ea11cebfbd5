"""Read a reconstruction into arrays, which the statistics are computed from."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pycolmap
from jaxtyping import Float64, Int

from tidefield.errors import SurveyError


@dataclass(frozen=True)
class Block:
    """Registered photographs and the points that they observe; z points up.

    Attributes:
        names: of the photographs, sorted.
        cameras: the lenses.
        lens: index into `cameras` of every photograph.
        position: projection centres.
        R_world_camera: rotate camera directions (OpenCV axes) into the world.
        detected: keypoints of every photograph, observed points or not.
        points: sparse points.
        photograph, point, uv_px: of every observation, those of one photograph together and in the photographs' order.
    """

    names: tuple[str, ...]
    cameras: tuple[pycolmap.Camera, ...]
    lens: Int[np.ndarray, " N"]
    position: Float64[np.ndarray, "N 3"]
    R_world_camera: Float64[np.ndarray, "N 3 3"]
    detected: Int[np.ndarray, " N"]
    points: Float64[np.ndarray, "P 3"]
    photograph: Int[np.ndarray, " O"]
    point: Int[np.ndarray, " O"]
    uv_px: Float64[np.ndarray, "O 2"]

    def __len__(self) -> int:
        return len(self.names)

    def camera(self, i: int) -> pycolmap.Camera:
        """The lens of photograph `i`."""
        return self.cameras[self.lens[i]]

    def observations(self) -> Iterator[tuple[int, slice]]:
        """Iterate over photographs that observe a point, with the slice of their observations."""
        ends = np.searchsorted(self.photograph, np.arange(len(self) + 1))
        return ((i, slice(first, last)) for i, (first, last) in enumerate(pairwise(ends.tolist())) if last > first)


def read_block(reconstruction: pycolmap.Reconstruction, level: bool) -> Block:
    """Collect all registered photographs and the points.

    Args:
        level: rotate the frame so that z is the normal of the points' plane on the cameras' side, and move its origin
            to the points' median; for a model without a georeference.

    Raises:
        SurveyError: nothing is registered, or there are no points.
    """
    images = sorted((i for i in reconstruction.images.values() if i.has_pose), key=lambda image: image.name)
    if not images or not reconstruction.num_points3D():
        raise SurveyError(
            f"the model has {len(images)} photographs and {reconstruction.num_points3D()} points: expected at least "
            "one of both; estimate the poses again"
        )
    lenses, lens = np.unique([image.camera_id for image in images], return_inverse=True)
    point_index = {key: i for i, key in enumerate(reconstruction.points3D)}
    seen, uv_px = [], []
    for image in images:  # COLMAP's objects take 450 bytes for each observation
        observed = image.get_observation_points2D()
        seen.append(np.array([point_index[p.point3D_id] for p in observed], dtype=np.int64))
        uv_px.append(np.array([p.xy for p in observed], dtype=np.float64).reshape(-1, 2))
    rotation = np.stack([image.cam_from_world().rotation.matrix().T for image in images])
    position = np.stack([image.projection_center() for image in images])
    points = np.array([point.xyz for point in reconstruction.points3D.values()])
    if level:
        turn, middle = _levelling(points, position)
        points, position, rotation = (points - middle) @ turn.T, (position - middle) @ turn.T, turn @ rotation
    return Block(
        names=tuple(image.name for image in images),
        cameras=tuple(reconstruction.cameras[key] for key in lenses.tolist()),
        lens=lens,
        position=position,
        R_world_camera=rotation,
        detected=np.array([len(image.points2D) for image in images]),
        points=points,
        photograph=np.repeat(np.arange(len(images)), list(map(len, seen))),
        point=np.concatenate(seen),
        uv_px=np.concatenate(uv_px),
    )


def _levelling(
    points: Float64[np.ndarray, "P 3"], position: Float64[np.ndarray, "N 3"]
) -> tuple[Float64[np.ndarray, "3 3"], Float64[np.ndarray, " 3"]]:
    """A rotation whose third row is the normal of the points' plane, towards the cameras, and the points' median."""
    middle = np.median(points, 0)
    offset = points - middle
    distance = np.linalg.norm(offset, axis=1)
    near = offset[distance <= np.percentile(distance, 90)]
    axes = np.linalg.eigh(near.T @ near)[1].T[::-1]
    if axes[2] @ (np.median(position, 0) - middle) < 0:
        axes[2] *= -1
    axes[0] = np.cross(axes[1], axes[2])  # right-handed, whatever the signs were
    return axes, middle
