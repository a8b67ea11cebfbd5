"""Write a map's point cloud: LAZ 1.4, point format 7, with the standard error and the number of photographs."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from pyproj import CRS
from pyproj.exceptions import CRSError

from tidefield import __version__
from tidefield.errors import need
from tidefield.files import completed_file
from tidefield.maps.grid import Grid

SCALE = 0.001
"""Coordinates are rounded to so many units, or, in local frames, whose unit may be any, to a twentieth of a cell."""


class CloudWriter:
    """Writes the points of some rows at a time."""

    def __init__(self, writer: Any, header: Any, grid: Grid) -> None:
        self._writer, self._header, self._grid = writer, header, grid
        self.count = 0

    def write(
        self,
        row: int,
        height: np.ndarray,
        sigma: np.ndarray,
        colour: np.ndarray,
        views: np.ndarray,
        classes: np.ndarray,
    ) -> None:
        """Write the cells of whole rows that have a height: rows x columns, colours 3 x rows x columns of 8 bits."""
        import laspy

        rows, columns = np.nonzero(np.isfinite(height))
        if not len(rows):
            return
        grid = self._grid
        record = laspy.ScaleAwarePointRecord.zeros(len(rows), header=self._header)
        record.x = grid.west + (columns + 0.5) * grid.cell
        record.y = grid.north - (row + rows + 0.5) * grid.cell
        record.z = height[rows, columns].astype(np.float64)
        # 16 bits: 255 becomes 65535.
        for band, name in enumerate(("red", "green", "blue")):
            record[name] = colour[band, rows, columns].astype(np.uint16) * 257
        record["classification"] = classes[rows, columns].astype(np.uint8)
        record["return_number"] = np.ones(len(rows), np.uint8)
        record["number_of_returns"] = np.ones(len(rows), np.uint8)
        record["user_data"] = np.clip(views[rows, columns], 0, 255).astype(np.uint8)
        record["sigma_z"] = sigma[rows, columns].astype(np.float32)
        record["views"] = np.clip(views[rows, columns], 0, 65535).astype(np.uint16)
        self._writer.write_points(record)
        self.count += len(rows)


@contextmanager
def cloud_writer(path: Path, grid: Grid) -> Iterator[CloudWriter]:
    """Write a point cloud by rows; it is there when the block ends.

    Raises:
        RunError: its folder cannot be written to, or is full.
    """
    laspy = need("laspy")
    header = laspy.LasHeader(point_format=7, version="1.4")
    finest = SCALE if grid.frame.frame is not None else min(SCALE, 10.0 ** math.floor(math.log10(grid.cell / 20)))
    header.scales = np.full(3, finest)
    header.offsets = np.floor([grid.west, grid.bounds[1], grid.height])
    header.generating_software = f"Tidefield {__version__}"[:32]
    header.system_identifier = "photographs"
    header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(_wkt(grid.frame.wkt)))
    header.global_encoding.wkt = True
    header.add_extra_dim(laspy.ExtraBytesParams("sigma_z", np.float32, "standard error of height"))
    header.add_extra_dim(laspy.ExtraBytesParams("views", np.uint16, "photographs that see it"))
    with completed_file(path, overwrite=True) as partial, laspy.open(partial, "w", header=header) as writer:
        yield CloudWriter(writer, header, grid)


def _wkt(wkt: str) -> str:
    """WKT 1, which LAS 1.4 asks for, or WKT 2 of systems that WKT 1 has no words for."""
    try:
        return CRS.from_wkt(wkt).to_wkt("WKT1_GDAL")
    except CRSError:
        return wkt
