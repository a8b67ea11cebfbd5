"""`tidefield prepare`, from photograph files to a scene that trains."""

import json
import shutil
from pathlib import Path
from typing import Literal

import ground_flight
import numpy as np
import pycolmap
import pytest
from ground_flight import ABOVE, FOCAL, Flight, fly
from rich.console import Console

from tidefield.data.georeference import read_georeference
from tidefield.data.load import load_scene
from tidefield.errors import RunError, SurveyError
from tidefield.survey.georeference.gps_alignment import camera_centres
from tidefield.survey.io.photographs import read_survey
from tidefield.survey.prepare import Prepared, prepare
from tidefield.survey.report import collect_findings, write_report
from tidefield.survey.sfm.features import FeatureOptions

GAINS = np.exp(np.random.default_rng(5).normal(0, 0.15, (12, 3)))
OPTIONS = FeatureOptions(count=1500)


def run(folder: Path, scene: Path, colour: Literal["auto", "off"] = "auto") -> Prepared:
    return prepare(read_survey(folder), scene, OPTIONS, pycolmap.Device.cpu, Console(quiet=True), colour=colour)


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Flight:
    pycolmap.logging.minloglevel = int(pycolmap.logging.ERROR)
    return fly(tmp_path_factory.mktemp("card") / "DCIM ä", gains=GAINS)


@pytest.fixture(scope="module")
def made(flight: Flight, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Prepared]:
    scene = tmp_path_factory.mktemp("made") / "scene"
    return scene, run(flight.folder, scene)


def position_error_m(scene: Path, flight: Flight) -> np.ndarray:
    """Distance of the cameras from the truth, through geographic coordinates."""
    located = read_georeference(scene)
    assert located is not None
    assert located.frame is not None
    centres = camera_centres(pycolmap.Reconstruction(scene / "sparse" / "0"))
    truth = located.frame.from_geographic(ground_flight.FRAME.to_geographic(flight.position_world))
    return np.array([centres[name] for name in flight.names]) - truth


def test_all_cameras_are_at_their_true_positions(made: tuple[Path, Prepared], flight: Flight):
    scene, prepared = made
    assert prepared.models == [sorted(flight.names)]
    assert np.abs(position_error_m(scene, flight)).max() < 0.15
    model = pycolmap.Reconstruction(scene / "sparse" / "0")
    assert model.compute_mean_reprojection_error() < 0.6
    camera = next(iter(model.cameras.values()))
    assert camera.focal_length_x == pytest.approx(FOCAL, rel=0.01)


def test_the_scene_loads_with_its_split_and_consistent_colours(made: tuple[Path, Prepared]):
    scene, prepared = made
    loaded = load_scene(scene)
    assert len(loaded.train) + len(loaded.test) == 12
    assert loaded.points is not None
    assert prepared.correction is not None
    assert prepared.correction.helps
    assert prepared.correction.after < 0.4 * prepared.correction.before
    relative = np.log(prepared.correction.gain / GAINS)
    np.testing.assert_allclose(relative - relative.mean(0), 0, atol=0.03)
    # What is left for the loader to correct is next to nothing.
    assert loaded.cameras.gain.log().abs().max() < 0.05


def test_transforms_list_the_same_photographs(made: tuple[Path, Prepared]):
    scene, _ = made
    written = json.loads((scene / "transforms.json").read_text(encoding="utf-8"))
    assert {frame["file_path"] for frame in written["frames"]} == {f"images/flight {k:03d}.jpg" for k in range(12)}
    assert (scene / written["ply_file_path"]).exists()


def test_the_report_shows_the_results(made: tuple[Path, Prepared]):
    scene, prepared = made
    page = write_report(collect_findings(prepared, scene, {"colour": "auto"}), scene)
    table = json.loads((scene / "report.json").read_text(encoding="utf-8"))
    assert table["reconstruction_statistics"]["reconstructed_shots_count"] == 12
    assert table["tidefield"]["resolution"]["height_above_ground"]["mean"] == pytest.approx(ABOVE, rel=0.03)
    assert table["tidefield"]["colour"]["applied"]
    assert (scene / "survey.geojson").exists()
    assert "flight 003.jpg" in page.read_text(encoding="utf-8")


def test_complete_stages_are_kept_and_a_changed_option_repeats_only_what_depends_on_it(
    made: tuple[Path, Prepared], flight: Flight, tmp_path: Path
):
    scene = shutil.copytree(made[0], tmp_path / "scene")
    before = {path: path.stat().st_mtime_ns for path in scene.rglob("*") if path.is_file()}
    again = run(flight.folder, scene)
    assert again.models == made[1].models
    unchanged = {path for path, at in before.items() if path.stat().st_mtime_ns == at}
    assert unchanged >= set(before) - {scene / "prepare" / "stages.json"}
    plain = run(flight.folder, scene, "off")
    assert plain.correction is None
    assert (scene / "prepare" / "database.db").stat().st_mtime_ns == before[scene / "prepare" / "database.db"]
    name = flight.names[0]
    assert (scene / "images" / name).read_bytes() == (flight.folder / name).read_bytes()
    assert (made[0] / "images" / name).read_bytes() != (flight.folder / name).read_bytes()


def test_an_interrupted_stage_continues(flight: Flight, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    import tidefield.survey.sfm.features as features

    original, written = features._write_features, []

    def interrupt_at_the_seventh(db, photograph, *rest):
        written.append(photograph.name)
        if len(written) == 7:
            raise KeyboardInterrupt
        original(db, photograph, *rest)

    monkeypatch.setattr(features, "_write_features", interrupt_at_the_seventh)
    with pytest.raises(KeyboardInterrupt):
        run(flight.folder, tmp_path / "scene")
    prepared = run(flight.folder, tmp_path / "scene")
    assert len(prepared.models[0]) == 12
    assert written == [*flight.names[:7], *flight.names[6:]]


def test_of_two_places_the_larger_is_made_and_the_other_photographs_are_named(flight: Flight, tmp_path: Path):
    folder = shutil.copytree(flight.folder, tmp_path / "both")
    other = fly(folder, rows=2, columns=3, seed=9, first=50, east_m=120.0)
    prepared = run(folder, tmp_path / "scene")
    assert prepared.models[0] == sorted(flight.names)
    reasons = {item.name: item.reason for item in collect_findings(prepared, tmp_path / "scene", {}).left_out}
    assert set(reasons) == set(other.names)
    if len(prepared.models) > 1:
        assert set(prepared.models[1]) <= set(other.names)
        assert "of a place that nothing connects" in reasons[prepared.models[1][0]]


def test_photographs_without_overlap_are_an_error(tmp_path: Path):
    for k in range(4):
        fly(tmp_path / "card", rows=1, columns=1, seed=20 + k, first=k)
    with pytest.raises(SurveyError, match="overlap"):
        run(tmp_path / "card", tmp_path / "scene")


def test_a_folder_with_other_content_is_left_alone(flight: Flight, tmp_path: Path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "letter.txt").write_text("dear")
    with pytest.raises(RunError, match="something else"):
        run(flight.folder, tmp_path / "mine")
    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["letter.txt"]
    with pytest.raises(RunError, match="holds the photographs"):
        run(flight.folder, flight.folder)
    with pytest.raises(RunError, match="holds the photographs"):
        run(flight.folder, flight.folder.parent)
    (tmp_path / "file").write_text("")
    with pytest.raises(RunError, match="is a file"):
        run(flight.folder, tmp_path / "file")


def test_rotated_photographs_are_upright_in_the_scene(flight: Flight, tmp_path: Path):
    from PIL import ExifTags, Image

    folder = shutil.copytree(flight.folder, tmp_path / "card")
    for name in flight.names[::2]:
        with Image.open(folder / name) as picture:
            table = picture.getexif()
            table[ExifTags.Base.Orientation] = 6  # upright after a quarter turn clockwise
            turned = picture.transpose(Image.Transpose.ROTATE_90)
            turned.save(folder / name, quality=95, exif=table)
    prepared = run(folder, tmp_path / "scene", "off")
    assert len(prepared.models[0]) == 12
    for name in flight.names[:2]:
        with Image.open(tmp_path / "scene" / "images" / name) as picture:
            assert picture.size == (400, 300)
            assert picture.getexif().get(ExifTags.Base.Orientation, 1) == 1
    assert np.abs(position_error_m(tmp_path / "scene", flight)).max() < 0.3
