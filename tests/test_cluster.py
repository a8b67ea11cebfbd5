"""Work on a Ray cluster, a real one on this machine: the same results as without, and nothing but tasks is lost."""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from tidefield.cluster import connected, on_cluster
from tidefield.errors import RunError
from tidefield.synthetic import make_survey, write_survey

ray = pytest.importorskip("ray", reason="Ray is not installed: pip install 'tidefield[cluster]'")
pytestmark = [
    pytest.mark.skipif(sys.platform != "linux", reason="tested on Linux only"),
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]


@pytest.fixture(scope="module")
def address():
    """A cluster with two cores, whose workers find this tree."""
    root = str(Path(__file__).parents[1])
    runtime = {"env_vars": {"PYTHONPATH": root, "OMP_NUM_THREADS": "1"}}
    context = ray.init(
        address="local", num_cpus=2, include_dashboard=False, log_to_driver=False, runtime_env=runtime,
        object_store_memory=100_000_000,
    )  # fmt: skip
    yield context.address_info["address"]
    ray.shutdown()


def test_every_item_is_worked_on_and_a_worker_prepares_once(address, tmp_path: Path):
    def prepare():
        (tmp_path / f"prepared {os.getpid()} {time.time_ns()}").touch()
        return lambda item: (tmp_path / f"item {item}").write_text(str(item**2))

    assert sorted(on_cluster(ray, "squares", prepare, range(12))) == list(range(12))
    assert [(tmp_path / f"item {k}").read_text() for k in range(12)] == [str(k**2) for k in range(12)]
    assert 1 <= len(list(tmp_path.glob("prepared *"))) <= 4


def test_an_error_of_the_function_is_raised_as_it_is(address):
    def prepare():
        def work(item):
            raise RunError(f"{item} is wrong: expected another; choose one")

        return work

    with pytest.raises(RunError, match="7 is wrong"):
        list(on_cluster(ray, "wrong", prepare, [7]))


def test_a_killed_worker_costs_one_task_and_nothing_else(address, tmp_path: Path):
    def prepare():
        def work(item):
            with (tmp_path / f"attempts {item}").open("a") as file:
                file.write(f"{os.getpid()}\n")
            time.sleep(0.6)
            (tmp_path / f"done {item}").touch()

        return work

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
    assert sorted(on_cluster(ray, "killed", prepare, range(10))) == list(range(10))
    thread.join(timeout=10)
    assert len(killed) == 3
    attempts = sum(len(path.read_text().split()) for path in tmp_path.glob("attempts *"))
    assert attempts == 10 + 3


@pytest.mark.slow
def test_a_map_of_a_cluster_is_that_of_one_process_to_the_last_byte(address, tmp_path: Path):
    scene = tmp_path / "scene"
    write_survey(make_survey("ground_textures", seed=4, views=9, width=240), scene)
    root = Path(__file__).parents[1]
    for name, cluster in (("here", []), ("there", ["--cluster", address])):
        words = ["map", scene, tmp_path / name, "--zero-shot", "--gsd", "0.5", "--device", "cpu", *cluster]
        environment = {**os.environ, "PYTHONPATH": str(root), "XDG_CACHE_HOME": str(tmp_path / "cache")}
        subprocess.run([sys.executable, "-m", "tidefield.cli", *map(str, words)], check=True, env=environment)
    files = sorted(path.relative_to(tmp_path / "here") for path in (tmp_path / "here").rglob("*") if path.is_file())
    assert len(files) >= 20
    rasters = [file for file in files if file.suffix in (".tif", ".laz", ".geojson")]
    assert len(rasters) > 10
    for file in rasters:
        assert (tmp_path / "here" / file).read_bytes() == (tmp_path / "there" / file).read_bytes(), file


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
