"""Match photographs to find the surface that a camera sees (docs/method.md, section 13).

A plane sweep from coarse to fine: at each level every pixel tries a few depths around those of the level before. The
photographs are projected there and compared without their local means and contrasts, over windows; the depth at which
they agree best is taken from a parabola through the three best costs, and smoothed the more the less it is determined.
The first level starts from the depth prior, that is from the sparse points. What the coarse levels find has to fit
better than that start, which counts elsewhere.

Alphabet: V photographs, K depths that are tried, H W pixels of a camera, h w cells of a prior.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise, product

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional as F

from tidefield.data.depth_prior import STRIDE, DepthPrior
from tidefield.data.images import Read
from tidefield.data.neighbours import BORDER, from_border
from tidefield.data.pyramid import Pyramid
from tidefield.data.scene import Scene
from tidefield.data.surface import groups, in_frame, which_see
from tidefield.geometry.cameras import Cameras, angle_between, pixel_grid
from tidefield.parallel import SharedValues, in_parallel, read_ahead

COARSEST_PX, LEAST_LEVELS = 25, 4
"""The first level's longer side, about, and the least number of levels, each twice as fine as the one before."""
AGREEMENT = 0.25
"""Cost at which a level finer than the picture counts half: the more photographs differ, the less do their fine details
belong together."""
COARSE_PX = 256
"""Levels of at most this side are coarse, except for the picture's own: they choose the photographs to compare, and
search more depths."""
COARSE_STEPS, STEPS, MOST_STEPS = 6, 2, 48
"""Depths that are tried on each side, a pixel of parallax apart: at coarse levels, at the others, and at most at the
first where nothing says where the surface is."""
DOUBT = 0.05
"""By how much less photographs have to differ where coarse levels came to than around the start."""
VIEWS = 4
"""Photographs that are compared, or blended, at a pixel: those from the most similar directions."""
SOFTNESS_RAD = 0.02
"""Angle at which a photograph's weight has halved: differences in angle below it hardly matter."""
CONTRAST_PX = 9
"""Side of the windows whose mean and contrast are removed from the photographs."""
NOISE = 2 / 255
"""Standard deviation of the grey values that is no contrast."""
WINDOW_PX, WIDE_PX, WIDE_SHARE = 5, 15, 0.5
"""Sides of the windows that photographs are compared over, and the share of the second: it decides where the first one
holds too little texture."""
HOLD = 0.001
"""Cost of a step away from the depth of the level before, squared: what decides where there is no texture."""
LEAST_ANGLE_RAD, WHOLE_ANGLE_RAD = math.radians(0.3), math.radians(1.0)
"""Photographs from directions less different than the first say nothing of depth, those beyond the second all they can:
one from the camera's own place fits at any depth."""
SMOOTH_PX = 3
"""Side of the window of the smoothing."""
LEAST_COST = 0.02
"""Cost that perfect agreement counts as in the smoothing."""
DILATIONS, EDGE = (1, 2), 0.3
"""Of the last smoothing: the spacings of its passes in pixels, and the difference of depth, in steps, at which the
weight of a pixel is a quarter."""
HALF_PX, SPREADS, SPREAD_PX = 1.0, 4.0, 9
"""Half of the interval that is left to search: pixels of parallax, and standard deviations of the matched depths in a
window of this side."""
FARTHEST = 0.01
"""Least inverse depth of a surface and of its interval, as a share of that of the camera's far: where depths differ
much, as at the edges of what stands before the horizon, the interval would reach beyond infinity."""
FRAME_PX, OVERLAP_PX = 768, 32
"""Side of the parts of a level that are matched at once, and how far they overlap, which is more than what a pixel's
windows reach; ..."""
GPU_FACTOR = 4
"""... and how many times larger the parts are on a GPU, which small ones do not keep busy."""
MARGIN_PX = 2.0
"""Pixels at the borders of photographs that are not compared: other depths would be read outside of them."""
SELECT_ABOVE = 256
"""With more photographs than this, those that see the camera's surface are found first."""
MATCHED_PX = 1024
"""Longest side at which the surfaces of photographs are matched to learn from: all pixels of larger ones would take
most of a few minutes."""
KEPT_BYTES = 300_000_000
"""Memory for photographs without their means and contrasts; those that were not read for the longest time go first."""


def blend_weights(angle: Float[Tensor, "V P"]) -> tuple[Float[Tensor, "K P"], Int[Tensor, "K P"]]:
    """Weights of unstructured lumigraph rendering (Buehler et al., 2001) for each point's `VIEWS` photographs of the
    smallest angles, radians; and which these are. Photographs of infinite angle do not count, and have the weight 0."""
    nearest, which = angle.topk(min(VIEWS + 1, len(angle)), dim=0, largest=False)
    # The weight falls to 0 at the first photograph left out, so that no seam shows where the choice changes.
    limit = nearest[VIEWS] if len(angle) > VIEWS else torch.full_like(nearest[0], torch.inf)
    nearest, which = nearest[:VIEWS], which[:VIEWS]
    weight = (1 - nearest / limit).clamp(min=1e-3) / (nearest + SOFTNESS_RAD)
    return torch.where(nearest.isfinite(), weight, 0.0), which


class Matcher:
    """Finds the surfaces that cameras see in one scene.

    Args:
        scene: whose training photographs are compared, except for a camera's own.
        pyramid: of the scene, where there is one already.
        most_px: pictures with a longer side are matched at half their size, or a quarter, ..., and the surface is
            interpolated.
        finer: match at twice a picture's size as well, where files have as much detail and it is not above `most_px`.
        device: where to compute; surfaces are returned on the CPU.
    """

    def __init__(
        self,
        scene: Scene,
        pyramid: Pyramid | None = None,
        most_px: int | None = None,
        finer: bool = False,
        device: torch.device | str = "cpu",
    ) -> None:
        self.scene, self.pyramid, self.most_px, self.finer = scene, pyramid or Pyramid(scene), most_px, finer
        self.device = torch.device(device)
        self._cameras = scene.cameras.to(self.device)
        self._images: SharedValues[tuple[int, int], Tensor] = SharedValues(KEPT_BYTES, lambda image: image.nbytes)

    @torch.inference_mode()
    def __call__(self, camera: Cameras, cells: Float[Tensor, "3 h w"]) -> DepthPrior:
        """Match the surface of a camera's pixels, starting from its depth prior.

        Rays without an expected depth keep what they have.
        """
        camera, cells = camera.to(self.device), cells.to(self.device)
        expected, near, far = cells
        known = expected.isfinite()
        start = _on_pixels(camera, torch.where(known, expected, (near + far) / 2))
        # Without any expected depth all of the range is searched first.
        reach = 0.0 if known.any() else float((near - far).max() / 2)
        known = known | ~known.any()
        side = max(camera.width, camera.height)
        octaves = max(0, math.ceil(math.log2(side / self.most_px))) if self.most_px else 0
        twice = camera.resized(2 * camera.width, 2 * camera.height)
        fits = self.most_px is None or 2 * side <= self.most_px
        finer = self.finer and fits and self.pyramid.files_show(twice.to("cpu"))
        matched = self._match(twice if finer else _smaller(camera, octaves), start, reach, finer)
        found, half = (_resized(image, camera) for image in matched)
        farthest = FARTHEST / camera.near_far[0, 1]
        found = found.clamp(min=farthest)
        middle, half = (_on_cells(cells, image) for image in (found, half))
        ends = middle + half, torch.minimum(middle - half, middle).clamp(min=farthest)
        result = torch.where(known & (half > 0), torch.stack([middle, *ends]), cells)
        detail = found - _on_pixels(camera, torch.where(known, result[0], middle))
        seen = _on_pixels(camera, (known & (half > 0)).to(found)) == 1
        return DepthPrior(result.cpu(), torch.where(seen, detail, 0.0).cpu())

    def _match(
        self, camera: Cameras, start: Float[Tensor, "A B"], reach: float, finer: bool
    ) -> tuple[Float[Tensor, "H W"], Float[Tensor, "H W"]]:
        """Inverse depths of the surface, and half of the interval that is left to search (0 if nothing matches).

        The interval is the wider the more the depths of neighbouring pixels differ: there are edges, or matches that
        are not to be trusted.

        Args:
            camera: of the last level.
            start: inverse depths to try others around, on pixels of any size.
            reach: how far around the start the first level searches, where that is more than usual.
            finer: the last level counts only where photographs agree, and the one before it elsewhere.
        """
        side = max(camera.width, camera.height)
        levels = max(LEAST_LEVELS + finer, 1 + round(math.log2(side / COARSEST_PX)))
        last_coarse = max(1 + finer, math.ceil(math.log2(side / COARSE_PX)))
        found, cost, surfaces = start, torch.ones_like(start), []
        weight, views = start.new_zeros(0, 1, 1), torch.zeros(0, dtype=torch.long)
        for level in reversed(range(levels)):
            small = _smaller(camera, level)
            found = _resized(found, small)
            if level >= last_coarse:
                weight, views = self._views(small, found)
            # Without any expected depth one photograph fits at all of them: nothing matches.
            if not len(views) or (reach and not ((weight > 0).sum(0) > 1).any()):
                kept = _resized(start, camera)
                return kept, torch.zeros_like(kept)
            steps = COARSE_STEPS if level >= last_coarse else STEPS
            around = reach if level == levels - 1 else 0.0
            found, cost, *surface = self._in_parts(small, found, weight, views, steps, around, smooth=level <= finer)
            if level == last_coarse and not reach:
                found = self._found_or_start(small, found, _resized(start, small), weight, views)
            if surface:
                surfaces.append([_resized(image, camera) for image in surface])
        (surface, half), (fine, fine_half) = surfaces[0], surfaces[-1]
        if not finer:
            return surface, half
        share = 1 / (1 + (_box(cost, SPREAD_PX) / AGREEMENT) ** 4)
        return surface.lerp(fine, share), half.lerp(fine_half, share)

    def _found_or_start(
        self,
        camera: Cameras,
        found: Float[Tensor, "H W"],
        start: Float[Tensor, "H W"],
        weight: Float[Tensor, "V a b"],
        views: Int[Tensor, " V"],
    ) -> Float[Tensor, "H W"]:
        """What coarse levels found, where photographs agree on it better than around the start, which counts elsewhere:
        two photographs agree on many a wrong depth, and what moves seems to lie at another."""
        (found, cost), (start, before) = (
            self._in_parts(camera, depths, weight, views, STEPS, 0.0, smooth=False) for depths in (found, start)
        )
        return torch.where(_box(cost, WINDOW_PX) + DOUBT < _box(before, WINDOW_PX), found, start)

    def _in_parts(
        self,
        camera: Cameras,
        start: Float[Tensor, "H W"],
        weight: Float[Tensor, "V a b"],
        views: Int[Tensor, " V"],
        steps: int,
        reach: float,
        smooth: bool,
    ) -> list[Float[Tensor, "H W"]]:
        """`_level` of a camera, part by part: inverse depths and their costs; where they are to be smoothed, those of
        the surface and half of the interval that is left to search as well."""
        images = [torch.empty_like(start) for _ in range(4 if smooth else 2)]

        def match(outer: _Box, inner: _Box) -> None:
            (left, top), (right, bottom) = outer
            part = replace(
                camera,
                principal_px=camera.principal_px - camera.principal_px.new_tensor([left, top]),
                size_px=camera.size_px.new_tensor([[right - left, bottom - top]]),
            )
            used = _used_in(weight, camera, outer)  # of many photographs few see a part
            its = _read_at(weight[used], camera, outer)
            found, fit = self._level(part, start[top:bottom, left:right], its, views[used.cpu()], steps, reach)
            (x0, y0), (x1, y1) = inner
            results = found, fit.cost, *(_surface(found, fit) if smooth else ())
            for image, values in zip(images, results, strict=True):
                image[y0:y1, x0:x1] = values[y0 - top : y1 - top, x0 - left : x1 - left]

        side = FRAME_PX * (1 if start.device.type == "cpu" else GPU_FACTOR)
        parts = [partial(match, *part) for part in _parts(camera, side)]
        if len(parts) > 1:
            in_parallel(parts, start.device)
        else:
            parts[0]()
        return images

    def _views(
        self, camera: Cameras, inverse_depth: Float[Tensor, "H W"]
    ) -> tuple[Float[Tensor, "V H W"], Int[Tensor, " V"]]:
        """The photographs to compare, and their weights at pixels (`blend_weights`)."""
        indices = torch.tensor(self.scene.sources(camera.to("cpu")), dtype=torch.long)
        shape = inverse_depth.shape
        rays = camera.directions_world(pixel_grid(camera.width, camera.height, self.device)[None])[0]
        points = camera.position_world[0] + rays / inverse_depth.reshape(-1, 1)
        if len(indices) > SELECT_ABOVE:  # most photographs of a large survey see nothing of this
            indices = indices[which_see(self._cameras[indices.to(self.device)], points).cpu()]
        if not len(indices):
            return inverse_depth.new_zeros(0, *shape), indices
        parts = [self._seen_from(indices[some], rays, points) for some in groups(len(indices), len(points))]
        angle, border = (torch.cat(part) for part in zip(*parts, strict=True))
        share, which = blend_weights(angle)
        share *= ((angle.gather(0, which) - LEAST_ANGLE_RAD) / (WHOLE_ANGLE_RAD - LEAST_ANGLE_RAD)).clamp(max=1)
        weight = torch.zeros_like(angle).scatter_(0, which, share)
        weight = weight * border
        used = (weight > 0).any(1)
        return weight[used].unflatten(1, shape), indices[used.cpu()]

    def _seen_from(
        self, indices: Int[Tensor, " V"], rays: Float[Tensor, "P 3"], points: Float[Tensor, "P 3"]
    ) -> tuple[Float[Tensor, "V P"], Float[Tensor, "V P"]]:
        """Angles between rays and photographs' directions to points on them, infinite where a photograph does not see
        the point or is in the ray's own place; and `from_border` of the points' pixels."""
        sources = self._cameras[indices.to(self.device)]
        uv, z = sources.project(points)
        seen = in_frame(sources, uv, z, self.scene.photographs.masks_of(indices.tolist()))
        theirs = F.normalize(points - sources.position_world[:, None], dim=-1)
        angle = angle_between(F.normalize(rays, dim=-1), theirs)
        angle = angle.masked_fill(~seen | (angle < LEAST_ANGLE_RAD), torch.inf)
        return angle, from_border(uv, sources.size_px[:, None], BORDER)

    def _level(
        self,
        camera: Cameras,
        start: Float[Tensor, "H W"],
        weight: Float[Tensor, "V H W"],
        views: Int[Tensor, " V"],
        steps: int,
        reach: float,
    ) -> tuple[Float[Tensor, "H W"], _Fit]:
        """One level: the best of 2 `steps` + 1 depths of every pixel, and how it fits.

        Args:
            start: inverse depths to try others around.
            weight: of the views.
            reach: inverse depth on each side that more steps are made for.
        """
        looks = self._looks(camera, start, weight, views)
        parallax = sum(float((look.parallax_px * look.weight).sum()) for look in looks)
        if parallax <= 0:
            return start, _Fit(torch.ones_like(start), torch.zeros_like(start), 0.0)
        step = sum(float(look.weight.sum()) for look in looks) / parallax
        steps = max(steps, min(MOST_STEPS, math.ceil(reach / step)))
        total = torch.zeros_like(start)
        for look in looks:
            total[look.rows, look.columns] += look.weight
        total = total.clamp(min=1e-6)
        offsets = torch.arange(-steps, steps + 1, device=start.device)[:, None, None]
        mean, square = (start.new_zeros(len(offsets), *start.shape) for _ in range(2))
        for look in looks:
            at = (..., look.rows, look.columns)
            value = look.read(start[at[1:]] + step * offsets)
            share = look.weight / total[at[1:]]
            part = share * value
            mean[at] += part
            square[at] += part * value
        # 2 is the variance of what has nothing in common: what one photograph alone has wrong counts no more.
        cost = _windowed((square - mean.square()).clamp(0, 2)) + (0.0 if reach else HOLD) * offsets**2
        # `argmin` of the first dimension takes eight times as long on a CPU.
        best = cost.min(0, keepdim=True).indices.clamp(1, 2 * steps - 1)
        before, lowest, after = (cost.gather(0, best + k)[0] for k in (-1, 0, 1))
        curvature = (before - 2 * lowest + after).clamp(min=1e-6)
        offset = best[0] - steps + ((before - after) / (2 * curvature)).clamp(-1, 1)
        known = curvature / (lowest + LEAST_COST) + 1e-4
        if reach:
            # What fewer than two photographs see fits at every depth; it lies where what is around it does.
            several = torch.zeros_like(start)
            for look in looks:
                several[look.rows, look.columns] += look.weight > 0
            found = _filled(start + (step * offset).clamp(-reach, reach), known * (several > 1))
        else:
            found = _box((start + step * offset) * known, SMOOTH_PX) / _box(known, SMOOTH_PX)
        return found, _Fit(known, lowest, step)

    def _looks(
        self, camera: Cameras, start: Float[Tensor, "H W"], weight: Float[Tensor, "V H W"], views: Int[Tensor, " V"]
    ) -> list[_Look]:
        height, width = start.shape
        rays = camera.directions_world(pixel_grid(width, height, self.device)[None])[0].T.unflatten(1, start.shape)
        rays = rays.contiguous()
        origin = camera.position_world[0]
        middle = origin + camera.directions_world(camera.size_px[None].to(start) / 2)[0] / start.median()
        levels = self.pyramid.levels(camera.to("cpu"), views[None], middle.cpu())[0]
        extents = [(_extent((view > 0).any(1)), _extent((view > 0).any(0))) for view in weight]
        keys = list(zip(views.tolist(), levels.tolist(), strict=True))
        used = [k for k, (rows, _) in enumerate(extents) if rows.stop > rows.start]
        looks = []
        for k, image in zip(used, self._images_of([keys[k] for k in used]), strict=True):
            at = (..., *extents[k])
            source = self.pyramid.camera(*keys[k]).to(self.device)
            looks.append(_Look(image, source, *extents[k], weight[k][at], rays[at], origin, start[at]))
        return looks

    def _images_of(self, keys: Sequence[tuple[int, int]]) -> list[Float[Tensor, "1 1 _ _"]]:
        """Photographs at levels of the pyramid, each without its local means and contrasts."""
        missing = [key for key in keys if key not in self._images]
        with read_ahead(lambda key: self.pyramid.read(*key), missing, self.device) as read:
            return self._images.get_all(keys, lambda key: self._image(key, read(key)))

    def _image(self, key: tuple[int, int], photograph: Read) -> Float[Tensor, "1 1 H W"]:
        colours, _ = photograph
        camera = self.pyramid.camera(*key).to(self.device)
        grey = (colours.to(self.device).float() / 255 / camera.gain_of_rows()).mean(-1)
        mean = _box(grey, CONTRAST_PX)
        variance = (_box(grey.square(), CONTRAST_PX) - mean.square()).clamp(min=0)
        return ((grey - mean) / (variance + NOISE**2).sqrt())[None, None]


@dataclass(frozen=True)
class _Fit:
    """How the depths that a level found fit.

    Attributes:
        known: how well each is determined.
        cost: how much the photographs differ there.
        step: between the depths that were tried; 0 if nothing was.
    """

    known: Float[Tensor, "H W"]
    cost: Float[Tensor, "H W"]
    step: float


def _surface(found: Float[Tensor, "H W"], fit: _Fit) -> tuple[Float[Tensor, "H W"], Float[Tensor, "H W"]]:
    """What a level found, smoothed up to its edges, and half of the interval that is left to search."""
    if not fit.step:
        return found, torch.zeros_like(found)
    for dilation in DILATIONS:
        found = _smoothed_up_to_edges(found, fit.known, EDGE * fit.step, dilation)
    # Inverse depths may differ by a thousandth: of the difference of their own squares no digit would be right.
    away = found - found.mean()
    spread = (_box(away.square(), SPREAD_PX) - _box(away, SPREAD_PX).square()).clamp(min=0).sqrt()
    return found, HALF_PX * fit.step + SPREADS * spread


class _Look:
    """One photograph, read at depths of the pixels of a part of a camera.

    Attributes:
        rows, columns: the part.
        weight: of the photograph.
        parallax_px: pixels that the photograph's point moves by per inverse depth.
    """

    def __init__(
        self,
        image: Float[Tensor, "1 1 a b"],
        source: Cameras,
        rows: slice,
        columns: slice,
        weight: Float[Tensor, "h w"],
        rays: Float[Tensor, "3 h w"],
        origin_world: Float[Tensor, "3"],
        start: Float[Tensor, "h w"],
    ) -> None:
        self.image, self.rows, self.columns, self.weight = image, rows, columns, weight
        matrix = source.projection[0]
        # Of origin + ray / d the homogeneous pixel is, times d: matrix ray + d matrix origin.
        far, near = (
            (matrix[:, :3] @ rays.flatten(1)).unflatten(1, start.shape),
            matrix[:, :3] @ origin_world + matrix[:, 3],
        )
        inverse = _positive(torch.addcmul(far[2], start, near[2])).reciprocal_()
        uv = torch.addcmul(far[:2], start, near[:2, None, None]) * inverse
        self.parallax_px = torch.hypot(*((near[:2, None, None] - uv * near[2]) * inverse))
        # The weights are of a coarser level's pixels, which may lie half outside of the photograph.
        width, height = source.size_px[0].tolist()
        inside = ((uv > MARGIN_PX) & (uv < uv.new_tensor([width, height])[:, None, None] - MARGIN_PX)).all(0)
        self.weight = self.weight * inside
        # From pixels to what `grid_sample` takes: -1 to 1 from border to border.
        scale = (2 / uv.new_tensor([width, height]))[:, None, None]
        pairs = _pairs(*uv)
        self._moved = (source.displaced(pairs.reshape(1, -1, 2)).reshape(pairs.shape) - pairs).movedim(-1, 0) * scale
        self._far = *(far[:2] * scale - far[2]), far[2]
        self._near = *(near[:2] * scale[:, 0, 0] - near[2]), near[2]

    def read(self, inverse_depth: Float[Tensor, "K h w"]) -> Float[Tensor, "K h w"]:
        """What the photograph shows at inverse depths of the pixels."""
        x, y, z = (torch.addcmul(far, inverse_depth, near) for far, near in zip(self._far, self._near, strict=True))
        inverse = _positive(z).reciprocal_()
        grid = _pairs(*(torch.addcmul(moved, q, inverse) for q, moved in zip((x, y), self._moved, strict=True)))
        value = F.grid_sample(self.image, grid.flatten(0, 1)[None], padding_mode="border", align_corners=False)
        return value.reshape(inverse_depth.shape)


def _positive(z: Tensor) -> Tensor:
    """z-depths, kept positive: what is behind a camera is out of its frame."""
    return z.clamp(min=1e-6)


def _pairs(x: Float[Tensor, "*B"], y: Float[Tensor, "*B"]) -> Float[Tensor, "*B 2"]:
    """Put values side by side; `stack` takes six times as long on a CPU."""
    return torch.view_as_real(torch.complex(x, y))


def _extent(used: Tensor) -> slice:
    """From the first to the last that is used."""
    where = used.nonzero()[:, 0]
    return slice(int(where[0]), int(where[-1]) + 1) if len(where) else slice(0, 0)


def _box(values: Float[Tensor, "*K H W"], side: int) -> Float[Tensor, "*K H W"]:
    """Means over windows of an odd side; at the borders, of what lies within."""
    for dim in (-2, -1):
        counts = _window_sums(values.new_ones(values.shape[dim]), side, -1)
        values = _window_sums(values, side, dim) / (counts[:, None] if dim == -2 else counts)
    return values


def _filled(values: Float[Tensor, "H W"], weight: Float[Tensor, "H W"]) -> Float[Tensor, "H W"]:
    """Weighted means over the smallest windows in which something has weight; the values where nothing has."""
    filled, empty, side = values, torch.ones_like(values, dtype=torch.bool), SMOOTH_PX
    while empty.any() and side < 4 * max(values.shape):
        share = _box(weight, side)
        found = empty & (share > 0)
        filled = torch.where(found, _box(values * weight, side) / share.clamp(min=1e-12), filled)
        empty, side = empty & ~found, 2 * side + 1
    return filled


def _window_sums(values: Tensor, side: int, dim: int) -> Tensor:
    """Sums over windows along a dimension, put together from sums of 1, 2, 4, ... values, each of which is a sum of two
    of the one before: several times as fast on a CPU as `avg_pool2d`."""
    size, half = values.shape[dim], side // 2
    power = F.pad(values, [0, 0] * (-1 - dim) + [half, half])
    total, start, width = torch.zeros_like(values), 0, 1
    while True:
        if side & width:
            total += power.narrow(dim, start, size)
            start += width
        if 2 * width > side:
            return total
        left = power.shape[dim] - width
        power = power.narrow(dim, 0, left) + power.narrow(dim, width, left)
        width *= 2


def _smoothed_up_to_edges(
    found: Float[Tensor, "H W"], known: Float[Tensor, "H W"], edge: float, dilation: int
) -> Float[Tensor, "H W"]:
    """Average inverse depths over 5 x 5 pixels `dilation` apart, those that differ by `edge` and more hardly: one pass
    of an edge-avoiding à-trous filter (Dammertz et al., 2010).

    Args:
        known: how well each is determined, which is its weight.
    """
    height, width = found.shape
    padded = F.pad(torch.stack([found, known])[None], (2 * dilation,) * 4, mode="replicate")[0]
    kernel = (1 / 16, 1 / 4, 3 / 8, 1 / 4, 1 / 16)
    total, weights = torch.zeros_like(found), torch.zeros_like(found)
    for row, column in product(range(5), repeat=2):
        top, left = row * dilation, column * dilation
        other, weight = padded[:, top : top + height, left : left + width]
        weight = kernel[row] * kernel[column] * weight / (1 + ((other - found) / edge).square()).square()
        total += weight * other
        weights += weight
    return total / weights


def _windowed(cost: Float[Tensor, "K H W"]) -> Float[Tensor, "K H W"]:
    near = _box(cost, WINDOW_PX)
    return near + WIDE_SHARE * _box(near, WIDE_PX)


def _smaller(camera: Cameras, octaves: int) -> Cameras:
    return camera.resized(*(max(1, side >> octaves) for side in (camera.width, camera.height)))


def _resized(image: Float[Tensor, "H W"], camera: Cameras) -> Float[Tensor, "h w"]:
    """An image of inverse depths on the pixels of a camera of another size."""
    size = camera.height, camera.width
    if image.shape == size:
        return image
    if image.shape[0] > size[0]:
        return F.interpolate(image[None, None], size=size, mode="area")[0, 0]
    return F.interpolate(image[None, None], size=size, mode="bilinear", align_corners=False)[0, 0]


def _on_pixels(camera: Cameras, cells: Float[Tensor, "h w"]) -> Float[Tensor, "H W"]:
    """Values of cells of `STRIDE` pixels, interpolated at the pixels as `read_prior` does."""
    image = F.interpolate(cells[None, None], scale_factor=STRIDE, mode="bilinear", align_corners=False)[0, 0]
    return image[: camera.height, : camera.width]


def _on_cells(cells: Float[Tensor, "3 h w"], image: Float[Tensor, "H W"]) -> Float[Tensor, "h w"]:
    """Means of pixels over cells of `STRIDE` pixels; those that reach beyond the image continue its border."""
    height, width = (STRIDE * side for side in cells.shape[1:])
    padded = F.pad(image[None, None], (0, width - image.shape[1], 0, height - image.shape[0]), mode="replicate")
    return F.avg_pool2d(padded, STRIDE)[0, 0]


_Box = tuple[tuple[int, int], tuple[int, int]]
"""Upper left corner of a part of a picture, and the corner that it ends before."""


def _read_at(images: Float[Tensor, "V a b"], camera: Cameras, box: _Box) -> Float[Tensor, "V h w"]:
    """Images of a camera at any size, interpolated at the pixels of a part of its picture."""
    (left, top), (right, bottom) = box
    x, y = ((torch.arange(*of, device=images.device) + 0.5) for of in ((left, right), (top, bottom)))
    grid = torch.stack(torch.meshgrid(2 * x / camera.width - 1, 2 * y / camera.height - 1, indexing="xy"), dim=-1)
    return F.grid_sample(images[None], grid[None], padding_mode="border", align_corners=False)[0]


def _used_in(images: Float[Tensor, "V a b"], camera: Cameras, box: _Box) -> Bool[Tensor, " V"]:
    """Which images have anything but 0 among what `_read_at` interpolates."""
    height, width = images.shape[1:]
    (left, top), (right, bottom) = box
    columns, rows = (
        slice(max(0, math.floor(first * size / side) - 1), math.ceil(last * size / side) + 1)
        for first, last, size, side in ((left, right, width, camera.width), (top, bottom, height, camera.height))
    )
    return (images[:, rows, columns] != 0).flatten(1).any(1)


def _parts(camera: Cameras, most_px: int) -> list[tuple[_Box, _Box]]:
    """Parts of a camera's picture to match, of at most a side, and the part of each that is used."""
    sides = []
    for side in (camera.width, camera.height):
        count = max(1, -(-side // most_px))
        edges = [round(k * side / count) for k in range(count + 1)]
        sides.append([(max(0, a - OVERLAP_PX), min(side, b + OVERLAP_PX), a, b) for a, b in pairwise(edges)])
    columns, rows = sides
    return [
        (((left, top), (right, bottom)), ((x0, y0), (x1, y1)))
        for top, bottom, y0, y1 in rows
        for left, right, x0, x1 in columns
    ]
