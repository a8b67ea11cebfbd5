"""Kill train, prepare and compare with SIGKILL at random moments, and compare what they then complete with the result
of a run that nobody interrupted.

Each kill has a folder of its own. After it, the processes that the command had started must end within seconds, the
same command (`train` with --resume) must complete the work, and the result must be the same bit for bit: tensors,
losses, models, photographs, pictures and figures; not seconds and dates. Trainings save after every step here, so that
kills meet saves.
"""

from __future__ import annotations

import contextlib
import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.records import MEASURED, say
from tidefield.compare.tables import Table
from tidefield.errors import RunError
from tidefield.files import file_sha256, read_json, write_json
from tidefield.machine import describe

KILLS_FILE = "kills.json"
WIDTH, STEPS, FEATURES = 64, 40, 1000
END_SECONDS = 20.0
"""A process that the killed one had started counts as left behind when it lives longer."""
EVERY_STEP = """
import sys
from tidefield import cli
from tidefield.train import loop
loop.SAVE_SECONDS = 0.0
cli.main()
"""
"""In place of `tidefield`."""
Content = dict[str, Any]
"""What must be the same, by name."""


@dataclass(frozen=True)
class Job:
    """A command that is killed.

    Attributes:
        words: of the command that writes a folder.
        again: of the one that continues it.
        content: of the folder, when it is complete.
    """

    words: Callable[[Path], list[str]]
    again: Callable[[Path], list[str]]
    content: Callable[[Path], Content]


def kills(
    runs: Path = MEASURED, train: int = 20, prepare: int = 10, compare: int = 10, seed: int = 0
) -> dict[str, dict[str, Any]]:
    """Kill every command that often, store the counts and return them.

    Args:
        runs: Store the counts in this folder's kills.json.
        train: How often `tidefield train` is killed.
        prepare: How often `tidefield prepare`.
        compare: How often `tidefield compare`.
        seed: Of the moments.

    Raises:
        RunError: a command failed, a result was another one, or something was left behind.
    """
    counts = {"train": train, "prepare": prepare, "compare": compare}
    moments, record = random.Random(seed), {}
    with tempfile.TemporaryDirectory(prefix="kills-") as folder:
        work = Path(folder)
        environment = {**os.environ, "XDG_CACHE_HOME": str(work / "cache")}
        for name, job in _jobs(work).items():
            if counts[name]:
                record[name] = _kill(job, name, counts[name], work, environment, moments)
                # After each, as the whole takes long and may be interrupted.
                done = " ".join(f"--{name} {record[name]['kills'] if name in record else 0}" for name in counts)
                command = f"python -m benchmarks kills {done} --seed {seed}"
                write_json(runs / KILLS_FILE, {"command": command, "kills": record, **describe()})
    bad = [name for name, of in record.items() if of["identical"] < of["kills"] or of["processes"] or of["files"]]
    if bad:
        raise RunError(
            f"{' and '.join(bad)} did not recover from every kill: expected the same result and nothing left; see "
            f"{runs / KILLS_FILE}"
        )
    for name, of in record.items():
        say(f"{name}: {of['identical']} of {of['kills']} identical")
    return record


def kills_table(kills: Mapping[str, Mapping[str, Any]]) -> Table:
    """What killed commands completed when they were repeated, and what they left behind."""
    keys = ("kills", "identical", "processes", "files")
    rows = [(f"tidefield {name}", *(str(record[key]) for key in keys)) for name, record in kills.items()]
    columns = ["command", "kills", "identical results", "processes left", "partial files left"]
    return Table("Killed commands", columns, rows)


def _jobs(work: Path) -> dict[str, Job]:
    """The commands on a small synthetic scene, which is made here."""
    from tidefield.synthetic import make_survey, write_survey

    scene, survey = work / "scene", work / "survey"
    write_survey(make_survey("vegetation", seed=1, views=9, width=WIDTH, supersample=1), scene)
    write_survey(make_survey("ground_textures", seed=1, views=9, width=400, supersample=1), survey, suffix=".jpg")
    train = ["train", str(scene)]
    budget = ["--steps", str(STEPS), "--device", "cpu"]
    prepare = ["prepare", str(survey / "images")]
    options = ["--device", "cpu", "--features", str(FEATURES), "--feature-width", "400"]

    def comparison(out: Path) -> list[str]:
        return ["compare", str(scene), "--methods", "tidefield", "nearest", *budget, "--out", str(out)]

    return {
        "train": Job(
            lambda run: [*train, str(run), *budget], lambda run: [*train, str(run), *budget, *_go_on(run)], _run_content
        ),
        "prepare": Job(
            lambda made: [*prepare, str(made), *options], lambda made: [*prepare, str(made), *options], _scene_content
        ),
        "compare": Job(comparison, comparison, _comparison_content),
    }


def _kill(
    job: Job,
    name: str,
    count: int,
    work: Path,
    environment: Mapping[str, str],
    moments: random.Random,
) -> dict[str, Any]:
    """Kill one command several times; returns the counts."""
    start = time.perf_counter()
    _complete(job.words(work / name), work, environment)
    seconds = time.perf_counter() - start
    wanted = job.content(work / name)
    at: list[float] = []
    record: dict[str, Any] = {"kills": count, "identical": 0, "processes": 0, "files": 0, "different": []}
    while len(at) < count:
        folder, moment = work / f"{name}-{len(at)}", moments.uniform(0, seconds)
        process = _start(job.words(folder), work, environment)
        try:
            process.wait(timeout=moment)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        else:  # it was faster this time
            _require_success(process, work)
            shutil.rmtree(folder, ignore_errors=True)
            continue
        at.append(round(moment, 2))
        record["processes"] += _count_left(process.pid)
        _complete(job.again(folder), work, environment)
        found = job.content(folder)
        different = sorted(key for key in {*wanted, *found} if wanted.get(key) != found.get(key))
        record["identical"] += not different
        record["different"] += different
        record["files"] += sum(".partial" in path.name for path in folder.rglob("*"))
        say(f"{name}, kill {len(at)} of {count} after {moment:.1f} s: {'other ' if different else 'the same '}result")
        shutil.rmtree(folder, ignore_errors=True)
    return record | {"uninterrupted_seconds": round(seconds, 2), "killed_after_seconds": at}


def _start(words: list[str], work: Path, environment: Mapping[str, str]) -> subprocess.Popen[bytes]:
    """A command in a session of its own, by whose number its children are found."""
    with (work / "log").open("wb") as log:
        return subprocess.Popen(
            [sys.executable, "-c", EVERY_STEP, *words],
            env=environment,
            stdout=log,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )


def _complete(words: list[str], work: Path, environment: Mapping[str, str]) -> None:
    process = _start(words, work, environment)
    try:
        process.wait()
    except BaseException:
        process.terminate()
        process.wait()
        raise
    _require_success(process, work)


def _require_success(process: subprocess.Popen[bytes], work: Path) -> None:
    if process.returncode:
        log = (work / "log").read_text(errors="replace").strip()[-2000:]
        raise RunError(f"{process.args} ended with status {process.returncode}: expected 0; its last words:\n{log}")


def _count_left(session: int) -> int:
    """How many processes of a session still live after a while."""
    end = time.monotonic() + END_SECONDS
    while (left := _living(session)) and time.monotonic() < end:
        time.sleep(0.1)
    return left


def _living(session: int) -> int:
    found = 0
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):  # it has ended meanwhile
            state, *_, its_session = stat.read_text().rpartition(")")[2].split()[:4]
            found += int(its_session) == session and state != "Z"
    return found


def _go_on(run: Path) -> list[str]:
    """How a user continues a run: what has no checkpoint starts again."""
    if (run / "checkpoint.safetensors").exists():
        return ["--resume"]
    return ["--overwrite"] if (run / "run.json").exists() else []


def _run_content(run: Path) -> Content:
    """Tensors, steps and losses of a run."""
    from safetensors import safe_open

    with safe_open(run / "checkpoint.safetensors", framework="np") as file:
        header = json.loads(file.metadata()["tidefield"])
        tensors = {name: file.get_tensor(name).tobytes() for name in file.keys()}  # noqa: SIM118
    return {**tensors, "step": header["step"], "losses": header["losses"]}


def _scene_content(scene: Path) -> Content:
    """All files of a scene but those of the work on it and of its report, which have times."""
    files = [path for path in scene.rglob("*") if path.is_file()]
    names = {path.relative_to(scene).as_posix(): path for path in files}
    own = {name: path for name, path in names.items() if not name.startswith(("prepare/", "report"))}
    return {name: file_sha256(path) for name, path in own.items()}


def _comparison_content(out: Path) -> Content:
    """The figures, pictures and tensors of a comparison."""
    content = {p.relative_to(out).as_posix(): file_sha256(p) for p in out.glob("runs/*/*/*/*.png")}
    for file in out.glob("runs/*/*/evaluation.json"):
        content[str(file.relative_to(out))] = read_json(file)["mean"]
    for run in out.glob("runs/*/tidefield"):
        content |= _run_content(run)
    rows = (out / "tables.md").read_text().partition("Time and memory")[0].splitlines()
    return content | {"tables": [row for row in rows if row.startswith("|")]}
