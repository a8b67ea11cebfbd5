"""Quality against time."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import textured_wall as wall
import torch
from networks import SMALL
from rich.console import Console

from tidefield.config import Budget
from tidefield.evaluation.curves import SHARES, SMALLER, make_curve
from tidefield.model.rendering import Rendering
from tidefield.train.loop import SceneTrainer, train


def test_small_views_are_judged_by_their_mean_error():
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


def test_a_training_leaves_a_point_for_each_share_of_its_budget(tmp_path: Path):
    scene = wall.scene(wall.cameras(6), (1, 3))
    trainer, budget, curve = SceneTrainer(SMALL, scene, 0, torch.device("cpu")), Budget(steps=32), make_curve(scene)
    train(trainer, tmp_path, budget, Console(quiet=True), curve.watch(tmp_path, 0.0))
    points = json.loads((tmp_path / "curve.json").read_text())
    assert len(points) == len(SHARES)
    assert [seconds for seconds, _ in points] == sorted(seconds for seconds, _ in points)
    assert all(10 < psnr < 60 for _, psnr in points)
