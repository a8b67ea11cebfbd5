"""Cut a large survey into areas, of which training holds one at a time.

An area is some photographs that lie together, and all others that see the same ground and may serve as neighbours. The
network is the same for all areas and has nothing of their borders: a photograph is learned from in one area, with the
neighbours that it has in the whole scene.

Alphabet: V photographs, T of an area, K points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from tidefield.data.scene import Scene, SparsePoints
from tidefield.data.surface import which_see
from tidefield.geometry.cameras import Cameras
from tidefield.geometry.halves import halves

WHOLE, WHOLE_BYTES = 400, 4e9
"""Up to this number of training photographs, whose depth priors take this memory, a scene is one area."""
MOST, FEWEST = 64, 8
"""Photographs of an area, without those around: half of these or more, or fewer where they are large."""
BYTES_PER_PIXEL = 5
"""Of a photograph in its depth prior."""
PLACES = (0.02, 0.26, 0.5, 0.74, 0.98)
"""Where, as shares of width and height, a photograph's ground is looked at to find those that see it, too."""


@dataclass(frozen=True)
class Area:
    """A part of a scene.

    Attributes:
        scene: the area's photographs and those that see its ground, all of them training photographs.
        targets: indices in `scene` of the area's own photographs.
        doubled: the same photographs at twice the size (`load.at_twice_the_size`).
    """

    scene: Scene
    targets: tuple[int, ...]
    doubled: Scene | None = None


def cut(scene: Scene, whole: int = WHOLE, most: int = MOST, whole_bytes: float = WHOLE_BYTES) -> list[tuple[int, ...]]:
    """Cut the training photographs of a scene into areas by their positions; returns the indices of each.

    Areas are halved across their longest side until none has more than `most` photographs.

    Args:
        scene: to cut.
        whole: up to this number of training photographs there is one area.
        most: photographs of an area.
        whole_bytes: memory that the depth priors of an area may take.
    """
    train = list(scene.train)
    each = BYTES_PER_PIXEL * float(scene.cameras.size_px[train].prod(1).double().mean())
    if len(train) <= whole and len(train) * each <= whole_bytes:
        return [scene.train]
    position = scene.cameras.position_world[train].double().cpu().numpy()
    most = min(most, max(FEWEST, int(whole_bytes / each)))
    return [tuple(train[i] for i in sorted(members)) for members in halves(position, most)]


def select(scene: Scene, targets: Sequence[int], doubled: Scene | None = None) -> Area:
    """Select an area of a scene: some training photographs, and all others that see their ground.

    The ground of a photograph is looked at in 25 of its pixels, at its nearest, farthest and mean inverse depth.

    Args:
        scene: to select from.
        targets: the photographs.
        doubled: the scene at twice the size, if it is read.
    """
    train = torch.tensor(scene.train)
    seeing = which_see(scene.cameras[train], _ground(scene.cameras[list(targets)]))
    seeing |= torch.isin(train, torch.tensor(targets))
    kept = train[seeing].tolist()
    of = {index: k for k, index in enumerate(kept)}
    return Area(_part(scene, kept), tuple(of[i] for i in targets), doubled and _part(doubled, kept))


def _part(scene: Scene, kept: list[int]) -> Scene:
    """The scene of some photographs, all of them training photographs."""
    photographs = scene.photographs
    return replace(
        scene,
        names=tuple(scene.names[i] for i in kept),
        cameras=scene.cameras[kept],
        photographs=replace(
            photographs,
            colours=tuple(photographs.colours[i] for i in kept),
            alphas=tuple(photographs.alphas[i] for i in kept) if photographs.alphas else (),
            masks=tuple(photographs.masks[i] for i in kept) if photographs.masks else (),
            files=tuple(photographs.files[i] for i in kept) if photographs.files else (),
        ),
        points=scene.points and _points(scene.points, kept, len(scene.names)),
        train=tuple(range(len(kept))),
        test=(),
    )


def _ground(cameras: Cameras) -> Float[Tensor, "K 3"]:
    """Points that some cameras see."""
    place = torch.tensor(PLACES)
    uv = torch.cartesian_prod(place, place)[None] * cameras.size_px[:, None]
    near, far = (1 / cameras.near_far[:, None]).unbind(-1)
    depth = 1 / torch.stack([near, (near + far) / 2, far])  # 3 T 1
    points = cameras.position_world[:, None] + cameras.directions_world(uv) * depth[..., None]
    return points.reshape(-1, 3)


def _points(points: SparsePoints, kept: list[int], count: int) -> SparsePoints | None:
    """The points that some of `count` photographs observed, with these photographs numbered anew."""
    number = torch.full((count,), -1, dtype=points.camera_index.dtype)
    number[kept] = torch.arange(len(kept), dtype=number.dtype)
    mine = number[points.camera_index.long()] >= 0
    if not mine.any():
        return None
    seen = torch.zeros(len(points.xyz_world), dtype=torch.bool)
    seen[points.point_index[mine].long()] = True
    own = points.observed(mine).subset(seen)
    return replace(own, camera_index=number[own.camera_index.long()])
