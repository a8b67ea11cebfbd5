"""`tidefield prepare`, from photograph files to a scene that trains."""

import json
import os
import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Literal
from unittest.mock import Mock

import ground_flight
import numpy as np
import pycolmap
import pytest
from camera_files import photograph, xmp
from ground_flight import ABOVE, FOCAL, Flight, fly
from located_surveys import unlocated_photograph
from PIL import Image
from rich.console import Console

from tidefield.data.georeference import LeftOut, read_georeference
from tidefield.data.load import load_scene, read_posed
from tidefield.errors import RunError, SceneError, SurveyError
from tidefield.files import LOCK_FILE, only_writer
from tidefield.geometry.lenses import FisheyeLens
from tidefield.survey.georeference.gps_alignment import camera_centres
from tidefield.survey.io.photographs import read_survey
from tidefield.survey.prepare import Prepared, _fingerprint, _is_rounded, _require_control, prepare
from tidefield.survey.quality.assessment import assess_quality, without
from tidefield.survey.report import collect_findings, write_report
from tidefield.survey.sfm import features, matching
from tidefield.survey.sfm.blocks import cut
from tidefield.survey.sfm.features import FeatureOptions
from tidefield.survey.stages import Stages
from tidefield.survey.survey import CHECK_FILE, Control, Mark, Survey

GAINS = np.exp(np.random.default_rng(5).normal(0, 0.15, (9, 3)))
OPTIONS = FeatureOptions(count=1000)


def run(
    folder: Path, scene: Path, colour: Literal["auto", "off"] = "auto", downscale: tuple[int, ...] = ()
) -> Prepared:
    survey, console = read_survey(folder), Console(quiet=True)
    return prepare(survey, scene, OPTIONS, pycolmap.Device.cpu, console, colour=colour, downscale=downscale)


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Flight:
    pycolmap.logging.minloglevel = int(pycolmap.logging.ERROR)
    return fly(tmp_path_factory.mktemp("card") / "DCIM ä", columns=3, gains=GAINS)


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


@pytest.mark.thorough
@pytest.mark.parametrize("mapper", ["incremental", "global"])
def test_poses_estimated_in_blocks_or_at_once_are_as_good(
    mapper: Literal["incremental", "global"],
    made: tuple[Path, Prepared],
    flight: Flight,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
):
    scene = tmp_path / "scene"
    shutil.copytree(made[0], scene)
    if mapper == "incremental":
        monkeypatch.setattr("tidefield.survey.prepare.cut", partial(cut, whole=6, most=6))
    survey, console = read_survey(flight.folder), Console(quiet=True)
    redone = prepare(survey, scene, OPTIONS, pycolmap.Device.cpu, console, colour="off", mapper=mapper, redo="poses")
    assert redone.models == [sorted(flight.names)]
    assert np.abs(position_error_m(scene, flight)).max() < 0.25
    assert not (scene / "prepare" / "blocks").exists()


def test_the_scene_loads_with_its_split_and_consistent_colours(made: tuple[Path, Prepared]):
    scene, prepared = made
    loaded = load_scene(scene)
    assert len(loaded.train) + len(loaded.test) == 9
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
    assert {frame["file_path"] for frame in written["frames"]} == {f"images/flight {k:03d}.jpg" for k in range(9)}
    assert (scene / written["ply_file_path"]).exists()


def test_the_report_shows_the_results(made: tuple[Path, Prepared]):
    scene, prepared = made
    page = write_report(collect_findings(prepared, scene, {"colour": "auto"}), scene)
    table = json.loads((scene / "report.json").read_text(encoding="utf-8"))
    assert table["reconstruction_statistics"]["reconstructed_shots_count"] == 9
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


def test_features_are_extracted_again_only_if_earlier_versions_misplaced_them(flight: Flight):
    """They did in photographs that are reduced to another aspect."""
    survey = read_survey(flight.folder)
    for size, misplaced in {(8192, 5460): True, (5472, 3648): False, (2000, 1501): False, (5460, 8192): True}.items():
        one = replace(survey.photographs[0], width=size[0], height=size[1])
        assert _is_rounded(replace(survey, photographs=(*survey.photographs, one)), 2400) == misplaced


def test_reduced_photographs_are_written_on_request_and_removed_without(
    made: tuple[Path, Prepared], flight: Flight, tmp_path: Path
):
    scene = shutil.copytree(made[0], tmp_path / "scene")
    images = {path: path.stat().st_mtime_ns for path in (scene / "images").iterdir()}
    run(flight.folder, scene, downscale=(2, 4))
    (scene / "images_4" / "notes.txt").write_text("mine")
    for factor in (2, 4):
        for name in flight.names:
            with Image.open(scene / "images" / name) as whole, Image.open(scene / f"images_{factor}" / name) as small:
                assert small.size == (whole.width // factor, whole.height // factor)
    run(flight.folder, scene, downscale=(2,))
    assert os.listdir(scene / "images_4") == ["notes.txt"]
    run(flight.folder, scene)
    assert not (scene / "images_2").exists()
    assert {path: path.stat().st_mtime_ns for path in (scene / "images").iterdir()} == images
    (scene / "images_2").symlink_to(flight.folder)
    with pytest.raises(RunError, match="images_2 is a link to"):
        run(flight.folder, scene, downscale=(2,))


def test_the_originals_behind_a_linked_images_folder_stay_as_they_are(
    made: tuple[Path, Prepared], flight: Flight, tmp_path: Path
):
    scene, mine = shutil.copytree(made[0], tmp_path / "scene"), shutil.copytree(flight.folder, tmp_path / "mine")
    (mine / "notes.txt").write_text("mine")
    shutil.rmtree(scene / "images")
    (scene / "images").symlink_to(mine)
    with pytest.raises(RunError, match="is a link to"):
        run(mine, scene)
    assert (mine / "notes.txt").exists()
    assert all((mine / name).read_bytes() == (flight.folder / name).read_bytes() for name in flight.names)


DAMAGE = {
    "an empty database": ("prepare/database.db", "features", lambda _: b""),
    "a database of garbage": ("prepare/database.db", "features", lambda _: b"garbage" * 999),
    "half a database": ("prepare/database.db", "features", lambda data: data[: len(data) // 2]),
    "half a file of frames": ("prepare/model/frames.bin", "poses", lambda data: data[: len(data) // 2]),
    "frames of garbage": ("prepare/model/frames.bin", "poses", lambda data: data[:8] + b"x" * (len(data) - 8)),
    "half a file of cameras": ("prepare/model/cameras.bin", "poses", lambda data: data[: len(data) // 2]),
    "an empty file of rigs": ("prepare/model/rigs.bin", "poses", lambda _: b""),
    "half a file of the scene's images": ("sparse/0/images.bin", "georeference", lambda data: data[: len(data) // 2]),
    "a damaged georeference": ("georeference.json", "georeference", lambda _: b"{}"),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_stage_whose_files_are_damaged_is_done_again_with_one_warning(
    damage: str, made: tuple[Path, Prepared], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog
):
    class Again(Exception): ...

    def stop(self: Stages, file: str) -> None:
        raise Again

    scene = shutil.copytree(made[0], tmp_path / "scene")
    name, stage, change = DAMAGE[damage]
    (scene / name).write_bytes(change((scene / name).read_bytes()))
    stages = json.loads((scene / "prepare" / "stages.json").read_text())
    stages[stage]["files"].append("images/stale.jpg")  # is removed first of all
    (scene / "prepare" / "stages.json").write_text(json.dumps(stages))
    monkeypatch.setattr(Stages, "_remove", stop)
    with pytest.raises(Again):
        run(made[1].survey.folder, scene)
    (warning,) = [record.message for record in caplog.records if record.levelname == "WARNING"]
    assert f"what the stage {stage} wrote is damaged" in warning


@pytest.mark.thorough
def test_a_damaged_database_makes_the_same_scene_again(made: tuple[Path, Prepared], tmp_path: Path):
    scene = shutil.copytree(made[0], tmp_path / "scene")
    (scene / "prepare" / "database.db").write_bytes(b"")
    run(made[1].survey.folder, scene)
    for path in (*made[0].glob("images/*"), *made[0].glob("sparse/0/*")):
        assert (scene / path.relative_to(made[0])).read_bytes() == path.read_bytes()


def test_the_split_of_an_earlier_run_is_not_read_while_photographs_are_written_again(
    made: tuple[Path, Prepared], tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    scene, survey = shutil.copytree(made[0], tmp_path / "scene"), made[1].survey
    written = (scene / "transforms.json").read_text(encoding="utf-8")
    earlier = json.loads(written) | {"train_filenames": ["images/gone.jpg"]}
    (scene / "transforms.json").write_text(json.dumps(earlier), encoding="utf-8")
    prepare(survey, scene, OPTIONS, pycolmap.Device.cpu, Console(quiet=True), redo="images")
    assert "split" not in caplog.text
    assert (scene / "transforms.json").read_text(encoding="utf-8") == written
    assert not (tmp_path / "cache").exists(), "what is not corrected yet is of no use to the user"


@pytest.mark.thorough
def test_other_positions_keep_features_and_matches(
    made: tuple[Path, Prepared], flight: Flight, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    scene = shutil.copytree(made[0], tmp_path / "scene")
    corrected = ground_flight.FRAME.to_geographic(flight.position_world + np.array([0.4, -0.3, 1.0]))
    rows = [f"{name},{x!r},{y!r},{z}\n" for name, (x, y, z) in zip(flight.names, corrected.tolist(), strict=True)]
    table = tmp_path / "ppk.csv"
    table.write_text("image_name,lon,lat,gps_height\n" + "".join(rows))
    for module, name in ((features, "_write_features"), (matching, "_match")):
        monkeypatch.setattr(module, name, Mock(side_effect=AssertionError("done again")))
    moved = read_survey(flight.folder, gps=table)
    again = prepare(moved, scene, OPTIONS, pycolmap.Device.cpu, Console(quiet=True))
    assert again.models == made[1].models
    assert position_error_m(scene, flight).mean(0) == pytest.approx([0.4, -0.3, 1.0], abs=0.05)


@pytest.mark.thorough
def test_an_interrupted_stage_continues(flight: Flight, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
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
    assert len(prepared.models[0]) == 9
    assert written == [*flight.names[:7], *flight.names[6:]]


@pytest.mark.thorough
def test_a_scene_whose_photographs_are_being_written_is_not_opened(
    made: tuple[Path, Prepared], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    import tidefield.survey.prepare as preparing

    scene, survey = shutil.copytree(made[0], tmp_path / "scene"), made[1].survey

    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(preparing, "write_transforms", interrupt)
        with pytest.raises(KeyboardInterrupt):
            prepare(survey, scene, OPTIONS, pycolmap.Device.cpu, Console(quiet=True), redo="images")
    with pytest.raises(SceneError, match="is not prepared to its end: expected a whole scene"):
        load_scene(scene)
    prepare(survey, scene, OPTIONS, pycolmap.Device.cpu, Console(quiet=True))
    assert len(load_scene(scene).names) == 9


@pytest.mark.thorough
def test_a_mask_of_a_photograph_that_has_no_pose_repeats_nothing(
    flight: Flight, tmp_path: Path, caplog: pytest.LogCaptureFixture
):
    card = shutil.copytree(flight.folder, tmp_path / "card")
    texture = np.random.default_rng(0).integers(0, 255, (ground_flight.HEIGHT, ground_flight.WIDTH, 3), np.uint8)
    Image.fromarray(texture).save(card / "other.jpg")
    (card / "masks").mkdir()
    Image.new("L", (ground_flight.WIDTH, ground_flight.HEIGHT), 255).save(card / "masks" / "other.jpg.png")
    assert "other.jpg" not in run(card, tmp_path / "scene").models[0]
    caplog.set_level("INFO", "tidefield")
    run(card, tmp_path / "scene")
    assert "images: complete already" in caplog.text


@pytest.mark.thorough
def test_found_control_that_fits_nothing_is_remarked_and_the_scene_goes_on(
    made: tuple[Path, Prepared], flight: Flight, tmp_path: Path, caplog: pytest.LogCaptureFixture
):
    folder, scene = shutil.copytree(flight.folder, tmp_path / "card"), shutil.copytree(made[0], tmp_path / "scene")
    times = {name: (flight.folder / name).stat() for name in flight.names}
    for name, state in times.items():
        os.utime(folder / name, ns=(state.st_atime_ns, state.st_mtime_ns))
    x, y, height = ground_flight.FRAME.to_crs(np.array([[3.0, 4.0, 0.0]]))[0]
    rng = np.random.default_rng(0)
    lines = [
        f"{x + 9 * k} {y - 9 * k % 20} {height} {rng.uniform(1, 399)} {rng.uniform(1, 299)} {name} P{k}"
        for k in range(5)
        for name in flight.names[:6]
    ]
    lines += [line.rpartition(" ")[0] + " CHK1" for line in lines[:6]]
    (folder / "gcp_list.txt").write_text("\n".join([ground_flight.FRAME.crs, *lines]))
    survey = read_survey(folder)
    assert survey.control is not None
    asked = replace(survey, control_was_found=False)
    with pytest.raises(SurveyError, match="control"):
        prepare(asked, scene, OPTIONS, pycolmap.Device.cpu, Console(quiet=True))
    prepared = prepare(survey, scene, OPTIONS, pycolmap.Device.cpu, Console(quiet=True))
    assert prepared.georeference.source == "GPS"
    assert "--no-control" in prepared.georeference.notes[-1]
    assert not (scene / CHECK_FILE).exists()  # maps would be compared with them
    assert len([record for record in caplog.records if record.levelname == "WARNING"]) == 1
    with pytest.raises(SurveyError, match="control"):
        prepare(asked, scene, OPTIONS, pycolmap.Device.cpu, Console(quiet=True))


def test_the_report_has_no_paths_and_no_options_that_are_off(made: tuple[Path, Prepared], tmp_path: Path):
    from tidefield.commands.prepare import Prepare, _shown

    scene, prepared = made
    folder = prepared.survey.folder
    survey = replace(prepared.survey, remarks=(f"Left out: {folder / 'a.jpg'} cannot be read.",))
    options = Prepare(folder, scene, gps=tmp_path / "gps.csv", keep_all=True)
    shown = _shown(options)
    assert "None" not in shown.values()
    assert "False" not in shown.values()
    assert (shown["gps"], shown["keep all"], shown["photographs"]) == ("gps.csv", "yes", folder.name)
    page = write_report(collect_findings(replace(prepared, survey=survey), scene, shown), scene)
    for text in (page.read_text(encoding="utf-8"), (scene / "report.json").read_text(encoding="utf-8")):
        assert "a.jpg cannot be read" in text
        assert str(folder.parent) not in text


def test_a_scene_without_georeference_and_rejected_control_show_on_the_terminal(
    made: tuple[Path, Prepared], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    from tidefield.commands.prepare import Prepare
    from tidefield.commands.prepare import prepare as command

    scene, folder = shutil.copytree(made[0], tmp_path / "scene"), made[1].survey.folder
    monkeypatch.setattr("tidefield.survey.report.write_report", lambda _, folder: folder / "report.html")
    left_out = (LeftOut("control point", "G1", "away"), *(LeftOut("mark", f"G2 in {k}.jpg", "away") for k in range(2)))
    for nowhere in (True, False):
        located = replace(made[1].georeference, notes=("It is nowhere.", "More."))
        located = replace(located, frame=None, source="none") if nowhere else replace(located, left_out=left_out)
        monkeypatch.setattr(
            "tidefield.survey.prepare.prepare", lambda *_, now=located, **__: replace(made[1], georeference=now)
        )
        caplog.clear()
        command(Prepare(folder, scene), Console(quiet=True))
        warnings = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
        assert warnings == (
            ["It is nowhere."]
            if nowhere
            else [f"ground control: 1 point and 2 single marks left out; why, is in {scene / 'report.html'}"]
        )


def test_angles_of_a_file_of_positions_are_part_of_the_key_and_the_photographs_own_are_not(tmp_path: Path):
    packet = xmp({"GimbalYawDegree": "30", "GimbalPitchDegree": "-90", "GimbalRollDegree": "0"})
    for name, own in (("own.jpg", packet), ("a.jpg", b""), ("b.jpg", b"")):
        photograph(tmp_path / name, packet=own)
    keys = []
    for yaw in (10, 20):
        rows = "".join(f"{name} -92 46 200 {yaw} 5 1\n" for name in ("own.jpg", "a.jpg"))
        (tmp_path / "geo.txt").write_text(f"EPSG:4326\n{rows}b.jpg -92 46 200\n")
        keys.append({entry[0]: entry for entry in _fingerprint(read_survey(tmp_path))})
    assert keys[0]["a.jpg"] != keys[1]["a.jpg"]
    assert keys[0]["own.jpg"] == keys[1]["own.jpg"]
    assert {name: len(entry) for name, entry in keys[0].items()} == {"own.jpg": 5, "a.jpg": 6, "b.jpg": 5}


def test_every_stage_says_when_it_starts_and_ends(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    with caplog.at_level("INFO", "tidefield"):
        Stages(tmp_path, 0).run("one", 0, [], lambda _: {})
    assert [record.message for record in caplog.records] == ["one: started", "one: done in 0.0 s"]


@pytest.mark.thorough
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


@pytest.mark.thorough
def test_photographs_without_overlap_are_an_error(tmp_path: Path):
    for k in range(4):
        fly(tmp_path / "card", rows=1, columns=1, seed=20 + k, first=k)
    with pytest.raises(SurveyError, match=r"none of the 4 photographs fit together \(4 match no other photograph\)"):
        run(tmp_path / "card", tmp_path / "scene")


@pytest.mark.thorough
def test_two_photographs_that_fit_are_too_few_and_the_others_are_explained(
    flight: Flight, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """pycolmap keeps a model of two where none is larger."""
    fly(tmp_path / "card", rows=1, columns=2)
    for k in range(3):
        fly(tmp_path / "card", rows=1, columns=1, seed=20 + k, first=10 + k)
    with pytest.raises(SurveyError, match=r"of the 5 photographs fit together \(3 match no other photograph\)"):
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


def test_a_scene_has_one_writer_and_no_lock_afterwards(made: tuple[Path, Prepared], flight: Flight, tmp_path: Path):
    scene = shutil.copytree(made[0], tmp_path / "scene")
    for folder in (scene, tmp_path / "new"):
        with only_writer(folder), pytest.raises(RunError, match=f"another process is writing to {folder}"):
            run(flight.folder, folder)
    (scene / LOCK_FILE).touch()  # of a process that was killed
    run(flight.folder, scene)
    assert LOCK_FILE not in os.listdir(scene)


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="only root can become another user")
@pytest.mark.parametrize("part", [".", "prepare", "prepare/stages.json", "sparse", "images", "georeference.json"])
def test_a_scene_that_may_not_be_read_is_one_error(part: str, made: tuple[Path, Prepared], tmp_path: Path):
    scene, folder = shutil.copytree(made[0], tmp_path / "scene"), made[1].survey.folder
    parents = {path: path.stat().st_mode for path in (*folder.parents, *scene.parents) if "pytest" in str(path)}
    for path in parents:
        path.chmod(0o755)
    (scene / part).chmod(0)
    os.seteuid(54321)
    try:
        with pytest.raises(RunError, match=r"cannot be written \(Permission denied.*\): expected"):
            run(folder, scene)
    finally:
        os.seteuid(0)
        for path, mode in parents.items():
            path.chmod(mode)


@pytest.mark.thorough
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
    assert len(prepared.models[0]) == 9
    for name in flight.names[:2]:
        with Image.open(tmp_path / "scene" / "images" / name) as picture:
            assert picture.size == (400, 300)
            assert picture.getexif().get(ExifTags.Base.Orientation, 1) == 1
    assert np.abs(position_error_m(tmp_path / "scene", flight)).max() < 0.3


@pytest.mark.thorough
def test_masks_go_into_the_scene_and_no_point_is_seen_in_them(flight: Flight, tmp_path: Path):
    card = shutil.copytree(flight.folder, tmp_path / "card")
    used = np.full((ground_flight.HEIGHT, ground_flight.WIDTH), 255, dtype=np.uint8)
    used[-60:] = 0
    (card / "masks").mkdir()
    *_, bare, _ = flight.names
    for name in {*flight.names} - {bare}:
        Image.fromarray(used).convert("RGB").save(card / "masks" / f"{name}.png")
    scene = tmp_path / "scene"
    assert run(card, scene).models[0] == sorted(flight.names)
    frames = json.loads((scene / "transforms.json").read_text(encoding="utf-8"))["frames"]
    assert [frame["mask_path"] for frame in frames] == [f"masks/{name}.png" for name in sorted(flight.names)]
    for name in flight.names:
        with Image.open(scene / "masks" / f"{name}.png") as mask:
            assert mask.mode == "L"  # of the kind that nerfstudio reads
            assert (np.asarray(mask) == (255 if name == bare else used)).all()
    loaded = load_scene(scene)
    assert loaded.points is not None
    masked = loaded.points.camera_index != loaded.index(bare)
    assert loaded.points.uv_px[masked, 1].max() < ground_flight.HEIGHT - 60
    assert loaded.points.uv_px[~masked, 1].max() > ground_flight.HEIGHT - 60
    # Without the masks everything is done again, as photographs are judged by what is used, and the scene has none.
    shutil.rmtree(card / "masks")
    with pytest.MonkeyPatch.context() as patch:
        judged = []
        patch.setattr(
            "tidefield.survey.prepare.assess_quality", lambda *given: judged.append(1) or assess_quality(*given)
        )
        run(card, scene)
    assert judged
    assert not (scene / "masks").exists()


@pytest.mark.thorough
def test_transparent_photographs_become_an_opaque_scene_with_masks(flight: Flight, tmp_path: Path):
    (tmp_path / "card").mkdir()
    alpha = np.full((ground_flight.HEIGHT, ground_flight.WIDTH), 255, dtype=np.uint8)
    alpha[-60:] = 0
    for name in flight.names:
        with Image.open(flight.folder / name) as picture:
            layers, exif = np.dstack([np.asarray(picture), alpha]), picture.getexif()
        Image.fromarray(layers).save((tmp_path / "card" / name).with_suffix(".png"), exif=exif.tobytes())
    scene = tmp_path / "scene"
    assert len(run(tmp_path / "card", scene).models[0]) == 9
    loaded = load_scene(scene)
    assert loaded.background_rgb is None
    assert loaded.hull is None
    assert loaded.points is not None
    assert loaded.points.uv_px[:, 1].max() < ground_flight.HEIGHT - 60
    assert not any(loaded.photographs.used(i)[-59:].any() for i in range(9))


@pytest.mark.thorough
def test_photographs_of_a_fisheye_become_a_scene_for_nerfstudio_and_for_us(tmp_path: Path):
    lens = FisheyeLens(ground_flight.WIDTH, ground_flight.HEIGHT, 260.0, 260.0, 200.0, 150.0, k1=0.03)
    flight = fly(tmp_path / "card", lens=lens)
    scene, survey = tmp_path / "scene", read_survey(flight.folder)
    prepared = prepare(survey, scene, OPTIONS, pycolmap.Device.cpu, Console(quiet=True), lens="fisheye")
    assert prepared.models[0] == sorted(flight.names)
    found = read_posed(scene, False).lenses[0]
    assert isinstance(found, FisheyeLens)
    rays = np.random.default_rng(0).uniform(-0.8, 0.8, (200, 2))
    rays = np.c_[rays, np.ones(200)]
    assert np.abs(found.project(rays) - lens.project(rays)).max() < 1.5
    assert np.abs(position_error_m(scene, flight)).max() < 0.3
    top = json.loads((scene / "transforms.json").read_text(encoding="utf-8"))
    assert top["camera_model"] == "OPENCV_FISHEYE"
    loaded = load_scene(scene)
    assert loaded.points is not None
    assert loaded.points.error_px.median() < 1
    page = write_report(collect_findings(prepared, scene, {}), scene)
    assert "FISHEYE" in (scene / "report.json").read_text(encoding="utf-8")
    assert page.is_file()


def test_control_whose_photographs_are_left_out_is_named(tmp_path: Path):
    points = {"A": (1.0, 2.0, 3.0), "B": (4.0, 5.0, 6.0), "CHK1": (7.0, 8.0, 9.0)}
    marks = (Mark("A", "0.jpg", (1.0, 2.0)), Mark("B", "1.jpg", (1.0, 2.0)), Mark("CHK1", "2.jpg", (1.0, 2.0)))
    photographs = tuple(replace(unlocated_photograph(k, None), name=f"{k}.jpg") for k in range(4))
    whole = Survey(tmp_path, photographs, Control("EPSG:27700", points, marks))
    assert _require_control(whole, whole) is None
    assert _require_control(whole, without(whole, ["3.jpg"])) is None
    said = _require_control(whole, without(whole, ["0.jpg"]))
    assert said == "1 of 3 points of ground control are marked only in photographs that are left out: A."
    with pytest.raises(SurveyError, match=r"2 of 3 points .*: A, B: expected some in photographs that are used"):
        _require_control(whole, without(whole, ["0.jpg", "1.jpg"]))
    found = replace(whole, control_was_found=True)
    assert _require_control(found, without(found, ["0.jpg", "1.jpg"])) is not None
