"""The network of the paper's Figure 2: neighbouring views in, colours and depths of rays out.

Alphabet: T tiles, R rays of a tile, M samples of a ray, P = R M, N views, C channels, H hidden channels.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from tidefield.config import NetworkConfig
from tidefield.geometry.cameras import Cameras, pixel_grid
from tidefield.model.aggregate import Evidence
from tidefield.model.colour import ColourBlend
from tidefield.model.compositing import composite
from tidefield.model.encoder import Encoder
from tidefield.model.field import Field
from tidefield.model.gather import doubled, maps_from_images
from tidefield.model.intervals import Intervals, histogram, refined, sample
from tidefield.model.stage import Samples, Stage, Weights, place_samples
from tidefield.model.views import Encoded, Gathered, Views


@dataclass(frozen=True)
class Tiles:
    """T square tiles of target views.

    Attributes:
        cameras: the target camera of each tile.
        corner_px: each tile's upper left pixel corner.
        side_px: width and height of the tiles, pixels; they may reach beyond the image.
    """

    cameras: Cameras
    corner_px: Float[Tensor, "T 2"]
    side_px: int

    def rays_px(self, stride: int, margin: int) -> Float[Tensor, "T R 2"]:
        """Pixels of a tile's rays: centres of stride x stride squares, with `margin` more around the tile."""
        assert self.side_px % stride == 0, f"tiles of {self.side_px} px cannot be covered by rays every {stride} px"
        count = self.side_px // stride + 2 * margin
        return self.corner_px[:, None] + (pixel_grid(count, count, self.corner_px.device) - margin) * stride


@dataclass(frozen=True)
class TileRendering:
    """Rendered tiles, at the common exposure.

    Attributes:
        colour: without what lies behind the scene; add (1 - opacity) times the background.
        depth: expected z-depth.
        opacity: sum of the weights.
        shown: how likely a view sees the surface.
        expected: per stage, the mean inverse depth of its rays, margin included.
        glimpses: per stage but the last, colours of its rays (margin included) as far as it can tell: the neighbours'
            mean colours under its weights.
    """

    colour: Float[Tensor, "T R 3"]
    depth: Float[Tensor, "T R"]
    opacity: Float[Tensor, "T R"]
    shown: Float[Tensor, "T R"]
    expected: tuple[Float[Tensor, "T _"], ...]
    glimpses: tuple[Float[Tensor, "T _ 3"], ...]

    def pieces(self) -> tuple[Tensor, ...]:
        """All of it, one after the other; `from_pieces` puts it together again."""
        return (self.colour, self.depth, self.opacity, self.shown, *self.expected, *self.glimpses)

    @staticmethod
    def from_pieces(pieces: tuple[Tensor, ...]) -> TileRendering:
        stages = (len(pieces) - 3) // 2
        return TileRendering(*pieces[:4], expected=pieces[4 : 4 + stages], glimpses=pieces[4 + stages :])


@dataclass(frozen=True)
class _Look:
    """What one pass along the rays found; expected is the mean inverse depth."""

    samples: Samples
    gathered: Gathered | None
    evidence: Evidence
    weights: Weights
    expected: Float[Tensor, "T R"]

    def composite(self, colours: Float[Tensor, "T P 3"]) -> Float[Tensor, "T R 3"]:
        return composite(self.weights.colour, colours.unflatten(1, self.weights.colour.shape[1:]))


class Network(nn.Module):
    """Features of the neighbours -> samples -> evidence -> ray transformer -> density and colour -> rendering."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        if config.views:
            wanted = {s.feature_stride: s.feature_channels for s in config.stages}
            self.encoder = Encoder(config.encoder, tuple(sorted(wanted.items(), reverse=True)))
            if not config.as_printed:
                self.descriptors = nn.ModuleDict({str(s): _descriptor(c) for s, c in wanted.items()})
                self.sharpen = nn.Parameter(torch.zeros(1, 1, 5, 5))
        self.field = Field(config.field) if config.field else None
        field_channels = self.field.channels if self.field else 0
        self.stages = nn.ModuleList(
            Stage(config, stage, field_channels, first=k == 0) for k, stage in enumerate(config.stages)
        )
        alone = "target colour" in config.without
        self.colour = ColourBlend(config.stages[-1].hidden, config.harmonics_degree, config.as_printed, alone)

    def forward(
        self,
        tiles: Tiles,
        views: Views | None,
        start: Intervals,
        opaque: bool,
        generator: torch.Generator | None = None,
    ) -> TileRendering:
        """Render tiles.

        Args:
            tiles: what to render.
            views: the tiles' neighbours; None with the per-scene field alone.
            start: intervals of the first stage's rays (`first_rays_px`).
            opaque: light that passes all samples is stopped by the last; False lets it through to the background.
            generator: jitters samples, for training.
        """
        intervals, density = start, torch.ones_like(start.near)[..., None]
        expected, glimpses = [], []
        last = len(self.config.stages) - 1
        for k in range(last):
            look = self._look(k, tiles, views, intervals, density, opaque, generator)
            expected.append(look.expected)
            glimpses.append(look.composite(look.evidence.mean_colour))
            this, following = self.config.stages[k : k + 2]
            density = histogram(look.weights.surface.detach(), look.samples.place, this.samples, self.config.doubt)
            intervals, density = refined(intervals, density, this.stride // following.stride, self.margin(k + 1))
        look = self._look(last, tiles, views, intervals, density, opaque, generator)
        colours = self.colour(look.evidence, look.gathered, look.samples.directions)
        return TileRendering(
            colour=look.composite(colours),
            depth=1 / look.expected,
            opacity=look.weights.colour.sum(-1),
            shown=look.weights.shown,
            expected=(*expected, look.expected),
            glimpses=tuple(glimpses),
        )

    def _look(
        self,
        k: int,
        tiles: Tiles,
        views: Views | None,
        intervals: Intervals,
        density: Float[Tensor, "T R B"],
        opaque: bool,
        generator: torch.Generator | None,
    ) -> _Look:
        """One pass along the rays: stage k."""
        stage, config = cast(Stage, self.stages[k]), self.config.stages[k]
        uv = tiles.rays_px(config.stride, self.margin(k))
        samples = place_samples(tiles.cameras, uv, intervals, sample(density, config.samples, generator))
        points, directions = samples.points_world, samples.directions
        gathered = None
        if views:
            within = ((uv - tiles.corner_px[:, None]) / tiles.side_px).clamp(0, 1)
            detail = k + 1 == len(self.stages)
            gathered = views.read(config.feature_stride, points, directions, within, detail)
        evidence = stage.evidence(gathered, self.field(points) if self.field else None)
        unit = self.field.unit if self.field and not views else None
        weights = stage.weights(evidence, samples, intervals, opaque, unit)
        # A ray that nothing stops is said to end in the middle of its samples.
        known = weights.surface + 1e-6 / config.samples
        expected = (known * samples.inverse_depth).sum(-1) / known.sum(-1)
        return _Look(samples, gathered, evidence, weights, expected)

    def margin(self, stage: int) -> int:
        """Rays around a tile that a stage adds, for the next one to interpolate between."""
        return int(stage + 1 < len(self.stages))

    def first_rays_px(self, tiles: Tiles) -> Float[Tensor, "T R 2"]:
        """Pixels at which `forward` wants its start intervals."""
        return tiles.rays_px(self.config.stages[0].stride, self.margin(0))

    def encode(self, photographs: Float[Tensor, "K 3 H W"], corner_px: Float[Tensor, "K 2"] | None = None) -> Encoded:
        """Features of photographs of one size, or of crops.

        Args:
            photographs: colours at the common exposure.
            corner_px: where in their photographs the crops' upper left corners lie; None for whole photographs.
        """
        corner = photographs.new_zeros(len(photographs), 2) if corner_px is None else corner_px
        maps = {}
        for stride, feature in zip(self.encoder.strides, self.encoder(photographs), strict=True):
            feature = feature.float()
            means = _means(photographs, stride)
            if not self.config.as_printed:
                feature = feature + self.descriptors[str(stride)](means)
            channels = [means, feature] if stride > 1 else [feature]
            maps[stride] = maps_from_images(torch.cat(channels, dim=1), corner, stride)
        if self.config.as_printed:
            return Encoded(maps, maps_from_images(photographs, corner, 1))
        return Encoded(maps, maps_from_images(doubled(self._sharpened(photographs)), corner, 0.5))

    def _sharpened(self, photographs: Float[Tensor, "K 3 H W"]) -> Float[Tensor, "K 3 H W"]:
        """Against the blur of reading between pixels and of blending: learned, begins as none, and sums to one."""
        planes = F.pad(photographs.flatten(0, 1)[:, None], (2, 2, 2, 2), mode="replicate")
        detail = F.conv2d(planes, self.sharpen - self.sharpen.mean())
        return photographs + detail.reshape(photographs.shape)


def _descriptor(channels: int) -> nn.Conv2d:
    return nn.Conv2d(3, channels, 5, padding=2, padding_mode="replicate", bias=False)


def _means(photographs: Float[Tensor, "K 3 H W"], stride: int) -> Float[Tensor, "K 3 h w"]:
    """The photographs on the texels of a map: means over an odd number of pixels, so that they are centred there."""
    if stride == 1:
        return photographs
    odd = stride + 1 - stride % 2
    return F.avg_pool2d(photographs, odd, stride, odd // 2, count_include_pad=False)
