"""Render a video along an orbit over the scene.

python examples/03_camera_path_video.py [FOLDER]
"""

import sys
import tempfile
from pathlib import Path

import tidefield as tf
from tidefield.render.camera_paths import make_trajectory
from tidefield.render.video import write_video
from tidefield.synthetic import make_survey, write_survey

folder = Path(sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp())
write_survey(make_survey("vegetation", seed=3, views=12, width=128), folder / "scene")
scene = tf.load_scene(folder / "scene")

# "cameras" flies among the photographs, "strip" looks straight down, a .json is a path of nerfstudio's viewer.
trajectory = make_trajectory("orbit", scene, frames=6, width=128, height=96)
render = tf.zero_shot(scene)
frames = (render(trajectory.cameras[k]) for k in range(len(trajectory.cameras)))

# Frames are rendered one by one while the video is written.
count = write_video(frames, folder / "orbit.mp4", trajectory.frames_per_second, overwrite=True)
print(f"{folder / 'orbit.mp4'}: {count} frames")
