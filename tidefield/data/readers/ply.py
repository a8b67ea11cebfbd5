"""Vertex positions and colours of PLY point clouds, ASCII and binary (http://paulbourke.net/dataformats/ply/)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float64, UInt8

from tidefield.data.readers.posed import bounded_bytes
from tidefield.errors import SceneError

_MEGABYTES = 4_000
_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
_COLOURS = ("red", "green", "blue")
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}


def read_ply(path: Path) -> tuple[Float64[np.ndarray, "P 3"], UInt8[np.ndarray, "P 3"] | None] | None:
    """Finite positions of the vertices, and their colours where they have 8-bit red, green, blue; None without any.

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
            columns = {name: table[:, i] for i, (name, _) in enumerate(layout)}
        else:
            table = np.frombuffer(body, np.dtype([(name, _ORDERS[order] + _TYPES[t]) for name, t in layout]), count)
            columns = {name: table[name] for name, _ in layout}
        xyz = np.stack([columns[axis] for axis in "xyz"], axis=-1).astype(np.float64)
        coloured = all(dict(layout).get(colour) in ("uchar", "uint8") for colour in _COLOURS)
        rgb = np.stack([columns[colour] for colour in _COLOURS], axis=-1) if coloured else None
        if len(xyz) != count:
            raise ValueError(f"{len(xyz)} of {count} vertices")
        if rgb is not None and not ((rgb >= 0) & (rgb <= 255)).all():
            raise ValueError("colours outside of 0 to 255")
    except (ValueError, KeyError, IndexError) as error:
        raise SceneError(f"{path} is no whole PLY file of points ({error}); export it again") from error
    finite = np.isfinite(xyz).all(axis=1)
    return (xyz[finite], None if rgb is None else rgb[finite].astype(np.uint8)) if finite.any() else None


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
