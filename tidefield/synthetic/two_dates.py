"""One flat at two dates: a creek that moves, a bar that grows, plants that spread; another tide, light and flight.

The change is known exactly: it is the difference of two height fields on one raster. `make_pair` photographs both;
`ground_pair` makes the height fields alone, and `surveyed` gives them the errors that surveys from drone photographs
have, for statistics of many pairs.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor

from tidefield.parallel import in_parallel
from tidefield.synthetic.flat import make_flats
from tidefield.synthetic.grids import Extent, Raster, blurred, smoothstep
from tidefield.synthetic.settings import settings_for
from tidefield.synthetic.survey import Flight, Survey, fly, ground_extent, photograph_flat
from tidefield.synthetic.terrain import Terrain, make_terrain

_BAR_M = (15.0, 8.0)
"""Half axes of the bar."""
_REACH = (0.3, 0.75)
"""Part of the extent, from south to north, in which the creek moves."""


@dataclass(frozen=True)
class Difference:
    """What is different at the second date.

    Attributes:
        change_m: the creek cuts this much on one bank and leaves as much on the other; the bar grows by it. Negative
            turns all of it round; 0 changes no ground, but for pools that a lower tide leaves behind.
        marsh_growth: the share of the dry ground that is marsh becomes this many times as large.
        tide_m: how much higher the water stands.
        sun_turn_deg: how far the sun's azimuth has moved.
    """

    change_m: float = 0.1
    marsh_growth: float = 1.5
    tide_m: float = -0.1
    sun_turn_deg: float = 100.0


def ground_change(terrain: Terrain, change_m: float, random: np.random.Generator) -> Float[Tensor, "H W"]:
    """Compute what is added to the ground: one bank cut, the other filled, a bar raised; plateaus with soft edges."""
    extent, near = terrain.extent, terrain.near_channel
    heading = float(random.uniform(0, 2 * math.pi))
    smooth = blurred(near, max(1, round(1.0 / extent.cell_m)))
    north, east = torch.gradient(smooth)
    side = (east * math.cos(heading) + north * math.sin(heading)) / (torch.hypot(east, north) + 1e-6)
    x, y = extent.nodes().reshape(2, extent.rows, extent.columns)
    along = (y - extent.south_m) / extent.size_m[1]
    reach = smoothstep(_REACH[0] - 0.04, _REACH[0] + 0.04, along) * smoothstep(
        _REACH[1] + 0.04, _REACH[1] - 0.04, along
    )
    bank = smoothstep(0.05, 0.15, smooth) * smoothstep(0.9, 0.75, smooth) * reach
    change = change_m * bank * (smoothstep(0.2, 0.5, -side) - smoothstep(0.2, 0.5, side))
    # The bar grows where there is no creek: of some places, the one that is furthest from all.
    width, height = extent.size_m
    places = random.uniform(0.2, 0.8, (40, 2)) * [width, height] + [extent.west_m, extent.south_m]
    busy = Raster(extent, blurred((near > 0.02).float(), max(1, round(_BAR_M[0] / extent.cell_m / 2)))[None])
    centre = places[int(busy.sample(torch.from_numpy(places.T).float())[0].argmin())]
    turn = float(random.uniform(0, math.pi))
    a = (x - centre[0]) * math.cos(turn) + (y - centre[1]) * math.sin(turn)
    b = (y - centre[1]) * math.cos(turn) - (x - centre[0]) * math.sin(turn)
    bar = smoothstep(1.08, 0.92, torch.hypot(a / _BAR_M[0], b / _BAR_M[1])) * smoothstep(0.1, 0.02, smooth)
    return change + change_m * bar


def changed(terrain: Terrain, change: Float[Tensor, "H W"]) -> Terrain:
    """A terrain with its ground changed; what stood under water stays there where it is still below the water."""
    ground = terrain.ground + change
    wet = terrain.water > terrain.ground
    water = torch.where(wet & (terrain.water > ground), terrain.water, ground - 10.0)
    return replace(terrain, ground=ground, water=water)


@dataclass(frozen=True)
class Pair:
    """Surveys of one flat at two dates, and the truth about its change.

    Attributes:
        ground_change: later minus earlier ground, under water and plants too.
        plants: density of the marsh at both dates.
    """

    earlier: Survey
    later: Survey
    ground_change: Raster
    plants: tuple[Raster, Raster]


def make_pair(
    category: str,
    seed: int,
    difference: Difference | None = None,
    views: int = 40,
    width: int = 240,
    flights: tuple[Flight, Flight] | None = None,
    supersample: int = 2,
) -> Pair:
    """Fly two surveys over a flat that changes between them. The same arguments give the same pixels.

    Args:
        category: tidal_trees, river_mouths, ground_textures, vegetation or deep_water.
        seed: of everything random.
        difference: between the dates; None for the defaults.
        views: photographs of each survey.
        width: of a photograph, pixels.
        flights: of both dates; None for the defaults, the second one 10% higher. A later flight without an elevation
            of the sun has that of the earlier one.

    Raises:
        SceneError: the category is unknown.
    """
    difference = difference or Difference()
    flights = flights or (Flight(), Flight(altitude_m=1.1 * Flight().altitude_m))
    settings = settings_for(category, np.random.default_rng([seed, 20260]))
    later_settings = replace(
        settings,
        tide_m=settings.tide_m + difference.tide_m,
        marsh_share=min(0.9, settings.marsh_share * difference.marsh_growth),
    )
    randoms = [np.random.default_rng([seed, 20261, k]) for k in range(2)]
    cameras = [fly(flight, views, width, random) for flight, random in zip(flights, randoms, strict=True)]
    extents = [ground_extent(c, flight) for c, flight in zip(cameras, flights, strict=True)]
    low = [min(e.west_m for e in extents), min(e.south_m for e in extents)]
    high = [max(e.east_m for e in extents), max(e.north_m for e in extents)]
    extent = Extent.around(low, high, min(e.cell_m for e in extents))
    earlier = flights[0].date(settings, np.random.default_rng([seed, 20262]))
    later = replace(
        flights[1].date(later_settings, np.random.default_rng([seed, 20262])),
        sun_azimuth_deg=(earlier.sun_azimuth_deg + difference.sun_turn_deg) % 360,
        change=partial(_change, change_m=difference.change_m, seed=seed),
    )
    if flights[1].sun_elevation_deg is None:
        later = replace(later, sun_elevation_deg=earlier.sun_elevation_deg)
    task = partial(make_flats, (earlier, later), extent, np.random.default_rng([seed, 20263]))
    # As a task of its own: then the flats do not depend on the number of cores.
    [flats] = in_parallel([task], "cpu")
    surveys = [
        photograph_flat(category, seed, flat, camera, flight, supersample, random)
        for flat, camera, flight, random in zip(flats, cameras, flights, randoms, strict=True)
    ]
    truth = Raster(extent, flats[1].bed.values - flats[0].bed.values)
    return Pair(surveys[0], surveys[1], truth, (flats[0].marsh, flats[1].marsh))


def _change(terrain: Terrain, change_m: float, seed: int) -> Terrain:
    return changed(terrain, ground_change(terrain, change_m, np.random.default_rng([seed, 20264])))


def ground_pair(
    category: str, seed: int, change_m: float, side_m: float = 120.0, cell_m: float = 0.25
) -> tuple[Raster, Raster]:
    """The ground of a flat at two dates, without water and plants.

    Args:
        change_m: as in `Difference`.
        side_m: of the square.
    """
    extent = Extent.around([0.0, 0.0], [side_m, side_m], cell_m)
    random = np.random.default_rng([seed, 20260])
    terrain = make_terrain(settings_for(category, random), extent, random)
    later = terrain.ground + ground_change(terrain, change_m, np.random.default_rng([seed, 20264]))
    return Raster(extent, terrain.ground[None]), Raster(extent, later[None])


@dataclass(frozen=True)
class SurveyErrors:
    """Errors of heights from drone photographs; deviations in metres.

    Attributes:
        white_m: of image matching, independent from cell to cell; larger on slopes.
        smooth_m, smooth_range_m: of the matching windows and of single photographs.
        long_m, long_range_m: of the block's bending.
        datum_m: of the whole survey.
        outliers: share of the cells that are wrong by decimetres.
    """

    white_m: float = 0.012
    smooth_m: float = 0.010
    smooth_range_m: float = 3.0
    long_m: float = 0.005
    long_range_m: float = 30.0
    datum_m: float = 0.03
    outliers: float = 0.0005


def surveyed(
    ground: Raster, extent: Extent, random: np.random.Generator, errors: SurveyErrors | None = None
) -> Float32[np.ndarray, "rows columns"]:
    """The ground as a survey has it on a grid of its own, row 0 in the north.

    Args:
        extent: its nodes are the centres of the survey's cells.
    """
    errors = errors or SurveyErrors()
    heights = ground.sample(extent.nodes())[0].reshape(extent.rows, extent.columns).numpy().astype(np.float64)
    north, east = np.gradient(heights, extent.cell_m)
    slope = np.hypot(north, east)
    found = heights + errors.white_m * np.sqrt(1 + (4 * slope) ** 2) * random.normal(size=heights.shape)
    for size, reach in ((errors.smooth_m, errors.smooth_range_m), (errors.long_m, errors.long_range_m)):
        found += size * _smooth(heights.shape, reach / extent.cell_m, random)
    found += errors.datum_m * random.normal()
    wrong = random.random(heights.shape) < errors.outliers
    found = found + np.where(wrong, random.normal(0, 0.3, heights.shape), 0)
    return np.asarray(found[::-1], np.float32)


def _smooth(shape: tuple[int, ...], reach: float, random: np.random.Generator) -> np.ndarray:
    """Noise of unit deviation whose correlation is exp(-3 (h / reach)^2): 5% are left at the reach."""
    padded = tuple(n + math.ceil(2 * reach) for n in shape)  # the noise comes round at the border
    spectrum = np.fft.rfft2(random.normal(size=padded))
    fy, fx = np.fft.fftfreq(padded[0])[:, None], np.fft.rfftfreq(padded[1])[None]
    # The square of this is the spectrum of that correlation.
    gain = np.exp(-((math.pi * reach) ** 2) * (fx**2 + fy**2) / 6)
    full = np.exp(-((math.pi * reach) ** 2) * (np.fft.fftfreq(padded[1])[None] ** 2 + fy**2) / 6)
    field = np.fft.irfft2(spectrum * gain, padded) / math.sqrt((full**2).mean())
    return field[: shape[0], : shape[1]]
