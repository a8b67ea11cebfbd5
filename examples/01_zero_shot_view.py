"""Show one held-out view of a scene with trained weights, without training on the scene.

python examples/01_zero_shot_view.py [FOLDER]
"""

import sys
import tempfile
from pathlib import Path

import tidefield as tf
from tidefield.render.stills import describe_view, write_still
from tidefield.synthetic import make_survey, write_survey

folder = Path(sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp())

# Any folder that Tidefield reads would do; this one is a small synthetic survey.
write_survey(make_survey("river_mouths", seed=1, views=12, width=128), folder / "scene")

scene = tf.load_scene(folder / "scene")
print(scene)

render = tf.zero_shot(scene)
camera = scene.cameras[scene.names[scene.test[0]]]
view = render(camera)
print("colour", tuple(view.colour.shape), "depth", tuple(view.depth.shape))

for file in write_still(view, folder / "view.png", about=describe_view(scene, camera), overwrite=True):
    print(file)
