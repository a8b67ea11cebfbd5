"""Check points: read, located by their marks, and compared with a surface whose error is known."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scenes_on_disk as disk

from tidefield.data.georeference import Georeference, Residuals, read_georeference
from tidefield.data.load import load_scene
from tidefield.data.scene import Scene
from tidefield.errors import RunError
from tidefield.geometry.geodesy import LocalFrame, parse_crs
from tidefield.geometry.similarity import Similarity
from tidefield.maps.check_points import _intersected, all_check_points, check, read_check_points, remark, summary
from tidefield.maps.grid import Grid, MapFrame, map_frame
from tidefield.maps.rasters import Raster, raster_writer
from tidefield.survey.io.gcp_file import write_check_points
from tidefield.survey.survey import CHECK_FILE, Control, Mark
from tidefield.synthetic import Flight, make_survey, write_survey

FRAME = LocalFrame.at("EPSG:27700", (351_200.0, 512_900.0, 260.0))
WORLD = np.array([[1.0, 2.0, 0.3], [-2.0, 1.0, 0.1], [0.5, -2.5, -0.2]])


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    folder = tmp_path_factory.mktemp("flat")
    flight = Flight(focal_ratio=2.4)
    survey = make_survey("ground_textures", seed=4, views=6, width=64, flight=flight, supersample=1)
    write_survey(survey, folder / "scene", truth=False)
    there = Similarity(1.0, np.eye(3), np.zeros(3))
    Georeference(FRAME, "GPS", there, Residuals(), Residuals(), Residuals(), (), ()).write(folder / "scene")
    return load_scene(folder / "scene", hold_out=False, calibrate=False, cache=folder / "cache")


@pytest.fixture(scope="module")
def frame(scene: Scene) -> MapFrame:
    return map_frame(scene, read_georeference(scene.root))


def written(folder: Path, grid: Grid, height: np.ndarray) -> list[Path]:
    """Rasters of heights, and of standard errors of 0.2."""
    pytest.importorskip("rasterio")
    paths = [folder / "dsm.tif", folder / "sigma.tif"]
    for path, values in zip(paths, (height, np.full(height.shape, 0.2)), strict=True):
        with raster_writer(Raster(path, ("values",)), grid) as writer:
            writer.write(0, values[None])
    return paths


def control(scene: Scene, names: tuple[str, ...] = ("CHK1", "chk 2", "G3")) -> Control:
    """Points at known places, marked where cameras show them."""
    import torch

    marks = []
    for name, xyz in zip(names, WORLD, strict=True):
        uv, _ = scene.cameras.project(torch.from_numpy(xyz[None]).float() - scene.origin_world.float())
        for index, (u, v) in enumerate(uv[:, 0].tolist()):
            if 0 < u < scene.cameras.width and 0 < v < scene.cameras.height:
                marks.append(Mark(name, scene.names[index], (u, v)))
    places = FRAME.to_crs(WORLD).tolist()
    return Control("EPSG:27700", {n: tuple(p) for n, p in zip(names, places, strict=True)}, tuple(marks))


def test_only_check_points_are_written_to_a_scene_and_all_of_them_are_read(
    scene: Scene, frame: MapFrame, tmp_path: Path
):
    write_check_points(control(scene), tmp_path)
    found = read_check_points(tmp_path / CHECK_FILE, scene, frame)
    assert [point.name for point in found] == ["CHK1", "chk 2"]
    np.testing.assert_allclose([point.surveyed for point in found], FRAME.to_crs(WORLD[:2]), atol=1e-6)
    assert all(len(point.marks) >= 2 for point in found)
    write_check_points(control(scene, ("G1", "G2", "G3")), tmp_path)
    assert not (tmp_path / CHECK_FILE).exists()


def test_a_model_is_fitted_to_the_others(scene: Scene):
    fitted = control(scene).fitted()
    assert fitted is not None
    assert set(fitted.points) == {mark.point for mark in fitted.marks} == {"G3"}


def test_errors_are_those_of_the_surface_and_of_the_marks(scene: Scene, frame: MapFrame, tmp_path: Path):
    write_check_points(control(scene), tmp_path)
    points = read_check_points(tmp_path / CHECK_FILE, scene, frame)
    grid = Grid(frame, 351_190.0, 512_910.0, 0.5, 40, 40, 260.0)
    # A plane of a known slope, 5 cm above the ground at its origin.
    east, north = grid.west + (np.arange(40) + 0.5) * 0.5, grid.north - (np.arange(40) + 0.5) * 0.5
    height = 260.05 + 0.1 * (east[None] - 351_200) - 0.2 * (north[:, None] - 512_900)
    checked = check(points, scene, grid, *written(tmp_path, grid, height))
    for one in checked:
        x, y, z = one.point.surveyed
        plane = 260.05 + 0.1 * (x - 351_200) - 0.2 * (y - 512_900)
        assert one.error[2] == pytest.approx(plane - z, abs=1e-4)
        assert np.abs(one.error[:2]).max() < 2e-3
        assert one.sigma == pytest.approx(0.2, abs=1e-6)
    found = summary(checked)
    assert found["vertical"]["n"] == 2
    assert found["vertical"]["mean"] == pytest.approx(np.mean([one.error[2] for one in checked]))
    assert found["remark"] == "2 check points: indicative, under ASPRS' 30"
    assert remark(30) == "30 check points"


def test_marks_in_photographs_from_one_place_place_nothing(scene: Scene, frame: MapFrame, tmp_path: Path):
    write_check_points(control(scene), tmp_path)
    point = read_check_points(tmp_path / CHECK_FILE, scene, frame)[0]
    (first, (u, v)), (second, _), *_ = point.marks
    assert np.isfinite(_intersected(point, scene, frame)).all()
    poses = scene.cameras.T_world_camera.clone()
    poses[second] = poses[first]
    poses[second, 0, 3] += 0.05
    hovering = replace(scene, cameras=replace(scene.cameras, T_world_camera=poses))
    near = replace(point, marks=((first, (u, v)), (second, (u + 0.5, v))))
    assert np.isnan(_intersected(near, hovering, frame)).all()


def test_marks_are_of_the_photographs_as_they_were_taken(tmp_path: Path):
    """Twice as wide as the scene's, and distorted by their lens."""
    truth = disk.survey(disk.BARREL)
    disk.write_colmap(tmp_path / "scene", truth)
    there = Similarity(1.0, np.eye(3), np.zeros(3))
    Georeference(FRAME, "GPS", there, Residuals(), Residuals(), Residuals(), (), ()).write(tmp_path / "scene")
    scene = load_scene(tmp_path / "scene", width=32, hold_out=False, calibrate=False, cache=tmp_path / "cache")

    def marks_of(point: np.ndarray) -> dict[str, np.ndarray]:
        """Distorted pixels in the photographs that show a point."""
        each = zip(truth.names, truth.lenses, truth.T_world_camera, strict=True)
        shown = {name: disk.observe(lens, pose, point[None]) for name, lens, pose in each}
        return {name: uv[0] for name, (uv, inside) in shown.items() if inside[0]}

    point = max(truth.ground[::7], key=lambda one: len(marks_of(one)))
    east, north, up = place = FRAME.to_crs(point[None])[0]
    lines = [f"{east:.6f} {north:.6f} {up:.6f} {u:.4f} {v:.4f} {n} peg" for n, (u, v) in marks_of(point).items()]
    assert len(lines) > 3
    (tmp_path / "check.txt").write_text("\n".join(["EPSG:27700", *lines]))
    own = map_frame(scene, read_georeference(scene.root))
    [found] = read_check_points(tmp_path / "check.txt", scene, own)
    assert len(found.marks) == len(lines)
    np.testing.assert_allclose(_intersected(found, scene, own), place, atol=2e-3)


def test_points_without_marks_have_a_height_only_and_those_outside_have_none(
    scene: Scene, frame: MapFrame, tmp_path: Path
):
    (tmp_path / "levelled.txt").write_text("EPSG:27700\n351200 512900 260.1 peg\n400000 512900 260 far\n")
    points = read_check_points(tmp_path / "levelled.txt", scene, frame)
    grid = Grid(frame, 351_190.0, 512_910.0, 0.5, 40, 40, 260.0)
    found = summary(check(points, scene, grid, *written(tmp_path, grid, np.full((40, 40), 260.0))))
    assert [found["vertical"][key] for key in ("n", "nmad", "within_1_96_sigma")] == [1, 0.0, 1.0]
    assert found["vertical"]["mean"] == pytest.approx(-0.1, abs=1e-4)
    assert found["horizontal_rmse"] is None
    assert [one["up"] for one in found["each"]] == [pytest.approx(-0.1, abs=1e-4), None]


def test_points_without_names_are_those_of_their_positions(scene: Scene, frame: MapFrame, tmp_path: Path):
    one, two = scene.names[:2]
    lines = (f"1 2 3 10 20 {one}", f"4 5 6 30 40 {one}", f"1 2 3 11 21 {two}", "1 2 3 5 6 gone photograph.jpg")
    (tmp_path / "check.txt").write_text("\n".join(("EPSG:27700", *lines, "7 8 9 50 60 gone.jpg peg")))
    points = read_check_points(tmp_path / "check.txt", scene, frame)
    assert [(point.name, [index for index, _ in point.marks]) for point in points] == [
        ("point 1", [0, 1]),
        ("point 2", [0]),
        ("peg", []),
    ]


def test_a_name_may_have_spaces(scene: Scene, frame: MapFrame, tmp_path: Path):
    (tmp_path / "check.txt").write_text("EPSG:27700\n1 2 3 GCP 1\n4 5 6\tGCP 2\n")
    assert [p.name for p in read_check_points(tmp_path / "check.txt", scene, frame)] == ["GCP 1", "GCP 2"]


@pytest.mark.parametrize(("crs", "refused"), [("EPSG:27700+5701", True), ("EPSG:27700", False), ("EPSG:4979", False)])
def test_heights_over_a_geoid_do_not_check_a_map_over_the_ellipsoid(
    scene: Scene, tmp_path: Path, crs: str, refused: bool
):
    local = LocalFrame.at("EPSG:27700", (351200.0, 512900.0, 260.0), "the WGS 84 ellipsoid")
    wkt = parse_crs(local.crs).to_wkt()
    frame = replace(map_frame(scene, None), frame=local, heights=local.vertical_datum, wkt=wkt)
    (tmp_path / "check.txt").write_text(f"{crs}\n1 2 3 peg\n")
    if refused:
        with pytest.raises(RunError, match="those of the map over the WGS 84 ellipsoid: expected one vertical datum"):
            read_check_points(tmp_path / "check.txt", scene, frame)
    else:
        assert len(read_check_points(tmp_path / "check.txt", scene, frame)) == 1


def test_a_point_at_two_positions_is_refused(scene: Scene, frame: MapFrame, tmp_path: Path):
    (tmp_path / "check.txt").write_text("EPSG:27700\n1 2 3 peg\n1 2 4 peg\n")
    with pytest.raises(RunError, match="expected one position per point"):
        read_check_points(tmp_path / "check.txt", scene, frame)


@pytest.mark.parametrize(
    "text", ["", "EPSG:27700\n", "EPSG:27700\n1 2\n", "nowhere\n1 2 3 a\n", "EPSG:27700\nnan 1 2 a\n"]
)
def test_a_damaged_file_is_refused(scene: Scene, frame: MapFrame, tmp_path: Path, text: str):
    (tmp_path / "check.txt").write_text(text)
    with pytest.raises(RunError, match="cannot be read as check points"):
        read_check_points(tmp_path / "check.txt", scene, frame)


def test_marks_that_undistorting_crops_are_left_out(tmp_path: Path):
    truth = disk.survey(disk.BARREL)
    disk.write_colmap(tmp_path / "scene", truth)
    there = Similarity(1.0, np.eye(3), np.zeros(3))
    Georeference(FRAME, "GPS", there, Residuals(), Residuals(), Residuals(), (), ()).write(tmp_path / "scene")
    scene = load_scene(tmp_path / "scene", hold_out=False, calibrate=False, cache=tmp_path / "cache")
    width, height = truth.lenses[0].width, truth.lenses[0].height
    corners = (-0.4 * width, -0.4 * height), (width / 2, height / 2), (width / 2, height / 3)
    each = zip(corners, truth.names, strict=False)
    lines = [f"351200 512900 260 {u:.3f} {v:.3f} {name} peg" for (u, v), name in each]
    (tmp_path / "check.txt").write_text("\n".join(["EPSG:27700", *lines]))
    own = map_frame(scene, read_georeference(scene.root))
    [found] = read_check_points(tmp_path / "check.txt", scene, own)
    assert len(found.marks) == 2
    assert np.isfinite(_intersected(found, scene, own)).all()


def test_each_point_checks_once_and_those_that_were_fitted_to_do_not(
    scene: Scene, frame: MapFrame, tmp_path: Path, caplog: pytest.LogCaptureFixture
):
    own = replace(scene, root=tmp_path)
    write_check_points(control(scene), tmp_path)
    (tmp_path / "again.txt").write_text((tmp_path / CHECK_FILE).read_text() + "351201 512902 260.3 G3\n")

    def found(given: Path | None, *fitted: str, at: tuple[float, ...] | None = None) -> list[str]:
        world = np.empty((0, 3)) if at is None else FRAME.from_crs(np.array([at]))
        residuals, none = Residuals(fitted, np.zeros((len(fitted), 3))), Residuals()
        itself = Similarity(1.0, np.eye(3), np.zeros(3))
        located = Georeference(FRAME, "ground control", itself, none, residuals, none, (), (), world)
        located.write(tmp_path)
        return [point.name for point in all_check_points(own, frame, given, read_georeference(tmp_path))]

    again = tmp_path / "again.txt"
    assert found(None) == ["CHK1", "chk 2"]
    assert found(again) == ["CHK1", "chk 2", "G3"]
    assert found(again, "G3") == ["CHK1", "chk 2"]
    assert "the scene was fitted to G3" in caplog.text
    # A peg is known by its place, too: names are not the same in all lists.
    assert found(again, "point 1", at=(351201.004, 512902.0, 260.31)) == ["CHK1", "chk 2"]
    assert found(again, "point 1", at=(351201.04, 512902.0, 260.3)) == ["CHK1", "chk 2", "G3"]
    assert all_check_points(own, map_frame(scene, None), None, None) == []
    assert "is not georeferenced" in caplog.text


def test_points_without_names_are_not_those_that_a_control_file_counts_alike(
    scene: Scene, frame: MapFrame, tmp_path: Path
):
    names, corners = (
        tuple(f"point {k + 1}" for k in range(4)),
        np.array([[x, y, 0.0] for x in (20, -20) for y in (20, -20)]),
    )
    itself, none = Similarity(1.0, np.eye(3), np.zeros(3)), Residuals()
    fitted = Residuals(names, np.zeros((4, 3)))
    there = Georeference(FRAME, "ground control", itself, none, fitted, none, (), (), corners)
    lines = [f"{351_200 + k} {512_900 + k} 260 10 20 {photograph}" for k in range(6) for photograph in scene.names[:2]]
    lines += ["351203 512901 260 point 2", "351220.4 512920.4 260 point 1", "351220.4 512879.6 260 10 20 gone.jpg"]
    (tmp_path / "check.txt").write_text("\n".join(["EPSG:27700", *lines[:12], lines[14]]))
    found = all_check_points(replace(scene, root=tmp_path), frame, tmp_path / "check.txt", there)
    assert [point.name for point in found] == [f"point {k + 1}" for k in range(7)]
    (tmp_path / "check.txt").write_text("\n".join(["EPSG:27700", *lines[12:14]]))
    found = all_check_points(replace(scene, root=tmp_path), frame, tmp_path / "check.txt", there)
    assert [point.name for point in found] == ["point 2"], "where no control point is; the other is within a metre"


@pytest.mark.parametrize("metre", [1.0, 3937 / 1200])
def test_a_list_that_is_printed_to_the_centimetre_has_the_same_points(
    scene: Scene, frame: MapFrame, tmp_path: Path, metre: float
):
    own = replace(scene, root=tmp_path)
    places = np.array([351_200, 512_900, 260]) + np.random.default_rng(0).uniform(-30, 30, (20, 3))
    for name, digits in ((CHECK_FILE, 6), ("rounded.txt", 2)):
        rows = [f"{x:.{digits}f} {y:.{digits}f} {z:.{digits}f} CHK{k}" for k, (x, y, z) in enumerate(places.tolist())]
        (tmp_path / name).write_text("\n".join(["EPSG:27700", *rows]))
    in_feet = replace(frame, metre_up=metre)
    assert len(all_check_points(own, in_feet, tmp_path / "rounded.txt", None)) == 20
    near = [f"{x} {y} {z + 0.03 * metre} near {k}" for k, (x, y, z) in enumerate(places[:2].tolist())]
    (tmp_path / "near.txt").write_text("\n".join(["EPSG:27700", *near]))
    assert len(all_check_points(own, in_feet, tmp_path / "near.txt", None)) == 22


def test_a_mark_that_is_listed_twice_is_one_and_two_in_one_photograph_are_refused(
    scene: Scene, frame: MapFrame, tmp_path: Path
):
    line = f"351200 512900 260 20 20 {scene.names[0]} peg"
    (tmp_path / "check.txt").write_text("\n".join(["EPSG:27700", line, line]))
    [point] = read_check_points(tmp_path / "check.txt", scene, frame)
    assert point.marks == ((0, (20.0, 20.0)),)
    assert np.isnan(_intersected(point, scene, frame)).all()
    (tmp_path / "check.txt").write_text("\n".join(["EPSG:27700", line, line.replace("20 20", "20.6 20.4")]))
    with pytest.raises(RunError, match=r"line 3 marks peg in .* a second time, at another pixel: expected one mark"):
        read_check_points(tmp_path / "check.txt", scene, frame)


def test_check_points_over_another_zero_are_refused(
    scene: Scene, frame: MapFrame, tmp_path: Path, caplog: pytest.LogCaptureFixture
):
    (tmp_path / "check.txt").write_text("EPSG:27700+5701\n351200 512900 210 peg\n")
    assert len(read_check_points(tmp_path / "check.txt", scene, frame)) == 1
    assert "heights in check.txt are over Ordnance Datum Newlyn, those of the map: unknown" in caplog.text
    known = replace(frame, wkt=parse_crs("EPSG:27700+5732").to_wkt())
    with pytest.raises(RunError, match="its heights are over Ordnance Datum Newlyn, those of the map over Belfast"):
        read_check_points(tmp_path / "check.txt", scene, known)


def test_a_scene_without_coordinates_has_no_check_points(scene: Scene, tmp_path: Path):
    (tmp_path / "check.txt").write_text("EPSG:27700\n1 2 3 a\n")
    with pytest.raises(RunError, match="not georeferenced"):
        read_check_points(tmp_path / "check.txt", scene, map_frame(scene, None))
