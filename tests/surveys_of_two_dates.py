"""Surfaces on disk for tests of change."""

from pathlib import Path

import numpy as np

WEST, NORTH = 400_000.0, 5_700_000.0


def write_surface(
    path: Path,
    heights: np.ndarray,
    cell: float = 0.5,
    west: float = WEST,
    north: float = NORTH,
    crs: str | None = "EPSG:32630",
    nodata: float | None = None,
    size: tuple[float, float] | None = None,
) -> Path:
    """Write heights as a GeoTIFF; size is of a pixel where it is not square."""
    import rasterio
    from affine import Affine

    across, down = size or (cell, cell)
    bands = heights[None] if heights.ndim == 2 else heights
    path.parent.mkdir(parents=True, exist_ok=True)
    with rasterio.open(
        path,
        "w",
        driver="GTiff",
        width=bands.shape[2],
        height=bands.shape[1],
        count=bands.shape[0],
        dtype=bands.dtype,
        crs=crs,
        nodata=nodata,
        transform=Affine(across, 0, west, 0, -down, north),
    ) as file:
        file.write(bands)
    return path


def noise(rng: np.random.Generator, shape: tuple[int, int], white: float, smooth: float, radius: int) -> np.ndarray:
    """White noise, and noise that is correlated over 2 radius cells, of these deviations."""
    r, c = (np.fft.fftfreq(n, 1 / n) for n in shape)
    disc = (np.hypot(r[:, None], c[None]) <= radius).astype(float)
    field = np.fft.irfft2(np.fft.rfft2(rng.normal(size=shape)) * np.fft.rfft2(disc), shape) / np.sqrt(disc.sum())
    return (white * rng.normal(size=shape) + smooth * field).astype(np.float32)


def pair(tmp_path: Path, seed: int, depth: float, shift: float = 0.0) -> tuple[Path, Path, np.ndarray]:
    """Two surfaces of 100 x 120 m, and the true change: a pit and a heap of this depth."""
    rng, shape = np.random.default_rng(seed), (200, 240)
    rows, columns = np.indices(shape)
    truth = np.zeros(shape, np.float32)
    truth[(np.hypot(rows - 60, columns - 60) < 25)] = -depth
    truth[(np.hypot(rows - 140, columns - 170) < 20)] = depth
    ground = (3 + 0.002 * columns + 0.3 * np.sin(rows / 20)).astype(np.float32)
    earlier = ground + noise(rng, shape, 0.015, 0.01, 5)
    later = ground + truth + shift + noise(rng, shape, 0.015, 0.01, 5)
    return (
        write_surface(tmp_path / f"early_{seed}.tif", earlier.astype(np.float32)),
        write_surface(tmp_path / f"late_{seed}.tif", later.astype(np.float32)),
        truth,
    )
