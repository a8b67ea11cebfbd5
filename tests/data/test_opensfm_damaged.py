"""OpenSfM projects that are damaged, malicious or not supported: one clear error each."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from opensfm_projects import reconstruction, tracks_of, write_opensfm, write_photographs, write_tracks

from tidefield.data.load import load_scene, read_posed
from tidefield.errors import SceneError


@pytest.mark.parametrize("name", ["../outside.png", "/etc/hostname", "a/../../outside.png", "", "a\0b"])
def test_paths_that_leave_the_project_are_refused(tmp_path: Path, name: str) -> None:
    root = tmp_path / "project"
    top = reconstruction()
    write_opensfm(root, top)
    (tmp_path / "outside.png").write_bytes(b"secret")
    (root / "outside.png").write_bytes(b"not a photograph")
    top["shots"][name] = top["shots"].pop("DJI_0004.png")
    write_opensfm(root, top, photographs=False)
    with pytest.raises(SceneError, match="outside of the scene's folder"):
        read_posed(root, False)


def test_image_lists_do_not_leave_a_project(tmp_path: Path) -> None:
    root = tmp_path / "project"
    write_opensfm(root, reconstruction())
    (root / "images" / "DJI_0004.png").rename(tmp_path / "DJI_0004.png")
    (root / "image_list.txt").write_text("../DJI_0004.png\n")
    with pytest.raises(SceneError, match=r"image_list\.txt names .* outside of the scene's folder"):
        read_posed(root, False)


@pytest.mark.parametrize("kind", ["fisheye62", "fisheye624", "dual", "spherical", 7])
def test_cameras_that_are_no_pinhole_cameras_are_refused_with_advice(tmp_path: Path, kind: object) -> None:
    top = reconstruction()
    top["cameras"]["v2 make model"]["projection_type"] = kind
    write_opensfm(tmp_path, top)
    with pytest.raises(SceneError, match=rf"projection type {kind!r}: supported are perspective.*undistorted"):
        read_posed(tmp_path, False)


def spoiled(path: str, value: object) -> dict[str, Any]:
    """A reconstruction with one value replaced; * stands for the first."""
    top: Any = reconstruction()
    *way, last = path.split("/")
    at = top
    for step in way:
        at = at[next(iter(at)) if step == "*" else step]
    at[last] = value
    return top


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        ("shots", [], "shots that are no table"),
        ("shots", {"a.png": 3}, "shots that are no table"),
        ("cameras", None, "cameras that are no table"),
        ("points", [[1, 2, 3]], "points that are no table"),
        ("shots/*/camera", "another", "'another', which it does not have"),
        ("shots/*/camera", ["list"], "which it does not have"),
        ("shots/*/rotation", [0.1, 0.2], r"DJI_0008\.png, has rotation = \[0\.1, 0\.2\]: expected 3 numbers"),
        ("shots/*/rotation", [0.1, float("nan"), 0.2], "rotation = nan"),
        ("shots/*/rotation", [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "rotation = .*expected 3 numbers"),
        ("shots/*/translation", None, "translation = None: expected 3 numbers"),
        ("shots/*/translation", [1.0, 2.0, float("inf")], "translation = inf"),
        ("shots/*/translation", [1.0, 2.0, "3"], "translation = '3'"),
        ("cameras/*/focal_x", None, "focal_x = None"),
        ("cameras/*/focal_x", -1.0, "unusable calibration"),
        ("cameras/*/k3", "much", "k3 = 'much'"),
        ("cameras/*/width", -64, "unusable calibration"),
        ("cameras/*/width", float("nan"), "width = nan"),
        ("cameras/*/width", 10**400, "width = 1000"),
        ("cameras/*/width", 1e12, r"DJI_0008\.png: a camera has the unusable calibration"),
        ("shots/*/translation", [1.0, 2.0, -1e300], r"translation = -1e\+300"),
        ("points/*/coordinates", [1.0, 2.0], r"expected points with coordinates and a color"),
        ("points/*/coordinates", "here", r"expected points with coordinates and a color"),
        ("points/*/color", [1.0, 2.0, 300.0], "colours outside of 0 to 255"),
        ("points/*/color", [1.0, 2.0, float("nan")], "colours outside of 0 to 255"),
    ],
)
def test_unusable_projects_are_refused(tmp_path: Path, path: str, value: object, message: str) -> None:
    write_photographs(tmp_path / "images", reconstruction())
    (tmp_path / "images" / "a.png").touch()
    write_opensfm(tmp_path, spoiled(path, value), photographs=False)
    with pytest.raises(SceneError, match=message):
        read_posed(tmp_path, False)


@pytest.mark.parametrize("content", ["", "{}", "[]", "[3]", "[" * 100_000, "null", '[{"shots": 3}]'])
def test_files_that_are_no_reconstruction_are_refused(tmp_path: Path, content: str) -> None:
    (tmp_path / "reconstruction.json").write_text(content)
    with pytest.raises(SceneError, match=r"reconstruction\.json .*(again|run OpenSfM)"):
        load_scene(tmp_path)


def test_a_smaller_reconstruction_without_shots_is_left_out(tmp_path: Path) -> None:
    whole = reconstruction()
    write_opensfm(tmp_path, whole)
    file = tmp_path / "reconstruction.json"
    file.write_text(file.read_text().rstrip().removesuffix("]") + ", {}]")
    assert set(read_posed(tmp_path, False).names) == set(whole["shots"])


def test_truncated_reconstructions_are_refused(tmp_path: Path) -> None:
    content = write_opensfm(tmp_path, reconstruction()).read_bytes()
    for keep in np.linspace(0, len(content) - 1, 40).astype(int):
        (tmp_path / "reconstruction.json").write_bytes(content[:keep])
        with pytest.raises(SceneError, match=r"damaged .*whole JSON"):
            read_posed(tmp_path, False)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"\t-1\t-1\n", b"\t-1\n", r"damaged \(a line has 10 columns, not 11, after 0 observations\)"),
        (b"_v2", b"_v1", "a line has 11 columns, not 9"),
        (b"_v2", b"_v9", r"version '9' .*remove the file"),
        (b"_v2", b"", "a line has 1 columns, not 8"),
        (b"DJI_0008.png\t0\t0\t", b"DJI_0008.png\t0\t0\tx", r"tracks\.csv is damaged"),
        (b"DJI_0008", b"DJI_\xff008", r"tracks\.csv is damaged"),
    ],
)
def test_tracks_that_are_damaged_are_refused(tmp_path: Path, old: bytes, new: bytes, message: str) -> None:
    top = reconstruction()
    write_opensfm(tmp_path, top)
    file = tmp_path / "tracks.csv"
    write_tracks(file, [("DJI_0008.png", "0", (0.1, 0.2)), *tracks_of(top)])
    content = file.read_bytes()
    assert old in content
    file.write_bytes(content.replace(old, new, 1))
    with pytest.raises(SceneError, match=message):
        read_posed(tmp_path, False)
