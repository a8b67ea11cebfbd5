"""What stands for no height in rasters, declared or not, and rasters without it."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from xml.sax.saxutils import escape

import numpy as np
from jaxtyping import Bool, Float64
from scipy.ndimage import binary_dilation, label

_SAMPLE = 1000
"""Rows and columns of a large surface that are compared with each other to see what its values are."""
STRIP_CELLS = 1 << 22
"""Cells read at once."""
_SENTINELS = (-10000.0, -9999.0, -99999.0, -32768.0, -32767.0, 9999.0, 1e20)
"""Values that programs write where they know no height; some do not declare them."""
IMPOSSIBLE_M = 20_000.0
"""No height on Earth is further from zero."""
_MOST_FAR = 8
"""Different values that are further away: programs write one of them."""
_UNLIKELY_M = 3_000.0
"""No flat is further from zero; 9999 feet are."""
_ZERO_SHARE = 0.01
"""Exact zeros in more cells than this are no heights if the others are all far from zero, or if they are a frame."""
_FAR_M = 1.0
"""What is further from zero is far."""
_STEP_M = 0.1
"""Where a survey ends, most of its heights are further from zero than this."""
_QUAY_M = 10.0
"""No quay is higher above levelled water."""


def undeclared(dataset: Any, metres: float) -> tuple[list[float], float, float]:
    """Find the values that stand for no height where neither nodata nor a mask says so.

    Returns:
        the values; their share of cells; the share of zeros that may be levelled water, or no heights.
    """
    sentinels = (*_SENTINELS, float(np.finfo(np.float32).min))
    values, known, count = _sampled(dataset, sentinels)
    scale, offset = dataset.scales[0], dataset.offsets[0]
    floats, found = np.issubdtype(np.dtype(dataset.dtypes[0]), np.floating), []
    possible = np.abs(values * scale + offset) * metres <= IMPOSSIBLE_M
    others = values[known & possible & ~np.isin(values, sentinels)]
    # Where many heights are lower and many higher, as 9.999 m in millimetres may be, it is one of them.
    low, high = np.quantile(others, (0.001, 0.999)) if len(others) else (math.inf, -math.inf)
    for value in sentinels:
        # Whole numbers with a scale reach some of these values; where others are declared they may be heights.
        unlikely = floats or abs(value * scale + offset) * metres > _UNLIKELY_M
        among = low <= value <= high
        if (unlikely or dataset.nodata is None) and not among and count[value]:
            found.append(value)
    share = sum(count[value] for value in found) / (dataset.width * dataset.height)
    zero, heights = known & (values == 0), known & (values != 0) & ~np.isin(values, found)
    doubtful = 0.0
    if offset == 0 and heights.any():
        sizes_m = np.abs(values) * abs(scale) * metres
        lowest, declared = float(np.quantile(sizes_m[heights], 0.01)), dataset.nodata is not None
        regions = [*([zero] if lowest > _FAR_M else []), *([_at_edges(zero)] if floats else [])]
        step = max((_step_m(region, heights, sizes_m) for region in regions), default=0.0)
        if declared and math.isinf(step):
            step = lowest  # nodata may lie between levelled water and its shore
        if step > (_QUAY_M if declared else _STEP_M):
            found.append(0.0)
        elif declared and step > _FAR_M:
            doubtful = float(zero.mean())
    far, cells = np.unique(values[known & ~possible & ~np.isin(values, found)], return_counts=True)
    found += far[np.argsort(-cells)[:_MOST_FAR]].tolist()
    others_found = [value for value in found if value not in count]
    return found, share + float((known & np.isin(values, others_found)).mean()), doubtful


def _sampled(
    dataset: Any, sentinels: tuple[float, ...]
) -> tuple[Float64[np.ndarray, "rows columns"], Bool[np.ndarray, "rows columns"], dict[float, int]]:
    """Values on a lattice of cells, whether each may be known, and how many of all cells have each sentinel.

    All cells are read: small holes lie between those of a lattice, and overviews mix the values at the edges of holes.
    """
    rows, columns = (
        ((np.arange(min(_SAMPLE, size)) + 0.5) * size / min(_SAMPLE, size)).astype(int)
        for size in (dataset.height, dataset.width)
    )
    values, known = np.zeros((len(rows), len(columns))), np.zeros((len(rows), len(columns)), bool)
    count = dict.fromkeys(sentinels, 0)
    block = dataset.block_shapes[0][0]
    step = max(1, STRIP_CELLS // dataset.width)
    if block * dataset.width <= 8 * STRIP_CELLS:  # else a block would be decoded for several strips
        step = -(-step // block) * block
    for first in range(0, dataset.height, step):
        raw = dataset.read(1, window=((first, min(first + step, dataset.height)), (0, dataset.width)), masked=True)
        strip = raw.filled(0).astype(np.float64)
        there = ~np.ma.getmaskarray(raw) & np.isfinite(strip)
        if dataset.nodata is not None:
            there &= ~np.isclose(strip, dataset.nodata)  # the lowest float is often declared with fewer digits
        for value in sentinels:
            count[value] += int(np.count_nonzero(there & (strip == value)))
        mine = (rows >= first) & (rows < first + step)
        inner = np.ix_(rows[mine] - first, columns)
        values[mine], known[mine] = strip[inner], there[inner]
    return values, known, count


def _at_edges(region: Bool[np.ndarray, "rows columns"]) -> Bool[np.ndarray, "rows columns"]:
    """The connected parts of a region that reach the edge of a raster."""
    numbers = np.zeros(region.shape, np.int32)
    label(region, output=numbers)
    edges = np.concatenate([numbers[0], numbers[-1], numbers[:, 0], numbers[:, -1]])
    return np.isin(numbers, edges[edges > 0])


def _step_m(
    zero: Bool[np.ndarray, "rows columns"], heights: Bool[np.ndarray, "rows columns"], sizes_m: np.ndarray
) -> float:
    """How far from zero heights are that end next to zeros; 0 where they run out to zero, as those of a shore do.

    A sea that was levelled is zero in large areas, too. Its shore rises no further to the first cell than from that to
    the second, however steep it is and however large its cells are. Zeros that touch no height have an infinite step.
    """
    if zero.mean() <= _ZERO_SHARE:
        return 0.0
    near = np.asarray(binary_dilation(zero), bool)
    first, second = near & heights, binary_dilation(near) & heights & ~near
    if not first.any():
        return math.inf
    here = float(np.median(sizes_m[first]))
    further = float(np.median(sizes_m[second])) if second.any() else here
    return here if here > 2 * abs(further - here) else 0.0


def is_masked(dataset: Any) -> bool:
    """Whether a raster has a mask of its own."""
    from rasterio.enums import MaskFlags

    return MaskFlags.per_dataset in dataset.mask_flag_enums[0]


@contextmanager
def cleared(dataset: Any, unknown: tuple[float, ...], scale: float = 1.0, offset: float = 0.0) -> Iterator[Any]:
    """The first band of a raster times a scale plus an offset, NaN where it is masked or has one of some values.

    Args:
        dataset: of rasterio; it is what comes back where there is nothing to do.
        unknown: values of the file that are no heights, besides what it declares.
    """
    import rasterio

    plain = (scale, offset) == (1, 0)
    if plain and not unknown:
        yield dataset
        return
    place = ",".join(map(repr, dataset.transform.to_gdal()))
    system = f"<SRS>{escape(dataset.crs.to_wkt())}</SRS>" if dataset.crs is not None else ""
    source = str(dataset.name)
    rules = ["<UseMaskBand>true</UseMaskBand>", *(f"<NODATA>{value!r}</NODATA>" for value in unknown)]
    if not plain:
        rules.append(f"<ScaleOffset>{offset!r}</ScaleOffset><ScaleRatio>{scale!r}</ScaleRatio>")
    # GDAL leaves out one value in each layer, or what is masked.
    for rule in rules:
        source = (
            f'<VRTDataset rasterXSize="{dataset.width}" rasterYSize="{dataset.height}">{system}<GeoTransform>{place}'
            '</GeoTransform><VRTRasterBand dataType="Float32" band="1"><NoDataValue>nan</NoDataValue><ComplexSource>'
            f"<SourceFilename>{escape(source)}</SourceFilename><SourceBand>1</SourceBand>{rule}</ComplexSource>"
            "</VRTRasterBand></VRTDataset>"
        )
    with rasterio.open(source) as layered:
        yield layered
