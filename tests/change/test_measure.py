"""Difference, level of detection, outlines and volumes against known changes."""

import math
from dataclasses import asdict, replace
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
import rasterio
import shapely
from surveys_of_two_dates import NORTH, WEST, noise, pair, write_surface

from tidefield.change.inputs import open_survey
from tidefield.change.measure import Change, Options, Register, _slopes, measure
from tidefield.change.page import limits
from tidefield.change.regions import Region, rasterised, read_regions
from tidefield.change.registration import Registration
from tidefield.change.shift import Shift
from tidefield.change.stable import sampled
from tidefield.change.surfaces import ChangeError, Grid, common_grid, open_surface
from tidefield.change.variogram import UNCORRELATED
from tidefield.change.volumes import ErrorModel, Volume
from tidefield.change.write import volume_rows, write_tables

AREA = 0.25


def measured(earlier: Path, later: Path, **options) -> Change:
    return measure(open_surface(earlier), open_surface(later), **options)


def east(grid) -> list[Region]:
    """The eastern part, which the pit is not in."""
    west, south, east, north = grid.bounds
    return [
        Region(
            "east",
            shapely.box(west + 0.75 * (east - west), south + 60, east, north).union(
                shapely.box(west, south, east, south + 12)
            ),
        )
    ]


def test_a_pit_and_a_heap_are_found_with_their_volumes(tmp_path: Path):
    earlier, later, truth = pair(tmp_path, 0, 0.10)
    found = measured(earlier, later)
    assert [volume.area_m2 > 100 for _, volume, _ in found.each].count(True) == 2
    for volume, sign in ((found.cut, -1), (found.fill, 1)):
        true = float((sign * truth).clip(min=0).sum()) * AREA
        low, high = volume.interval_m3
        assert low < true < high
        assert volume.value_m3 == pytest.approx(true, rel=0.1)


@pytest.mark.parametrize(("cells", "cell_m"), [(38, 0.8), (27, 1.5)])
def test_a_pit_across_a_survey_of_few_cells_leaves_stable_ground(cells: int, cell_m: float, tmp_path: Path):
    """Margins of windows of 21 cells would leave none."""
    rng = np.random.default_rng(5)
    rows, columns = cell_m * (np.indices((cells, cells)) - cells / 2)
    pit = -0.5 * (1 - (rows**2 + columns**2) / 36).clip(min=0)
    heights = (noise(rng, pit.shape, 0.005, 0.002, 2) for _ in range(2))
    earlier, later = (
        write_surface(tmp_path / f"{k}.tif", (10 + 0.02 * columns + k * pit + z).astype(np.float32), cell_m)
        for k, z in enumerate(heights)
    )
    found = measured(earlier, later)
    low, high = found.cut.interval_m3
    assert low < -pit.sum() * cell_m**2 < high
    assert high - low < 15
    assert found.false_alarms < 0.1


@pytest.mark.thorough
def test_heights_over_other_datums_are_refused_where_nothing_takes_the_difference(tmp_path: Path):
    surfaces = [open_surface(path) for path in pair(tmp_path, 0, 0.10)[:2]]
    one, other = (replace(surface, datum=datum) for surface, datum in zip(surfaces, ("sea", "take-off"), strict=True))
    asked = Options(register="none", datum_error_m=0.02)
    with pytest.raises(ChangeError, match=r"different vertical datums: sea and take-off.*leave --register none out"):
        measure(one, other, asked)
    alike = measure(one, replace(other, datum="sea"), asked, stable=east)
    assert not any("datums" in remark for remark in alike.remarks)
    remarks = " ".join(measure(one, other, stable=east).remarks)
    assert "heights are over different vertical datums: sea and take-off; only stable ground" in remarks


def test_a_shift_of_all_heights_is_taken_out_over_stable_ground(tmp_path: Path):
    earlier, later, truth = pair(tmp_path, 1, 0.10, shift=0.3)
    found = measured(earlier, later, stable=east)
    assert found.errors.registration.vertical_m == pytest.approx(0.3, abs=3 * found.errors.registration.systematic_m)
    assert found.errors.registration.systematic_m < 0.005
    low, high = found.net.interval_m3
    assert low < truth.sum() * AREA < high


def test_a_known_datum_error_enters_every_volume(tmp_path: Path):
    earlier, later, _ = pair(tmp_path, 2, 0.0)
    found = measured(earlier, later, stable=east, options=Options(register="none", datum_error_m=0.05))
    assert found.errors.registration.vertical_m == 0
    assert found.net.systematic_m3 == pytest.approx(0.05 * found.net.area_m2, rel=1e-6)
    assert found.net.datum_m3 == pytest.approx(found.net.systematic_m3)


def test_what_scattered_stable_ground_cannot_show_is_taken_for_granted_in_a_remark(tmp_path: Path):
    earlier, later, _ = pair(tmp_path, 2, 0.0)
    corners = [(WEST + 5.0 * k, NORTH - 5.0 * j - 0.5) for k in range(24) for j in range(20)]
    cells = Region("cells", shapely.MultiPolygon([shapely.box(x, y, x + 0.5, y + 0.5) for x, y in corners]))
    found = measured(earlier, later, stable=lambda grid: [cells])
    assert found.errors.registration.stable_cells == len(corners)
    assert any("shared within 5.0 m is taken for granted" in remark for remark in found.remarks)
    assert not any("taken for granted" in remark for remark in measured(earlier, later, stable=east).remarks)


def test_heights_that_share_control_and_disagree_have_the_disagreement_as_error(tmp_path: Path):
    earlier, later, _ = pair(tmp_path, 3, 0.0, shift=0.08)
    found = measured(earlier, later, stable=east, options=Options(register="none"))
    assert found.errors.registration.systematic_m == pytest.approx(0.08, abs=0.01)
    assert not found.net.significant


def test_where_nothing_changed_nothing_is_outlined_and_the_net_contains_zero(tmp_path: Path):
    alarms = []
    for seed in range(2):
        earlier, later, _ = pair(tmp_path, 10 + seed, 0.0)
        found = measured(earlier, later)
        assert found.cut.area_m2 + found.fill.area_m2 < 0.01 * found.net.area_m2
        alarms.append(found.false_alarms)
    assert np.mean(alarms) == pytest.approx(0.05, abs=0.015)


def test_volumes_of_polygons_are_given_one_by_one(tmp_path: Path):
    earlier, later, truth = pair(tmp_path, 4, 0.2)
    pit = Region("pit", shapely.Point(WEST + 30, NORTH - 30).buffer(14))
    level = Region("level", shapely.Point(WEST + 100, NORTH - 90).buffer(5))
    found = measured(earlier, later, stable=east, regions=lambda grid: [pit, level])
    (region, net, cut, fill, compared), nothing = found.per_region
    assert (nothing.cut.value_m3, np.signbit(nothing.cut.value_m3)) == (0, False)
    assert region.name == "pit"
    assert compared == 1
    assert net.value_m3 == pytest.approx(truth[:100, :110].sum() * AREA, rel=0.05)
    assert cut.value_m3 == pytest.approx(-net.value_m3, rel=0.05)
    assert fill.value_m3 == 0


def test_a_polygon_is_summed_in_its_own_rows_and_columns(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    earlier, later, _ = pair(tmp_path, 4, 0.2)
    pit = Region("pit", shapely.Point(WEST + 30, NORTH - 30).buffer(14))
    edge = Region("edge", shapely.LineString([(WEST + 110.3, NORTH - 90.1), (WEST + 130.2, NORTH - 93.7)]))
    whole, shapes = [rasterised([region], common_grid([open_surface(earlier)])) for region in (pit, edge)], []
    monkeypatch.setattr(
        "tidefield.change.regions.rasterised", lambda of, grid: shapes.append(grid.shape) or rasterised(of, grid)
    )
    found = measured(earlier, later, stable=east, regions=lambda grid: [pit, edge])
    assert shapes == [(59, 59), (10, 21)]
    for one, cells in zip(found.per_region, whole, strict=True):
        expected = found.errors.volume(found.dz, cells)
        assert asdict(one.net) == pytest.approx(asdict(expected))


def test_the_table_of_no_outlines_has_its_header(tmp_path: Path):
    change = measured(*pair(tmp_path, 2, 0.0)[:2], stable=east)
    write_tables(replace(change, each=[]), tmp_path)
    fields = "id,change,area_m2,volume_m3,low_m3,high_m3,mean_dz_m,largest_dz_m,east,north\n"
    assert (tmp_path / "outlines.csv").read_text() == fields


@pytest.mark.thorough
def test_polygons_that_are_compared_in_part_say_so(tmp_path: Path):
    earlier, later, _ = pair(tmp_path, 4, 0.2)
    with rasterio.open(later, "r+") as file:
        heights = file.read(1)
        heights[:, 200:] = np.nan
        file.write(heights, 1)
    regions = [
        Region("whole", shapely.box(WEST + 10, NORTH - 30, WEST + 40, NORTH - 10)),
        Region("over the edge", shapely.box(WEST - 30, NORTH - 30, WEST + 10, NORTH - 10)),
        Region("over a gap", shapely.box(WEST + 90, NORTH - 30, WEST + 110, NORTH - 10)),
        Region("a line over both", shapely.LineString([(WEST - 20, NORTH - 20), (WEST + 140, NORTH - 20)])),
        Region("in the gap", shapely.box(WEST + 105, NORTH - 30, WEST + 110, NORTH - 10)),
    ]
    found = measured(earlier, later, stable=east, regions=lambda grid: regions)
    compared = {one.region.name: one.compared for one in found.per_region}
    assert compared == pytest.approx(
        {"whole": 1, "over the edge": 0.25, "over a gap": 0.5, "a line over both": 100 / 160}, abs=0.01
    )
    assert any(
        r.startswith("polygons over the edge (25%), over a gap (50%), a line over both (6") for r in found.remarks
    )
    assert "polygon in the gap: no cell of both surveys is in it" in found.remarks
    inner = Region("all", shapely.box(WEST, NORTH - 100, WEST + 20, NORTH))
    limited = measured(earlier, later, stable=east, within=lambda grid: [inner], regions=lambda grid: regions[:1])
    assert limited.per_region[0].compared == pytest.approx(1 / 3, abs=0.02)
    assert any("have heights and --within reaches" in r for r in limited.remarks)
    rows = {(row["region"], row["volume"]): row["compared"] for row in volume_rows(found)}
    assert rows["over the edge", "cut"] == pytest.approx(0.25, abs=0.01)
    assert rows["all", "net"] is None


@pytest.mark.parametrize("stable", [False, True])
def test_what_one_survey_has_from_the_other_is_left_out(tmp_path: Path, stable: bool):
    earlier, later, _ = pair(tmp_path, 14, 0.2)
    with rasterio.open(earlier) as file:
        old = file.read(1)
    with rasterio.open(later, "r+") as file:
        heights = file.read(1) + 0.05  # another datum
        heights[:, :100] = old[:, :100]
        file.write(heights, 1)
    half = Region("half", shapely.box(WEST + 1, NORTH - 99, WEST + 119, NORTH - 70))
    found = measured(earlier, later, stable=(lambda grid: [half]) if stable else None)
    assert any("42% of the cells have the same height" in r and "left out" in r for r in found.remarks)
    assert np.isnan(found.dz[:, :100]).all()
    assert found.net.area_m2 == pytest.approx(70 * 100)
    alone = tmp_path / "alone"
    alone.mkdir()
    for path in (earlier, later):
        with rasterio.open(path) as file:
            write_surface(alone / path.name, file.read(1)[:, 100:], west=WEST + 50)
    expected = measured(alone / earlier.name, alone / later.name, stable=(lambda grid: [half]) if stable else None)
    assert found.net.value_m3 == pytest.approx(expected.net.value_m3, rel=1e-3, abs=0.1)
    assert found.net.sigma_m3 == pytest.approx(expected.net.sigma_m3, rel=0.1)


def test_heights_that_are_nearly_all_the_same_are_said_to_have_no_errors(tmp_path: Path):
    earlier, later, _ = pair(tmp_path, 15, 0.2)
    with rasterio.open(earlier) as file:
        heights = file.read(1)
    heights[20:40, 20:40] += 0.3  # as those who try it do
    write_surface(later, heights)
    found = measured(earlier, later, stable=east)
    assert found.fill.value_m3 == pytest.approx(0.3 * 100, rel=0.05)
    assert any("99% of the cells have the same height" in r and "too small" in r for r in found.remarks)
    found = measured(earlier, earlier)
    assert any("all heights are the same" in r for r in found.remarks)


def rounded_pair(
    folder: Path, step: float, noise_m: float, offset_m: float = 0.0, copied: int = 0, lift_m: float = 0.0
) -> list[Path]:
    """Two surveys on a flat with a slope, rounded; the later one has some columns from the earlier."""
    rng, (rows, columns) = np.random.default_rng(16), np.indices((160, 180))
    flat, paths, first = 4 + 0.013 * columns + 0.007 * rows, [], None
    for name, lift in (("a", 0.0), ("b", lift_m * (np.hypot(rows - 80, columns - 120) < 20) + offset_m)):
        heights = np.rint((flat + lift + rng.normal(0, noise_m, flat.shape)) / step) * step
        first = heights if first is None else first
        heights[:, :copied] = first[:, :copied]
        paths.append(write_surface(folder / f"{name}.tif", heights.astype(np.float32)))
    return paths


@pytest.mark.thorough
@pytest.mark.parametrize("step", [0.1, 0.25])
@pytest.mark.parametrize("with_sigma", [False, True])
def test_errors_of_rounded_heights_are_at_least_those_of_the_rounding(tmp_path: Path, step: float, with_sigma: bool):
    paths = rounded_pair(tmp_path, step, 0.004, lift_m=0.6)
    for path in paths if with_sigma else ():
        write_surface(path.with_name(f"{path.stem}_sigma.tif"), np.full((160, 180), 0.004, np.float32))
    found = measured(*paths)
    least = step / math.sqrt(6)
    assert any(f"heights are rounded, by which they are off by {least:.3g} m" in r for r in found.remarks)
    assert 0.999 * least < np.median(found.errors.sigma) < 1.7 * least
    assert not any("the same height" in r for r in found.remarks)
    low, high = found.fill.interval_m3
    assert low < 0.6 * math.pi * 20**2 * AREA < high


@pytest.mark.thorough
@pytest.mark.parametrize(("step", "noise_m", "offset_m"), [(0.1, 0.03, 0.03), (0.05, 0.015, 0.02), (0.05, 0.004, 0.01)])
@pytest.mark.parametrize("register", ["vertical", "none"])
def test_the_shift_of_rounded_heights_is_no_whole_step(
    tmp_path: Path, step: float, noise_m: float, offset_m: float, register: Register
):
    found = measured(*rounded_pair(tmp_path, step, noise_m, offset_m), stable=east, options=Options(register=register))
    if register == "vertical":
        assert found.errors.registration.vertical_m == pytest.approx(offset_m, abs=0.1 * step)
    else:
        assert found.errors.registration.systematic_m == pytest.approx(offset_m, abs=0.1 * step)


@pytest.mark.parametrize("step", [0.001, 0.01])
def test_copied_cells_are_found_among_rounded_ones(tmp_path: Path, step: float):
    found = measured(*rounded_pair(tmp_path, step, 0.03, copied=60), stable=east)
    assert np.isnan(found.dz[:, :58]).all()
    assert np.isfinite(found.dz[:, 62:]).mean() > 0.99
    assert any("33% of the cells have the same height" in r for r in found.remarks)
    assert not any("rounded" in r for r in found.remarks), "the noise is larger"


def test_copied_cells_are_found_where_the_later_survey_is_shifted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("tidefield.change.measure.find_shift", lambda *_: Shift(0.13, -0.08, 0.01, 50, 50, 0.5))
    paths = rounded_pair(tmp_path, 0.001, 0.03, copied=60)
    surveys = [replace(open_surface(path), orthophoto=path) for path in paths]
    found = measure(*surveys, Options(shift="images"), stable=east)
    assert np.isnan(found.dz[5:-5, 5:58]).all()
    assert np.isfinite(found.dz[5:-5, 64:-5]).all()


def test_what_the_choice_of_an_outline_adds_takes_no_more_than_there_is():
    few = Volume(1.0, 0.1, 0.1, 0.1, 10.0).chosen(3.0, 0.5)
    assert (few.value_m3, few.bias_m3) == (0.0, 1.0)
    assert Volume(5.0, 0.1, 0.1, 0.1, 10.0).chosen(3.0, 0.5).value_m3 == 2.0


def test_standard_errors_of_the_cells_are_used_and_calibrated(tmp_path: Path):
    rng, shape = np.random.default_rng(5), (200, 200)
    sigma = np.where(np.arange(200)[None] < 100, 0.01, 0.04) * np.ones(shape)
    for name in ("early", "late"):
        write_surface(tmp_path / f"{name}.tif", (sigma * rng.normal(size=shape)).astype(np.float32))
        # The surveys' own estimates are half of the truth.
        write_surface(tmp_path / f"{name}_sigma.tif", (sigma / 2).astype(np.float32))
    found = measured(tmp_path / "early.tif", tmp_path / "late.tif")
    assert isinstance(found.errors.sigma, np.ndarray)
    assert found.errors.sigma[50, 20] == pytest.approx(0.01 * np.sqrt(2), rel=0.05)
    assert found.errors.sigma[50, 180] == pytest.approx(0.04 * np.sqrt(2), rel=0.05)


@pytest.mark.parametrize("unknown", [np.nan, 0.0])
def test_cells_that_are_left_out_for_want_of_a_standard_error_are_remarked(tmp_path: Path, unknown: float):
    earlier, later, _ = pair(tmp_path, 6, 0.1)
    sigma = np.full((200, 240), 0.02, np.float32)
    sigma[:, :120] = unknown
    for path in (earlier, later):
        write_surface(path.with_name(f"{path.stem}_sigma.tif"), sigma)
    found = measured(earlier, later, stable=east)
    assert found.net.area_m2 == 200 * 120 * AREA
    [remark] = [remark for remark in found.remarks if "no standard error" in remark]
    assert remark.startswith("50.0% of the cells, 6,000 m², have no standard error above 0 in one survey or both (")
    assert "(early_6_sigma.tif, late_6_sigma.tif)" in remark


def test_the_comparison_is_limited_to_polygons(tmp_path: Path):
    earlier, later, _ = pair(tmp_path, 6, 0.1)
    area = Region("area", shapely.box(WEST, NORTH - 50, WEST + 50, NORTH))
    found = measured(earlier, later, within=lambda grid: [area], stable=east)
    assert found.net.area_m2 == pytest.approx(2500, rel=0.01)
    assert found.errors.registration.stable_cells > 1000


def test_stable_ground_is_found_outside_of_what_is_asked_about(tmp_path: Path):
    earlier, later, truth = pair(tmp_path, 6, 0.1)
    area = Region("pit", shapely.box(WEST + 16, NORTH - 44, WEST + 44, NORTH - 16))
    found = measured(earlier, later, within=lambda grid: [area])
    true = float(truth[32:88, 32:88].sum()) * AREA
    assert found.net.value_m3 == pytest.approx(true, rel=0.1)
    assert found.net.interval_m3[0] < true < found.net.interval_m3[1]
    assert found.net.area_m2 == pytest.approx(28**2, rel=0.01)


@pytest.mark.thorough
def test_parts_of_the_survey_share_what_the_choice_of_outlines_adds(tmp_path: Path):
    earlier, later, _ = pair(tmp_path, 4, 0.2)
    halves = [
        Region("west", shapely.box(WEST, NORTH - 100, WEST + 60, NORTH)),
        Region("east", shapely.box(WEST + 60, NORTH - 100, WEST + 120, NORTH)),
        Region("all of it", shapely.box(WEST, NORTH - 100, WEST + 120, NORTH)),
    ]
    found = measured(earlier, later, stable=east, regions=lambda grid: halves)
    assert found.cut.bias_m3 != 0
    for k, whole in ((2, found.cut), (3, found.fill)):
        one, other, both = (volumes[k] for volumes in found.per_region)
        assert one.value_m3 + other.value_m3 == pytest.approx(whole.value_m3)
        assert both == whole


def test_a_part_that_only_one_survey_has_is_refused(tmp_path: Path):
    import rasterio

    earlier, later, _ = pair(tmp_path, 6, 0.1)
    with rasterio.open(later, "r+") as file:
        heights = file.read(1)
        heights[:40, :40] = np.nan
        file.write(heights, 1)
    creek = Region("creek", shapely.box(WEST + 1, NORTH - 19, WEST + 19, NORTH - 1))
    with pytest.raises(ChangeError, match="no cell with heights of both within the polygons"):
        measured(earlier, later, within=lambda grid: [creek], stable=east)


def test_too_little_stable_ground_is_refused(tmp_path: Path):
    earlier, later, _ = pair(tmp_path, 7, 0.1)
    spot = Region("spot", shapely.Point(WEST + 30, NORTH - 30).buffer(1))
    with pytest.raises(ChangeError, match="stable ground"):
        measured(earlier, later, stable=lambda grid: [spot])


def test_a_tilt_needs_stable_ground_on_all_sides(tmp_path: Path):
    earlier, later, _ = pair(tmp_path, 8, 0.0)
    corner = Region("corner", shapely.box(WEST, NORTH - 40, WEST + 40, NORTH))
    with pytest.raises(ChangeError, match="all sides"):
        measured(earlier, later, stable=lambda grid: [corner], options=Options(register="tilt"))


@pytest.mark.thorough
def test_a_tilt_is_found(tmp_path: Path):
    earlier, later, _ = pair(tmp_path, 9, 0.0)
    import rasterio

    with rasterio.open(later, "r+") as file:
        tilted = file.read(1) + (0.002 * 0.5 * np.arange(240)[None] - 0.001 * 0.5 * np.arange(200)[:, None])
        file.write(tilted.astype(np.float32), 1)
    found = measured(earlier, later, options=Options(register="tilt"))
    np.testing.assert_allclose(
        found.stable_before_dz - found.stable_dz,
        sampled(found.errors.registration.plane(found.grid, slice(0, 200)), found.stable),
        atol=1e-5,
    )
    _, gx, gy = found.errors.registration.coefficients
    assert gx == pytest.approx(0.002, abs=2e-4)
    assert gy == pytest.approx(0.001, abs=2e-4)
    assert np.nanstd(found.dz) < 0.03


def test_a_change_smaller_than_the_tilt_is_found_where_stable_ground_is_not_given(tmp_path: Path):
    earlier, later, truth = pair(tmp_path, 9, 0.1)
    with rasterio.open(later, "r+") as file:
        tilted = file.read(1) + 0.004 * 0.5 * np.arange(240)[None] - 0.002 * 0.5 * np.arange(200)[:, None]
        file.write(tilted.astype(np.float32), 1)
    found = measured(earlier, later, options=Options(register="tilt"))
    _, gx, gy = found.errors.registration.coefficients
    assert (gx, gy) == pytest.approx((0.004, 0.002), abs=2e-4)
    for volume, sign in ((found.cut, -1), (found.fill, 1)):
        low, high = volume.interval_m3
        assert low < float((sign * truth).clip(min=0).sum()) * AREA < high


def test_after_a_tilt_cells_far_out_share_a_larger_error(tmp_path: Path):
    earlier, later, _ = pair(tmp_path, 9, 0.0)
    ring = Region("all", shapely.box(WEST, NORTH - 100, WEST + 120, NORTH))
    errors = measured(earlier, later, stable=lambda grid: [ring], options=Options(register="tilt")).errors
    near = errors.near_sigma()
    assert isinstance(near, np.ndarray)
    np.testing.assert_allclose(near, errors.registration.deviation(errors.grid, slice(0, 200)))
    assert near[0, 0] > 2 * near[100, 120]


@pytest.mark.thorough
def test_an_outline_has_the_systematic_error_of_its_own_cells(tmp_path: Path):
    earlier, later, _ = pair(tmp_path, 9, 0.3)
    found = measured(earlier, later, options=Options(register="tilt", datum_error_m=0.02))
    assert len(found.each) >= 2
    for number, volume, _ in found.each:
        inside = found.outlines.labels == number
        expected = found.errors.registration.deviation_of_sum(found.grid, inside) * AREA
        assert volume.systematic_m3 == pytest.approx(expected)
        assert volume.datum_m3 == pytest.approx(0.02 * volume.area_m2)


def test_an_error_of_the_shift_adds_up_over_a_slope_and_cancels_out_over_a_hill():
    error, slope, rows, columns = 0.02, 0.3, 60, 80
    grid, none = Grid(None, 0.0, 0.0, 0.5, columns, rows), (0.0, 0.0, 0.0)
    covariance = np.diag([0.003**2, 0.0, 0.0])
    registration = Registration("none", none, covariance, (20.0, -15.0), 100, none, none, shift_error_m=error)
    north, east = np.meshgrid(np.linspace(1, -1, rows), np.linspace(-1, 1, columns), indexing="ij")
    plane = np.stack([np.full(grid.shape, slope), np.zeros(grid.shape)]).astype(np.float32)
    hill = np.stack([-slope * east, -slope * north]).astype(np.float32)
    dz, every = np.zeros(grid.shape, np.float32), np.ones(grid.shape, bool)
    part = every & (east > 0)
    box = (slice(0, rows), slice(columns // 2, columns))
    for region in (every, part):
        area = float(region.sum()) * AREA
        on_plane = ErrorModel(0.05, UNCORRELATED, registration, grid, slopes=plane).volume(dz, region)
        assert on_plane.systematic_m3 == pytest.approx(math.hypot(0.003 * area, slope * error * area))
        assert on_plane.random_m3 == pytest.approx(0.05 * math.sqrt(region.sum()) * AREA)
    on_hill = ErrorModel(0.05, UNCORRELATED, registration, grid, slopes=hill)
    assert on_hill.volume(dz, every).systematic_m3 == pytest.approx(0.003 * every.sum() * AREA)
    assert on_hill.systematic_of_sum(part[box], box) == pytest.approx(on_hill.systematic_of_sum(part))
    assert asdict(on_hill.volume(dz[box], part[box], box=box)) == pytest.approx(asdict(on_hill.volume(dz, part)))
    assert on_hill.cell_sigma(slice(0, 1))[0, 0] == pytest.approx(math.hypot(0.05, 0.003, slope * error * math.sqrt(2)))


def test_slopes_are_those_to_the_east_and_to_the_north_without_seams(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    east, north = np.broadcast_arrays(0.5 * np.arange(40), 0.5 * np.arange(30)[::-1, None])
    bowl = (0.3 * east - 0.1 * north + 0.01 * east**2 + 0.02 * north**2).astype(np.float32)
    surface = open_surface(write_surface(tmp_path / "bowl.tif", bowl))
    monkeypatch.setattr(Grid, "strips", lambda self: [slice(k, k + 10) for k in (0, 10, 20)])
    found = _slopes(surface, common_grid([surface]))
    for slopes, expected in zip(found, (0.3 + 0.02 * east, -0.1 + 0.04 * north), strict=True):
        np.testing.assert_allclose(slopes[1:-1, 1:-1], expected[1:-1, 1:-1], atol=1e-4)


@pytest.mark.parametrize("register", ["none", "vertical"])
def test_the_error_of_a_shift_on_a_slope_is_what_the_vertical_registration_leaves(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, register: Register
):
    earlier, later, _ = pair(tmp_path, 12, 0.0)
    error, steep = 0.05, np.where(np.arange(240) < 120, 0.0, 0.4)
    for path in (earlier, later):
        with rasterio.open(path, "r+") as file:
            file.write((file.read(1) + 0.5 * np.cumsum(steep)).astype(np.float32), 1)
    monkeypatch.setattr("tidefield.change.measure.find_shift", lambda *_: Shift(0.0, 0.0, error, 50, 50, 0.5))
    surveys = [replace(open_surface(path), orthophoto=path) for path in (earlier, later)]
    flat = Region("flat", shapely.box(WEST, NORTH - 100, WEST + 58, NORTH))
    rest = Region("rest", shapely.box(WEST + 62, NORTH - 100, WEST + 120, NORTH))
    asked = Options(register=register, shift="images", datum_error_m=0.0)
    found = measure(*surveys, asked, stable=lambda grid: [flat], regions=lambda grid: [flat, rest])
    (_, level, *_), (_, slope, *_) = found.per_region
    own = found.errors.registration.systematic_m
    assert slope.systematic_m3 == pytest.approx(math.hypot(own, 0.4 * error) * slope.area_m2, rel=0.02)
    assert level.systematic_m3 < 0.02 * slope.systematic_m3 + own * level.area_m2
    everywhere = Region("both", shapely.box(WEST, NORTH - 100, WEST + 120, NORTH))
    found = measure(*surveys, asked, stable=lambda grid: [everywhere])
    whole = 0.2 * error * found.net.area_m2 if register == "none" else 0.0
    own = found.errors.registration.systematic_m
    assert found.net.systematic_m3 == pytest.approx(math.hypot(own * found.net.area_m2, whole), rel=0.03)


@pytest.mark.thorough
@pytest.mark.parametrize(("shift", "found_by_pictures"), [("none", False), ("auto", False), ("auto", True)])
def test_a_stated_error_of_the_shift_counts_on_slopes_unless_a_shift_is_measured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shift: Literal["none", "auto"], found_by_pictures: bool
):
    earlier, later, _ = pair(tmp_path, 12, 0.0)
    for path in (earlier, later):
        with rasterio.open(path, "r+") as file:
            file.write((file.read(1) + 0.2 * np.arange(240, dtype=np.float32)), 1)  # 0.4 of cells of 0.5 m
    tells = Shift(0.0, 0.0, 0.01, 50, 50, 0.5) if found_by_pictures else Shift(None, None, math.nan, 50, 3, 0.5)
    monkeypatch.setattr("tidefield.change.measure.find_shift", lambda *_: tells)
    surveys = [replace(open_surface(path), orthophoto=path) for path in (earlier, later)]
    found = measure(*surveys, Options(register="vertical", shift=shift, shift_error_m=0.05), stable=east)
    bare = measure(*surveys, Options(register="vertical", shift=shift), stable=east)
    # A vertical registration takes out what the error does on the mean slope, which is all of this one.
    slope = Options(register="none", shift="none", datum_error_m=0.0, shift_error_m=0.05)
    net = measure(*surveys, slope, stable=east).net
    assert net.systematic_m3 == pytest.approx(0.4 * 0.05 * found.net.area_m2, rel=0.02)
    assert found.errors.registration.shift_error_m == (0.01 if found_by_pictures else 0.05)
    assert bare.errors.registration.shift_error_m == (0.01 if found_by_pictures else 0.0)
    # What was stated is not widened for little stable ground.
    assert net.datum_m3 == pytest.approx(net.systematic_m3)
    mentioned = any("0.05 m that was stated" in limit for limit in limits(found))
    assert mentioned == (not found_by_pictures)
    assert any("compared where they lie" in limit for limit in limits(bare)) == (not found_by_pictures)
    remarks = " ".join(found.remarks)
    assert ("0.05 m that was stated counts on slopes" in remarks) == (shift == "auto" and not found_by_pictures)
    assert any("(--shift-error)" in remark for remark in bare.remarks) == (shift == "auto" and not found_by_pictures)


def test_polygons_that_cannot_be_read_are_found_before_heights_are(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    earlier, later, _ = pair(tmp_path, 0, 0.1)
    monkeypatch.setattr("tidefield.change.measure.read_difference", lambda *_, **__: pytest.fail("it was measured"))

    def unreadable(grid: Grid) -> list[Region]:
        raise ChangeError("cannot be read")

    for option in ("stable", "within", "regions"):
        with pytest.raises(ChangeError, match="cannot be read"):
            measure(open_surface(earlier), open_surface(later), **{option: unreadable})


def test_a_comparison_within_copied_heights_is_made_with_a_remark(tmp_path: Path):
    earlier, later, _ = pair(tmp_path, 0, 0.1)
    gap = np.s_[20:60, 100:160]
    with rasterio.open(earlier) as file:
        copied = file.read(1)[gap]
    with rasterio.open(later, "r+") as file:
        heights = file.read(1)
        heights[gap] = copied
        file.write(heights, 1)
    box = Region("gap", shapely.box(WEST + 52, NORTH - 28, WEST + 78, NORTH - 12))
    found = measured(earlier, later, options=Options(register="none"), stable=east, within=lambda grid: [box])
    assert found.net.value_m3 == pytest.approx(0, abs=1e-3)
    assert any("as if one had them from the other: errors are too small" in remark for remark in found.remarks)


@pytest.mark.thorough
def test_the_order_of_windows_does_not_matter(tmp_path: Path):
    earlier, later, _ = pair(tmp_path, 0, 0.06)
    one, other = (measured(earlier, later, stable=east, options=Options(windows=w)) for w in ((5, 11, 21), (21, 5, 11)))
    np.testing.assert_array_equal(one.outlines.labels, other.outlines.labels)
    assert one.cut.value_m3 == pytest.approx(other.cut.value_m3)


def test_polygons_of_one_name_stay_apart_and_none_is_called_as_the_whole(tmp_path: Path):
    import json

    names = ["mud", "mud", "all", "", "mud (2)"]
    corners = [(0, 0), (10, 0), (10, 10), (0, 0)]
    shapes = [[[WEST + x, NORTH - 20 + y] for x, y in corners] for _ in names]
    features = [
        {"type": "Feature", "properties": {"name": name}, "geometry": {"type": "Polygon", "coordinates": [shape]}}
        for name, shape in zip(names, shapes, strict=True)
    ]
    system = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::32630"}}
    path = tmp_path / "a.geojson"
    path.write_text(json.dumps({"type": "FeatureCollection", "crs": system, "features": features}))
    grid = common_grid([open_surface(write_surface(tmp_path / "a.tif", np.zeros((100, 100), np.float32)))])
    found = [region.name for region in read_regions(path, grid)]
    assert found == ["mud", "mud (2)", "all (2)", "4", "mud (2) (2)"]


def test_a_folder_of_maps_is_opened_by_its_names(tmp_path: Path):
    write_surface(tmp_path / "odm_dem/dsm.tif", np.zeros((20, 20), np.float32))
    write_surface(tmp_path / "odm_orthophoto/odm_orthophoto.tif", np.zeros((3, 20, 20), np.uint8))
    found = open_survey(tmp_path, "2024-05-01")
    assert found.path.name == "dsm.tif"
    assert found.orthophoto is not None
    assert found.name == "2024-05-01"
    with pytest.raises(ChangeError, match="no surface"):
        open_survey(tmp_path / "odm_orthophoto")
