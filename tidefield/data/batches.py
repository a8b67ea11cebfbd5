"""Training batches: tiles of training photographs, and their neighbours.

Alphabet: T tiles of S x S pixels, R = S^2 rays, N neighbours, K crops or photographs to encode.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from tidefield.config import TrainConfig
from tidefield.data.depth_prior import STRIDE, DepthPriors, Observed, unproject_to_surface
from tidefield.data.exposure import to_common_exposure, windows_in_common_light
from tidefield.data.images import Masks
from tidefield.data.neighbours import choose_neighbours
from tidefield.data.scene import Scene
from tidefield.data.surface import in_frame
from tidefield.geometry.cameras import Cameras, pixel_grid


@dataclass(frozen=True)
class Batch:
    """Training tiles. All colours are at the common exposure.

    Attributes:
        targets: the tiles' photographs.
        corner_px: the tiles' upper left pixel corners.
        colours: the ground truth.
        weight: of each pixel in the loss: 0 where it is masked, 0 outside its photograph, which may be smaller than a
            tile, and
            `TrainConfig.unseen_weight` where fewer than two other training photographs see the surface.
        detail: of the depth priors, at each pixel.
        inverse_depth: of the sparse points that the target photograph observed, at their pixels; 0 elsewhere.
        depth_weight: confidence in these depths, 0 to 1; 0 where there is none.
        neighbours: photographs serving as the tiles' neighbouring views.
        blend_weight: of each neighbour at the tile's four corners.
        which: for each neighbour, the image of `images` to read.
        images: what to encode, in groups of one size: crops of photographs, or whole ones.
        image_corner_px: upper left corners of the images in their photographs.
        image_used: 1 for pixels of the images that are not masked; empty if the scene has no masks.
        image_doubled: the images at twice the size; empty if they are not read.
    """

    targets: Int[Tensor, " T"]
    corner_px: Float[Tensor, "T 2"]
    colours: Float[Tensor, "T R 3"]
    weight: Float[Tensor, "T R"]
    detail: Float[Tensor, "T R"]
    inverse_depth: Float[Tensor, "T R"]
    depth_weight: Float[Tensor, "T R"]
    neighbours: Int[Tensor, "T N"]
    blend_weight: Float[Tensor, "T N 4"]
    which: Int[Tensor, "T N"]
    images: tuple[Float[Tensor, "_ 3 _ _"], ...]
    image_corner_px: tuple[Float[Tensor, "_ 2"], ...]
    image_used: tuple[Float[Tensor, "_ 1 _ _"], ...] = ()
    image_doubled: tuple[Float[Tensor, "_ 3 _ _"], ...] = ()

    def to(self, device: torch.device) -> Batch:
        def move(value: Tensor | tuple[Tensor, ...]) -> Tensor | tuple[Tensor, ...]:
            return tuple(v.to(device) for v in value) if isinstance(value, tuple) else value.to(device)

        return Batch(**{f.name: move(getattr(self, f.name)) for f in fields(self)})  # type: ignore[arg-type]

    def parts(self, count: int) -> list[Batch]:
        """Split into at most `count` batches of some of the tiles each; into one where tiles share images."""
        tiles, views = self.which.shape
        if len(self.images) != 1 or len(self.images[0]) != tiles * views:
            return [self]
        size = -(-tiles // count)
        return [self._part(slice(first, min(first + size, tiles))) for first in range(0, tiles, size)]

    def _part(self, tiles: slice) -> Batch:
        own = {f.name: getattr(self, f.name)[tiles] for f in fields(self) if not f.name.startswith("image")}
        chosen = own["which"].reshape(-1)
        return Batch(
            **own | {"which": torch.arange(len(chosen), device=chosen.device).reshape(own["which"].shape)},
            images=(self.images[0][chosen],),
            image_corner_px=(self.image_corner_px[0][chosen],),
            image_used=tuple(used[chosen] for used in self.image_used),
            image_doubled=tuple(doubled[chosen] for doubled in self.image_doubled),
        )


def tile_doubly_seen(
    camera: Cameras,
    prior: Float[Tensor, "3 h w"],
    corner_px: Float[Tensor, "2"],
    side_px: int,
    others: Cameras,
    masks: Masks = (),
) -> Bool[Tensor, " R"]:
    """Decide which pixels of a tile show surface that at least two other cameras see, at the prior's resolution."""
    cells = max(1, side_px // STRIDE)
    middles = corner_px + pixel_grid(cells, cells) * (side_px / cells)
    uv, z = others.project(unproject_to_surface(camera, prior, middles))
    seen = (in_frame(others, uv, z, masks).sum(0) >= 2).reshape(cells, cells)
    cell = torch.arange(side_px) * cells // side_px
    return seen[cell][:, cell].reshape(-1)


def _sparse_depth(
    observed: Observed, corner_px: Float[Tensor, "2"], side: int
) -> tuple[Float[Tensor, " R"], Float[Tensor, " R"]]:
    """Inverse depths of a tile's pixels that show a sparse point, and the confidence in them; both 0 elsewhere."""
    u, v = (observed.uv_px - corner_px).floor().long().unbind(-1)
    inside = (u >= 0) & (u < side) & (v >= 0) & (v < side)
    pixel, weight = (v * side + u)[inside], observed.weight[inside]
    total = torch.zeros(side * side).index_add(0, pixel, weight)
    inverse = torch.zeros(side * side).index_add(0, pixel, weight * observed.inverse_depth[inside])
    return inverse / total.clamp(min=1e-12), total.clamp(max=1)


def draw_batch(
    scene: Scene,
    priors: DepthPriors,
    config: TrainConfig,
    views: int,
    generator: torch.Generator,
    of: Sequence[int] | None = None,
    doubled: Scene | None = None,
) -> Batch:
    """Draw random tiles of random training photographs.

    Args:
        priors: of the scene.
        views: neighbouring views at each corner of a tile; 0 encodes nothing.
        of: training photographs to draw from; all of them if not given.
        doubled: the scene at twice the size, where crops are read from it, too.
    """
    side = config.tile_px
    train = torch.tensor(scene.train)
    drawn_from = train if of is None else torch.tensor(of)
    per_photograph = config.tiles if config.crop_px is None else 1
    picks = torch.randint(len(drawn_from), (config.tiles // per_photograph,), generator=generator)
    targets = drawn_from[picks].repeat_interleave(per_photograph)
    free = (scene.cameras.size_px[targets] - side + 1).clamp(min=1)
    corner = (torch.rand(len(targets), 2, generator=generator) * free).floor()
    tiles = []
    for target, at in zip(targets.tolist(), corner, strict=True):
        camera, prior = scene.cameras[target], priors[target].cells
        middle_world = unproject_to_surface(camera, prior, at[None] + side / 2)[0]
        found = choose_neighbours(camera, prior, at, (1, 1), side, scene, views, config.neighbours)
        colours, inside = _tile(scene, target, at.long(), side)
        weight = torch.ones(side * side)
        if config.unseen_weight != 1:
            others = train[train != target]
            masks = scene.photographs.masks_of(others.tolist())
            seen = tile_doubly_seen(camera, prior, at, side, scene.cameras[others], masks)
            weight[~seen] = config.unseen_weight
        depth = _sparse_depth(priors.observed(target), at, side)
        detail = priors[target].detail_of_tiles(at[None], side)[0]
        tiles.append((colours, weight * inside, detail, *depth, found.index[0], found.blend_weight[0], middle_world))
    columns = (torch.stack(column) for column in zip(*tiles, strict=True))
    colours, weight, detail, inverse_depth, depth_weight, neighbours, blend_weight, middles_world = columns
    if not views:
        which, images, corners, used, twice = neighbours, (), (), (), ()
    elif config.crop_px is None:
        which, images, corners, used, twice = *_whole(scene, neighbours), ()
    else:
        which, images, corners, used, twice = _crops(scene, neighbours, middles_world, config.crop_px, doubled)
    return Batch(
        targets=targets,
        corner_px=corner,
        colours=colours,
        weight=weight,
        detail=detail,
        inverse_depth=inverse_depth,
        depth_weight=depth_weight,
        neighbours=neighbours,
        blend_weight=blend_weight,
        which=which,
        images=images,
        image_corner_px=corners,
        image_used=used,
        image_doubled=twice,
    )


def _tile(
    scene: Scene, index: int, corner: Int[Tensor, "2"], side: int
) -> tuple[Float[Tensor, "R 3"], Bool[Tensor, " R"]]:
    """Colours of a tile's pixels, and which of them lie in the photograph and are not masked."""
    u, v = corner.tolist()
    pixels = to_common_exposure(scene, index, slice(v, v + side), slice(u, u + side))
    height, width = pixels.shape[:2]
    colours, inside = torch.zeros(side, side, 3), torch.zeros(side, side, dtype=torch.bool)
    colours[:height, :width], inside[:height, :width] = pixels, True
    if scene.photographs.masks:
        inside[:height, :width] = scene.photographs.used(index)[v : v + side, u : u + side]
    return colours.reshape(-1, 3), inside.reshape(-1)


_Images = tuple[Tensor, tuple[Tensor, ...], tuple[Tensor, ...], tuple[Tensor, ...]]
"""`which`, `images`, `image_corner_px` and `image_used` of a batch."""


def _whole(scene: Scene, neighbours: Int[Tensor, "T N"]) -> _Images:
    """Every neighbour once, whole, in groups of one size."""
    photographs, which = neighbours.unique(return_inverse=True)
    sizes, group = scene.cameras.size_px[photographs].unique(dim=0, return_inverse=True)
    order = group.argsort(stable=True)
    groups = [photographs[group == g].tolist() for g in range(len(sizes))]
    images = tuple(torch.stack([to_common_exposure(scene, i).permute(2, 0, 1) for i in mine]) for mine in groups)
    used = tuple(
        torch.stack([scene.photographs.used(i)[None].float() for i in mine])
        for mine in groups
        if scene.photographs.masks
    )
    return order.argsort()[which], images, tuple(torch.zeros(len(i), 2) for i in images), used


def _crops(
    scene: Scene,
    neighbours: Int[Tensor, "T N"],
    middle_world: Float[Tensor, "T 3"],
    side: int,
    doubled: Scene | None,
) -> tuple[*_Images, tuple[Tensor, ...]]:
    """A crop of every neighbour of each tile, around the projection of the tile's middle; also at twice the size."""
    flat = neighbours.reshape(-1)
    cameras = scene.cameras[flat]
    points = middle_world.repeat_interleave(neighbours.shape[1], 0)
    uv = cameras.project(points[:, None])[0][:, 0]
    width, height = (min(side, int(x)) for x in scene.cameras.size_px.amin(0))
    extent = torch.tensor([width, height])
    corner = torch.minimum((uv - extent / 2).round().clamp(min=0), (cameras.size_px - extent).float())
    places = list(zip(flat.tolist(), corner.long().tolist(), strict=True))
    crops = _windows(scene, places, (width, height))
    used: tuple[Tensor, ...] = ()
    if scene.photographs.masks:
        masks = [scene.photographs.used(i)[None, v : v + height, u : u + width] for i, (u, v) in places]
        used = (torch.stack(masks).float(),)
    twice: tuple[Tensor, ...] = ()
    if doubled is not None:
        twice = (_windows(doubled, [(i, [2 * u, 2 * v]) for i, (u, v) in places], (2 * width, 2 * height)),)
    return torch.arange(len(flat)).reshape(neighbours.shape), (crops,), (corner,), used, twice


def _windows(scene: Scene, places: Sequence[tuple[int, list[int]]], size: tuple[int, int]) -> Float[Tensor, "K 3 h w"]:
    """Windows of photographs in the common light: of each the photograph and the upper left corner, in pixels."""
    width, height = size
    windows = torch.stack([scene.photographs[i][v : v + height, u : u + width] for i, (u, v) in places])
    photographs, corners = (torch.tensor(column) for column in zip(*places, strict=True))
    return windows_in_common_light(windows, scene.cameras[photographs], corners).permute(0, 3, 1, 2)
