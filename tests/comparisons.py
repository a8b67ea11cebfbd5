"""Stand-ins for the processes that a comparison starts."""

import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from PIL import Image

from tidefield.compare.run import Settings, Usage
from tidefield.data.scene import Scene
from tidefield.errors import RunError
from tidefield.evaluation.evaluate import NAMES

SETTINGS = Settings(minutes=10.0, steps=None, width=48, device="cpu", seed=0)


def evaluation(scene: Scene, psnr: float) -> dict:
    values = {name: psnr if name.startswith("psnr") else 0.1 for name in NAMES} | {"lpips_alex": None}
    return {
        "per_photograph": {scene.names[i]: values for i in scene.test},
        "mean": {**values, "reasons": {"lpips_alex": "no weights"}},
        "rays_per_second": 1234.0,
        "seconds_per_frame": 0.5,
        "width": 48,
        "split": {"train": [], "test": []},
        "lpips_weights": {"lpips_alex": "7be5be79" + 56 * "0", "lpips_vgg": 64 * "f"},
        "configuration": {"trained": {"steps": 7, "seconds": 600.0}},
    }


class Children:
    """Stands in for the processes: writes what they would write, and records their commands."""

    def __init__(self, scene: Scene) -> None:
        self.scene, self.words, self.fails_at = scene, [], None

    def __call__(self, command: Sequence[str], environment: Mapping[str, str]) -> Usage:
        assert command[:3] == [sys.executable, "-m", "tidefield.cli"]
        words = list(command[3:])
        self.words.append(words)
        if len(self.words) == self.fails_at:
            raise RunError("it broke")
        untrained = words[0] == "evaluate" and not {"--method", "--zero-shot"}.isdisjoint(words)
        folder = Path(words[2] if words[0] == "train" or untrained else words[1])
        folder.mkdir(parents=True, exist_ok=True)
        if words[0] == "train":
            (folder / "run.json").write_text("{}")
            (folder / "curve.json").write_text("[[10, 20.5], [600, 25.0]]")
        else:
            psnr = 28.0 if folder.name == "nearest" else 20.0
            (folder / "evaluation.json").write_text(json.dumps(evaluation(self.scene, psnr)))
            for i in self.scene.test:
                picture = (folder / "renderings" / self.scene.names[i]).with_suffix(".png")
                picture.parent.mkdir(parents=True, exist_ok=True)
                Image.fromarray(self.scene.photographs[i].numpy()).save(picture)
        return Usage(12.5, 3_000_000_000)


def quiet(text: str) -> None:
    assert text
