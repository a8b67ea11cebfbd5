"""Train on a scene for a few steps, open the run again, and evaluate it on the held-out photographs.

The same as `tidefield train` and `tidefield evaluate`, from Python.

python examples/02_train_and_evaluate.py [FOLDER]
"""

import sys
import tempfile
from pathlib import Path

import torch
from rich.console import Console

import tidefield as tf
from tidefield.config import PRESETS, Budget, config_to_json
from tidefield.evaluation.evaluate import evaluate
from tidefield.synthetic import make_survey, write_survey
from tidefield.train.checkpoint import Run, shipped_weights, weights_sha256, write_run
from tidefield.train.loop import SceneTrainer, train

folder = Path(sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp())
write_survey(make_survey("river_mouths", seed=2, views=12, width=128), folder / "scene")
scene = tf.load_scene(folder / "scene")

# From trained weights on, as the command does it.
weights = shipped_weights("swift")
config = PRESETS["swift"]
write_run(folder / "run", Run(scene.root, None, seed=0, config=config, weights=weights_sha256(weights)))
trainer = SceneTrainer(config, scene, seed=0, device=torch.device("cpu"), weights=weights)
train(trainer, folder / "run", Budget(steps=5), Console(quiet=True))

with tf.open_run(folder / "run", device="cpu") as run:
    result = evaluate(run, run.scene, folder / "run", configuration=config_to_json(run.config), overwrite=True)
print(f"PSNR {result.mean['psnr']:.2f} dB, SSIM {result.mean['ssim']:.3f}")
