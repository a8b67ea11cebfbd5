"""The paper's network, as printed.

Ge, Zhu, Wang et al., "View synthesis in tidal flat environments with spherical harmonics and neighboring views
integration", Figure 2. `forward` reads like the figure; each box is a class of the same name in this folder:

    photographs --encode--> F_i           Table 1                           encoder.Encoder
    rays --samples--> X, d                Section 3                         sampling.place_samples
    X --project, read--> C_i, F_i, d_i    Section 3                         views.Views.read
    [F_i, mu, v] --> F_N,i, w_n,i, F_sigma   eq. 6                          aggregate.Aggregate
    F_sigma --ray transformer--> sigma    "ray transformation module"       ray_transformer.RayTransformer
    C_i, C_target --blend--> c            eqs. 7-10                         colour.ColourBlend
    sigma, c --volume rendering--> C(r)   eqs. 1-4                          compositing

Where the print is silent, docs/method.md says what was decided.

Alphabet: T tiles, R rays of a tile, M samples of a ray, P = R M, H hidden channels.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from tidefield.config import NetworkConfig
from tidefield.model.aggregate import Aggregate
from tidefield.model.colour import ColourBlend
from tidefield.model.compositing import composite, weights
from tidefield.model.encoder import Encoder
from tidefield.model.network import Network, TileRendering
from tidefield.model.ray_transformer import RayTransformer
from tidefield.model.sampling import Intervals, Tiles, place_samples, sample
from tidefield.model.views import Encoded, Views, maps_from_images


class PaperNetwork(Network):
    """Neighbouring views -> aggregation -> ray transformer -> density and colour -> volume rendering.

    One ray per pixel, M samples on it, spread evenly in inverse depth between the ends of its interval.
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__(config)
        (self.rays,) = config.passes
        hidden, channels = self.rays.hidden, self.rays.feature_channels
        # The shipped weights have learned with displaced features (docs/method.md, section 2).
        self.encoder = Encoder(config.encoder, ((self.rays.feature_stride, channels),), aligned=False)
        self.aggregate = Aggregate(channels, hidden, uniform_weights=not config.has("direction weights"))
        self.transformer = RayTransformer(hidden, config.heads) if config.has("ray transformer") else None
        self.density = nn.Linear(hidden, 1)
        self.colour = ColourBlend(hidden, config.harmonics_degree, not config.has("target colour"))

    def encode(
        self,
        photographs: Float[Tensor, "K 3 H W"],
        corner_px: Float[Tensor, "K 2"] | None = None,
        doubled: Float[Tensor, "K 3 2*H 2*W"] | None = None,
    ) -> Encoded:
        corner = photographs.new_zeros(len(photographs), 2) if corner_px is None else corner_px
        (features,) = self.encoder(photographs)
        stride = self.rays.feature_stride
        maps = {stride: maps_from_images(features.float(), corner, stride)}
        return Encoded(maps, maps_from_images(photographs, corner, 1))

    def forward(
        self,
        tiles: Tiles,
        views: Views,
        start: Intervals,
        opaque: bool,
        detail: Float[Tensor, "T R"] | None = None,
        jitter: tuple[Float[Tensor, "T _ _"], ...] = (),
    ) -> TileRendering:
        uv = tiles.rays_px(self.rays.stride)
        if detail is not None:
            start = start.moved(detail)
        even = torch.ones_like(start.inv_near)[..., None]
        s = sample(even, self.rays.samples, jitter[0] if jitter else None)
        samples = place_samples(tiles.cameras, uv, start, s)
        in_tile = (uv - tiles.corner_px[:, None]) / tiles.side_px
        scale = tiles.pixels_per_unit(samples.inverse_depth)
        gathered = views.read(self.rays.feature_stride, samples.points_world, samples.directions, in_tile, scale)
        evidence = self.aggregate(gathered.features, gathered.cosine, gathered.valid)
        rays = samples.s.shape
        valid = evidence.valid.unflatten(1, rays[1:])
        # Per mean interval of the ray: a length that features can know, whatever the scale of the scene.
        unit = samples.delta.mean(-1, keepdim=True)
        sigma = self._density(evidence.density.unflatten(1, rays[1:]), samples.s, valid) / unit
        delta = samples.delta
        if opaque:
            delta = torch.cat([delta[..., :-1], torch.full_like(delta[..., -1:], torch.inf)], dim=-1)
        weight = weights(sigma, delta)
        colours = self.colour(evidence, gathered, samples.directions).unflatten(1, rays[1:])
        # 1e-6: a ray that nothing stops has its depth in the middle of its samples.
        known = weight + 1e-6 / self.rays.samples
        inverse_depth = (known * samples.inverse_depth).sum(-1) / known.sum(-1)
        opacity = weight.sum(-1)
        return TileRendering(
            colour=composite(weight, colours),
            depth=1 / inverse_depth,
            opacity=opacity,
            visibility=torch.ones_like(opacity),
            inverse_depths=(inverse_depth,),
        )

    def _density(
        self, features: Float[Tensor, "T R M H"], s: Float[Tensor, "T R M"], valid: Tensor
    ) -> Float[Tensor, "T R M"]:
        """sigma >= 0 from all F_sigma of a ray together; 0 where no view sees the sample."""
        if self.transformer is not None:
            rays = (x.flatten(0, 1) for x in (features, s, valid))
            features = self.transformer(*rays).unflatten(0, features.shape[:2])
        return F.softplus(self.density(features)[..., 0]) * valid
