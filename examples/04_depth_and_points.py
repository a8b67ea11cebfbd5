"""Turn the depth of a view into coloured points in the world, and compare the depth with the truth.

python examples/04_depth_and_points.py [FOLDER]
"""

import sys
import tempfile
from pathlib import Path

import numpy as np
import torch

import tidefield as tf
from tidefield.data.ply import write_ply
from tidefield.geometry.cameras import pixel_grid
from tidefield.synthetic import make_survey, write_survey

folder = Path(sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp())
write_survey(make_survey("ground_textures", seed=4, views=12, width=128), folder / "scene")
scene = tf.load_scene(folder / "scene")

name = scene.names[scene.test[0]]
camera = scene.cameras[name]
view = tf.zero_shot(scene)(camera)

# Depth is z-depth, and these directions have z = 1 in the camera's own frame: their product leads to the surface.
directions = camera.directions_world(pixel_grid(camera.width, camera.height)[None])[0]
points_world = camera.position_world + directions * view.depth.reshape(-1, 1)

# The origin was subtracted in float64 when the scene was read; it is added back where the points leave the program.
xyz = points_world.double() + scene.origin_world
rgb = (view.colour.reshape(-1, 3) * 255).round().to(torch.uint8)
write_ply(folder / "points.ply", xyz.numpy(), rgb.numpy(), overwrite=True)

truth = np.load(folder / "scene" / "truth" / "depth" / f"{Path(name).stem}.npy")
error_m = np.abs(view.depth.numpy() - truth)
print(f"{folder / 'points.ply'}: {len(xyz)} points, median error of the depth {np.median(error_m):.3f} m")
