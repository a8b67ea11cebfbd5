"""Training batches: tiles of training photographs, and their neighbours.

Alphabet: T tiles of S x S pixels, R = S^2 rays, N neighbours, K crops or photographs to encode.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from tidefield.config import TrainConfig
from tidefield.data.depth_prior import STRIDE, DepthPriors, Observed, unproject_to_surface
from tidefield.data.exposure import windows_in_common_light
from tidefield.data.images import Masks
from tidefield.data.neighbours import choose_neighbours
from tidefield.data.scene import Scene
from tidefield.data.surface import in_frame
from tidefield.errors import SceneError
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
        images: pixels to encode, in groups of one size: crops of photographs, or whole ones.
        image_cameras: of the photographs that the images are from.
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
    images: tuple[UInt8[Tensor, "_ _ _ 3"], ...] = ()
    image_cameras: tuple[Cameras, ...] = ()
    image_corner_px: tuple[Int[Tensor, "_ 2"], ...] = ()
    image_used: tuple[Float[Tensor, "_ 1 _ _"], ...] = ()
    image_doubled: tuple[UInt8[Tensor, "_ _ _ 3"], ...] = ()

    def colours_of_images(self, group: int) -> Float[Tensor, "_ 3 _ _"]:
        """Return the colours of a group of images."""
        return _in_common_light(self.images[group], self.image_cameras[group], self.image_corner_px[group])

    def colours_at_twice_the_size(self, group: int) -> Float[Tensor, "_ 3 _ _"] | None:
        """Return the colours of a group of images at twice the size; None if they are not read."""
        if not self.image_doubled:
            return None
        cameras = self.image_cameras[group]
        doubled = cameras.resized_each(2 * cameras.size_px)
        return _in_common_light(self.image_doubled[group], doubled, 2 * self.image_corner_px[group])

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
            image_cameras=(self.image_cameras[0][chosen],),
            image_corner_px=(self.image_corner_px[0][chosen],),
            image_used=tuple(used[chosen] for used in self.image_used),
            image_doubled=tuple(doubled[chosen] for doubled in self.image_doubled),
        )


def tile_doubly_seen(
    camera: Cameras,
    prior: Float[Tensor, "3 h w"],
    corner_px: Float[Tensor, "2"],
    side_px: int,
    cameras: Cameras,
    others: Bool[Tensor, " V"],
    masks: Masks = (),
) -> Bool[Tensor, " R"]:
    """Decide which pixels of a tile show surface that at least two other cameras see, at the prior's resolution.

    Args:
        cameras, others: some cameras, and which of them are other ones.
        masks: of the cameras.
    """
    cells = max(1, side_px // STRIDE)
    middles = corner_px + pixel_grid(cells, cells) * (side_px / cells)
    uv, z = cameras.project(unproject_to_surface(camera, prior, middles))
    seen = (in_frame(cameras, uv, z, masks)[others].sum(0) >= 2).reshape(cells, cells)
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

    Raises:
        SceneError: views are asked for, and there is no training photograph besides the target.
    """
    if views and len(scene.train) < 2:
        raise SceneError(
            f"{scene.root} has no training photograph besides the target's own: expected another to render its view "
            "from; add photographs"
        )
    side = config.tile_px
    train = torch.tensor(scene.train)
    drawn_from = train if of is None else torch.tensor(of)
    per_photograph = config.tiles if config.crop_px is None else 1
    picks = torch.randint(len(drawn_from), (config.tiles // per_photograph,), generator=generator)
    targets = drawn_from[picks].repeat_interleave(per_photograph)
    free = (scene.cameras.size_px[targets] - side + 1).clamp(min=1)
    corner = (torch.rand(len(targets), 2, generator=generator) * free).floor()
    cameras, masks, tiles = scene.cameras[train], scene.photographs.masks_of(scene.train), []
    for target, at in zip(targets.tolist(), corner, strict=True):
        camera, prior = scene.cameras[target], priors[target].cells
        middle_world = unproject_to_surface(camera, prior, at[None] + side / 2)[0]
        found = choose_neighbours(camera, prior, at, (1, 1), side, scene, views, config.neighbours)
        pixels, inside = _tile(scene, target, at.long(), side)
        weight = torch.ones(side * side)
        if config.unseen_weight != 1:
            seen = tile_doubly_seen(camera, prior, at, side, cameras, train != target, masks)
            weight[~seen] = config.unseen_weight
        depth = _sparse_depth(priors.observed(target), at, side)
        detail = priors[target].detail_of_tiles(at[None], side)[0]
        tiles.append((pixels, weight * inside, detail, *depth, found.index[0], found.blend_weight[0], middle_world))
    columns = (torch.stack(column) for column in zip(*tiles, strict=True))
    pixels, weight, detail, inverse_depth, depth_weight, neighbours, blend_weight, middles_world = columns
    batch = Batch(
        targets=targets,
        corner_px=corner,
        colours=windows_in_common_light(pixels, scene.cameras[targets], corner.long()).flatten(1, 2),
        weight=weight,
        detail=detail,
        inverse_depth=inverse_depth,
        depth_weight=depth_weight,
        neighbours=neighbours,
        blend_weight=blend_weight,
        which=neighbours,
    )
    if not views:
        return batch
    if config.crop_px is None:
        return _with_whole_photographs(batch, scene)
    return _with_crops(batch, scene, middles_world, config.crop_px, doubled)


def _tile(
    scene: Scene, index: int, corner: Int[Tensor, "2"], side: int
) -> tuple[UInt8[Tensor, "S S 3"], Bool[Tensor, " R"]]:
    """A tile's pixels, and which of them lie in the photograph and are not masked."""
    u, v = corner.tolist()
    part = scene.photographs[index][v : v + side, u : u + side]
    height, width = part.shape[:2]
    pixels, inside = part.new_zeros(side, side, 3), torch.zeros(side, side, dtype=torch.bool)
    pixels[:height, :width], inside[:height, :width] = part, True
    if scene.photographs.masks:
        inside[:height, :width] = scene.photographs.used(index)[v : v + side, u : u + side]
    return pixels, inside.reshape(-1)


def _with_whole_photographs(batch: Batch, scene: Scene) -> Batch:
    """The batch with every neighbour once, whole, in groups of one size."""
    photographs, which = batch.neighbours.unique(return_inverse=True)
    sizes, group = scene.cameras.size_px[photographs].unique(dim=0, return_inverse=True)
    order = group.argsort(stable=True)
    groups = [photographs[group == g].tolist() for g in range(len(sizes))]
    masked = groups if scene.photographs.masks else []
    return replace(
        batch,
        which=order.argsort()[which],
        images=tuple(torch.stack([scene.photographs[i] for i in mine]) for mine in groups),
        image_cameras=tuple(scene.cameras[torch.tensor(mine)] for mine in groups),
        image_corner_px=tuple(torch.zeros(len(mine), 2, dtype=torch.long) for mine in groups),
        image_used=tuple(torch.stack([scene.photographs.used(i)[None].float() for i in mine]) for mine in masked),
    )


def _with_crops(
    batch: Batch, scene: Scene, middle_world: Float[Tensor, "T 3"], side: int, doubled: Scene | None
) -> Batch:
    """The batch with a crop of every neighbour of each tile, around the projection of the tile's middle; also at twice
    the size."""
    flat = batch.neighbours.reshape(-1)
    cameras = scene.cameras[flat]
    points = middle_world.repeat_interleave(batch.neighbours.shape[1], 0)
    uv = cameras.project(points[:, None])[0][:, 0]
    width, height = (min(side, int(x)) for x in scene.cameras.size_px.amin(0))
    extent = torch.tensor([width, height])
    corner = torch.minimum((uv - extent / 2).round().clamp(min=0), (cameras.size_px - extent).float()).long()
    places = list(zip(flat.tolist(), corner.tolist(), strict=True))
    used: tuple[Tensor, ...] = ()
    if scene.photographs.masks:
        masks = [scene.photographs.used(i)[None, v : v + height, u : u + width] for i, (u, v) in places]
        used = (torch.stack(masks).float(),)
    twice: tuple[Tensor, ...] = ()
    if doubled is not None:
        twice = (_windows(doubled, [(i, [2 * u, 2 * v]) for i, (u, v) in places], (2 * width, 2 * height)),)
    return replace(
        batch,
        which=torch.arange(len(flat)).reshape(batch.neighbours.shape),
        images=(_windows(scene, places, (width, height)),),
        image_cameras=(cameras,),
        image_corner_px=(corner,),
        image_used=used,
        image_doubled=twice,
    )


def _windows(scene: Scene, places: Sequence[tuple[int, list[int]]], size: tuple[int, int]) -> UInt8[Tensor, "K h w 3"]:
    """Windows of photographs: of each the photograph and the upper left corner, in pixels."""
    width, height = size
    return torch.stack([scene.photographs[i][v : v + height, u : u + width] for i, (u, v) in places])


def _in_common_light(
    pixels: UInt8[Tensor, "K h w 3"], cameras: Cameras, corner_px: Int[Tensor, "K 2"]
) -> Float[Tensor, "K 3 h w"]:
    return windows_in_common_light(pixels, cameras, corner_px).permute(0, 3, 1, 2)
