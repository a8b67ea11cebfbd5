"""Scenes to compare on; and every method on every scene, run in a process of its own, one after another, measured.

Scenes may be on machines of a cluster at the same time; on a machine all is one after another.

OUT/runs/SCENE/METHOD/ holds what `tidefield train` and `tidefield evaluate` write there, and process.json: the time and
memory that they used. What has an evaluation.json is not repeated; an interrupted training is started again, so that
its figures are those of one process.

Windows does not tell the memory. Imports nothing heavy: at its start, a process is charged with the peak memory of the
one that started it, so the measuring process must stay small.
"""

from __future__ import annotations

import os
import re
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import IO, Any

from tidefield.config import PROTOCOL
from tidefield.errors import RunError, SceneError
from tidefield.evaluation import EVALUATION_FILE
from tidefield.files import completed_folder, only_writer, read_json, write_json
from tidefield.machine import describe, peak_bytes
from tidefield.methods import METHODS, UNTRAINED_DEVICE
from tidefield.processes import Ended, end_with_parent

WHOLE = "tidefield"
"""Our network, of which an ablation has variants."""
AGAIN_VARIABLE = "TIDEFIELD_AGAIN"
"""The environment variable with what continues a training that is interrupted, where another command has started it."""
_LAST_FAILURE = 128
"""Larger exit statuses are those of signals."""
WRITER_SECONDS = 120.0
"""More than a training needs to save, and a shared folder to release the lock of a machine that died."""
RUNS, PROCESS_FILE, RUN_FILE = "runs", "process.json", "run.json"
STEPS = ("train", "evaluate")
MIPNERF360 = {
    "bicycle": "images_4",
    "bonsai": "images_2",
    "counter": "images_2",
    "garden": "images_4",
    "kitchen": "images_2",
    "room": "images_2",
    "stump": "images_4",
}
"""The seven public scenes of mip-NeRF 360, and which of their folders of photographs is used: as in that paper, a
quarter of the size outdoors and half of it indoors."""


@dataclass(frozen=True)
class Usage:
    """Wall-clock seconds of a process, and the most memory that it held resident at once, where the system tells it."""

    seconds: float
    peak_memory_bytes: int | None


Runner = Callable[[Sequence[str], Mapping[str, str]], Usage]
"""Runs a command to its end, with additional environment variables."""


@dataclass(frozen=True)
class Failure:
    """A command of a comparison that failed: on what, why, and the exit status that it gives the comparison."""

    title: str
    reason: str
    status: int


class Unfinished(RunError):
    """Some commands failed; everything else is done."""

    def __init__(self, text: str, failures: Sequence[Failure] = ()) -> None:
        super().__init__(text)
        self.failures = failures


@dataclass(frozen=True)
class Settings:
    """What all methods and scenes share.

    Attributes:
        minutes, steps: of training; one of them.
        width: of the photographs, pixels; None for their own.
        device: where everything is computed.
        seed: of weights and batches.
        preset: that "tidefield" stands for, and that variants change.
        from_scratch: whether our presets start from random weights.
        protocol: of the evaluations.
    """

    minutes: float | None
    steps: int | None
    width: int | None
    device: str
    seed: int
    preset: str = "swift"
    from_scratch: bool = False
    protocol: str = PROTOCOL


def mipnerf360(folder: Path, out: Path) -> dict[str, Path]:
    """The scenes in a folder as it is published, by name.

    Args:
        folder: the data set's.
        out: for a folder of each scene, of links to its poses and to the photographs of the size that is used.

    Raises:
        SceneError: none of them is there, or one has no photographs of that size.
        RunError: `out` has links to another data set.
    """
    there = [name for name in MIPNERF360 if (folder / name / "sparse").is_dir()]
    if not there:
        raise SceneError(
            f"{folder} has none of {', '.join(MIPNERF360)}: expected the folder that the data set of mip-NeRF 360 "
            "unpacks to; name it"
        )
    for name in there:
        photographs = folder / name / MIPNERF360[name]
        if not photographs.is_dir():
            raise SceneError(f"{photographs} is not there: expected the photographs as published; unpack them all")
        (out / name).mkdir(parents=True, exist_ok=True)
        for link, target in (("images", photographs), ("sparse", folder / name / "sparse")):
            _make_link(out / name / link, target.resolve())
    return {name: out / name for name in there}


def _make_link(link: Path, target: Path) -> None:
    """Make a link to a folder unless it is there; one that leads nowhere is replaced.

    Raises:
        RunError: it leads to another folder, or Windows does not let this user make links.
    """
    if link.is_symlink() and not link.exists():
        link.unlink()
    if not link.is_symlink():
        try:
            link.symlink_to(target, target_is_directory=True)
        except OSError as error:
            raise RunError(
                f"{link} cannot be made ({error.strerror}): expected a place for links; on Windows turn Developer Mode "
                "on, else name another folder with --out"
            ) from error
    elif link.resolve() != target:
        raise RunError(
            f"{link} leads to {link.resolve()}: expected {target}, of the data set that is named; name another folder "
            "with --out"
        )


def tidal_flats(folder: Path, width: int, real: Sequence[Path]) -> dict[str, Path]:
    """The five synthetic categories, made in `folder` unless they are there, and real surveys, by name.

    Raises:
        SceneError: two scenes have the same name.
    """
    from tidefield.synthetic import CATEGORIES

    surveys, scenes = named(real), {}
    for category in surveys.keys() & set(CATEGORIES):
        raise SceneError(
            f"{surveys[category]} has the name of a scene of the protocol: expected another than "
            f"{', '.join(CATEGORIES)}; rename or link it"
        )
    for category in CATEGORIES:
        scenes[category] = scene = folder / f"{category}-{width}"
        make_flat(scene, category, seed=11, views=40, width=width)
    return scenes | surveys


def make_flat(scene: Path, category: str, seed: int, views: int, width: int) -> None:
    """Make the survey of a built-in flat in a folder, unless that is there; photographs are `width` pixels wide."""
    from tidefield.synthetic import make_survey, write_survey

    if not scene.exists():
        with completed_folder(scene) as partial:
            write_survey(make_survey(category, seed=seed, views=views, width=width), partial)


def named(scenes: Sequence[Path]) -> dict[str, Path]:
    """Scenes by the names of their folders.

    Raises:
        SceneError: two have the same.
    """
    names = [Path(os.path.abspath(scene)).name for scene in scenes]  # a link has a name of its own
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise SceneError(f"two scenes are named {twice}: expected different names of folders; rename or link one")
    return dict(zip(names, scenes, strict=True))


def tidefield(*words: object) -> list[str]:
    """A command line of this environment's tidefield."""
    return [sys.executable, "-m", "tidefield.cli", *map(str, words)]


def run_measured(command: Sequence[str], environment: Mapping[str, str], output: IO[bytes] | None = None) -> Usage:
    """Run a command in a process of its own; it prints to `output`, to ours if that is not given.

    Raises:
        SystemExit: it failed, and has said why; with its status.
        RunError: a signal ended it.
    """
    start, peak = time.perf_counter(), None
    process = subprocess.Popen(
        command, env={**os.environ, **environment}, stdout=output, stderr=output, preexec_fn=end_with_parent
    )
    try:
        if hasattr(os, "wait4"):
            # The usage of this one child; getrusage(RUSAGE_CHILDREN) is the largest of all so far.
            _, status, usage = os.wait4(process.pid, 0)
            process.returncode = os.waitstatus_to_exitcode(status)
            peak = peak_bytes(usage.ru_maxrss)
        else:
            process.wait()
    except KeyboardInterrupt as error:
        if isinstance(error, Ended):
            process.send_signal(error.number)
        process.wait()  # Ctrl-C has reached it, too; a training saves before it stops.
        raise
    if process.returncode > 0:
        sys.exit(process.returncode)
    if process.returncode < 0:
        raise RunError(
            f"{signal.Signals(-process.returncode).name} ended `{shlex.join(command)}`: expected it to go on, with "
            "memory enough for it; repeat the command, which continues from there"
        )
    return Usage(time.perf_counter() - start, peak)


def commands(scene: Path, folder: Path, method: str, settings: Settings) -> dict[str, list[str]]:
    """The tidefield commands of a method, or of a variant of our network, on a scene, by name, in their order."""
    kind, (name, further) = kind_of(method), variant_and_seed(method)
    preset = preset_of(method, settings)
    device = ["--device", settings.device]
    width = [] if settings.width is None else ["--width", str(settings.width)]
    start = ["--from-scratch"] if settings.from_scratch else []
    if kind == "variant":
        source = ["--preset", settings.preset, *([] if name == WHOLE else ["--variant", name]), *start]
    elif kind == "preset":
        variant = METHODS[method].variant
        source = ["--preset", str(preset), *(["--variant", variant] if variant else []), *start]
    elif kind == "zero-shot":
        source = ["--zero-shot", "--preset", str(preset)]
    else:
        source = ["--method", method]
    if kind == "untrained":
        return {"evaluate": ["evaluate", str(scene), str(folder), *source, *width, "--device", UNTRAINED_DEVICE]}
    if kind == "zero-shot":
        return {"evaluate": ["evaluate", str(scene), str(folder), *source, *width, *device]}
    if settings.minutes is not None:
        budget = ["--minutes", f"{settings.minutes:g}", "--curve"]
    else:
        budget = ["--steps", str(settings.steps)]
    seed = ["--seed", str(settings.seed + further)]
    return {
        "train": ["train", str(scene), str(folder), *source, *budget, *width, *device, *seed],
        "evaluate": ["evaluate", str(folder), *device],
    }


def of_seed(name: str, seed: int) -> str:
    """The name, in a comparison, of a variant of our network with one of several seeds, counted from that of all."""
    return f"{name}-seed-{seed}" if seed else name


def variant_and_seed(method: str) -> tuple[str, int]:
    """What `of_seed` made a name of."""
    found = re.fullmatch(r"(.+)-seed-(\d+)", method)
    return (found[1], int(found[2])) if found else (method, 0)


def compare(
    scenes: Mapping[str, Path],
    methods: Sequence[str],
    settings: Settings,
    out: Path,
    run: Runner,
    say: Callable[[str], object],
    contents: Mapping[str, str] | None = None,
) -> None:
    """Train and evaluate what has not been evaluated yet; after a command that fails, all others.

    Args:
        scenes: folders by the names that the tables give them.
        methods: of `METHODS`, or variants of our network.
        settings: for all.
        out: the comparison's folder.
        run: runs a command.
        say: reports progress.
        contents: of the scenes (`check_scene`), by name, for the record.

    Raises:
        Unfinished: commands failed, in the end.
        RunError: the folder holds results of other settings.
        SystemExit: a signal ended a command, or the reader of its output has gone.
    """
    require_same_settings(scenes, methods, settings, out)
    jobs, failures = _jobs(scenes, methods, out), list[Failure]()
    for number, (folder, name, scene, method) in enumerate(jobs, start=1):
        title = f"{name}, {method} ({number} of {len(jobs)})"
        if read_evaluation(folder) is not None and "evaluate" in read_process(folder):
            say(f"{title}: done before")
            continue
        portable = commands(Path("SCENE"), Path("RUN"), method, settings)
        for step, words in commands(scene, folder, method, settings).items():
            say(f"{title}: {step}")
            made_from = {} if contents is None else {"scene": {"contents": contents[name]}}
            record = read_process(folder) or {"settings": _record(scene, method, settings), **made_from}
            if step == "train" and step in record:
                continue
            written = {"train": RUN_FILE, "evaluate": EVALUATION_FILE}[step]
            again = ["--overwrite"] if (folder / written).exists() else []
            try:
                usage = run(tidefield(*words, *again), {AGAIN_VARIABLE: "the same command"})
            except (RunError, SystemExit) as error:
                status = error.code if isinstance(error, SystemExit) else 2
                if not isinstance(status, int) or status > _LAST_FAILURE:
                    raise
                reason = str(error) if isinstance(error, RunError) else f"it ended with status {status}"
                failures.append(Failure(f"{name}, {method}: {step}", reason, status))
                break
            command = shlex.join(["tidefield", *portable[step]])
            write_json(folder / PROCESS_FILE, {**record, step: {"command": command, **asdict(usage), **describe()}})
    if failures:
        raise Unfinished(failures[0].reason, failures)


def require_same_settings(scenes: Mapping[str, Path], methods: Sequence[str], settings: Settings, out: Path) -> None:
    """Raises: RunError when the folder of a comparison holds damaged results, or such of other settings."""
    for folder, _, scene, method in _jobs(scenes, methods, out):
        read_evaluation(folder)
        wanted, process = _record(scene, method, settings), read_process(folder)
        found = process.get("settings", wanted)
        if "contents" in process.get("scene", {}):
            wanted |= {"scene": found.get("scene")}  # moved, perhaps; `require_same_sources` knows
        was = {key: found.get(key) for key in wanted if found.get(key) != wanted[key]}
        if was:
            asked = {key: wanted[key] for key in was}
            raise RunError(f"{folder} was made with {was}: expected {asked}; name another folder with --out")


def _jobs(scenes: Mapping[str, Path], methods: Sequence[str], out: Path) -> list[tuple[Path, str, Path, str]]:
    """Folder, name of the scene, scene and method of each result."""
    return [(out / RUNS / name / method, name, scene, method) for name, scene in scenes.items() for method in methods]


@contextmanager
def scene_runner(
    scenes: Mapping[str, Path],
    methods: Sequence[str],
    settings: Settings,
    out: Path,
    environment: Mapping[str, str],
    contents: Mapping[str, str] | None = None,
) -> Iterator[Callable[[str], None]]:
    """`compare` in a worker of a cluster: a function of a scene's name, for all methods.

    Args:
        scenes, methods, settings, out, contents: as for `compare`; the paths are absolute.
        environment: additional variables of all processes.
    """
    from tidefield.addresses import pull, push

    def run(command: Sequence[str], own: Mapping[str, str]) -> Usage:
        with tempfile.TemporaryFile() as output:
            try:
                return run_measured([*command, "--quiet"], {**environment, **own}, output)
            except SystemExit as error:  # it would end the worker
                output.seek(max(0, output.tell() - 2000))
                said = output.read().decode(errors="replace").strip().removeprefix("tidefield: ")
                raise RunError(
                    said or f"`{shlex.join(command)}` failed: expected it to end well; run it alone"
                ) from error

    def work(name: str) -> None:
        for folder, *_ in _jobs({name: scenes[name]}, methods, out):
            with only_writer(folder, WRITER_SECONDS):
                pass  # the child of a worker that died has saved and ended, too
        for path in (scenes[name], out / RUNS / name):
            pull(path)
        try:
            compare({name: scenes[name]}, methods, settings, out, run, lambda _: None, contents)
        finally:
            push(out / RUNS / name)

    yield work


def read_evaluation(folder: Path) -> dict[str, Any] | None:
    """The evaluation of the run in a folder, or of what needs no run; None where there is none.

    Raises:
        RunError: it is damaged, or of another run than the one that is there.
    """
    evaluation, run = _read(folder / EVALUATION_FILE, _is_evaluation), read_json(folder / RUN_FILE)
    if run is not None and not isinstance(run, dict):
        raise RunError(f"{folder / RUN_FILE} is damaged: expected what this program wrote; delete it and repeat")
    if evaluation is not None and run is not None and evaluation["configuration"].get("run") != run.get("id"):
        raise RunError(
            f"{folder / EVALUATION_FILE} is of another run than {RUN_FILE}: expected two files of one run; delete it "
            "and repeat the command"
        )
    return evaluation


def read_process(folder: Path) -> dict[str, Any]:
    """The process.json of a run, empty where there is none.

    Raises:
        RunError: it is damaged.
    """
    return _read(folder / PROCESS_FILE, _is_process) or {}


def _read(path: Path, is_valid: Callable[[Any], bool]) -> Any:
    data = read_json(path)
    try:
        valid = data is None or is_valid(data)
    except (AttributeError, KeyError, TypeError):  # a part is missing or of another kind
        valid = False
    if not valid:
        raise RunError(f"{path} is damaged: expected what this program wrote; delete it and repeat")
    return data


def _is_evaluation(data: Any) -> bool:
    """Whether a comparison can read all that it needs."""
    mean, trained = dict(data["mean"]), data["configuration"].get("trained") or {}
    reasons, weights = mean.pop("reasons", {}), data.get("lpips_weights", {})
    optional = [*mean.values(), *(trained.get(name) for name in ("steps", "seconds"))]
    numbers = [
        data["width"],
        data["rays_per_second"],
        data["seconds_per_frame"],
        *(x for x in optional if x is not None),
    ]
    numbers += [one["psnr"] for one in data["per_photograph"].values() if one["psnr"] is not None]
    texts = [*reasons.values(), *weights.values()]
    are_whole = bool(data["per_photograph"]) and set(weights) <= set(mean)
    return are_whole and all(_is_number(x) for x in numbers) and all(isinstance(x, str) for x in texts)


def _is_process(data: Any) -> bool:
    steps = [data[step] for step in STEPS if step in data]
    peaks = [step.get("peak_memory_bytes") for step in steps]
    parts = [data["settings"], data.get("scene", {}), *steps]
    described = all(_is_description(step) for step in steps if "machine" in step)
    return described and all(isinstance(x, dict) for x in parts) and all(p is None or _is_number(p) for p in peaks)


def _is_description(data: Any) -> bool:
    """Whether a record has what `describe` returns."""
    machine = data["machine"]
    texts = [data["date"], data["version"], *(machine[name] for name in ("processor", "system", "python", "torch"))]
    numbers = [machine["cores"], machine["memory_bytes"]]
    return all(isinstance(x, str) for x in (*texts, *machine.get("gpus", []))) and all(map(_is_number, numbers))


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= sys.float_info.max


def kind_of(method: str) -> str:
    """The kind of a method, or "variant" for variants of our network and for other seeds."""
    return METHODS[method].kind if method in METHODS else "variant"


def preset_of(method: str, settings: Settings) -> str | None:
    """The preset of a method, None for those that have none."""
    if method in (WHOLE, "zero-shot"):
        return settings.preset
    return METHODS[method].preset if method in METHODS else None


def starts_from_weights(method: str, settings: Settings) -> bool:
    """Whether a method has trained weights before it sees the scene, if some are installed."""
    return kind_of(method) == "zero-shot" or (kind_of(method) == "preset" and not settings.from_scratch)


def _record(scene: Path, method: str, settings: Settings) -> dict[str, object]:
    """What a result depends on: no budget where nothing is trained, and no start weights but for our presets."""
    kept = asdict(settings)
    if kind_of(method) in ("zero-shot", "untrained"):
        kept |= {"minutes": None, "steps": None, "seed": None}
    if kind_of(method) not in ("preset", "variant"):
        del kept["from_scratch"]
    return {**kept, "scene": str(scene.resolve())}
