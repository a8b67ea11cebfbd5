"""Figures of the source paper (its Tables 2 and 3), to stand beside measured ones.

Its Nerfacto is far under what Nerfacto's authors publish for the same scenes; hence they are compared with, not relied
on.
"""

from __future__ import annotations

METRICS = ("psnr", "ssim", "lpips")

TABLE_2 = {
    "bicycle": {"tidefield": (22.74, 0.649, 0.384), "nerfacto": (19.62, 0.497, 0.385)},
    "bonsai": {"tidefield": (27.33, 0.872, 0.252), "nerfacto": (21.40, 0.693, 0.302)},
    "counter": {"tidefield": (25.51, 0.798, 0.328), "nerfacto": (24.01, 0.744, 0.331)},
    "garden": {"tidefield": (25.01, 0.745, 0.282), "nerfacto": (23.06, 0.627, 0.284)},
    "kitchen": {"tidefield": (25.92, 0.789, 0.302), "nerfacto": (26.00, 0.791, 0.299)},
    "room": {"tidefield": (28.54, 0.891, 0.259), "nerfacto": (22.32, 0.777, 0.303)},
    "stump": {"tidefield": (15.97, 0.369, 0.736), "nerfacto": (15.96, 0.345, 0.727)},
}
"""PSNR, SSIM and LPIPS on scenes of mip-NeRF 360."""

TABLE_3 = {
    "tidal_trees": {"nerfacto": (20.46, 0.685, 0.231), "tidefield": (21.77, 0.736, 0.171)},
    "river_mouths": {"nerfacto": (25.52, 0.418, 0.189), "tidefield": (24.90, 0.463, 0.145)},
    "ground_textures": {"nerfacto": (21.65, 0.464, 0.351), "tidefield": (22.18, 0.411, 0.209)},
    "vegetation": {"nerfacto": (23.39, 0.771, 0.240), "tidefield": (23.27, 0.787, 0.229)},
    "deep_water": {"nerfacto": (20.49, 0.429, 0.384), "tidefield": (20.34, 0.443, 0.383)},
}
"""The same on the paper's own tidal flats, which are not public; our categories only have their names."""
