"""Pairs are chosen by positions, times and their largest features; they are matched and verified once."""

import shutil
import tracemalloc
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from itertools import combinations, pairwise
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pycolmap
import pytest
import torch
from located_surveys import unlocated_photograph
from torch import Tensor

from tidefield.data.sift import MAX_ANGLE_RAD, MAX_RATIO
from tidefield.errors import RunError
from tidefield.survey.sfm import features, matching
from tidefield.survey.sfm.matching import match
from tidefield.survey.sfm.pairs import (
    EXHAUSTIVE,
    MAX_PAIRS,
    MIN_PAIRS,
    MOST_AT_PLACE,
    NEIGHBOURS,
    PREVIEW,
    SEQUENTIAL,
    candidate_pairs,
    match_descriptors,
    places_of,
    preview_descriptors,
    select_pairs,
)
from tidefield.survey.survey import Photograph


def lawnmower(rows: int, columns: int) -> list[Photograph]:
    """Photographs 20 m apart along lines 30 m apart, flown back and forth."""
    made = []
    for row in range(rows):
        for column in range(columns) if row % 2 == 0 else reversed(range(columns)):
            made.append(unlocated_photograph(len(made), 54 + 30 * row / 111_000, 20 * column / 65_000))
    return made


def apart_m(flight: list[Photograph]) -> dict[tuple[int, int], float]:
    """Distance of each pair of photographs."""
    position = np.array(
        [[p.position.latitude_deg * 111_000, p.position.longitude_deg * 65_000] for p in flight if p.position]
    )
    return {(i, j): float(np.linalg.norm(position[i] - position[j])) for i, j in combinations(range(len(flight)), 2)}


def pairs_of(flight: list[Photograph]) -> list[tuple[int, int]]:
    return candidate_pairs(flight, places_of(flight))


def test_few_photographs_are_all_paired():
    photographs = [unlocated_photograph(k, None) for k in range(EXHAUSTIVE)]
    assert pairs_of(photographs) == list(combinations(range(EXHAUSTIVE), 2))


def test_number_of_candidates_is_linear_with_positions():
    small, large = lawnmower(8, 10), lawnmower(20, 40)
    assert len(pairs_of(large)) < 1.3 * len(pairs_of(small)) * len(large) / len(small)
    assert len(pairs_of(large)) <= len(large) * (NEIGHBOURS + SEQUENTIAL)


def test_near_photographs_are_paired_and_far_ones_are_not():
    flight = lawnmower(20, 20)
    pairs = set(pairs_of(flight))
    for (i, j), apart in apart_m(flight).items():
        if apart < 45:
            assert (i, j) in pairs
        if apart > 200 and j - i > SEQUENTIAL:
            assert (i, j) not in pairs


def rig(cameras: int) -> list[Photograph]:
    """Photographs of several cameras, whose positions are some decimetres apart, at each station of a flight."""
    rng, flight = np.random.default_rng(0), []
    for station in lawnmower(8, 12):
        assert station.position is not None
        for camera in range(cameras):
            east, north = rng.normal(0, 0.3, 2).tolist()
            position = replace(
                station.position,
                latitude_deg=station.position.latitude_deg + north / 111_000,
                longitude_deg=station.position.longitude_deg + east / 65_000,
            )
            flight.append(replace(station, name=f"{camera}/{station.name}", camera=str(camera), position=position))
    return flight


def test_photographs_of_cameras_that_fly_together_are_paired_across_flight_lines():
    flight = rig(5)
    pairs = pairs_of(flight)
    lines = {frozenset((i, j // 60)) for a, b in pairs for i, j in ((a, b), (b, a)) if i // 60 != j // 60}
    for k, line in ((k, k // 60) for k in range(len(flight))):
        beyond = {line - 1, line + 1} & set(range(8))
        assert {frozenset((k, other)) for other in beyond} <= lines
    assert len(pairs) < len(flight) * 5 * (NEIGHBOURS + 1)


def test_usual_flights_have_a_place_for_each_photograph():
    flight = lawnmower(8, 10)
    assert places_of(flight) == list(range(80))


def test_photographs_of_one_place_do_not_take_all_pairs():
    """Of eleven photographs at two places two of each, the best, are paired with another; of unlike places all are."""
    matches = {(0, k): 20 - k for k in range(1, 12)}
    table = torch.zeros(12, PREVIEW, 128)
    for (_, k), count in matches.items():
        table[0, :20, :20] = table[k, :count, :20] = 0
        table[0, torch.arange(20), torch.arange(20)] = 1
        table[k, torch.arange(count), torch.arange(count)] = 1
    kept = {
        where: select_pairs(list(matches), table, places, lambda done, whole: None)
        for where, places in (("two", [0, *[1] * 6, *[2] * 5]), ("own", range(12)))
    }
    assert [pair for pair in kept["two"] if pair[1] in (1, 2, 7, 8)] == [(0, 1), (0, 2), (0, 7), (0, 8)]
    assert kept["own"] == sorted(matches)


def test_a_drone_that_hovers_is_not_paired_with_itself_all_the_time():
    flight = [replace(one, position=lawnmower(1, 1)[0].position) for one in lawnmower(20, 10)]
    assert len(pairs_of(flight)) <= len(flight) * (NEIGHBOURS + 1) * MOST_AT_PLACE / 2


def test_near_photographs_on_both_sides_of_the_date_line_are_paired():
    there = lawnmower(8, 10)
    flight = [
        replace(p, position=replace(p.position, longitude_deg=(p.position.longitude_deg + 359.9985) % 360 - 180))
        for p in there
        if p.position
    ]
    assert len({p.position.longitude_deg > 0 for p in flight if p.position}) == 2
    assert {pair for pair, apart in apart_m(there).items() if apart < 45} <= set(pairs_of(flight))


def test_fields_far_apart_are_not_paired():
    here = lawnmower(4, 5)
    there = [
        replace(p, time_s=p.time_s + 1e6, position=replace(p.position, latitude_deg=55.0)) for p in here if p.position
    ]
    also = [
        replace(p, time_s=p.time_s + 2e6, position=replace(p.position, latitude_deg=56.0)) for p in here if p.position
    ]
    pairs = pairs_of([*here, *there, *also])
    assert not [pair for pair in pairs if pair[0] // 20 != pair[1] // 20]
    assert len([pair for pair in pairs if pair[1] < 20]) > 100


def test_a_photograph_without_position_is_paired_with_all():
    flight = lawnmower(10, 10)
    flight[37] = replace(flight[37], position=None)
    pairs = set(pairs_of(flight))
    assert all((min(37, k), max(37, k)) in pairs for k in range(100) if k != 37)


def test_consecutive_photographs_are_paired_whatever_their_positions():
    flight = lawnmower(10, 10)
    assert flight[50].position is not None
    flight[50] = replace(flight[50], position=replace(flight[50].position, latitude_deg=-10.0))
    pairs = set(pairs_of(flight))
    assert {(49, 50), (50, 51), (48, 50), (50, 52)} <= pairs


def test_a_long_pause_ends_the_sequence():
    field = [unlocated_photograph(k, 54 + 20 * k / 111_000) for k in range(30)]
    later = [unlocated_photograph(30 + k, 54.5 + 20 * k / 111_000, time_s=3600.0 + k) for k in range(30)]
    assert not [pair for pair in pairs_of([*field, *later]) if pair[0] < 30 <= pair[1]]
    timeless = [replace(one, time_s=float("nan")) for one in (*field, *later)]
    assert {(28, 30), (29, 30), (29, 31)} <= set(pairs_of(timeless))


def test_photographs_without_a_time_leave_the_order_of_the_others_as_it_is():
    # Names run against the times, and of the photographs with a time every other one is far from all others.
    flight = [replace(one, name=f"{99 - k:02d}.jpg") for k, one in enumerate(lawnmower(10, 10))][::-1]
    for k in range(0, 100, 2):
        flight[k] = replace(flight[k], time_s=float("nan"))
    for k in range(1, 100, 4):
        own = flight[k].position
        assert own is not None
        flight[k] = replace(flight[k], position=replace(own, latitude_deg=-10.0 - k))
    timed = range(1, 100, 2)
    assert {*pairwise(timed), *zip(timed, timed[2:], strict=False)} <= set(pairs_of(flight))


@pytest.mark.thorough
def test_candidates_of_many_photographs_without_positions_take_little_memory():
    count = 200
    pairs = list(combinations(range(count), 2))
    tracemalloc.start()
    assert pairs_of([unlocated_photograph(k, None) for k in range(count)]) == pairs
    chosen_from = tracemalloc.get_traced_memory()[1]
    tracemalloc.reset_peak()
    before = tracemalloc.get_traced_memory()[0]
    kept = select_pairs(pairs, torch.ones(count, 1, 1), range(count), lambda done, whole: None)
    selected_from = tracemalloc.get_traced_memory()[1] - before
    tracemalloc.stop()
    assert len(kept) < len(pairs) / 10
    assert chosen_from < 110 * len(pairs)
    assert selected_from < 60 * len(pairs)


def test_the_best_pairs_of_each_photograph_are_selected_the_first_among_equals():
    rng, count = np.random.default_rng(0), 40
    shared = rng.integers(0, 3, (count, 3))
    ground = rng.integers(0, 255, (3, 3, 128)).astype(np.uint8)
    table = preview_descriptors([np.stack([ground[k, own[k]] for k in range(3)]) for own in shared])
    matches = {(i, j): int((shared[i] == shared[j]).sum()) for i, j in combinations(range(count), 2)}
    expected = set()
    for k in range(count):
        ranked = sorted((pair for pair in matches if k in pair), key=lambda pair: (-matches[pair], pair))
        expected |= set(ranked[:MIN_PAIRS])
    assert select_pairs(list(matches), table, range(len(table)), lambda done, whole: None) == sorted(expected)


def test_pairs_whose_largest_features_match_are_selected_with_the_best_of_each_photograph():
    rng, count = np.random.default_rng(0), 34
    # Photograph k shares half of its features with k + 1.
    ground = rng.integers(0, 255, (count + 1, PREVIEW // 2, 128)).astype(np.uint8)
    table = preview_descriptors([np.concatenate([ground[k], ground[k + 1]]) for k in range(count)])
    kept = select_pairs(list(combinations(range(count), 2)), table, range(count), lambda done, whole: None)
    assert {(k, k + 1) for k in range(count - 1)} <= set(kept)
    assert len(kept) <= count * MAX_PAIRS / 2
    partners = [sum(k in pair for pair in kept) for k in range(count)]
    assert min(partners) >= MIN_PAIRS


def test_previews_are_padded_with_zeros():
    table = preview_descriptors([np.full((3, 128), 9, dtype=np.uint8), np.zeros((0, 128), dtype=np.uint8)])
    assert table.shape == (2, PREVIEW, 128)
    assert table[0, :3].norm(dim=1).allclose(table.new_ones(3))
    assert (table[0, 3:] == 0).all()
    assert select_pairs([(0, 1)], table, range(2), lambda done, whole: None) == [(0, 1)]


def unit(count: int, seed: int) -> Tensor:
    values = torch.rand(count, 128, generator=torch.Generator().manual_seed(seed))
    return torch.nn.functional.normalize(values**4, dim=1)


def brute_force(ours: Tensor, theirs: Tensor) -> list[int]:
    angle = (ours @ theirs.T).clamp(-1, 1).acos()
    result = []
    for i, row in enumerate(angle):
        first, second = row.sort().values[:2].tolist()
        j = int(row.argmin())
        stands_out = first < MAX_RATIO * second and first < MAX_ANGLE_RAD
        result.append(j if stands_out and int(angle[:, j].argmin()) == i else -1)
    return result


def test_descriptors_match_as_by_brute_force():
    ours, strangers = unit(60, 0), unit(30, 1)
    noisy = torch.nn.functional.normalize(ours[10:50] + 0.03 * unit(40, 2), dim=1)
    theirs = torch.cat([strangers, noisy, ours[:1], ours[:1]])  # the last two are alike: nothing stands out
    found = match_descriptors(ours, theirs)
    assert found.tolist() == brute_force(ours, theirs)
    assert found[0] == -1
    assert (found[10:50] == torch.arange(30, 70)).float().mean() > 0.9


def test_batched_matching_equals_single_pairs():
    first, second = torch.stack([unit(20, 0), unit(20, 1)]), torch.stack([unit(25, 0), unit(25, 1)])
    together = match_descriptors(first, second)
    assert torch.equal(together, torch.stack([match_descriptors(a, b) for a, b in zip(first, second, strict=True)]))


def test_zeros_match_nothing():
    assert (match_descriptors(torch.zeros(4, 128), unit(6, 0)) == -1).all()


def write_database(path: Path, wrong: Mapping[int, int] | None = None) -> list[str]:
    """A database of photographs whose features have their points' own descriptors: all matches are right.

    In the photographs in `wrong`, so many features have those of other points, and the rest are like nothing.
    """
    rng = np.random.default_rng(0)
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=1, num_cameras_per_rig=1, num_frames_per_rig=4, num_points3D=200
    )
    with pycolmap.Database.open(path) as db:
        model = pycolmap.synthesize_dataset(options, db)
        descriptors = {number: rng.integers(0, 255, (128,)) for number in model.point3D_ids()}
        db.clear_matches()
        db.clear_two_view_geometries()
        db.clear_descriptors()
        images = sorted(db.read_all_images(), key=lambda image: image.name)
        for number, image in enumerate(images):
            points = model.image(image.image_id).points2D
            table = np.stack([descriptors.get(p.point3D_id, rng.integers(0, 255, (128,))) for p in points]).astype(
                np.uint8
            )
            if wrong and number in wrong:
                kept = wrong[number]
                table[:kept], table[kept:] = table[:kept][::-1].copy(), rng.integers(0, 255, table[kept:].shape)
            described = pycolmap.FeatureDescriptors(data=table, type=pycolmap.FeatureExtractorType.SIFT)
            db.write_descriptors(image.image_id, described)
        return [image.name for image in images]


def test_pairs_are_matched_verified_and_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(matching, "worker_processes", lambda *_: nullcontext(ThreadPoolExecutor(1)))
    path = tmp_path / "database.db"
    names = write_database(path)
    pairs, calls = [(names[0], names[1]), (names[1], names[2])], []
    agree, inliers = match(path, pairs, pycolmap.Device.cpu, lambda done, whole: calls.append((done, whole)))
    assert agree == 2
    assert inliers > 200
    assert calls[-1] == (2, 2)
    again = match(
        path, [*pairs, (names[0], names[3])], pycolmap.Device.cpu, lambda done, whole: calls.append((done, whole))
    )
    assert again[0] == 3
    assert calls[-1] == (3, 3)
    with pycolmap.Database.open(path) as db:
        assert len(db.read_two_view_geometries()[0]) == 3
        assert db.num_matches() == 0, "mapping reads no others"


def test_what_is_not_matched_any_more_is_deleted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(matching, "worker_processes", lambda *_: nullcontext(ThreadPoolExecutor(1)))
    path = tmp_path / "database.db"
    first, second, third, _ = write_database(path)
    for pairs in ([(first, second), (second, third)], [(third, first), (second, first)]):
        assert match(path, pairs, pycolmap.Device.cpu, lambda done, whole: None)[0] == 2
    with pycolmap.Database.open(path) as db:
        number = {image.name: image.image_id for image in db.read_all_images()}
        assert db.exists_two_view_geometry(number[first], number[second])
        assert db.exists_two_view_geometry(number[first], number[third])
        assert not db.exists_two_view_geometry(number[second], number[third])


def test_matches_do_not_depend_on_the_number_of_processes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    names = write_database(tmp_path / "one.db")
    shutil.copy(tmp_path / "one.db", tmp_path / "many.db")
    found, calls = [], []
    for name, workers, batch in (("one.db", 1, 256), ("many.db", 2, 2)):
        monkeypatch.setattr(features, "cores", lambda workers=workers: workers)
        monkeypatch.setattr(matching, "BATCH", batch)
        match(tmp_path / name, list(combinations(names, 2)), pycolmap.Device.cpu, lambda *done: calls.append(done))
        with pycolmap.Database.open(tmp_path / name) as db:
            numbers, geometries = db.read_two_view_geometries()
            found.append((numbers, [geometry.inlier_matches.tolist() for geometry in geometries]))
    assert found[0] == found[1]
    assert len(found[0][0]) == 6
    assert calls == [(6, 6), (2, 6), (4, 6), (6, 6)]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["many.db", "one.db"]


@pytest.mark.thorough
def test_pairs_without_matches_or_without_a_geometry_are_not_matched_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(matching, "worker_processes", lambda *_: nullcontext(ThreadPoolExecutor(1)))
    names = write_database(tmp_path / "database.db", wrong={2: 0, 3: 30})
    shutil.copy(tmp_path / "database.db", tmp_path / "raw.db")
    pairs = list(combinations(names, 2))
    found = match(tmp_path / "database.db", pairs, pycolmap.Device.cpu, lambda done, whole: None)
    with pycolmap.Database.open(tmp_path / "database.db") as db:
        number = {image.name: image.image_id for image in db.read_all_images()}
        first, _, unlike, wrong = (number[name] for name in names)
        for other in (unlike, wrong):
            assert db.exists_two_view_geometry(first, other)
            assert len(db.read_two_view_geometry(first, other).inlier_matches) == 0
    matching._match(tmp_path / "raw.db", [(first, unlike), (first, wrong)], pycolmap.Device.cpu, 1)
    with pycolmap.Database.open(tmp_path / "raw.db") as db:
        assert len(db.read_matches(first, unlike)) == 0
        assert len(db.read_matches(first, wrong)) > 0
    monkeypatch.setattr(pycolmap, "match_image_pairs", Mock(side_effect=AssertionError("matched again")))
    assert match(tmp_path / "database.db", pairs, pycolmap.Device.cpu, lambda done, whole: None) == found


def test_processes_match_on_one_thread(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Clusters of descriptors differ between runs on several threads, rarely: pycolmap's results cannot show it."""
    names, used = write_database(tmp_path / "database.db"), []
    monkeypatch.setattr(matching, "worker_processes", lambda *_: nullcontext(ThreadPoolExecutor(1)))
    monkeypatch.setattr(pycolmap, "match_image_pairs", lambda _, options, *__: used.append(options.num_threads))
    match(tmp_path / "database.db", [(names[0], names[1])], pycolmap.Device.cpu, lambda done, whole: None)
    assert used == [1]


def test_a_killed_process_is_one_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    names = write_database(tmp_path / "database.db")

    @contextmanager
    def killed(*_: object) -> Iterator[Mock]:
        yield Mock(submit=Mock(side_effect=BrokenProcessPool("terminated")))

    monkeypatch.setattr(matching, "worker_processes", killed)
    with pytest.raises(RunError, match=r"that matches photographs was killed, .*: expected memory for .*; give fewer"):
        match(tmp_path / "database.db", [(names[0], names[1])], pycolmap.Device.cpu, lambda done, whole: None)
    assert [path.name for path in tmp_path.iterdir()] == ["database.db"]
