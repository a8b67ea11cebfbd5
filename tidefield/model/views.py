"""The neighbouring views of a batch of tiles, read at samples: projection and gathering (method.md, section 3).

Alphabet: T tiles, N views, K maps, P samples of a tile, C channels.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from tidefield.data.neighbours import from_border
from tidefield.geometry.cameras import Cameras
from tidefield.model.gather import FeatureMaps, gather, joined

FEATHER = 0.02
"""Share of its width over which a view fades towards the border of its frame."""
LEAST_PRESENCE = 1e-4
"""Of a view that has faded out: its logarithm enters the blending, and where it alone sees, it must do."""


@dataclass(frozen=True)
class Gathered:
    """What N views show at P samples.

    Attributes:
        colours: C_i, at the common exposure.
        features: F_i.
        directions: d_i, unit, from each view's camera to the sample.
        cosine: d.d_i with the target's direction.
        valid: whether the sample is in front of the camera and inside the encoded part of the photograph.
        presence: how far each view is there (`data.neighbours`), above 0.
    """

    colours: Float[Tensor, "T N P 3"]
    features: Float[Tensor, "T N P C"]
    directions: Float[Tensor, "T N P 3"]
    cosine: Float[Tensor, "T N P"]
    valid: Bool[Tensor, "T N P"]
    presence: Float[Tensor, "T N P"]


@dataclass(frozen=True)
class Encoded:
    """Photographs as the network reads them.

    Attributes:
        features: by stride; from stride 2 on the first three channels are the photographs' mean colours, at the common
            exposure.
        photographs: the colours themselves, at stride 1 or 1/2.
    """

    features: dict[int, FeatureMaps]
    photographs: FeatureMaps

    @staticmethod
    def joined(parts: list[Encoded]) -> Encoded:
        """Groups of photographs of one size each as one set."""
        features = {stride: joined([part.features[stride] for part in parts]) for stride in parts[0].features}
        return Encoded(features, joined([part.photographs for part in parts]))


@dataclass(frozen=True)
class Views:
    """N neighbouring photographs for each of T tiles, encoded: {(I_i, P_i, F_i)} of the paper.

    Attributes:
        cameras: of the T N views, tile by tile.
        which: the map of each view.
        presence: how far each view is there at its tile's corners (`data.neighbours`).
        encoded: all maps.
    """

    cameras: Cameras
    which: Int[Tensor, "T N"]
    presence: Float[Tensor, "T N 4"]
    encoded: Encoded

    def __getitem__(self, tiles: Int[Tensor, " t"]) -> Views:
        rows = torch.arange(self.which.numel(), device=self.which.device).reshape(self.which.shape)[tiles].reshape(-1)
        return Views(self.cameras[rows], self.which[tiles], self.presence[tiles], self.encoded)

    def read(
        self,
        stride: int,
        points_world: Float[Tensor, "T P 3"],
        directions: Float[Tensor, "T P 3"],
        within: Float[Tensor, "T R 2"],
        detail: bool,
    ) -> Gathered:
        """Project samples into every view and read the maps of one stride there.

        Args:
            points_world: of the samples of R rays, all rays' samples one after the other.
            directions: d, unit, from the target's camera to the samples.
            within: where the rays pass their tile, 0 to 1 from its left and from its top.
            detail: read the photographs themselves, not their means over the stride.
        """
        tiles, count = self.which.shape
        # One product for all views of a tile, with all x in memory, then all y, then all z.
        matrix = self.cameras.projection.unflatten(0, (tiles, count)).flatten(1, 2)
        products = torch.baddbmm(matrix[..., 3:], matrix[..., :3], points_world.transpose(1, 2))
        homogeneous = products.unflatten(1, (count, 3)).transpose(2, 3)
        z = homogeneous[..., 2:]
        front = z > 1e-6
        uv = homogeneous[..., :2] / torch.where(front, z, 1.0)
        size = self.cameras.size_px.reshape(tiles, count, 1, 2)
        inside = front[..., 0] & (uv >= 0).all(-1) & (uv <= size).all(-1)
        values, on_map = gather(self.encoded.features[stride], self.which, uv)
        colours, features = values.split([3, values.shape[-1] - 3], dim=-1) if stride > 1 else (values, values)
        if detail or stride == 1:
            colours, on_map = gather(self.encoded.photographs, self.which, uv)
        offset = points_world[:, None] - self.cameras.position_world.reshape(tiles, count, 1, 3)
        theirs = offset * offset.square().sum(-1, keepdim=True).clamp(min=1e-18).rsqrt()
        return Gathered(
            colours=colours,
            features=features,
            directions=theirs,
            cosine=(theirs * directions[:, None]).sum(-1),
            valid=inside & on_map,
            presence=self._presence(within, points_world.shape[1], from_border(uv, size, FEATHER)),
        )

    def _presence(
        self, within: Float[Tensor, "T R 2"], samples: int, inside: Float[Tensor, "T N P"]
    ) -> Float[Tensor, "T N P"]:
        """How far each view is there at every sample: as far as at its ray, and as the sample is inside its frame."""
        right, below = (x[:, None] for x in within.unbind(-1))
        rows = self.presence.unflatten(-1, (2, 2)).unbind(2)
        upper, lower = (torch.lerp(row[..., :1], row[..., 1:], right) for row in rows)
        rays = torch.lerp(upper, lower, below).repeat_interleave(samples // within.shape[1], dim=-1)
        return (rays * inside).clamp(min=LEAST_PRESENCE)
