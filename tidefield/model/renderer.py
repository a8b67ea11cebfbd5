"""Rendering of a camera's view by a trained network, tile by tile.

Ground that none of a tile's neighbours sees is unknown to a network that only reads neighbours. With networks that ask
for it (`Network.fills_unseen`) the colours around are continued into it, unless the scene may be empty there.
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional as F

from tidefield.config import USUAL_SAMPLING, Config, Sampling
from tidefield.data.depth_prior import STRIDE, DepthPrior, surface_prior, unproject_to_surface
from tidefield.data.exposure import to_common_exposure
from tidefield.data.matching import Matcher
from tidefield.data.neighbours import EXTRA_VIEWS, Neighbours, choose_neighbours
from tidefield.data.scene import Scene
from tidefield.errors import SceneError
from tidefield.geometry.cameras import Cameras
from tidefield.model.cache import CacheFull, FeatureCache
from tidefield.model.network import Network
from tidefield.model.rendering import Render, Rendering, fill_unseen, render_with_rays
from tidefield.model.sampling import Intervals, Tiles
from tidefield.model.views import Encoded, Views
from tidefield.parallel import check_interrupted, in_parallel
from tidefield.recording import Recorder, moved

TILE_PX = 32
VALUES_AT_ONCE = 5_000_000
"""Numbers gathered at once by a pass on one core: enough to outweigh the time of starting operations, and few enough
for the memory ..."""
GPU_FACTOR = 8
"""... and so many times more keep a GPU busy."""
BEHIND_PHOTOGRAPHS, BEHIND_STEP = 32, 16
"""Photographs, and pixels between their pixels, whose mean colour lies behind pixels that let light through."""
BLOCK_TILES = 16
"""Tiles along the sides of the blocks that a view is rendered in, so that successive tiles share photographs."""


@dataclass(frozen=True)
class _Piece:
    """Some tiles of a view, with all that their network reads but the maps.

    Attributes:
        tiles: to render.
        cameras, which, blend_weight: of `Views`.
        start: intervals of the first pass's rays.
        detail: of the depth prior, at each pixel.
    """

    tiles: Tiles
    cameras: Cameras
    which: Int[Tensor, "T N"]
    blend_weight: Float[Tensor, "T N 4"]
    start: Intervals
    detail: Float[Tensor, "T R"]


def as_given(scene: Scene, config: Config) -> Scene:
    """What a preset, or a variant of it, is given of a scene: not the sparse points where it does without."""
    return scene if config.network.has("sparse points") else replace(scene, points=None)


class Renderer:
    """Renders views of one scene with a network.

    Args:
        network: in evaluation mode, on `device`.
        scene: whose training photographs serve as neighbours, except for their own cameras' views.
        config: the run's.
        device: where to compute.
        sampling: of a pixel's footprint.
    """

    def __init__(
        self,
        network: Network,
        scene: Scene,
        config: Config,
        device: torch.device,
        sampling: Sampling = USUAL_SAMPLING,
    ) -> None:
        scene = as_given(scene, config)
        self.network, self.scene, self.config, self.device = network, scene, config, device
        self.sampling = sampling
        self.cache = FeatureCache(network, scene, device, sampling.cones)
        self.matcher = None
        if config.network.has("matched surface"):
            self.matcher = Matcher(scene, self.cache.pyramid, finer=True, device=device)
        gathered = network.values_per_tile(TILE_PX, network.config.views + EXTRA_VIEWS)
        limit = VALUES_AT_ONCE * (1 if device.type == "cpu" else GPU_FACTOR)
        # A power of two divides blocks into few kinds of pieces, which a GPU records one by one.
        self.tiles_at_once = 1 << max(0, (limit // gathered).bit_length() - 1)
        # Of tiles larger than that, one on each core would take too much memory: all cores share one.
        self.tiles_in_parallel = gathered <= limit
        self.fills_unseen = network.fills_unseen and scene.background_rgb is None
        few = scene.train[:: -(-len(scene.train) // BEHIND_PHOTOGRAPHS)]
        lines = slice(None, None, BEHIND_STEP)
        self.mean_colours = {i: to_common_exposure(scene, i, lines, lines).mean((0, 1)) for i in few}
        self._recorded: tuple[Encoded, Recorder[_Piece, Tensor]] | None = None

    def renew(self, network: Network) -> None:
        """Go on with other weights; what was read and compared of photographs depends on none."""
        pyramid = self.cache.pyramid
        del self.cache  # its memory first
        self.network, self._recorded = network, None
        self.cache = FeatureCache(network, self.scene, self.device, self.sampling.cones, pyramid=pyramid)

    def __call__(self, camera: Cameras, prior: Float[Tensor, "3 h w"] | None = None) -> Rendering:
        """Render the view of one camera, at its own gain, from its sources (`Scene.sources`).

        Args:
            camera: a single camera.
            prior: where its rays are sampled, on cells of its pixels (`depth_prior.surface_prior`); that of the scene's
                points if not given.
        """
        if prior is None:
            return self._view(camera, self._points_surface(camera))
        side = self._rays_per_side(camera)
        cells = prior.repeat_interleave(side, 1).repeat_interleave(side, 2)
        return render_with_rays(partial(self._render, cells=cells, match=False), camera, side)

    def in_turn(self, cameras: Cameras) -> Iterator[Rendering]:
        """Render the views of cameras, one after the other.

        While a GPU renders a view, the processor looks for the surface of the next one among the sparse points.
        """
        with ThreadPoolExecutor(1) as pool:
            next_one = pool.submit(self._points_surface, cameras[0])
            for k in range(len(cameras)):
                surface = next_one.result()
                if k + 1 < len(cameras):
                    next_one = pool.submit(self._points_surface, cameras[k + 1])
                yield self._view(cameras[k], surface)

    def _view(self, camera: Cameras, surface: Float[Tensor, "3 h w"]) -> Rendering:
        """Render the view of a camera, around the surface that photographs show near `_points_surface`."""
        return render_with_rays(partial(self._render, cells=surface, match=True), camera, self._rays_per_side(camera))

    def _rays_per_side(self, camera: Cameras) -> int:
        return self.sampling.rays_per_side or (2 if self.cache.pyramid.is_much_coarser(camera) else 1)

    def _points_surface(self, camera: Cameras) -> Float[Tensor, "3 h w"]:
        """The surface of a camera, of all its rays, before photographs are matched."""
        side, scene = self._rays_per_side(camera), self.scene
        camera = camera.resized(side * camera.width, side * camera.height)
        return surface_prior(camera, scene.points, scene.cameras, scene.hull)

    @torch.inference_mode()
    def _render(self, camera: Cameras, cells: Float[Tensor, "3 h w"], match: bool) -> Rendering:
        """Render a view with a ray in each pixel.

        Args:
            camera: of the view.
            cells: where its rays are sampled.
            match: match photographs first, where the network asks for it, starting from the cells.
        """
        scene = self.scene
        sources = scene.sources(camera)
        if not sources:
            raise SceneError(
                f"{scene.root} has no training photograph besides the camera's own: expected another to render its "
                "view from; add photographs"
            )
        prior = self.matcher(camera, cells) if match and self.matcher is not None else DepthPrior(cells)
        columns, rows = (-(-x // TILE_PX) for x in (camera.width, camera.height))
        picture = torch.empty(rows * TILE_PX, columns * TILE_PX, 6, device=self.device)
        for top in range(0, rows, BLOCK_TILES):
            for left in range(0, columns, BLOCK_TILES):
                size = (min(BLOCK_TILES, columns - left), min(BLOCK_TILES, rows - top))
                block = self._block(camera, prior, (left, top), size)
                height, width = block.shape[:2]
                at = (top * TILE_PX, left * TILE_PX)
                picture[at[0] : at[0] + height, at[1] : at[1] + width] = block
        colour, opacity, depth, visibility = picture[: camera.height, : camera.width].split([3, 1, 1, 1], dim=-1)
        white = scene.background_rgb
        mean_colour = torch.stack([colour for i, colour in self.mean_colours.items() if i in sources]).mean(0)
        gain = camera.to(self.device).gain_of_rows()
        behind = mean_colour.to(gain) * gain if white is None else gain.new_tensor(white)
        colour = colour * gain + (1 - opacity) * behind
        if self.fills_unseen:
            colour = fill_unseen(colour, visibility[..., 0] > 0.5)
        depth = depth[..., 0].clone()
        return Rendering(*(x.cpu() for x in (colour.clamp(0, 1), depth, opacity[..., 0].clamp(0, 1))))

    def _block(
        self, camera: Cameras, prior: DepthPrior, corner: tuple[int, int], size: tuple[int, int]
    ) -> Float[Tensor, "H W 6"]:
        """Colour, opacity, depth and visibility of a block of tiles; corner and size in tiles."""
        (left, top), (columns, rows) = corner, size
        v, u = torch.meshgrid(torch.arange(top, top + rows), torch.arange(left, left + columns), indexing="ij")
        corners = torch.stack([u, v], -1).reshape(-1, 2).float() * TILE_PX
        middles = unproject_to_surface(camera, prior.cells, corners + TILE_PX / 2)
        side = TILE_PX // STRIDE
        part = prior.cells[:, side * top : side * (top + rows), side * left : side * (left + columns)]
        ends = _ends(camera, part, middles)
        views, strategy = self.network.config.views, self.config.train.neighbours
        neighbours = choose_neighbours(camera, prior.cells, corners[0], size, TILE_PX, self.scene, views, strategy)
        found = self._tiles(camera, prior, corners, neighbours, middles, ends)
        stacked = found.reshape(rows, columns, TILE_PX, TILE_PX, 6)
        return stacked.transpose(1, 2).reshape(rows * TILE_PX, columns * TILE_PX, 6)

    def _tiles(
        self,
        camera: Cameras,
        prior: DepthPrior,
        corners: Float[Tensor, "T 2"],
        neighbours: Neighbours,
        middle_world: Float[Tensor, "T 3"],
        ends_world: Float[Tensor, "T 2 3"],
    ) -> Float[Tensor, "T R 6"]:
        try:
            views = self.cache.views(camera, neighbours, middle_world, ends_world)
        except CacheFull:
            if len(corners) == 1:
                raise
            half = len(corners) // 2
            halves = (slice(half), slice(half, None))
            parts = ((corners[s], neighbours[s], middle_world[s], ends_world[s]) for s in halves)
            return torch.cat([self._tiles(camera, prior, *part) for part in parts])
        pieces = [
            partial(self._piece, camera, prior, corners[part], views[part])
            for part in (slice(k, k + self.tiles_at_once) for k in range(0, len(corners), self.tiles_at_once))
        ]
        return torch.cat(in_parallel(pieces, self.device) if self.tiles_in_parallel else [piece() for piece in pieces])

    def _piece(
        self, camera: Cameras, prior: DepthPrior, corners: Float[Tensor, "T 2"], views: Views
    ) -> Float[Tensor, "T R 6"]:
        check_interrupted()  # of pieces that are not in parallel
        tiles = Tiles(camera[torch.zeros(len(corners), dtype=torch.long)], corners, TILE_PX)
        start = self.network.start_intervals(tiles, [prior.cells])
        detail = prior.detail_of_tiles(corners, TILE_PX)
        piece = _Piece(tiles, views.cameras, views.which, views.blend_weight, start, detail)
        if self.device.type != "cuda":
            return self._compute(views.encoded, moved(piece, self.device))
        if self._recorded is None or self._recorded[0] is not views.encoded:
            recorder = Recorder(partial(self._compute, views.encoded), self.device, after=1)
            self._recorded = views.encoded, recorder
        return self._recorded[1](piece).clone()

    def _compute(self, encoded: Encoded, piece: _Piece) -> Float[Tensor, "T R 6"]:
        views = Views(piece.cameras, piece.which, piece.blend_weight, encoded)
        found = self.network(piece.tiles, views, piece.start, self.scene.background_rgb is None, piece.detail)
        single = torch.stack([found.opacity, found.depth, found.visibility], dim=-1)
        return torch.cat([found.colour, single], dim=-1)


def _ends(camera: Cameras, cells: Float[Tensor, "3 h w"], middle_world: Float[Tensor, "T 3"]) -> Float[Tensor, "T 2 3"]:
    """Where the surface in the middles of tiles would be at the least and at the greatest depth in each.

    Args:
        camera: of the tiles.
        cells: of its prior, in the tiles.
        middle_world: the surface in their middles, row by row.
    """
    expected, near, far = cells
    inverse = torch.where(expected.isnan(), (near + far) / 2, expected)[None]
    side = TILE_PX // STRIDE
    ends = [sign * F.max_pool2d(sign * inverse, side, ceil_mode=True).reshape(-1) for sign in (1, -1)]
    ray = middle_world - camera.position_world
    share = 1 / (torch.stack(ends, -1) * (ray @ camera.forward_world[0])[:, None])
    return camera.position_world + ray[:, None] * share[..., None]


def in_turn(render: Render, cameras: Cameras) -> Iterator[Rendering]:
    """Render the views of cameras one after the other, by any method."""
    if isinstance(render, Renderer):
        return render.in_turn(cameras)
    return (render(cameras[k]) for k in range(len(cameras)))
