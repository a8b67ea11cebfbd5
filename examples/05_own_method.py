"""Evaluate a method of your own: any function from a camera to a rendering.

This one shows the nearest training photograph as it is, which is a very simple baseline.

python examples/05_own_method.py [FOLDER]
"""

import sys
import tempfile
from pathlib import Path

import torch

import tidefield as tf
from tidefield.evaluation.evaluate import evaluate
from tidefield.synthetic import make_survey, write_survey

folder = Path(sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp())
write_survey(make_survey("tidal_trees", seed=5, views=12, width=128), folder / "scene")
scene = tf.load_scene(folder / "scene")


def nearest_photograph(camera: tf.Cameras) -> tf.Rendering:
    """Return the photograph that was taken closest to the camera; its depth is the middle of near and far."""
    train = list(scene.train)
    distance = (scene.cameras[train].position_world - camera.position_world).norm(dim=-1)
    colour = scene.photographs[train[int(distance.argmin())]] / 255
    depth = torch.full(colour.shape[:2], float(camera.near_far.mean()))
    return tf.Rendering(colour=colour, depth=depth, opacity=torch.ones_like(depth))


result = evaluate(nearest_photograph, scene, folder / "nearest", configuration={"method": "nearest photograph"})
print(f"PSNR {result.mean['psnr']:.2f} dB")
