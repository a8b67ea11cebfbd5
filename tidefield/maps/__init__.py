"""Make maps of a scene: orthophoto, surface model, terrain and point cloud, each with its error.

`grid` places cells on the ground, `surface` measures their heights in the photographs, `orthophoto` renders their
colours by parallel rays, `make` goes through the tiles of a map and writes the files of `rasters` and `cloud`.
"""
