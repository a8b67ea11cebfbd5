"""Photographs of low quality are found by stated limits, on synthetic and real surveys."""

import math
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from camera_files import BRIGHTON, exif, photograph, real_survey, survey_folder, texture, xmp
from located_surveys import unlocated_photograph
from PIL import Image

from tidefield.errors import SurveyError
from tidefield.survey.io.image_decoding import upright
from tidefield.survey.io.photographs import read_survey
from tidefield.survey.quality.assessment import (
    QualityDecision,
    _blurred,
    _flat_or_badly_exposed,
    assess_quality,
    find_beyond_gap,
    select_photographs,
)
from tidefield.survey.quality.measures import Measures, sharpness
from tidefield.survey.survey import Control, Mark, Photograph, Survey

SIZE = (400, 300)
GROUND = texture((1800, 900), seed=7)


def view(left: int, top: int = 100) -> np.ndarray:
    """The image of the synthetic ground from one position."""
    return GROUND[top : top + SIZE[1], left : left + SIZE[0]]


def with_light(pixels: np.ndarray, factor: float) -> np.ndarray:
    """The same photograph with as many times the light."""
    values = pixels / 255
    linear = np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4) * factor
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055)
    return np.clip(np.round(encoded * 255), 0, 255).astype(np.uint8)


def moved(pixels: np.ndarray, length_px: int, angle_deg: float) -> np.ndarray:
    """Blurred by a movement along one direction, with the sensor's noise on top."""
    kernel = np.zeros((2 * length_px + 1,) * 2, np.float32)
    for along in np.linspace(-length_px / 2, length_px / 2, 16 * length_px):
        x, y = (length_px + along * part for part in (math.cos(angle_deg), math.sin(angle_deg)))
        kernel += np.maximum(0, 1 - np.abs(np.arange(len(kernel)) - x)) * np.maximum(
            0, 1 - np.abs(np.arange(len(kernel)) - y)
        ).reshape(-1, 1)
    blurred = cv2.filter2D(pixels, -1, kernel / kernel.sum()).astype(np.float64)
    return np.clip(blurred + np.random.default_rng(0).normal(0, 1.5, pixels.shape), 0, 255).astype(np.uint8)


def hovering(pixels: np.ndarray) -> np.ndarray:
    """The same place a moment later: a few pixels aside, a little turned, a little darker, with other noise."""
    height, width = pixels.shape[:2]
    turn = cv2.getRotationMatrix2D((width / 2, height / 2), 0.8, 1.005) + np.array([[0, 0, 0.006 * width], [0, 0, 2]])
    moved_on = cv2.warpAffine(pixels, turn, (width, height), borderMode=cv2.BORDER_REFLECT)
    noise = np.random.default_rng(1).normal(0, 3, pixels.shape)
    return np.clip(moved_on * 0.85 + noise, 0, 255).astype(np.uint8)


def flight(folder: Path, count: int = 10, **others: np.ndarray) -> Survey:
    """A strip of photographs that overlap by two thirds, and others."""
    for index in range(count):
        place = BRIGHTON[0] + 1.2e-4 * index, BRIGHTON[1]
        photograph(folder / f"f{index:02d}.jpg", table=exif(place=place), pixels=view(130 * index))
    for name, pixels in others.items():
        photograph(folder / f"{name}.jpg", pixels=pixels)
    return read_survey(folder)


def left_out(survey: Survey) -> dict[str, str]:
    return {decision.name: decision.left_out for decision in assess_quality(survey) if decision.left_out}


def test_all_photographs_of_a_good_flight_are_kept_and_progress_is_reported(tmp_path):
    survey = flight(tmp_path)
    reported = []
    decisions = assess_quality(survey, lambda done, of: reported.append((done, of)))
    assert [decision.name for decision in decisions] == [photograph.name for photograph in survey.photographs]
    assert all(decision.left_out is None and decision.measures for decision in decisions)
    assert reported == [(index, 10) for index in range(1, 11)]
    assert select_photographs(survey, decisions) == survey


@pytest.mark.parametrize("angle_deg", [0, 30, 45, 90, 120])
def test_a_photograph_blurred_by_motion_in_any_direction_is_found(tmp_path, angle_deg):
    found = left_out(flight(tmp_path, blurred=moved(view(500, 300), 6, math.radians(angle_deg))))
    assert list(found) == ["blurred.jpg"]
    assert found["blurred.jpg"].startswith("blurred: its sharpness is 0.")
    assert "is the limit" in found["blurred.jpg"]


def test_a_photograph_out_of_focus_is_found(tmp_path):
    assert list(left_out(flight(tmp_path, soft=cv2.GaussianBlur(view(500, 300), (0, 0), 2.5)))) == ["soft.jpg"]


def test_smooth_mud_is_not_blurred(tmp_path):
    smooth = cv2.GaussianBlur(view(500, 300).astype(np.float32), (0, 0), 6)
    mud = 120 + 0.5 * (smooth - smooth.mean())
    for index in range(40):  # shells and runnels, in a seventh of the picture
        x, y = 20 + 9 * (index % 20), 40 + 130 * (index // 20)
        mud[y : y + 3, x : x + 3] += 40
    noise = np.random.default_rng(3).normal(0, 1.5, mud.shape)
    bare = np.full_like(mud, 120) + noise
    survey = flight(tmp_path, mud=np.clip(mud + noise, 0, 255).astype(np.uint8), bare=bare.astype(np.uint8))
    decisions = {decision.name: decision for decision in assess_quality(survey)}
    assert decisions["mud.jpg"].left_out is None
    bare_measures = decisions["bare.jpg"].measures
    assert bare_measures is not None
    assert math.isnan(bare_measures.sharpness)  # too little texture: it is flat, not blurred
    assert (decisions["bare.jpg"].left_out or "").startswith("flat")


def test_noise_and_contrast_do_not_change_sharpness():
    grey = GROUND[:600, :800, 1].astype(np.float32)
    noisy = grey + np.random.default_rng(2).normal(0, 1.5, grey.shape).astype(np.float32)
    assert sharpness(noisy) == pytest.approx(sharpness(grey), rel=0.15)
    assert sharpness(100 + 0.5 * (grey - 100)) == pytest.approx(sharpness(grey), rel=0.1)


@pytest.mark.parametrize(("factor", "kind"), [(0.02, "under"), (0.1, "under"), (6, "over"), (20, "over")])
def test_a_badly_exposed_photograph_is_found(tmp_path, factor, kind):
    found = left_out(flight(tmp_path, odd=with_light(view(500, 300), factor)))
    assert list(found) == ["odd.jpg"]
    assert found["odd.jpg"].startswith(f"{kind}-exposed: ")
    assert "the limit" in found["odd.jpg"]


def test_one_stop_more_or_less_is_kept(tmp_path):
    assert not left_out(flight(tmp_path, less=with_light(view(500, 300), 0.5), more=with_light(view(900, 300), 2)))


def test_a_whole_survey_in_the_dark_is_found_and_one_at_dusk_kept(tmp_path):
    for share, name in ((0.01, "dark"), (0.08, "dusk")):
        for index in range(5):
            photograph(tmp_path / name / f"{index}.jpg", pixels=with_light(view(130 * index), share))
    assert not left_out(read_survey(tmp_path / "dusk"))
    found = left_out(read_survey(tmp_path / "dark"))
    assert len(found) == 5
    assert all(reason.startswith(("under-exposed", "flat")) for reason in found.values())
    of_lit_ground = Measures(0.3, 8.0, 15.0, 0.002, 0.0, 0.0, 18.1, 0.0)  # turin_lot at this share
    reason = _flat_or_badly_exposed(of_lit_ground, [of_lit_ground] * 6) or ""
    assert reason.startswith("under-exposed: 95% of it is darker than level 15 of 255, and 98% lies within 18 levels")


def test_what_is_transparent_is_neither_white_nor_sky(tmp_path):
    for index in range(5):
        alpha = np.zeros(SIZE[::-1], np.uint8)
        cv2.circle(alpha, (SIZE[0] // 2, SIZE[1] // 2), 140, 255, -1)
        photograph(tmp_path / f"{index}.png", pixels=np.dstack([view(130 * index), alpha]))
    survey = read_survey(tmp_path)
    assert all(p.has_alpha for p in survey.photographs)
    decisions = assess_quality(survey)
    assert not any(decision.left_out for decision in decisions)
    assert not any(decision.measures and decision.measures.white for decision in decisions)


def test_what_is_masked_is_not_judged(tmp_path):
    glare = view(500, 300).copy()
    glare[:, :200] = 255
    survey = flight(tmp_path, sky=sky(0.5), glare=glare)
    assert sorted(left_out(survey)) == ["glare.jpg", "sky.jpg"]
    for name, part in (("sky", np.s_[:150]), ("glare", np.s_[:, :200])):
        mask = np.full(SIZE[::-1], 255, np.uint8)
        mask[part] = 0
        photograph(tmp_path / "masks" / f"{name}.jpg.png", pixels=mask)
    decisions = {decision.name: decision for decision in assess_quality(read_survey(tmp_path))}
    assert not any(decision.left_out for decision in decisions.values())
    assert decisions["sky.jpg"].measures.sky == decisions["glare.jpg"].measures.white == 0


def test_a_mask_of_everything_is_no_mask(tmp_path):
    flight(tmp_path, count=5)
    photograph(tmp_path / "masks" / "f00.jpg.png", pixels=np.zeros(SIZE[::-1], np.uint8))
    assert not left_out(read_survey(tmp_path))


def test_neighbours_without_light_or_sharpness_are_nothing_to_compare_with():
    bright = Measures(0.1, 200.0, 250.0, 0.6, 0.9, 0.1, 100.0, 0.0)
    assert _flat_or_badly_exposed(bright, [replace(bright, light=0.0)] * 6) is None
    assert _blurred(0.1, 0.0, 0.0) is None
    assert (_blurred(0.0, 0.0, 0.0) or "").startswith("blurred: its sharpness is 0.000")


def test_of_a_hovering_drone_the_sharpest_photograph_is_kept(tmp_path):
    later = cv2.GaussianBlur(hovering(view(130 * 4)), (0, 0), 0.5)
    found = left_out(flight(tmp_path, later=later, softer=cv2.GaussianBlur(later, (0, 0), 0.5), copy=view(130 * 7)))
    assert sorted(found) == ["f07.jpg", "later.jpg", "softer.jpg"]
    for name in ("later.jpg", "softer.jpg"):
        assert found[name].startswith("duplicate: it has the view of f04.jpg, shifted by 0.")
    assert found["f07.jpg"].startswith("duplicate: it has the view of copy.jpg, shifted by 0.0%")


def test_of_a_blurred_duplicate_the_sharp_one_is_kept(tmp_path):
    found = left_out(flight(tmp_path, blurred=moved(view(130 * 4), 8, 0.3)))
    assert list(found) == ["blurred.jpg"]
    assert found["blurred.jpg"].startswith("blurred")


def sky(share: float) -> np.ndarray:
    """A landscape from the side: bright sky over ground."""
    pixels = view(500, 300).copy()
    rows = round(share * SIZE[1])
    pixels[:rows] = np.linspace(235, 205, rows)[:, None, None].astype(np.uint8)
    return pixels


def test_a_photograph_of_the_sky_is_found_without_metadata(tmp_path):
    found = left_out(flight(tmp_path, sky=sky(0.5), strip=sky(0.2)))
    assert list(found) == ["sky.jpg"]
    assert found["sky.jpg"].startswith("horizon: 5") or found["sky.jpg"].startswith("horizon: 4")


def test_smooth_water_in_several_photographs_of_one_place_is_no_sky(tmp_path):
    flight(tmp_path)
    x = np.arange(SIZE[0])
    waterline = SIZE[1] * (0.42 + 0.04 * np.sin(x / SIZE[0] * 9) + 0.02 * np.sin(x / SIZE[0] * 31))
    for index in range(3, 7):
        pixels = view(130 * index).copy()
        pixels[np.arange(SIZE[1])[:, None] < waterline] = 205
        place = BRIGHTON[0] + 1.2e-4 * index, BRIGHTON[1]
        photograph(tmp_path / f"f{index:02d}.jpg", table=exif(place=place), pixels=pixels)
    decisions = assess_quality(read_survey(tmp_path))
    assert [index for index, d in enumerate(decisions) if d.measures and d.measures.sky > 0.35] == [3, 4, 5, 6]
    assert not any(decision.left_out for decision in decisions)


@pytest.mark.parametrize(("pitch_deg", "share", "out"), [("-5", 0.45, True), ("-90", 0.45, False), ("-5", 0.0, False)])
def test_gimbal_pitch_counts_where_the_image_confirms_it(tmp_path, pitch_deg, share, out):
    angles = {"GimbalYawDegree": "10", "GimbalPitchDegree": pitch_deg, "GimbalRollDegree": "0"}
    flight(tmp_path)
    photograph(tmp_path / "g.jpg", packet=xmp(angles), pixels=sky(share))
    found = left_out(read_survey(tmp_path))
    assert list(found) == (["g.jpg"] if out else [])
    assert all("above the horizon" in reason for reason in found.values())


def test_photographs_away_from_the_survey_are_found(tmp_path):
    survey = flight(tmp_path, away=view(500, 400), low=view(900, 400))
    photographs = [replace(p, relative_altitude_m=40.0) for p in survey.photographs]
    first = next(p.position for p in photographs if p.position)
    for index, p in enumerate(photographs):
        if p.name == "away.jpg":
            photographs[index] = replace(p, position=replace(first, longitude_deg=first.longitude_deg + 0.01))
        elif p.name == "low.jpg":
            photographs[index] = replace(p, position=first, relative_altitude_m=2.0)
    found = left_out(replace(survey, photographs=tuple(photographs)))
    assert sorted(found) == ["away.jpg", "low.jpg"]
    assert found["away.jpg"].startswith("off the survey: it was taken 76")
    assert "2 m above the take-off point, the others at 40 m" in found["low.jpg"]


def stations(lines: list[int], along_m: float, across_m: float, cameras: int = 1) -> list[Photograph]:
    """As many photographs along each line, of each camera."""
    places = [(line, k) for line, count in enumerate(lines) for k in range(count) for _ in range(cameras)]
    return [
        unlocated_photograph(number, line * across_m / 111_195, k * along_m / 111_195)
        for number, (line, k) in enumerate(places)
    ]


@pytest.mark.parametrize(("cameras", "along_m", "across_m"), [(1, 5, 35), (5, 14, 31)])
def test_a_short_outer_flight_line_is_part_of_a_survey_of_unknown_height(cameras: int, along_m: int, across_m: int):
    assert find_beyond_gap(stations([40] * 5 + [2], along_m, across_m, cameras)) == {}


def test_how_far_a_photograph_lies_off_the_survey_is_measured_to_all_that_stay():
    far = stations([50, 0, 40, 0, 0, 1], 5, 150)
    assert list(find_beyond_gap(far)) == [90]
    assert "taken 450 m from the nearest of the others; 100 m is the limit" in find_beyond_gap(far)[90]


def test_values_that_fill_a_small_part_of_16_bits_are_to_be_stretched(tmp_path):
    for index in range(4):
        levels = 7000 + 3 * view(130 * index)[..., 0].astype(np.uint16)
        Image.fromarray(levels).save(tmp_path / f"{index}.tif")
    survey = read_survey(tmp_path)
    with pytest.raises(SurveyError, match="--keep-all; where values of 16 bits fill a small part of their range, str"):
        select_photographs(survey, assess_quality(survey))


def test_a_second_field_and_a_low_flight_are_parts_of_the_survey(tmp_path):
    survey = flight(tmp_path)
    first = survey.photographs[0].position
    assert first is not None
    photographs = [
        replace(
            p,
            position=p.position and replace(p.position, longitude_deg=first.longitude_deg + (0.01 if index > 6 else 0)),
            relative_altitude_m=10.0 if index in (2, 3) else 60.0,
        )
        for index, p in enumerate(survey.photographs)
    ]
    assert not left_out(replace(survey, photographs=tuple(photographs)))


def test_a_survey_of_many_fields_is_one_survey(tmp_path):
    survey = flight(tmp_path)
    fields = []
    for field in range(30):
        for taken in survey.photographs:
            assert taken.position is not None
            east = replace(taken.position, longitude_deg=taken.position.longitude_deg + 0.01 * field)
            fields.append(replace(taken, name=f"{field:02d}/{taken.name}", position=east))
    assert find_beyond_gap(fields) == {}


def test_a_flat_set_is_one_clear_error(tmp_path):
    for index in range(5):
        photograph(tmp_path / f"{index}.jpg", pixels=np.full((*SIZE[::-1], 3), 128, np.uint8))
    survey = read_survey(tmp_path)
    decisions = assess_quality(survey)
    with pytest.raises(SurveyError, match=r"0 of the 5 photographs .*\(5 flat; such as 0.jpg, flat: .*--keep-all"):
        select_photographs(survey, decisions)
    assert select_photographs(survey, decisions, keep_all=True) == survey


def test_undecodable_photographs_are_left_out_even_with_keep_all(tmp_path):
    survey = flight(tmp_path, odd=view(500, 300))
    data = bytearray((tmp_path / "odd.jpg").read_bytes())
    (tmp_path / "odd.jpg").write_bytes(data[:3000])  # after the survey was read
    control = Control(
        "EPSG:4326",
        {"A": (0.0, 0.0, 0.0), "B": (0.0, 0.0, 1.0)},
        (Mark("A", "odd.jpg", (1.0, 2.0)), Mark("B", "odd.jpg", (1.0, 2.0)), Mark("B", "f01.jpg", (3.0, 4.0))),
    )
    survey = replace(survey, control=control)
    decisions = assess_quality(survey)
    odd = next(decision for decision in decisions if decision.name == "odd.jpg")
    assert odd.measures is None
    assert (odd.left_out or "").startswith("undecodable: ")
    kept = select_photographs(survey, decisions, keep_all=True)
    assert len(kept.photographs) == 10
    assert kept.control is not None
    assert list(kept.control.points) == ["B"]
    assert [mark.photograph for mark in kept.control.marks] == ["f01.jpg"]


def test_tiny_photographs_are_assessed(tmp_path):
    assert all(
        isinstance(decision, QualityDecision) for decision in assess_quality(read_survey(survey_folder(tmp_path)))
    )


@pytest.mark.thorough
@pytest.mark.parametrize(("name", "count"), [("brighton_beach", 18), ("turin_lot", 32), ("swindale", 79)])
def test_every_photograph_of_the_real_surveys_is_kept(name, count):
    survey = read_survey(real_survey(name))
    kept = select_photographs(survey, assess_quality(survey))
    assert len(kept.photographs) == count
    assert kept == survey


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["brighton_beach", "turin_lot"])
def test_defects_made_of_real_photographs_are_found(name, tmp_path):
    survey = read_survey(real_survey(name))
    # The same six photographs of every survey, so that the test is quick; each defect takes the place of one of them.
    chosen = survey.photographs[1:13]
    defects = {
        1: lambda pixels: moved(pixels, 6, 0.5),
        3: lambda pixels: with_light(pixels, 0.05),
        5: lambda pixels: with_light(pixels, 6),
        7: lambda pixels: np.full_like(pixels, 90),
    }
    photographs = []
    for index, taken in enumerate(chosen):
        if index in defects:
            path = tmp_path / taken.name.replace(".jpg", ".png")
            Image.fromarray(defects[index](upright(taken))).save(path, compress_level=1)
            taken = replace(taken, path=path)
        photographs.append(taken)
    path = tmp_path / "later.png"
    Image.fromarray(hovering(upright(chosen[9]))).save(path, compress_level=1)
    photographs.append(replace(chosen[9], path=path, name="later.png"))
    found = left_out(replace(survey, photographs=tuple(photographs)))
    kinds = {chosen[1]: "blurred", chosen[3]: "under-exposed", chosen[5]: "over-exposed", chosen[7]: "flat"}
    assert found.keys() == {photograph.name for photograph in kinds} | {"later.png"}
    for taken, kind in kinds.items():
        assert found[taken.name].startswith(kind)
    assert found["later.png"].startswith(f"duplicate: it has the view of {chosen[9].name}, ")
