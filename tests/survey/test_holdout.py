"""`tidefield prepare --holdout`: what is held out has no part in what is measured."""

import json
import shutil
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from ground_flight import Flight, fly
from PIL import Image
from rich.console import Console

from tidefield.data.load import load_scene
from tidefield.errors import SurveyError
from tidefield.survey.import_project import import_project
from tidefield.survey.io.photographs import read_survey
from tidefield.survey.prepare import Prepared, prepare
from tidefield.survey.report import collect_findings, write_report
from tidefield.survey.report.figures import draw_histogram
from tidefield.survey.report.page import draw_charts
from tidefield.survey.report.statistics import measure
from tidefield.survey.sfm import features, matching
from tidefield.survey.sfm.features import FeatureOptions

GAINS = np.exp(np.random.default_rng(5).normal(0, 0.1, (12, 1)) * np.ones(3))


def run(folder: Path, scene: Path, holdout: bool = True) -> Prepared:
    console = Console(quiet=True)
    return prepare(
        read_survey(folder), scene, FeatureOptions(count=1000), pycolmap.Device.cpu, console, holdout=holdout
    )


@pytest.fixture(scope="module", autouse=True)
def no_processes() -> Iterator[None]:
    """Features and matches are found in this process."""
    with pytest.MonkeyPatch.context() as patch:
        for module in (features, matching):
            patch.setattr(module, "worker_processes", lambda *_: nullcontext(ThreadPoolExecutor(1)))
        yield


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Flight:
    pycolmap.logging.minloglevel = int(pycolmap.logging.ERROR)
    return fly(tmp_path_factory.mktemp("card") / "photographs", gains=GAINS)


@pytest.fixture(scope="module")
def made(flight: Flight, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Prepared]:
    scene = tmp_path_factory.mktemp("made") / "scene"
    return scene, run(flight.folder, scene)


def pose_of(scene: Path, name: str) -> bytes:
    model = pycolmap.Reconstruction(scene / "sparse" / "0")
    (image,) = [image for image in map(model.image, model.reg_image_ids()) if image.name == name]
    return image.cam_from_world().matrix().tobytes()


def files(scene: Path, held_out: set[str]) -> dict[str, bytes]:
    """What other photographs than the held-out ones gave."""
    model = pycolmap.Reconstruction(scene / "sparse" / "0")
    images = {image.name: image for image in map(model.image, model.reg_image_ids()) if image.name not in held_out}
    poses = {name: image.cam_from_world().matrix().tobytes() for name, image in images.items()}
    seen = {f"{name} seen": np.array([p.xy for p in image.points2D]).tobytes() for name, image in images.items()}
    paths = [path for path in (scene / "images").iterdir() if path.name not in held_out]
    paths += [scene / name for name in ("sparse/0/points3D.bin", "sparse/0/cameras.bin", "holdout.json")]
    return poses | seen | {path.name + " file": path.read_bytes() for path in paths}


def change(path: Path, pixels_of: Callable[[np.ndarray], np.ndarray]) -> None:
    """Change the pixels of a photograph, and nothing of its metadata."""
    with Image.open(path) as picture:
        exif, pixels = picture.getexif(), pixels_of(np.asarray(picture))
    Image.fromarray(pixels).save(path, exif=exif, quality=95)


def test_other_pixels_in_held_out_photographs_change_nothing_of_the_others(
    made: tuple[Path, Prepared], flight: Flight, tmp_path: Path
):
    folder, held_out = shutil.copytree(flight.folder, tmp_path / "card"), {flight.names[0], flight.names[8]}
    change(folder / flight.names[0], lambda pixels: cv2.GaussianBlur(pixels, (0, 0), 1.0) // 2)
    change(folder / flight.names[8], lambda pixels: np.where(np.arange(400)[:, None] < 250, pixels, 255 - pixels))
    run(folder, tmp_path / "scene")
    before, after = (files(scene, held_out) for scene in (made[0], tmp_path / "scene"))
    assert before.keys() == after.keys()
    assert [name for name in before if before[name] != after[name]] == []
    assert pose_of(made[0], flight.names[0]) != pose_of(tmp_path / "scene", flight.names[0])
    one, other = load_scene(made[0]), load_scene(tmp_path / "scene")
    assert (one.cameras.gain - other.cameras.gain).abs().max() < 1e-3  # they depend on the held-out cameras' positions


@pytest.mark.thorough
def test_what_cannot_be_placed_is_left_out_with_one_message_and_without_the_option_everything_is_used(
    made: tuple[Path, Prepared], flight: Flight, tmp_path: Path, caplog: pytest.LogCaptureFixture
):
    folder, scene = shutil.copytree(flight.folder, tmp_path / "card"), tmp_path / "scene"
    change(folder / flight.names[0], lambda pixels: 255 - pixels)
    prepared = run(folder, scene)
    (warning,) = [record.message for record in caplog.records if record.levelname == "WARNING"]
    assert warning.startswith(f"{flight.names[0]} is held out and cannot be placed: ")
    assert prepared.models[0] == sorted(flight.names[1:])
    loaded = load_scene(scene)
    assert [loaded.names[i] for i in loaded.test] == [flight.names[8]]
    held_out = {flight.names[0], flight.names[8]}
    before, after = (files(scene, held_out) for scene in (made[0], scene))
    assert [name for name in before if before[name] != after[name]] == ["holdout.json file"]
    assert run(folder, scene).models == prepared.models  # nothing is done again
    prepared = run(folder, scene, holdout=False)
    assert not (scene / "holdout.json").exists()
    assert flight.names[8] in prepared.models[0]
    assert (scene / "images" / flight.names[8]).read_bytes() != (folder / flight.names[8]).read_bytes()
    run(folder, scene)
    assert {**files(scene, held_out)} == after


def test_held_out_photographs_are_placed_as_well_as_the_others(made: tuple[Path, Prepared], flight: Flight):
    model = pycolmap.Reconstruction(made[0] / "sparse" / "0")
    images = {image.name: image for image in map(model.image, model.reg_image_ids())}
    centres = np.array([images[name].projection_center() for name in flight.names])
    train = [k for k in range(12) if k % 8]
    to_truth = pycolmap.estimate_sim3d(centres[train], flight.position_world[train])
    assert to_truth is not None
    error_m = np.linalg.norm(np.array([to_truth * c for c in centres]) - flight.position_world, axis=1)
    assert error_m[[0, 8]].max() < 1.5 * error_m[train].max() < 0.15  # a pixel is 0.125 m
    assert not any(point.has_point3D() for k in (0, 8) for point in images[flight.names[k]].points2D)


def test_held_out_photographs_stay_as_taken_and_their_gains_are_of_the_same_scale(
    made: tuple[Path, Prepared], flight: Flight
):
    scene, prepared = made
    assert prepared.correction is not None
    assert prepared.correction.helps
    for k, name in enumerate(flight.names):
        same = (scene / "images" / name).read_bytes() == (flight.folder / name).read_bytes()
        assert same == (k % 8 == 0)
    loaded = load_scene(scene)
    assert [loaded.names[i] for i in loaded.test] == [flight.names[0], flight.names[8]]
    assert loaded.cameras.gain[list(loaded.train)].log().abs().max() < 0.02


def test_an_imported_scene_holds_the_same_photographs_out(made: tuple[Path, Prepared], tmp_path: Path):
    import_project(made[0], tmp_path / "scene")
    before, after = load_scene(made[0]), load_scene(tmp_path / "scene")
    assert after.test == before.test
    assert (after.cameras.gain - before.cameras.gain).abs().max() < 1e-6


def test_the_split_is_written_for_nerfstudio_and_the_report_counts_it(made: tuple[Path, Prepared], flight: Flight):
    scene, prepared = made
    written = json.loads((scene / "transforms.json").read_text(encoding="utf-8"))
    assert written["test_filenames"] == [f"images/{flight.names[k]}" for k in (0, 8)]
    assert len(written["train_filenames"]) == 10
    page = write_report(collect_findings(prepared, scene, {"holdout": "yes"}), scene).read_text(encoding="utf-8")
    assert "2 photographs are held out" in page
    assert page.count('<td class="n">held out</td>') == 2


@pytest.mark.thorough
def test_held_out_photographs_are_no_photographs_without_features_in_the_report(
    made: tuple[Path, Prepared], flight: Flight
):
    scene, prepared = made
    held_out = {flight.names[0], flight.names[8]}
    found = collect_findings(prepared, scene, {})
    assert found.held_out == held_out
    write_report(found, scene)
    table = json.loads((scene / "report.json").read_text(encoding="utf-8"))
    for what in table["features_statistics"].values():
        assert what["min"] > 30
    for one in table["tidefield"]["photographs"]:
        assert one["held_out"] == (one["name"] in held_out) == (one["points"] is None)
    cameras = [
        feature["properties"]
        for feature in json.loads((scene / "survey.geojson").read_text(encoding="utf-8"))["features"]
        if feature["properties"]["kind"] == "camera"
    ]
    assert {camera["photograph"] for camera in cameras if camera["points"] is None} == held_out
    statistics = measure(found)
    observed = statistics.observed[statistics.observed > 0]
    assert len(observed) == 10
    title = "Points per photograph"
    assert dict(draw_charts(statistics, True))[title] == draw_histogram(title, "points", "photographs", observed, 0)


def test_too_few_photographs_beside_the_held_out_ones_are_one_clear_error(flight: Flight, tmp_path: Path):
    (tmp_path / "card").mkdir()
    for name in flight.names[:3]:
        shutil.copy(flight.folder / name, tmp_path / "card" / name)
    with pytest.raises(SurveyError, match="2 photographs are left beside those that --holdout keeps out"):
        run(tmp_path / "card", tmp_path / "scene")
