"""Values on a ground grid in metres, read bilinearly anywhere."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class Extent:
    """A rectangle of ground, in metres east and north, and the spacing of the nodes laid over it."""

    west_m: float
    south_m: float
    columns: int
    rows: int
    cell_m: float

    @staticmethod
    def around(west_m: float, south_m: float, east_m: float, north_m: float, cell_m: float) -> Extent:
        """The smallest grid of nodes that covers a rectangle, border included."""
        columns, rows = (int(-(-side // cell_m)) + 1 for side in (east_m - west_m, north_m - south_m))
        return Extent(west_m, south_m, columns, rows, cell_m)

    @property
    def size_m(self) -> tuple[float, float]:
        """East-west and north-south length between the outer nodes."""
        return (self.columns - 1) * self.cell_m, (self.rows - 1) * self.cell_m

    @property
    def east_m(self) -> float:
        return self.west_m + self.size_m[0]

    @property
    def north_m(self) -> float:
        return self.south_m + self.size_m[1]

    def nodes(self, device: torch.device | str | None = None) -> Float[Tensor, "2 P"]:
        """All nodes, row by row from the south-west."""
        x = torch.arange(self.columns, device=device) * self.cell_m + self.west_m
        y = torch.arange(self.rows, device=device) * self.cell_m + self.south_m
        y, x = torch.meshgrid(y, x, indexing="ij")
        return torch.stack([x.reshape(-1), y.reshape(-1)])


@dataclass(frozen=True)
class Raster:
    """C values per node of an extent; row 0 is the south."""

    extent: Extent
    values: Float[Tensor, "C H W"]

    @staticmethod
    def of(extent: Extent, *channels: Float[Tensor, " P"]) -> Raster:
        """A raster from one value per node and channel, in the order of `Extent.nodes`."""
        return Raster(extent, torch.stack(channels).reshape(-1, extent.rows, extent.columns))

    def sample(self, xy: Float[Tensor, "2 P"]) -> Float[Tensor, "C P"]:
        """Bilinear values at ground points; beyond the border its values go on."""
        width, height = self.extent.size_m
        x = (xy[0] - self.extent.west_m) * (2 / width) - 1
        y = (xy[1] - self.extent.south_m) * (2 / height) - 1
        grid = torch.stack([x, y], dim=-1)[None, None]
        # Corners aligned: the outer nodes lie on the extent's border.
        return F.grid_sample(self.values[None], grid, padding_mode="border", align_corners=True)[0, :, 0]

    def gradient(self) -> Float[Tensor, "2 H W"]:
        """Slope of the first channel, east and north, by central differences."""
        north, east = torch.gradient(self.values[0], spacing=self.extent.cell_m)
        return torch.stack([east, north])

    def steepest(self) -> float:
        """A bound on the slope of the bilinear surface of the first channel."""
        z = self.values[0]
        east, north = z.diff(dim=1).abs() / self.extent.cell_m, z.diff(dim=0).abs() / self.extent.cell_m
        east = torch.maximum(east[1:], east[:-1])
        north = torch.maximum(north[:, 1:], north[:, :-1])
        return float(torch.sqrt(east**2 + north**2).max())


def blurred(values: Float[Tensor, "H W"], radius: int) -> Float[Tensor, "H W"]:
    """Two passes of a box of (2 radius + 1) nodes: nearly a Gaussian."""
    size = 2 * radius + 1
    x = values[None, None]
    for _ in range(2):
        x = F.avg_pool2d(F.pad(x, (radius, radius, 0, 0), mode="replicate"), (1, size), stride=1)
        x = F.avg_pool2d(F.pad(x, (0, 0, radius, radius), mode="replicate"), (size, 1), stride=1)
    return x[0, 0]
