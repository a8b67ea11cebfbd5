import io
import json
import re
from dataclasses import replace

import numpy as np
import pytest
import textured_wall as wall
import torch
from PIL import Image
from rich.console import Console

from tidefield import __version__
from tidefield.data.holdout import Holdout
from tidefield.errors import RunError
from tidefield.evaluation import evaluate as module
from tidefield.evaluation.evaluate import evaluate
from tidefield.evaluation.lpips import Lpips
from tidefield.evaluation.metrics import METRICS, PSNR_LIMIT_DB, SUFFIXES
from tidefield.geometry.cameras import Cameras
from tidefield.model.rendering import Rendering

NAMES = {metric + suffix for metric in METRICS for suffix in SUFFIXES}


@pytest.fixture
def scene():
    return wall.scene(wall.cameras(3), test=(1,))


@pytest.fixture(autouse=True)
def no_lpips(monkeypatch):
    monkeypatch.setattr(module, "load_lpips", lambda: {"lpips_alex": "not here", "lpips_vgg": "not here"})


def perfect(camera: Cameras) -> Rendering:
    """The wall as it is."""
    colour = wall.photograph(camera).float() / 255
    depth = wall.true_depth(camera)
    return Rendering(colour=colour, depth=depth, opacity=torch.ones_like(depth))


def darker(camera: Cameras) -> Rendering:
    """The wall at an exposure that a colour fit undoes."""
    return replace(perfect(camera), colour=perfect(camera).colour * 0.8 + 0.05)


def quiet() -> Console:
    return Console(file=io.StringIO(), width=120)


@pytest.mark.parametrize("listed", [7, ["a"], [1], "abc", None])
def test_an_evaluation_with_a_damaged_list_of_photographs_is_replaced(listed, scene, tmp_path):
    (tmp_path / "evaluation.json").write_text(json.dumps({"per_photograph": listed}))
    evaluate(perfect, scene, tmp_path, configuration={}, overwrite=True, console=quiet())
    assert set(json.loads((tmp_path / "evaluation.json").read_text())["per_photograph"]) == {"01.jpg"}


def test_the_report_holds_every_key_that_scripts_rely_on(scene, tmp_path):
    evaluation = evaluate(darker, scene, tmp_path / "out", configuration={"method": "wall"}, console=quiet())
    report = json.loads((tmp_path / "out" / "evaluation.json").read_text())
    assert report == evaluation.report
    assert set(report["per_photograph"]) == {"01.jpg"}
    for row in (report["mean"], report["per_photograph"]["01.jpg"]):
        assert set(row) >= NAMES | {"reasons", "seen_share"}
        missing = {name for name in NAMES if row[name] is None}
        assert missing == {name for name in NAMES if name.startswith("lpips")}
        assert row["reasons"] == dict.fromkeys(missing, "not here")
    assert report["version"] == __version__
    assert report["configuration"] == {"method": "wall"}
    assert report["split"] == {"train": ["00.jpg", "02.jpg"], "test": ["01.jpg"]}
    assert report["width"] == 48
    assert report["peak_memory_bytes"] > 10_000_000
    assert report["rays_per_second"] == pytest.approx(48 * 36 / report["seconds_per_frame"])


def test_the_memory_is_that_of_the_gpu_that_was_used(scene, tmp_path, monkeypatch):
    report = evaluate(perfect, scene, tmp_path / "cpu", configuration={}, console=quiet()).report
    monkeypatch.setattr(torch.cuda, "is_initialized", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 3)
    monkeypatch.setattr(torch.cuda, "max_memory_allocated", lambda device=0: [0, 7_000_000, 0][device])
    gpus = evaluate(perfect, scene, tmp_path / "gpus", configuration={}, console=quiet()).report
    found = [one["peak_cuda_memory_bytes"] for one in (report, gpus)]
    assert found == [None, 7_000_000]


def test_the_memory_is_that_of_all_photographs(tmp_path, monkeypatch):
    scene = wall.scene(wall.cameras(5), test=(1, 3))
    peak = [0]

    def render(camera):
        peak[0] += 1_000_000
        return perfect(camera)

    monkeypatch.setattr(module, "_peak_memory", lambda: {"peak_memory_bytes": peak[0], "peak_cuda_memory_bytes": None})
    report = evaluate(render, scene, tmp_path, configuration={}, console=quiet()).report
    assert report["peak_memory_bytes"] == 2_000_000


@pytest.mark.parametrize("prepared_without", [True, False])
def test_the_report_says_whether_poses_know_of_the_held_out_photographs(prepared_without, scene, tmp_path):
    scene = replace(scene, root=tmp_path)
    if prepared_without:
        Holdout(frozenset({"01.jpg"}), {}).write(tmp_path)
    report = evaluate(perfect, scene, tmp_path / "out", configuration={}, console=quiet()).report
    assert report["held_out_of_poses"] is prepared_without


def test_results_on_other_poses_or_another_split_can_be_told_apart(scene, tmp_path):
    moved = scene.cameras.T_world_camera.clone()
    moved[2, 0, 3] += 0.01
    rounded = scene.cameras.T_world_camera * (1 + 1e-7)
    states = {
        "as it is": scene,
        "rounded": replace(scene, cameras=replace(scene.cameras, T_world_camera=rounded)),
        "moved": replace(scene, cameras=replace(scene.cameras, T_world_camera=moved)),
        "split": replace(scene, train=(0,), test=(1, 2)),
    }
    poses = {
        name: evaluate(perfect, state, tmp_path / name, configuration={}, console=quiet()).report["poses"]
        for name, state in states.items()
    }
    assert poses["as it is"] == poses["rounded"]
    assert len(set(poses.values())) == 3


def test_a_colour_fit_undoes_an_exposure(scene, tmp_path):
    mean = evaluate(darker, scene, tmp_path, configuration={}, console=quiet()).mean
    assert mean["psnr"] < 25
    assert mean["psnr_cc"] > 45
    assert mean["psnr_seen_cc"] > 45


def test_a_perfect_method_scores_the_best_values(scene, tmp_path):
    mean = evaluate(perfect, scene, tmp_path, configuration={}, console=quiet()).mean
    assert mean["psnr"] == mean["psnr_seen"] == PSNR_LIMIT_DB
    assert mean["ssim"] == pytest.approx(1)
    assert mean["flip"] == pytest.approx(0, abs=1e-6)


def test_masked_pixels_do_not_count(scene, tmp_path):
    masked = wall.with_left_halves_masked(scene, (1,))

    def wrong_on_the_left(camera: Cameras) -> Rendering:
        colour = perfect(camera).colour
        colour[:, : camera.width // 2] = 0
        return replace(perfect(camera), colour=colour)

    mean = evaluate(wrong_on_the_left, masked, tmp_path / "masked", configuration={}, console=quiet()).mean
    assert mean["psnr"] == mean["psnr_seen"] == PSNR_LIMIT_DB
    plain = evaluate(wrong_on_the_left, scene, tmp_path / "plain", configuration={}, console=quiet()).mean
    assert plain["psnr"] < 15


def test_an_evaluation_that_dies_leaves_no_older_report_beside_its_pictures(tmp_path):
    scene = wall.scene(wall.cameras(5), test=(1, 3))
    settings = {"configuration": {}, "console": quiet(), "overwrite": True}
    evaluate(darker, scene, tmp_path, **settings)

    def die(camera: Cameras) -> Rendering:
        raise KeyboardInterrupt

    def die_at_the_second(camera: Cameras) -> Rendering:
        return die(camera) if camera.names == ("03.jpg",) else perfect(camera)

    with pytest.raises(KeyboardInterrupt):
        evaluate(die, scene, tmp_path, **settings)
    assert (tmp_path / "evaluation.json").exists(), "before the first new picture"
    with pytest.raises(KeyboardInterrupt):
        evaluate(die_at_the_second, scene, tmp_path, **settings)
    assert not list(tmp_path.glob("*evaluation*"))


@pytest.mark.parametrize(("changed", "asked"), [(False, True), (True, True), (False, False)])
def test_an_interrupted_evaluation_goes_on_unless_something_else_is_evaluated(tmp_path, monkeypatch, changed, asked):
    monkeypatch.setattr(module, "commit", lambda: None)
    anew = changed or not asked
    scene, rendered = wall.scene(wall.cameras(6), test=(1, 3, 4)), []

    def counted(camera: Cameras) -> Rendering:
        rendered.extend(camera.names)
        if camera.names == ("04.jpg",) and rendered.count("04.jpg") == 1:
            raise KeyboardInterrupt
        return darker(camera)

    with pytest.raises(KeyboardInterrupt):
        evaluate(counted, scene, tmp_path, configuration={"steps": 1}, console=quiet(), goes_on=True)
    (tmp_path / "renderings" / "01.png").unlink()
    steps = {"steps": 2 if changed else 1}
    found = evaluate(counted, scene, tmp_path, configuration=steps, console=quiet(), goes_on=asked)
    assert rendered[3:] == (["01.jpg", "03.jpg", "04.jpg"] if anew else ["01.jpg", "04.jpg"])
    whole = evaluate(darker, scene, tmp_path / "whole", configuration=steps, console=quiet())
    assert found.mean == whole.mean
    assert list(found.report["per_photograph"]) == ["01.jpg", "03.jpg", "04.jpg"]
    assert found.report.get("of_an_interrupted_evaluation") == (None if anew else 2)
    assert not (tmp_path / "measured_so_far.json").exists()
    evaluate(counted, scene, tmp_path, configuration=steps, console=quiet(), overwrite=True)
    assert rendered[-3:] == ["01.jpg", "03.jpg", "04.jpg"]


def test_an_evaluation_of_another_split_leaves_no_pictures_of_the_former(tmp_path):
    for test in ((1, 3), (2,)):
        scene = wall.scene(wall.cameras(5), test=test)
        evaluate(darker, scene, tmp_path, configuration={}, console=quiet(), overwrite=True)
    assert [path.name for path in (tmp_path / "renderings").iterdir()] == ["02.png"]


def test_renderings_and_labelled_pictures_are_written(scene, tmp_path):
    evaluate(darker, scene, tmp_path, configuration={}, console=quiet())
    with Image.open(tmp_path / "renderings" / "01.png") as picture:
        bare = np.asarray(picture)
    expected = (darker(scene.cameras[1]).colour * 255).round().numpy()
    np.testing.assert_array_equal(bare, expected)
    with Image.open(tmp_path / "pictures" / "01.png") as labelled:
        assert labelled.width > 4 * 48
        assert labelled.height > 36


def test_means_are_over_the_photographs_that_have_a_value(tmp_path):
    # The last camera looks at ground that no training photograph sees.
    own = wall.cameras(4)
    pose = own.T_world_camera.clone()
    pose[3, 0, 3] = 100.0
    scene = wall.scene(replace(own, T_world_camera=pose), test=(1, 3))
    report = evaluate(darker, scene, tmp_path, configuration={}, console=quiet()).report
    seen, unseen = report["per_photograph"]["01.jpg"], report["per_photograph"]["03.jpg"]
    assert unseen["seen_share"] == 0
    assert unseen["psnr_seen"] is None
    assert "psnr_seen" in unseen["reasons"]
    assert report["mean"]["psnr_seen"] == seen["psnr_seen"]
    assert report["mean"]["psnr"] == pytest.approx((seen["psnr"] + unseen["psnr"]) / 2)


class Half(Lpips):
    """Finds the same distance everywhere."""

    def __init__(self) -> None:
        self.sha256 = "7be5be79"

    def __call__(self, image, truth, masks):
        return [0.5] * len(masks)


def test_lpips_is_measured_of_all_photographs_or_of_none(tmp_path, monkeypatch):
    own = wall.cameras(4, 48, 36)
    larger = replace(own, size_px=torch.tensor([[48, 36], [48, 36], [48, 36], [64, 48]]))
    scene = wall.scene(larger, test=(1, 3))
    monkeypatch.setattr(module, "load_lpips", lambda: {"lpips_alex": Half(), "lpips_vgg": "no"})
    for memory_px, expected in ((64 * 48, 0.5), (64 * 48 - 1, None)):
        monkeypatch.setattr("tidefield.evaluation.lpips.memory_bytes", lambda px=memory_px: 2 * 150 * px)
        report = evaluate(perfect, scene, tmp_path / str(memory_px), configuration={}, console=quiet()).report
        assert [row["lpips_alex"] for row in report["per_photograph"].values()] == [expected, expected]
        assert report["mean"]["reasons"]["lpips_vgg"] == "no", "the first reason"
    assert report["mean"]["reasons"]["lpips_alex"].startswith("LPIPS of 64 x 48 pixels takes")


def test_an_evaluation_is_only_overwritten_on_request(scene, tmp_path):
    (tmp_path / "evaluation.json").write_text("precious")
    with pytest.raises(RunError, match=r"evaluation\.json is there already.*--overwrite"):
        evaluate(perfect, scene, tmp_path, configuration={}, console=quiet())
    assert (tmp_path / "evaluation.json").read_text() == "precious"
    assert [path.name for path in tmp_path.iterdir()] == ["evaluation.json"]
    evaluate(perfect, scene, tmp_path, configuration={}, overwrite=True, console=quiet())
    assert json.loads((tmp_path / "evaluation.json").read_text())["version"] == __version__


def test_weights_are_downloaded_when_an_evaluation_can_be_written_only(scene, tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr("tidefield.evaluation.evaluate.download_lpips_weights", lambda: asked.append(True))
    monkeypatch.setattr(module, "prepare_torchvision", lambda: None)
    evaluate(perfect, scene, tmp_path, configuration={}, console=quiet())
    with pytest.raises(RunError):
        evaluate(perfect, scene, tmp_path, configuration={}, console=quiet(), download_lpips=True)
    assert asked == []
    evaluate(perfect, scene, tmp_path, configuration={}, console=quiet(), overwrite=True, download_lpips=True)
    assert asked == [True]


def test_weights_that_nothing_can_use_are_not_downloaded(scene, tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(module, "download_lpips_weights", lambda: asked.append(True))
    monkeypatch.setattr(module, "prepare_torchvision", lambda: "torchvision is not installed")
    with pytest.raises(RunError, match="--download-lpips was given, but torchvision is not installed"):
        evaluate(perfect, scene, tmp_path, configuration={}, console=quiet(), download_lpips=True)
    assert asked == []


def test_a_rendering_that_is_not_finite_is_named(scene, tmp_path):
    def diverged(camera: Cameras) -> Rendering:
        return replace(perfect(camera), colour=perfect(camera).colour * torch.nan)

    with pytest.raises(RunError, match=r"01\.jpg holds NaN"):
        evaluate(diverged, scene, tmp_path, configuration={}, console=quiet())


def test_a_scene_without_held_out_photographs_cannot_be_evaluated(tmp_path):
    scene = wall.scene(wall.cameras(3), test=())
    with pytest.raises(RunError, match="holds no photograph out"):
        evaluate(perfect, scene, tmp_path, configuration={}, console=quiet())


def test_an_output_path_that_is_a_file_is_one_clear_error(scene, tmp_path):
    (tmp_path / "out").write_text("a file")
    with pytest.raises(RunError, match="cannot be written"):
        evaluate(perfect, scene, tmp_path / "out", configuration={}, console=quiet())


def test_the_table_says_what_is_missing_and_why(scene, tmp_path):
    console = quiet()
    evaluate(darker, scene, tmp_path, configuration={}, console=console)
    assert isinstance(console.file, io.StringIO)
    text = console.file.getvalue()
    assert re.search(r"PSNR, dB .*\d\d\.\d\d", text)
    assert re.search(r"LPIPS, VGG .*-", text)
    assert "No LPIPS, AlexNet; LPIPS, VGG: " in text
    assert text.count("not here") == 1
    assert str(tmp_path / "pictures") in text


def test_what_is_missing_of_some_pixels_only_is_named_with_them(tmp_path):
    reasons = {f"{metric}{suffix}": "nobody sees them" for metric in module.METRICS for suffix in ("_seen", "_seen_cc")}
    reasons |= {f"lpips_vgg{suffix}": "not installed" for suffix in module.SUFFIXES}
    report = {"mean": {"reasons": reasons, "seen_share": 0.0}, "seconds_per_frame": 1.0, "rays_per_second": 1.0}
    first, second, *_ = module._remarks(report, tmp_path)
    assert first.startswith("No PSNR, dB (doubly seen; doubly seen, colour fit); SSIM (doubly seen;")
    assert second == "No LPIPS, VGG: not installed"


def test_pictures_of_photographs_that_differ_in_their_suffix_only_do_not_collide():
    names = [str(path) for path in module.picture_names(["a.JPG", "a.png", "strip/b.jpg"])]
    assert names == ["a.JPG.png", "a.png.png", "strip/b.png"]
