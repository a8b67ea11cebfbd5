"""Read and write point clouds with colours as PLY files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64, UInt8

from tidefield.data.readers.files import in_range, opened
from tidefield.files import completed_file

_MEGABYTES = 4_000
_COLOURS = ("red", "green", "blue")


def read_ply(path: Path) -> tuple[Float64[np.ndarray, "P 3"], UInt8[np.ndarray, "P 3"] | None] | None:
    """Read the finite positions of a cloud's vertices, and their colours if they are 8-bit; None without vertices.

    Raises:
        SceneError: the file is damaged, or has no element `vertex` with x, y, z.
    """
    with opened(path, "a complete PLY file of points; export it again", _MEGABYTES):
        vertex = read_vertices(path)
        xyz = np.stack([vertex[axis] for axis in "xyz"], axis=-1).astype(np.float64)
        coloured = all(c in vertex.dtype.names and vertex.dtype[c] == np.uint8 for c in _COLOURS)
        rgb = np.stack([vertex[c] for c in _COLOURS], axis=-1) if coloured else None
    finite = in_range(xyz).all(axis=1)
    return (xyz[finite], None if rgb is None else rgb[finite]) if finite.any() else None


def read_vertices(path: Path) -> Any:
    """Read the element `vertex` as a structured array, inside `opened`, which bounds the size and names the file."""
    from plyfile import PlyData, PlyParseError

    try:
        return PlyData.read(path)["vertex"].data
    except PlyParseError as error:
        raise ValueError(str(error)) from error


def write_ply(path: Path, xyz: Float64[np.ndarray, "P 3"], rgb: UInt8[np.ndarray, "P 3"], overwrite: bool) -> None:
    """Write a cloud as a binary PLY file, in the form that Open3D and nerfstudio read.

    Raises:
        RunError: the file exists and must not be overwritten, or its folder cannot be written to.
    """
    from plyfile import PlyData, PlyElement

    vertex = np.empty(len(xyz), [*((axis, "<f4") for axis in "xyz"), *((colour, "u1") for colour in _COLOURS)])
    for names, values in (("xyz", xyz), (_COLOURS, rgb)):
        for name, column in zip(names, values.T, strict=True):
            vertex[name] = column
    with completed_file(path, overwrite=overwrite) as partial:
        PlyData([PlyElement.describe(vertex, "vertex")], byte_order="<").write(partial)
