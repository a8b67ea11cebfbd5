"""The classes of points in a cloud, which the rasters of a map share (ASPRS, LAS 1.4 R15, table 17)."""

GROUND, VEGETATION, WATER = 2, 3, 9
NOISE = (7, 18)
"""Low and high."""
