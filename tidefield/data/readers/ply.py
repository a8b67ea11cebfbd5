"""Vertex positions of PLY point clouds, ASCII and binary (http://paulbourke.net/dataformats/ply/)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float64

from tidefield.data.readers.posed import bounded_bytes
from tidefield.errors import SceneError

_MEGABYTES = 4_000
_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}


def read_ply(path: Path) -> Float64[np.ndarray, "P 3"] | None:
    """Finite positions of the vertices; None when there are none.

    Raises:
        SceneError: when the file is no whole PLY file whose first element is a list of vertices with x, y, z.
    """
    content = bounded_bytes(path, _MEGABYTES)
    try:
        header, found, body = content.partition(b"end_header\n")
        if not found:
            header, _, body = content.partition(b"end_header\r\n")
        count, layout, order = _header(header.decode("ascii").splitlines())
        if order == "ascii":
            lines = body.decode("ascii").splitlines()[:count]
            table = np.array([line.split()[: len(layout)] for line in lines], dtype=np.float64).reshape(-1, len(layout))
            columns = [table[:, [name for name, _ in layout].index(axis)] for axis in "xyz"]
        else:
            table = np.frombuffer(body, np.dtype([(name, _ORDERS[order] + _TYPES[t]) for name, t in layout]), count)
            columns = [table[axis] for axis in "xyz"]
        xyz = np.stack(columns, axis=-1).astype(np.float64)
        if len(xyz) != count:
            raise ValueError(f"{len(xyz)} of {count} vertices")
    except (ValueError, KeyError, IndexError) as error:
        raise SceneError(f"{path} is no whole PLY file of points ({error}); export it again") from error
    xyz = xyz[np.isfinite(xyz).all(axis=1)]
    return xyz if len(xyz) else None


def _header(lines: list[str]) -> tuple[int, list[tuple[str, str]], str]:
    """Number of vertices, their properties (name, type), and the kind of the file."""
    words = [line.split() for line in lines if line.strip()]
    elements = [w for w in words if w[0] == "element"]
    if words[0] != ["ply"] or words[1][0] != "format" or words[1][1] not in _ORDERS or elements[0][1] != "vertex":
        raise ValueError("its header does not begin with ply, format, element vertex")
    start = words.index(elements[0])
    end = words.index(elements[1]) if len(elements) > 1 else len(words)
    layout = [(w[-1], w[1]) for w in words[start:end] if w[0] == "property"]
    return int(elements[0][2]), layout, words[1][1]
