"""`holdout.json`: the split of a scene, and what its photographs were divided by."""

import json
from pathlib import Path

import numpy as np
import pytest
from scenes_on_disk import PINHOLE, survey, write_colmap

from tidefield.data.holdout import Holdout
from tidefield.data.load import load_scene, read_posed
from tidefield.errors import SceneError


def test_a_scene_holds_out_what_its_file_names_and_knows_what_the_others_were_divided_by(tmp_path: Path) -> None:
    truth = survey(PINHOLE)
    write_colmap(tmp_path, truth)
    held_out, other = truth.names[4], truth.names[2]
    Holdout(frozenset([held_out]), {other: np.array([2.0, 1.0, 0.5])}).write(tmp_path)
    scene = load_scene(tmp_path)
    assert [scene.names[i] for i in scene.test] == [held_out]
    assert len(scene.train) == 8
    divided_by = read_posed(tmp_path, False).divided_by
    assert divided_by is not None
    expected = [[2.0, 1.0, 0.5] if name == other else [1.0, 1.0, 1.0] for name in scene.names]
    np.testing.assert_array_equal(divided_by, expected)
    assert load_scene(tmp_path, hold_out=False).test == ()


DAMAGE = {
    "half": '{"held_out": [',
    "no list": "{}",
    "another photograph": json.dumps({"held_out": ["a.jpg"], "divided_by": {}}),
    "none": json.dumps({"held_out": [], "divided_by": {}}),
    "two numbers": json.dumps({"held_out": ["strip_0/photo_8.png"], "divided_by": {"strip_0/photo_8.png": [1, 2]}}),
    "a gain of 0": json.dumps({"held_out": ["strip_0/photo_8.png"], "divided_by": {"strip_0/photo_8.png": [1, 2, 0]}}),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_damaged_file_is_one_error_that_names_it(damage: str, tmp_path: Path) -> None:
    write_colmap(tmp_path, survey(PINHOLE))
    (tmp_path / "holdout.json").write_text(DAMAGE[damage])
    with pytest.raises(SceneError, match=r"holdout\.json.*expected"):
        load_scene(tmp_path)
