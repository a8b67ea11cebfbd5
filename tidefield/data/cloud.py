"""Points with colours as a file that others read."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float64, UInt8

from tidefield.files import completed_file

_VERTEX = np.dtype([("xyz", "<f4", 3), ("rgb", "u1", 3)])


def write_cloud(path: Path, xyz: Float64[np.ndarray, "P 3"], rgb: UInt8[np.ndarray, "P 3"], overwrite: bool) -> None:
    """A binary PLY file, as open3d and thereby nerfstudio reads it."""
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(xyz)}"]
    header += [f"property float {axis}" for axis in "xyz"]
    header += [f"property uchar {colour}" for colour in ("red", "green", "blue")]
    vertices = np.empty(len(xyz), _VERTEX)
    vertices["xyz"], vertices["rgb"] = xyz, rgb
    with completed_file(path, overwrite=overwrite) as partial:
        partial.write_bytes("\n".join([*header, "end_header\n"]).encode() + vertices.tobytes())
