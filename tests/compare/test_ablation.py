"""The ablation: variants change one thing, and the table says what each of them brings."""

import json
from dataclasses import replace
from pathlib import Path
from typing import cast

import pytest
from comparisons import Children, evaluation, quiet
from scenes_on_disk import PINHOLE, survey, write_colmap

from tidefield.commands.ablate import Ablate
from tidefield.compare.ablation import Difference, ablation_tables, summarise, variants, write_ablation
from tidefield.compare.results import Result, Results, read_results
from tidefield.compare.run import Settings, commands, compare
from tidefield.config import (
    PAPER,
    SWIFT,
    VARIANTS,
    Config,
    EncoderConfig,
    NerfConfig,
    config_from_json,
    config_to_json,
    variants_of,
    vary,
)
from tidefield.data.load import load_scene
from tidefield.data.scene import Scene
from tidefield.errors import RunError
from tidefield.model.network import make_network

SETTINGS = Settings(minutes=10.0, steps=None, width=48, device="cpu", seed=0, preset="paper")


@pytest.mark.parametrize(
    ("preset", "name"),
    [(preset, name) for preset in (SWIFT, PAPER) for name in variants_of(preset)],
    ids=lambda value: value if isinstance(value, str) else value.preset,
)
def test_a_variant_is_a_network_that_a_run_can_store(preset: Config, name: str):
    varied = vary(preset, name)
    assert config_from_json(json.loads(json.dumps(config_to_json(varied)))) == varied
    if name == "no-neighbours":
        assert isinstance(varied, NerfConfig), "without neighbouring views what is left is classical NeRF"
        return
    if name.startswith("neighbours"):
        assert varied != preset
        assert varied == replace(preset, train=replace(preset.train, neighbours=name.removeprefix("neighbours-")))
        return
    weight = {"no-depth-loss": ("depth_weight", 0.0), "no-structure-loss": ("structure_weight", 0.0)}.get(name)
    if weight is not None or name == "unseen-alike":
        field, value = weight or ("unseen_weight", 1.0)
        assert varied == replace(preset, train=replace(preset.train, **{field: value}))
        assert varied != preset
        return
    assert varied.train == preset.train
    small = replace(varied.network, encoder=EncoderConfig((8, 8, 8, 8), (1, 1, 1), instance_norm=False))
    assert sum(p.numel() for p in make_network(small).parameters()) > 0
    assert varied != preset


def test_an_unknown_variant_is_refused():
    with pytest.raises(RunError, match="no variant colourless: expected one of no-neighbours"):
        vary(SWIFT, "colourless")


@pytest.mark.parametrize(
    ("preset", "name", "reason"),
    [
        (SWIFT, "no-ray-transformer", "it has no ray transformer"),
        (SWIFT, "degree-1", "it has no target colour"),
        (PAPER, "with-target-colour", "it has its target colour already"),
        (PAPER, "no-matched-surface", "it has no matched surface"),
        (PAPER, "no-depth-loss", "its depth_weight is 0 already"),
    ],
    ids=lambda value: value if isinstance(value, str) else value.preset,
)
def test_a_variant_of_a_part_that_a_preset_does_not_have_is_refused(preset: Config, name: str, reason: str):
    with pytest.raises(RunError, match=f"{preset.preset} has no variant {name}: {reason}; expected one of no-neigh"):
        vary(preset, name)
    assert name not in variants_of(preset)


def test_several_parts_are_changed_one_after_the_other():
    varied = vary(SWIFT, "no-sparse-points+views-2")
    assert varied == vary(cast(Config, vary(SWIFT, "views-2")), "no-sparse-points")
    with pytest.raises(RunError, match="it has no agreement"):
        vary(SWIFT, "no-agreement+no-agreement")
    with pytest.raises(RunError, match="nothing after no-neighbours, which has no parts"):
        vary(SWIFT, "no-neighbours+views-2")


def test_parts_that_are_added_come_back():
    both = vary(SWIFT, "with-every-part")
    assert isinstance(both, Config)
    assert both.network.without == ()
    assert len(list(make_network(both.network).parameters())) > len(list(make_network(SWIFT.network).parameters()))


def test_variants_are_trained_like_the_network_itself():
    names = variants(("views-2",), "paper", 2)
    assert names == ("tidefield", "views-2", "tidefield-seed-1", "views-2-seed-1")
    whole, fewer, *other = (commands(Path("S"), Path("F"), name, SETTINGS)["train"] for name in names)
    assert whole[3:5] == ["--preset", "paper"]
    assert fewer == [*whole[:5], "--variant", "views-2", *whole[5:]]
    assert other == [[*whole[:-1], "1"], [*fewer[:-1], "1"]]
    everything = variants(Ablate.variants, "swift", 1)
    assert everything[1:] == variants_of(SWIFT)
    assert set(variants_of(SWIFT) + variants_of(PAPER)) == set(VARIANTS)


def results(scene: Scene, psnr: dict[str, dict[str, float]]) -> Results:
    """Results by scene and method."""
    by = {(name, method): Result(evaluation(scene, value)) for name, of in psnr.items() for method, value in of.items()}
    return Results(tuple(psnr), tuple(dict.fromkeys(method for of in psnr.values() for method in of)), by)


@pytest.fixture
def flats(tmp_path: Path) -> Scene:
    write_colmap(tmp_path / "flats", survey(PINHOLE))
    return load_scene(tmp_path / "flats", width=48)


def test_the_table_marks_differences_within_the_noise(flats: Scene):
    # Two variants with two seeds, 0.2 and 0.4 dB apart: of one, the standard deviation is sqrt((0.02 + 0.08) / 2).
    own = {"tidefield": 30.0, "views-2": 27.0, "degree-0": 29.85, "tidefield-seed-1": 30.2, "views-2-seed-1": 27.4}
    (table,) = ablation_tables(results(flats, {"flats": own, "creek": {"tidefield": 25.0}}))
    assert [row[:4] for row in table.rows] == [
        ["tidefield", "1-2", "30.10", "25.00"],
        ["views-2", "2", "-2.90 ± 0.22", "-"],
        ["degree-0", "1", "-0.25 ± 0.27, noise", "-"],
    ]
    # Of scenes that both have: creek has no variant.
    assert [row[4] for row in table.rows[1:]] == ["-2.90", "-0.25"]
    assert table.rows[1][-2:] == ["1.00", "1.00"]


def test_the_table_has_steps_and_speeds_relative_to_the_whole_networks():
    def measured(steps: int, rays_per_second: float) -> Result:
        trained = {"steps": steps, "seconds": 60.0}
        mean = {"psnr_seen_cc": 20.0}
        own = {"mean": mean, "rays_per_second": rays_per_second, "configuration": {"trained": trained}}
        return Result(own, {"settings": {"minutes": 10}})

    by = {("flats", "tidefield"): measured(100, 1000.0), ("flats", "views-2"): measured(150, 4000.0)}
    (table,) = ablation_tables(Results(("flats",), ("tidefield", "views-2"), by))
    assert table.rows[1][-2:] == ["1.50", "4.00"]


def test_seeds_of_one_scene_show_the_noise_of_all(flats: Scene):
    own = {"tidefield": 30.0, "tidefield-seed-1": 30.2}
    (table,) = ablation_tables(results(flats, {"flats": own, "creek": {"tidefield": 25.0, "views-2": 25.3}}))
    assert table.rows[1][3] == "+0.30 ± 0.20, noise"


def test_a_difference_is_beyond_the_noise_of_few_seeds_by_students_distribution():
    """Of one further seed 12.7 standard errors are exceeded in one of twenty cases; of many, 1.96."""
    assert [Difference(0.5, 0.2, freedom).effect for freedom in (1, 1000)] == ["within the noise", "better"]
    assert Difference(2.6, 0.2, 1).effect == "better"


def test_without_other_seeds_small_differences_are_noise(flats: Scene):
    own = {"tidefield": 30.0, "views-2": 30.04, "degree-0": 30.06}
    (table,) = ablation_tables(results(flats, {"flats": own}))
    assert [row[2] for row in table.rows] == ["30.00", "+0.04, noise", "+0.06"]
    better, within, seeds = summarise(results(flats, {"flats": own}))
    assert better == "Better, and nowhere worse: degree-0."
    assert within == "Within 0.05 dB on all scenes, so that no effect was measured: views-2."
    assert seeds.startswith("All were trained with one seed")


def test_a_variant_of_a_variant_is_compared_with_that_one(flats: Scene):
    own = {"tidefield": 30.0, "no-sparse-points": 28.0, "no-agreement": 29.9, "no-sparse-points+no-agreement": 26.0}
    whole, pointless = ablation_tables(results(flats, {"flats": own}))
    assert [row[0] for row in whole.rows] == ["tidefield", "no-sparse-points", "no-agreement"]
    assert [row[:3:2] for row in pointless.rows] == [
        ["no-sparse-points", "28.00"],
        ["no-sparse-points+no-agreement", "-2.00"],
    ]
    assert pointless.title.startswith("Of no-sparse-points: ")


def test_a_variant_of_several_parts_is_measured_with_what_it_is_compared_with():
    names = variants(("no-agreement+views-2", "views-2", "views-2"), "swift", 2)
    one = ("tidefield", "no-agreement", "no-agreement+views-2", "views-2")
    assert names == (*one, *(f"{name}-seed-1" for name in one))


def test_a_variant_of_what_was_not_measured_has_no_difference(flats: Scene):
    (table,) = ablation_tables(results(flats, {"flats": {"no-agreement+views-2": 27.0}}))
    assert [row[:4] for row in table.rows] == [["no-agreement", "0", "-", "-"], ["no-agreement+views-2", "1", "-", "-"]]


def test_the_summary_names_what_has_no_effect_on_any_scene(flats: Scene):
    psnr = {
        "flats": {
            "tidefield": 30.0,
            "views-2": 27.0,
            "degree-0": 29.85,
            "field": 31.0,
            "views-8": 29.0,
            "tidefield-seed-1": 30.02,
        },
        "creek": {"tidefield": 25.0, "views-2": 25.01, "degree-0": 25.04, "field": 25.2, "views-8": 25.9},
    }
    lines = summarise(results(flats, psnr))
    assert [line.rpartition(": ")[2] for line in lines[:3]] == ["views-2.", "field.", "degree-0."]
    assert "no effect" in lines[2]
    assert lines[3].startswith("The noise, 0.014 dB of a training")
    assert lines[3].endswith("(1 degrees of freedom): flats.")


def test_an_ablation_is_run_and_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    write_colmap(tmp_path / "flats", survey(PINHOLE))
    run, names = Children(load_scene(tmp_path / "flats", width=48)), variants(("views-2",), "paper", 2)
    compare({"flats": tmp_path / "flats"}, names, SETTINGS, tmp_path / "out", run, quiet)
    results = read_results(tmp_path / "out", ["flats"], names)
    files = write_ablation(results, SETTINGS, tmp_path / "out")
    assert [file.name for file in files] == ["ablation.md", "ablation.tex", "ablation.csv", "ablation.json"]
    assert "| views-2 |" in files[0].read_text()
    assert len(json.loads(files[3].read_text())["results"]) == 4
