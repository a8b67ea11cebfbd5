"""Files of Gaussians in the layout of Kerbl et al."""

from pathlib import Path

import numpy as np
from plyfile import PlyData, PlyElement


def write_gaussians(path: Path, mean, scale, rotation, opacity, harmonics) -> None:
    """Write standard deviations, quaternions (w, x, y, z), opacities and harmonics (G, 3, K) as programs do."""
    harmonics, opacity = np.asarray(harmonics), np.asarray(opacity, dtype=float)
    with np.errstate(divide="ignore"):
        columns = {
            **dict(zip("xyz", np.asarray(mean).T, strict=True)),
            **dict.fromkeys(("nx", "ny", "nz"), np.zeros(len(harmonics))),
            **{f"f_dc_{k}": harmonics[:, k, 0] for k in range(3)},
            **{
                f"f_rest_{k}": column
                for k, column in enumerate(harmonics[:, :, 1:].reshape(len(harmonics), 3 * harmonics.shape[2] - 3).T)
            },
            "opacity": np.log(opacity / (1 - opacity)),
            **{f"scale_{k}": column for k, column in enumerate(np.log(np.asarray(scale, dtype=float)).T)},
            **{f"rot_{k}": column for k, column in enumerate(np.asarray(rotation).T)},
        }
    vertex = np.empty(len(harmonics), [(name, "<f4") for name in columns])
    for name, column in columns.items():
        vertex[name] = column
    PlyData([PlyElement.describe(vertex, "vertex")], byte_order="<").write(path)
