"""Quality against training time."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import textured_wall as wall
import torch
from networks import SMALL
from rich.console import Console

from tidefield.config import Budget
from tidefield.data.scene import Scene
from tidefield.errors import SceneError
from tidefield.evaluation.curves import SHARES, SMALLER, QualityCurve, make_curve
from tidefield.model.rendering import Rendering
from tidefield.train.loop import SceneTrainer, train


def test_a_point_is_the_mean_psnr_of_small_views():
    scene = wall.scene(wall.cameras(6), (1, 3, 4))
    curve = make_curve(scene)
    assert [camera.width for camera in curve.cameras] == [scene.cameras.width // SMALLER] * 2
    own = scene.photographs[1].float().reshape(*curve.truths[0].shape[:1], SMALLER, -1, SMALLER, 3).mean((1, 3))
    torch.testing.assert_close(curve.truths[0].float(), own, atol=0.5, rtol=0)
    depth = torch.ones(curve.truths[0].shape[:2])
    right = [Rendering(truth.float() / 255, depth, depth) for truth in curve.truths]
    off = [Rendering((truth.float() / 255 - 0.1).clamp(0, 1), depth, depth) for truth in curve.truths]
    curve.add(1.0, right)
    curve.add(2.0, off)
    assert curve.points[0][1] > 50
    assert curve.points[1] == (2.0, pytest.approx(20, abs=1))


class StillTrainer:
    """A trainer whose views are always the truth."""

    def __init__(self, curve: QualityCurve) -> None:
        depth = torch.ones(curve.truths[0].shape[:2])
        self.renderings = [Rendering(truth.float() / 255, depth, depth) for truth in curve.truths]
        self.progress, self.asked = SimpleNamespace(seconds=7.0), 0

    def views(self, cameras):
        self.asked += 1
        return self.renderings


def test_a_resumed_training_renders_once_for_each_share_that_is_left(tmp_path: Path):
    curve = make_curve(wall.scene(wall.cameras(6), (1, 3)))
    trainer = StillTrainer(curve)
    watch = curve.watch(tmp_path, used=1 / 8)
    for share, asked in ((0.13, 0), (0.24, 0), (0.26, 1), (0.49, 1), (0.99, 2), (1.0, 3), (1.0, 3)):
        watch(trainer, share)
        assert trainer.asked == asked
    assert json.loads((tmp_path / "curve.json").read_text()) == [[7.0, 100.0]] * 3


@pytest.mark.thorough
def test_a_training_leaves_a_point_for_each_share_of_its_budget(tmp_path: Path):
    scene = wall.scene(wall.cameras(6), (1, 3))
    trainer, budget, curve = SceneTrainer(SMALL, scene, 0, torch.device("cpu")), Budget(steps=32), make_curve(scene)
    train(trainer, tmp_path, budget, Console(quiet=True), curve.watch(tmp_path, 0.0))
    points = json.loads((tmp_path / "curve.json").read_text())
    assert len(points) == len(SHARES)
    assert [seconds for seconds, _ in points] == sorted(seconds for seconds, _ in points)
    assert all(10 < psnr < 60 for _, psnr in points)


def test_masked_pixels_do_not_count():
    scene = wall.with_left_halves_masked(wall.scene(wall.cameras(6), (1, 3, 4)), (1, 3))
    curve = make_curve(scene)
    depth = torch.ones(curve.truths[0].shape[:2])
    wrong_left = [truth.float() / 255 for truth in curve.truths]
    for colour in wrong_left:
        colour[:, : colour.shape[1] // 2] = 0
    curve.add(1.0, [Rendering(colour, depth, depth) for colour in wrong_left])
    assert curve.points[0][1] > 50


def test_wholly_masked_photographs_are_left_out():
    scene = wall.scene(wall.cameras(6), (1, 3, 4))
    nothing = torch.zeros(scene.photographs.colours[0].shape[:2], dtype=torch.bool)

    def masked(*which: int) -> Scene:
        masks = tuple(nothing if index in which else None for index in range(6))
        return replace(scene, photographs=replace(scene.photographs, masks=masks))

    curve = make_curve(masked(1, 3))
    assert [camera.names for camera in curve.cameras] == [(scene.names[4],)]
    with pytest.raises(SceneError, match=r"wholly masked ones only: expected one for --curve"):
        make_curve(masked(1, 3, 4))
