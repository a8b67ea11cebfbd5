"""Work on a Ray cluster, a real one on this machine: the same results as without, and nothing but tasks is lost."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import av
import numpy as np
import pytest
import torch

from tidefield.cluster import Share, connected, each_on_cluster, on_cluster, share_of
from tidefield.commands.common import ZeroShot, open_zero_shot
from tidefield.commands.render import Render, _frames_of_cluster, _key
from tidefield.compare.run import Settings, scene_runner
from tidefield.data.load import load_scene
from tidefield.errors import RunError
from tidefield.render.camera_paths import make_trajectory
from tidefield.render.stills import colour_picture
from tidefield.synthetic import make_survey, write_survey

ray = pytest.importorskip("ray", reason="Ray is not installed: pip install 'tidefield[cluster]'")
pytestmark = [
    pytest.mark.skipif(sys.platform != "linux", reason="tested on Linux only"),
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]


ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def address():
    """A cluster with two cores, whose workers find this tree."""
    runtime = {"env_vars": {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}}
    context = ray.init(
        address="local", num_cpus=2, include_dashboard=False, log_to_driver=False, runtime_env=runtime,
        object_store_memory=100_000_000,
    )  # fmt: skip
    yield context.address_info["address"]
    ray.shutdown()


@pytest.mark.thorough
def test_every_item_is_worked_on_and_a_worker_prepares_once(address, tmp_path: Path):
    @contextmanager
    def prepare():
        (tmp_path / f"prepared {os.getpid()} {time.time_ns()}").touch()
        yield lambda item: item**2

    assert sorted(on_cluster(ray, "squares", prepare, range(12))) == [(k, k**2) for k in range(12)]
    assert 1 <= len(list(tmp_path.glob("prepared *"))) <= 4


@pytest.mark.thorough
def test_items_come_in_their_order_if_that_is_wanted(address):
    @contextmanager
    def prepare():
        def work(item):
            time.sleep(0.3 if item == 0 else 0)
            return item

        yield work

    found = [item for item, _ in on_cluster(ray, "order", prepare, range(6))]
    assert sorted(found) == list(range(6))
    assert found != list(range(6))
    assert [item for item, _ in on_cluster(ray, "order", prepare, range(6), in_order=True)] == list(range(6))


@pytest.mark.thorough
def test_what_a_worker_has_open_is_closed_before_it_opens_something_else(address, tmp_path: Path):
    @contextmanager
    def prepare(name):
        (tmp_path / f"open {os.getpid()}").touch(exist_ok=False)
        yield lambda item: name
        (tmp_path / f"open {os.getpid()}").unlink()

    for name in ("first", "second"):
        assert {made for _, made in on_cluster(ray, name, partial(prepare, name), range(6))} == {name}


@pytest.mark.thorough
def test_an_error_of_the_function_is_raised_as_it_is(address):
    @contextmanager
    def prepare():
        def work(item):
            raise RunError(f"{item} is wrong: expected another; choose one")

        yield work

    with pytest.raises(RunError, match="7 is wrong"):
        list(on_cluster(ray, "wrong", prepare, [7]))


@pytest.mark.thorough
def test_a_killed_worker_costs_one_task_and_nothing_else(address, tmp_path: Path):
    @contextmanager
    def prepare():
        def work(item):
            with (tmp_path / f"attempts {item}").open("a") as file:
                file.write(f"{os.getpid()}\n")
            time.sleep(0.6)
            (tmp_path / f"done {item}").touch()

        yield work

    killed: list[int] = []

    def kill() -> None:
        generator = np.random.default_rng(0)
        while len(killed) < 3:
            time.sleep(float(generator.uniform(0.1, 0.5)))
            running = [
                int(path.read_text().split()[-1])
                for path in tmp_path.glob("attempts *")
                if path.read_text() and not (tmp_path / path.name.replace("attempts", "done")).exists()
            ]
            if running and running[0] not in killed:
                os.kill(running[0], signal.SIGKILL)
                killed.append(running[0])

    thread = threading.Thread(target=kill)
    thread.start()
    assert sorted(item for item, _ in on_cluster(ray, "killed", prepare, range(10))) == list(range(10))
    thread.join(timeout=10)
    assert len(killed) == 3
    attempts = sum(len(path.read_text().split()) for path in tmp_path.glob("attempts *"))
    assert attempts == 10 + 3


@pytest.mark.thorough
def test_an_item_of_a_group_comes_when_it_is_done(address, tmp_path: Path):
    @contextmanager
    def prepare():
        def work(group):
            for item in group:
                while item and not (tmp_path / f"got {item - 1}").exists():
                    time.sleep(0.05)
                yield item

        yield work

    found = []
    for item in each_on_cluster(ray, "groups", prepare, [(0, 1), (2, 3)]):
        (tmp_path / f"got {item}").touch()
        found.append(item)
    assert found == [0, 1, 2, 3]


@pytest.mark.thorough
def test_a_killed_worker_s_group_goes_on_where_it_was(address, tmp_path: Path):
    @contextmanager
    def prepare():
        def work(group):
            for item in group:
                made = tmp_path / str(item)
                if item % 2 and not made.exists():
                    made.touch()
                    os.kill(os.getpid(), signal.SIGKILL)
                yield item

        yield work

    assert sorted(each_on_cluster(ray, "killed groups", prepare, [(0, 1, 2), (3, 4), (5,)])) == list(range(6))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["1", "3", "5"]


@pytest.mark.thorough
def test_an_error_within_a_group_is_raised_as_it_is(address):
    @contextmanager
    def prepare():
        def work(group):
            yield group[0]
            raise RunError(f"{group[1]} is wrong: expected another; choose one")

        yield work

    with pytest.raises(RunError, match="7 is wrong"):
        list(each_on_cluster(ray, "wrong groups", prepare, [(6, 7)]))


def tidefield(folder: Path, *words: object) -> None:
    """Run a command with a cache of its own."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "XDG_CACHE_HOME": str(folder / "cache")}
    subprocess.run([sys.executable, "-m", "tidefield.cli", *map(str, words)], check=True, env=environment)


@pytest.mark.slow
def test_a_map_of_a_cluster_is_that_of_one_process_to_the_last_byte(address, tmp_path: Path):
    scene = tmp_path / "scene"
    write_survey(make_survey("ground_textures", seed=4, views=9, width=240), scene)
    for name, cluster in (("here", []), ("there", ["--cluster", address])):
        tidefield(tmp_path, "map", scene, tmp_path / name, "--zero-shot", "--gsd", "0.5", "--device", "cpu", *cluster)
    files = sorted(path.relative_to(tmp_path / "here") for path in (tmp_path / "here").rglob("*") if path.is_file())
    assert len(files) >= 20
    rasters = [file for file in files if file.suffix in (".tif", ".laz", ".geojson")]
    assert len(rasters) > 10
    for file in rasters:
        assert (tmp_path / "here" / file).read_bytes() == (tmp_path / "there" / file).read_bytes(), file


@pytest.mark.slow
def test_the_frames_of_a_cluster_are_those_of_one_process(address, tmp_path: Path):
    write_survey(make_survey("ground_textures", seed=4, views=9, width=160), tmp_path / "scene")
    own = ZeroShot(zero_shot=True)
    options = Render(tmp_path / "scene", tmp_path / "video.mp4", zero=own, device="cpu")
    scene = load_scene(options.source)
    view, record = open_zero_shot(own, scene, torch.device("cpu"))
    cameras = make_trajectory("orbit", scene, frames=18, width=160, height=120).cameras
    here = np.stack([colour_picture(view(cameras[k])) for k in range(18)])
    there = np.stack(list(_frames_of_cluster(ray, options, cameras, _key(scene, record))))
    np.testing.assert_array_equal(here, there)
    words = ["render", options.source, options.out, "--zero-shot", "--frames", "18", "--device", "cpu"]
    tidefield(tmp_path, *words, "--cluster", address)
    # The same frames become another file in each run of x264, whose lookahead depends on the order of its threads.
    shown = frames(options.out).astype(np.float32)
    error = np.stack([np.abs(shown - frame).mean((1, 2, 3)) for frame in here])
    assert error.diagonal().max() < 4
    np.testing.assert_array_equal(error.argmin(0), np.arange(18))


def frames(video: Path) -> np.ndarray:
    with av.open(str(video)) as container:
        return np.stack([frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)])


@pytest.mark.slow
def test_a_comparison_of_a_cluster_has_the_figures_of_one_process(address, tmp_path: Path):
    scenes = [tmp_path / name for name in ("first", "second")]
    for seed, scene in enumerate(scenes):
        write_survey(make_survey("ground_textures", seed=seed, views=9, width=120), scene)
    for name, cluster in (("here", []), ("there", ["--cluster", address])):
        words = ["--methods", "nearest", "tidefield", "--steps", "2", "--device", "cpu"]
        tidefield(tmp_path, "compare", *scenes, *words, "--out", tmp_path / name, *cluster)
    for scene in scenes:
        for method in ("nearest", "tidefield"):
            files = [tmp_path / name / "runs" / scene.name / method for name in ("here", "there")]
            here, there = (json.loads((file / "evaluation.json").read_text())["mean"]["psnr"] for file in files)
            assert here == pytest.approx(there, abs=1e-4)
            process = json.loads((files[1] / "process.json").read_text())
            assert process["evaluate"]["seconds"] > 0
    assert (tmp_path / "there" / "tables.md").exists()


@pytest.mark.thorough
def test_a_command_that_fails_on_a_worker_is_its_own_error(tmp_path: Path):
    settings = Settings(None, 2, None, "cpu", 0)
    with (
        scene_runner({"a": tmp_path / "none"}, ["nearest"], settings, tmp_path / "out", {}) as work,
        pytest.raises(RunError, match=r"^[^:]*none is missing: expected one of"),
    ):
        work("a")


def test_a_scene_waits_until_the_child_of_a_dead_worker_has_ended(tmp_path: Path, monkeypatch):
    folder = tmp_path / "out" / "runs" / "a" / "nearest"
    code = f"""
import time
from pathlib import Path
from tidefield.files import only_writer
with only_writer(Path({str(folder)!r})):
    Path({str(tmp_path / "locked")!r}).touch()
    time.sleep(1.5)
    Path({str(tmp_path / "saved")!r}).touch()
"""
    child = subprocess.Popen([sys.executable, "-c", code], env={**os.environ, "PYTHONPATH": str(ROOT)})
    while not (tmp_path / "locked").exists():
        time.sleep(0.05)
    saved = []
    monkeypatch.setattr("tidefield.compare.run.compare", lambda *_: saved.append((tmp_path / "saved").exists()))
    with scene_runner({"a": tmp_path}, ["nearest"], Settings(None, 2, None, "cpu", 0), tmp_path / "out", {}) as work:
        work("a")
    assert child.wait() == 0
    assert saved == [True]


def test_tasks_ask_for_what_the_machines_have():
    def cluster(*machines):
        nodes = [{"Alive": alive, "Resources": {"CPU": c, **({"GPU": g} if g else {})}} for alive, c, g in machines]
        return SimpleNamespace(nodes=lambda: nodes)

    processors = cluster((True, 2.0, 0), (True, 8.0, 0), (False, 64.0, 8))
    assert share_of(processors, "auto", "core") == Share(1.0, 0.0)
    assert share_of(processors, "auto", "gpu") == Share(1.0, 0.0)
    assert share_of(processors, "auto", "machine") == Share(8.0, 0.0)
    mixed = cluster((True, 32.0, 0), (True, 12.0, 4.0), (True, 8.0, 4.0))
    assert share_of(mixed, "auto", "core") == Share(1.0, 0.3333)
    assert share_of(mixed, "cuda", "gpu") == Share(1.0, 1.0)
    assert share_of(mixed, "cuda", "machine") == Share(12.0, 4.0)
    assert share_of(mixed, "cpu", "machine") == Share(32.0, 0.0)


def test_a_cluster_that_does_not_answer_is_one_error(monkeypatch):
    def refuse(**_):
        raise ConnectionError("nobody there")

    monkeypatch.setattr(ray, "init", refuse)
    with (
        pytest.raises(RunError, match=r"no Ray cluster answers at 10.0.0.1:6379 \(nobody there\)"),
        connected("10.0.0.1:6379"),
    ):
        pass


def test_without_ray_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(RunError, match=r"tidefield\[cluster\]"), connected("auto"):
        pass
