"""Quality against time: a few held-out views, rendered small while a method trains."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import UInt8
from torch import Tensor
from torch.nn import functional as F

from tidefield.data.scene import Scene
from tidefield.files import completed_file
from tidefield.geometry.cameras import Cameras
from tidefield.model.rendering import Rendering, to_8_bit

SHARES = (1 / 32, 1 / 16, 1 / 8, 1 / 4, 1 / 2, 1.0)
"""Of the budget, when the views are rendered."""
SMALLER = 4
"""Enough to see how a method gets on; at full size, some render for minutes."""
CURVE_FILE = "curve.json"
_VIEWS = 2


@runtime_checkable
class InTraining(Protocol):
    """What a curve needs to know of a `tidefield.train.loop.Trainer`; `progress.seconds` is the time spent so far."""

    progress: Any

    def views(self, cameras: Sequence[Cameras]) -> list[Rendering]: ...


@dataclass
class Curve:
    """What is rendered, and what came out.

    Attributes:
        cameras: of the first held-out photograph and of the middle one, some times as small.
        truths: the photographs, averaged over the pixels' squares.
        points: (seconds of training, mean PSNR).
    """

    cameras: tuple[Cameras, ...]
    truths: tuple[UInt8[Tensor, "H W 3"], ...]
    points: list[tuple[float, float]] = field(default_factory=list)

    def add(self, seconds: float, renderings: Sequence[Rendering]) -> None:
        """Judge one round of renderings."""
        errors = [
            (to_8_bit(rendering.colour).float() - truth.float()).square().mean() / 255**2
            for rendering, truth in zip(renderings, self.truths, strict=True)
        ]
        values = [-10 * torch.log10(error.clamp(min=1e-10)).item() for error in errors]
        self.points.append((seconds, sum(values) / len(values)))

    def watch(self, folder: Path, used: float) -> Callable[[InTraining, float], None]:
        """Renders and writes when a share of `SHARES` is used, of those above the one that is used already."""
        due = [share for share in SHARES if share > used]

        def look(learner: InTraining, share: float) -> None:
            if due and share >= due[0]:
                due[:] = [later for later in due if later > share]
                self.add(learner.progress.seconds, learner.views(self.cameras))
                self.write(folder)

        return look

    def write(self, folder: Path) -> None:
        """RUN/curve.json."""
        with completed_file(folder / CURVE_FILE, overwrite=True) as partial:
            partial.write_text(json.dumps(self.points), encoding="utf-8")


def make_curve(scene: Scene, smaller: int = SMALLER) -> Curve:
    """For a scene that holds photographs out; views are `smaller` times as small as these."""
    test = scene.test
    chosen = sorted({test[0], test[len(test) // 2]})[:_VIEWS]
    cameras, truths = [], []
    for index in chosen:
        camera = scene.cameras[index]
        small = camera.resized(max(1, camera.width // smaller), max(1, camera.height // smaller))
        whole = scene.photographs[index].permute(2, 0, 1)[None].float()
        mean = F.interpolate(whole, size=(small.height, small.width), mode="area")
        cameras.append(small)
        truths.append(mean[0].permute(1, 2, 0).round().to(torch.uint8))
    return Curve(tuple(cameras), tuple(truths))
