"""The commands as a user calls them."""

from __future__ import annotations

import errno
import json
import os
import re
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from PIL import Image
from surveys_of_two_dates import write_surface

from tidefield import cli, synthetic
from tidefield import progress as meter
from tidefield.commands import common, demo
from tidefield.data.load import load_scene
from tidefield.files import only_writer
from tidefield.synthetic import make_survey, write_survey


def call(*arguments: object) -> None:
    """Run a command in this process."""
    sys.argv = ["tidefield", *map(str, arguments)]
    cli.main()


def fails(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """Run a command that must end with one message and status 2; returns the message."""
    with pytest.raises(SystemExit) as ended:
        call(*arguments)
    assert ended.value.code == 2
    message = capsys.readouterr().err
    assert message.startswith("tidefield: ")
    assert "Traceback" not in message
    return message


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("flat") / "scene"
    write_survey(make_survey("vegetation", seed=1, views=9, width=64, supersample=1), folder)
    return folder


@pytest.fixture(scope="module")
def run(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs") / "run"
    call("train", scene, folder, "--steps", 1, "--device", "cpu", "-q")
    return folder


def test_train_evaluate_and_render_work_together(scene: Path, run: Path, tmp_path: Path) -> None:
    call("evaluate", run, "--device", "cpu", "-q")
    report = json.loads((run / "evaluation.json").read_text())
    assert set(report["per_photograph"]) == {"vegetation_0001.png", "vegetation_0009.png"}
    assert report["mean"]["psnr_seen_cc"] > 20
    assert report["rays_per_second"] > 0
    assert report["configuration"]["preset"] == "swift"
    assert report["split"]["test"] == ["vegetation_0001.png", "vegetation_0009.png"]
    still = tmp_path / "view.png"
    call("render", run, still, "--camera", "vegetation_0001", "--width", 40, "-q")
    with Image.open(still) as picture:
        assert picture.size == (40, 30)
        assert picture.text["Title"] == "scene, vegetation_0001.png"
        assert json.loads(picture.text["Camera"])["width"] == 40
    assert np.load(tmp_path / "view_depth.npy").shape == (30, 40)
    video = tmp_path / "flight.mp4"
    call("render", run, video, "--path", "strip", "--frames", 2, "--width", 32, "-q")
    assert video.stat().st_size > 0


@pytest.mark.thorough
def test_a_path_of_a_file_has_its_own_size_unless_another_in_its_proportion_is_given(
    scene: Path, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pose = load_scene(scene).cameras.T_world_camera[0].numpy() @ np.diag([1.0, -1.0, -1.0, 1.0])  # OpenGL's axes
    frame = {"camera_to_world": [*pose.flatten().tolist(), 0.0, 0.0, 0.0, 1.0], "fov": 50.0, "aspect": 4 / 3}
    path = tmp_path / "camera_path.json"
    path.write_text(json.dumps({"render_width": 48, "render_height": 36, "fps": 24, "camera_path": [frame, frame]}))
    for name, options, size in (("own", [], (48, 36)), ("small", ["--width", 32], (32, 24))):
        video = tmp_path / f"{name}.mp4"
        call("render", run, video, "--path", path, *options, "--device", "cpu", "-q")
        capture = cv2.VideoCapture(str(video))
        assert tuple(int(capture.get(k)) for k in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)) == size
        assert int(capture.get(cv2.CAP_PROP_FRAME_COUNT)) == 2
    stretched = ["--path", path, "--width", 32, "--height", 32]
    assert "the same proportion" in fails(capsys, "render", run, tmp_path / "a.mp4", *stretched)
    name = load_scene(scene).names[0]
    stretched = ["--camera", name, "--width", 32, "--height", 32]
    assert "the same proportion" in fails(capsys, "render", run, tmp_path / "a.png", *stretched)
    call("render", run, tmp_path / "smallest.png", "--camera", name, "--width", 16, "--device", "cpu", "-q")
    with Image.open(tmp_path / "smallest.png") as picture:
        assert picture.size == (16, 16)  # of the least height


@pytest.mark.thorough
def test_a_run_is_evaluated_at_another_width_than_its_own_and_with_several_rays(
    scene: Path, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    psnr = {}
    for rays in (1, 4):
        out = tmp_path / str(rays)
        call("evaluate", run, out, "--width", 32, "--rays-per-pixel", rays, "--device", "cpu", "-q")
        report = json.loads((out / "evaluation.json").read_text())
        assert (report["width"], report["configuration"]["trained_width"]) == (32, 64)
        assert report["configuration"]["sampling"] == {"cones": True, "rays_per_side": rays**0.5}
        with Image.open(out / "renderings" / "vegetation_0001.png") as picture:
            assert picture.size == (32, 24)
        psnr[rays] = report["mean"]["psnr_seen_cc"]
    assert psnr[4] != psnr[1] > 20
    assert "--width is given without OUT" in fails(capsys, "evaluate", run, "--width", 32)


@pytest.mark.parametrize("source", ["run", "scene"])
def test_the_view_of_a_training_photograph_is_made_from_the_others_unless_asked(
    source: str, scene: Path, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    own = [request.getfixturevalue(source), *(["--zero-shot"] if source == "scene" else [])]
    for options in ([], ["--with-itself"]):
        out = tmp_path / f"{len(options)}.png"
        call("render", *own, out, "--camera", "vegetation_0005", *options, "--device", "cpu", "-q")
    truth, made, with_itself = (
        np.asarray(Image.open(path).convert("RGB"), np.float32)
        for path in (scene / "images" / "vegetation_0005.png", tmp_path / "0.png", tmp_path / "1.png")
    )
    assert np.square(made - truth).mean() > 2 * np.square(with_itself - truth).mean()


def test_resume_goes_on_from_the_last_step(scene: Path, run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from tidefield.model.network import make_network
    from tidefield.train.checkpoint import load_network, read_run

    call("train", scene, run, "--steps", 2, "--resume", "-q")
    assert load_network(run, make_network(read_run(run).config.network)).step == 2
    capsys.readouterr()
    call("train", scene, run, "--resume")
    assert "the budget was used before" in capsys.readouterr().out


def test_a_run_is_not_overwritten_unasked(scene: Path, run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = (run / "checkpoint.safetensors").read_bytes()
    assert "--overwrite" in fails(capsys, "train", scene, run, "--steps", 1)
    assert (run / "checkpoint.safetensors").read_bytes() == before


def test_a_folder_with_other_files_is_not_made_a_run(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "thesis.tex").write_text("years of work")
    assert "other files" in fails(capsys, "train", scene, tmp_path, "--steps", 1, "--overwrite")
    assert (tmp_path / "thesis.tex").read_text() == "years of work"


def test_an_imported_scene_is_told_of_and_can_be_used(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    call("import", scene, tmp_path / "own", "--link")
    assert re.search(
        r"own: 9 photographs, 2 of them held out; 1 camera; [\d,]+ sparse points, observed [\d,]+ times",
        capsys.readouterr().out,
    )
    assert (tmp_path / "own" / "transforms.json").is_file()
    assert "is there already" in fails(capsys, "import", scene, tmp_path / "own")
    assert "no posed photographs" in fails(capsys, "import", tmp_path, tmp_path / "other")
    call("evaluate", tmp_path / "own", tmp_path / "floor", "--method", "sparse-depth", "--width", 48, "-q")
    report = json.loads((tmp_path / "floor" / "evaluation.json").read_text())
    assert report["split"]["test"] == ["vegetation_0001.png", "vegetation_0009.png"]
    assert (report["width"], report["configuration"]) == (48, {"method": "sparse-depth"})


def test_users_mistakes_are_one_clear_message(
    scene: Path, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert "no posed photographs" in fails(capsys, "train", tmp_path, tmp_path / "new")
    assert "cuda:7" in fails(capsys, "train", scene, tmp_path / "new", "--device", "cuda:7")
    assert "both" in fails(capsys, "train", scene, tmp_path / "new", "--steps", 1, "--minutes", 1)
    assert "holds no run" in fails(capsys, "evaluate", tmp_path)
    assert "nowhere is missing" in fails(capsys, "evaluate", tmp_path / "nowhere")
    assert "nowhere to write" in fails(capsys, "evaluate", scene, "--method", "sparse-depth")
    assert "--opened-width belongs to --zero-shot" in fails(capsys, "evaluate", run, "--opened-width", 400)
    weights = "--weights", tmp_path / "w.safetensors"
    for words in (
        ("evaluate", run),
        ("evaluate", tmp_path, tmp_path / "new", "--method", "nearest"),
        ("render", run, tmp_path / "a.png", "--camera", "a"),
    ):
        assert "--weights belongs to --zero-shot" in fails(capsys, *words, *weights)
        assert "--preset belongs to --zero-shot" in fails(capsys, *words, "--preset", "paper")
    for given in (("--path", "orbit"), ("--frames", 240)):
        said = fails(capsys, "render", run, tmp_path / "a.png", "--camera", "a", *given)
        assert f"{given[0]} belongs to a video" in said
    said = fails(capsys, "train", scene, run, "--steps", 5, "--resume", "--overwrite")
    assert "--resume continues the run that --overwrite replaces" in said
    assert "no photograph named" in fails(capsys, "render", run, tmp_path / "a.png", "--camera", "nobody")
    assert ".mp4" in fails(capsys, "render", run, tmp_path / "a.gif")
    assert "with --camera" in fails(capsys, "render", run, tmp_path / "a.png")
    for command in (("render", scene, tmp_path / "a.mp4"), ("evaluate", scene, tmp_path / "out")):
        message = fails(capsys, *command)
        assert "add --zero-shot" in message
        assert f"`tidefield train {scene} RUN`" in message
    assert "--zero-shot" not in fails(capsys, "render", tmp_path, tmp_path / "a.mp4")
    photographs = scene / "images"
    assert f"`tidefield prepare {photographs} SCENE`" in fails(capsys, "train", photographs, tmp_path / "new")
    assert "--camera" in fails(capsys, "render", run, tmp_path / "a.mp4", "--with-itself")
    assert not (tmp_path / "new").exists()


def test_where_a_rendering_goes_is_checked_before_it_is_made(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tidefield.methods.trained", lambda *_: pytest.fail("a run was opened"))
    (tmp_path / "file").touch()
    for name in ("folder.mp4", "folder.png", "other_depth.npy"):
        (tmp_path / name).mkdir()
    for out, message in (
        ("folder.mp4", "is a folder"),
        ("folder.png", "is a folder"),
        ("other.png", "other_depth.npy is a folder"),
        ("file/a.mp4", "Not a directory"),
    ):
        camera = ["--camera", "vegetation_0001"] if out.endswith(".png") else []
        assert message in fails(capsys, "render", run, tmp_path / out, *camera, "--overwrite", "-q")
    monkeypatch.undo()
    monkeypatch.setattr("tidefield.evaluation.evaluate._timed", lambda *_: pytest.fail("something was rendered"))
    assert "Not a directory" in fails(capsys, "evaluate", run, tmp_path / "file" / "out", "-q")


@pytest.mark.parametrize("frames", [0, -1])
def test_a_video_needs_a_frame(frames: int, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    message = fails(capsys, "render", run, tmp_path / "a.mp4", "--frames", frames, "--width", 32, "-q")
    assert "expected at least one" in message
    assert not (tmp_path / "a.mp4").exists()


def test_the_cache_of_photographs_is_shown_and_emptied(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    call("cache")
    assert capsys.readouterr().out == f"{tmp_path / 'tidefield'}: 0 files, 0 MB of at most 20,000 MB\n"
    for width in (32, 48):  # of files of 64, which are also read at 64; what is estimated at each width is kept, too
        call("evaluate", scene, tmp_path / str(width), "--method", "nearest", "--width", width, "-q")
    (tmp_path / "tidefield" / "thesis.tex").touch()
    monkeypatch.setenv("TIDEFIELD_CACHE_GB", "0.5")
    call("cache")
    assert capsys.readouterr().out == f"{tmp_path / 'tidefield'}: 5 files, 0 MB of at most 500 MB\n"
    call("cache", "--clear")
    assert capsys.readouterr().out.startswith("deleted: 5 files, 0 MB\n")
    assert [path.name for path in (tmp_path / "tidefield").iterdir()] == ["thesis.tex"]


@pytest.mark.thorough
def test_the_demonstration_makes_all_that_it_names(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def smaller(category: str, seed: int, views: int, width: int) -> synthetic.Survey:
        return make_survey(category, seed, views, width=width // 10, supersample=1)

    monkeypatch.setattr(synthetic, "make_survey", smaller)
    monkeypatch.setattr(demo, "FRAMES", 2)
    monkeypatch.setattr(demo, "FLIGHT_SIZE", (64, 36))
    monkeypatch.setattr(demo, "TRAINING_WIDTH", 32)
    out = tmp_path / "demo"
    words = "demo", out, "--minutes", 0.01, "--device", "cpu"
    call(*words)
    named = [Path(line.split()[-1]) for line in capsys.readouterr().out.split("Written:")[1].strip().splitlines()]
    names = ["scene", "first-view.png", "run/evaluation.json", "side-by-side.png", "run/pictures", "flight.mp4"]
    assert named == [out / name for name in names]
    assert all(path.exists() for path in named)
    # Again: what is there is used, what was changed stays, what is missing is made.
    (out / "run" / "evaluation.json").write_text("{}")
    (out / "thesis.docx").write_text("years of work")
    (out / "side-by-side.png").unlink()
    before = contents(out)
    call(*words)
    after = contents(out)
    assert after.pop(Path("side-by-side.png"))
    assert after == before
    # Anew: what the demonstration made is replaced, unless something else would be lost with it.
    (out / "run" / "notes.txt").write_text("mine")
    call(*words)  # what is completed again does not become the demonstration's
    assert "no demonstration made (run/notes.txt)" in fails(capsys, *words, "--overwrite")
    assert contents(out).items() >= before.items()
    (out / "run" / "notes.txt").unlink()
    (out / "link").symlink_to(out)
    call("demo", out / "link", *words[2:], "--overwrite")
    assert (out / "thesis.docx").read_text() == "years of work"
    assert json.loads((out / "run" / "evaluation.json").read_text())["mean"]


def test_mistakes_are_refused_before_anything_is_made_or_read(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(common, "load", lambda *_: pytest.fail("photographs were read"))
    out = tmp_path / "demo"
    assert "--minutes 0.0" in fails(capsys, "demo", out, "--minutes", 0)
    assert not out.exists()
    video = "render", scene, tmp_path / "a.mp4", "--zero-shot"
    assert "no camera path is called 'oribt'" in fails(capsys, *video, "--path", "oribt")
    assert "path.json" in fails(capsys, *video, "--path", tmp_path / "path.json")
    assert "0 frames" in fails(capsys, *video, "--frames", 0)
    assert "--width 8" in fails(capsys, *video, "--width", 8)
    (tmp_path / "notes.txt").write_text("no weights")
    weights = "--weights", tmp_path / "notes.txt"
    assert "notes.txt is damaged" in fails(capsys, *video, *weights)
    assert "notes.txt is damaged" in fails(capsys, "evaluate", scene, tmp_path / "out", "--zero-shot", *weights)
    monkeypatch.setattr("tidefield.commands.train.load", lambda *_: pytest.fail("photographs were read"))
    assert "notes.txt is damaged" in fails(capsys, "train", scene, tmp_path / "run", *weights)
    assert "notes.txt is a file" in fails(capsys, "train", scene, tmp_path / "notes.txt")


def test_an_evaluation_that_would_be_replaced_is_refused_before_its_run_is_opened(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tidefield.commands.evaluate.open_trained", lambda *_: pytest.fail("a run was opened"))
    (tmp_path / "evaluation.json").write_text("{}")
    assert "evaluation.json is there already" in fails(capsys, "evaluate", run, tmp_path)


def test_a_run_is_no_scene(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "is a run, not a scene" in fails(capsys, "train", run, tmp_path / "new")


def contents(folder: Path) -> dict[Path, bytes]:
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("options", [[], ["--overwrite"]])
def test_the_demonstration_leaves_alone_what_it_did_not_make(
    options: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "mine"
    for name in ("scene/truth/height.npy", "run/evaluation.json", "thesis.docx"):
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        (out / name).write_text("years of work")
    before = contents(out)
    assert "no demonstration made" in fails(capsys, "demo", out, *options)
    assert contents(out) == before


def test_a_folder_has_one_demonstration_at_a_time(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    partial = tmp_path / ".scene-0123abcd.partial"
    partial.mkdir()
    (tmp_path / "demonstration.json").write_text('{"files": [], "unfinished": true}')
    with only_writer(tmp_path):
        assert "another process is writing" in fails(capsys, "demo", tmp_path)
    assert partial.exists(), "the other one is making it"


def test_progress_is_told_where_there_is_no_terminal(
    scene: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(meter, "LINE_SECONDS", 0.0)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    command = "evaluate", scene, tmp_path / "floor", "--method", "sparse-depth", "--width", 40, "--overwrite"
    call(*command)
    printed = capfd.readouterr()
    assert re.search(r"^\d\d:\d\d:\d\d Reading photographs: 9 of 9$", printed.err, flags=re.MULTILINE)
    assert re.search(r"^\d\d:\d\d:\d\d Evaluating: 2 of 2$", printed.err, flags=re.MULTILINE)
    assert "Evaluating" not in printed.out
    call(*command, "-q")
    printed = capfd.readouterr()
    assert (printed.out, printed.err) == ("", "")


@pytest.mark.parametrize("name", ["[/red]", "[x] :sea: [bold]", "caf\udce9"])
def test_a_name_is_printed_as_it_is(
    name: str, scene: Path, tmp_path: Path, capfdbinary: pytest.CaptureFixture[bytes]
) -> None:
    call("import", scene, tmp_path / name)
    call("evaluate", tmp_path / name, tmp_path / name / "out", "--method", "nearest", "--width", 40)
    printed = capfdbinary.readouterr().out.decode()
    assert printed.count(name.encode(errors="backslashreplace").decode()) >= 2


@pytest.mark.thorough
def test_a_reader_that_is_gone_ends_a_command_quietly(scene: Path, tmp_path: Path) -> None:
    for words in (["import", scene, tmp_path / "new"], ["--version"]):
        reading, writing = os.pipe()
        os.close(reading)
        command = [sys.executable, "-m", "tidefield.cli", *map(str, words)]
        done = subprocess.run(command, stdout=writing, stderr=subprocess.PIPE, text=True, check=False)
        os.close(writing)
        assert (done.returncode, done.stderr) == (141, "")
    assert (tmp_path / "new" / "sparse").is_dir()


def test_what_is_no_users_mistake_is_reported_as_a_defect(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def stumble(words: list[str]) -> None:
        raise ZeroDivisionError("oh")

    monkeypatch.setattr(cli, "_run", stumble)
    with pytest.raises(SystemExit) as ended:
        call("train", "a b")
    message = capsys.readouterr().err
    assert ended.value.code == 70
    assert re.search(r"Traceback.*in stumble.*ZeroDivisionError: oh\n.*a defect of the program", message, re.DOTALL)
    assert message.endswith("  command: tidefield train 'a b'\n")


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (MemoryError(), "the system gave no more"),
        (None, "DefaultCPUAllocator: can't allocate memory"),  # as PyTorch has it on this system
        (RuntimeError("DefaultCPUAllocator: not enough memory: you tried 8"), "DefaultCPUAllocator: not enough memory"),
        (OSError(errno.ENOMEM, "Cannot allocate memory"), "[Errno 12] Cannot allocate memory"),
        (RuntimeError("MPS backend out of memory (allocated: 9 GB)"), "MPS backend out of memory (allocated: 9 GB)"),
        (torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2 GiB. GPU 0 has\nmore"), "CUDA out of memory"),
    ],
)
def test_too_little_memory_is_no_defect(
    error: Exception | None, reason: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def stumble(words: list[str]) -> None:
        if error is None:
            torch.empty(10**15)
        else:
            raise error

    monkeypatch.setattr(cli, "_run", stumble)
    message = fails(capsys, "train", "a", "b")
    assert f"not enough memory ({reason}): expected more; choose a smaller --width" in message


def test_a_place_that_the_system_refuses_is_one_clear_message(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    for place, reason in (("a" * 300, "name too long"), ("loop/x", "symbolic links|cannot be"), ("a\0b", "zero byte")):
        assert re.search(reason, fails(capsys, "train", scene, tmp_path / place, "--steps", 1))
        assert re.search(reason, fails(capsys, "import", scene, tmp_path / place))
        assert fails(capsys, "train", tmp_path / place, tmp_path / "new", "--steps", 1)
        assert fails(capsys, "evaluate", tmp_path / place)


@pytest.mark.skipif(sys.platform == "win32", reason="needs a terminal to write to")
@pytest.mark.parametrize("given", ["", "1"])
def test_help_has_no_colours_where_none_are_wanted(given: str) -> None:
    import pty

    own, terminal = pty.openpty()
    environment = {**os.environ, "TERM": "xterm", "NO_COLOR": given}
    words = [sys.executable, "-m", "tidefield.cli", "cache", "--help"]
    child = subprocess.Popen(words, env=environment, stdout=terminal, stderr=terminal)
    os.close(terminal)
    found = b""
    try:
        while some := os.read(own, 65536):
            found += some
    except OSError:  # Linux ends what is read from a terminal that is closed like this
        pass
    os.close(own)
    assert child.wait() == 0
    assert b"--clear" in found
    assert (b"\x1b[" in found) == (given == "")


def test_help_does_not_import_torch() -> None:
    code = "import sys; sys.argv = ['tidefield', '--help']\nfrom tidefield import cli\n"
    code += "try:\n    cli.main()\nexcept SystemExit:\n    assert 'torch' not in sys.modules\n    print('fine')\n"
    start = time.monotonic()
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.endswith("fine\n"), time.monotonic() - start


@pytest.mark.thorough
def test_surfaces_and_clouds_are_compared_without_torch(tmp_path: Path) -> None:
    modules = ", ".join(f"tidefield.change.{name}" for name in ("inputs", "measure", "cover", "water", "write", "page"))
    rng = np.random.default_rng(0)
    heights = [rng.normal(0, 0.02, (60, 80)).astype(np.float32) for _ in range(3)]
    paths = [write_surface(tmp_path / f"2023-05-0{k}.tif", some) for k, some in enumerate(heights, start=1)]
    words = ["change", str(paths[0]), str(paths[1]), str(tmp_path / "out"), "--series", str(paths[2]), "-q"]
    code = f"import sys, {modules}; from tidefield import cli; cli._run({words})\n"
    code += "assert not {'torch', 'pycolmap'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)
    assert (tmp_path / "out" / "series.html").is_file()
