"""The ablation: variants change one thing, and the table says what each of them brings."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from comparisons import Children, evaluation, quiet
from scenes_on_disk import PINHOLE, survey, write_colmap

from tidefield.commands.ablate import Ablate
from tidefield.compare.ablation import ablation_tables, summarise, variants, write_ablation
from tidefield.compare.results import Result, Results, read_results
from tidefield.compare.run import OTHER_SEED, Settings, commands, compare
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
        assert varied == replace(preset, train=replace(preset.train, neighbours=name.removeprefix("neighbours-")))
        return
    assert varied.train == preset.train
    small = replace(varied.network, encoder=EncoderConfig((8, 8, 8, 8), (1, 1, 1), instance_norm=False))
    assert sum(p.numel() for p in make_network(small).parameters()) > 0
    itself = {f"degree-{preset.network.harmonics_degree}", f"views-{preset.network.views}"}
    assert (varied == preset) == (name in itself)


def test_an_unknown_variant_is_refused():
    with pytest.raises(RunError, match="no variant colourless: expected one of no-neighbours"):
        vary(SWIFT, "colourless")


@pytest.mark.parametrize(
    ("preset", "name", "reason"),
    [
        (SWIFT, "no-ray-transformer", "it has no ray transformer"),
        (SWIFT, "degree-1", "it has no target colour"),
        (PAPER, "with-target-colour", "it has its target colour already"),
    ],
    ids=lambda value: value if isinstance(value, str) else value.preset,
)
def test_a_variant_of_a_part_that_a_preset_does_not_have_is_refused(preset: Config, name: str, reason: str):
    with pytest.raises(RunError, match=f"{preset.preset} has no variant {name}: {reason}; expected one of no-neigh"):
        vary(preset, name)
    assert name not in variants_of(preset)


def test_parts_that_are_added_come_back():
    both = vary(SWIFT, "with-every-part")
    assert isinstance(both, Config)
    assert both.network.without == ()
    assert len(list(make_network(both.network).parameters())) > len(list(make_network(SWIFT.network).parameters()))


def test_variants_are_trained_like_the_network_itself():
    names = variants(("views-2",), "paper")
    assert names == ("tidefield", OTHER_SEED, "views-2")
    whole, other, fewer = (commands(Path("S"), Path("F"), name, SETTINGS)["train"] for name in names)
    assert whole[3:5] == ["--preset", "paper"]
    assert fewer == [*whole[:5], "--variant", "views-2", *whole[5:]]
    assert other == [*whole[:-1], "1"]
    everything = variants(Ablate.variants, "swift")
    assert everything[2:] == variants_of(SWIFT)
    assert set(variants_of(SWIFT) + variants_of(PAPER)) == set(VARIANTS)


def test_the_table_marks_differences_within_the_noise(tmp_path: Path):
    write_colmap(tmp_path / "flats", survey(PINHOLE))
    scene = load_scene(tmp_path / "flats", width=48)
    psnr = {"tidefield": 30.0, OTHER_SEED: 30.2, "views-2": 27.0, "degree-0": 29.85}
    by = {("flats", name): Result(evaluation(scene, value)) for name, value in psnr.items()}
    by["creek", "tidefield"] = Result(evaluation(scene, 25.0))
    table, other = ablation_tables(Results(("flats", "creek"), (*psnr, "field"), by))
    assert [row[-1] for row in table.rows] == ["-", "+0.20", "-3.00", "-0.15, within the noise"]
    assert table.rows[2][:2] == ["views-2", "27.00"]
    assert "flats" in table.title
    assert [row[:2] for row in other.rows] == [["tidefield", "25.00"]]


def test_the_summary_names_what_has_no_effect_on_any_scene(tmp_path: Path):
    write_colmap(tmp_path / "flats", survey(PINHOLE))
    scene = load_scene(tmp_path / "flats", width=48)
    psnr = {
        "flats": {
            "tidefield": 30.0,
            OTHER_SEED: 30.2,
            "views-2": 27.0,
            "degree-0": 29.85,
            "field": 31.0,
            "views-8": 29.0,
        },
        "creek": {"tidefield": 25.0, "views-2": 25.01, "degree-0": 25.04, "field": 25.2, "views-8": 25.3},
    }
    by = {(name, method): Result(evaluation(scene, value)) for name, of in psnr.items() for method, value in of.items()}
    lines = summarise(Results(tuple(psnr), (*psnr["flats"], "no-neighbours"), by))
    assert [line.rpartition(": ")[2] for line in lines] == ["views-2.", "field.", "degree-0."]
    assert "no effect" in lines[2]


def test_an_ablation_is_run_and_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    write_colmap(tmp_path / "flats", survey(PINHOLE))
    run, names = Children(load_scene(tmp_path / "flats", width=48)), variants(("views-2",), "paper")
    compare({"flats": tmp_path / "flats"}, names, SETTINGS, tmp_path / "out", run, quiet)
    results = read_results(tmp_path / "out", ["flats"], names)
    files = write_ablation(results, SETTINGS, tmp_path / "out")
    assert [file.name for file in files] == ["ablation.md", "ablation.tex", "ablation.csv", "ablation.json"]
    assert "| views-2 |" in files[0].read_text()
    assert len(json.loads(files[3].read_text())["results"]) == 3
