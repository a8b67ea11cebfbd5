"""Every method on every scene, in processes of their own, one after another.

OUT/runs/SCENE/METHOD/ holds what `tidefield train` and `tidefield evaluate` write there, and process.json: what they
took. What has an evaluation.json is not repeated; a training that was broken off begins anew, so that its figures are
those of one process.
"""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from tidefield.compare.record import Runner, tidefield
from tidefield.errors import RunError
from tidefield.files import read_json, write_json
from tidefield.machine import describe

UNTRAINED = ("plane-sweep", "sparse-depth", "nearest")
WHOLE, OTHER_SEED = "tidefield", "another-seed"
"""Our network, and once more for the noise of an ablation."""
PEERS = ("nerfacto", "nerf", "splatfacto")
ZERO_SHOT, PAPER_ZERO_SHOT = "zero-shot", "paper-zero-shot"
METHODS = (WHOLE, ZERO_SHOT, "paper", PAPER_ZERO_SHOT, *PEERS, *UNTRAINED)
"""What can be compared; in an ablation, the variants of our network, too."""
_NOT_TRAINED = (ZERO_SHOT, PAPER_ZERO_SHOT, *UNTRAINED)
RUNS, PROCESS_FILE, EVALUATION_FILE, RUN_FILE = "runs", "process.json", "evaluation.json", "run.json"


@dataclass(frozen=True)
class Settings:
    """What all methods and scenes share.

    Attributes:
        minutes, steps: of training; one of them.
        width: of the photographs, pixels; None for their own.
        device: where everything is computed.
        seed: of weights and batches.
        preset: that "tidefield" stands for, and that variants change.
        from_scratch: whether our presets begin with random weights.
    """

    minutes: float | None
    steps: int | None
    width: int | None
    device: str
    seed: int
    preset: str = "swift"
    from_scratch: bool = False


def commands(scene: Path, folder: Path, method: str, settings: Settings) -> dict[str, list[str]]:
    """The tidefield commands of a method on a scene, by name, in their order."""
    device = ["--device", settings.device]
    width = [] if settings.width is None else ["--width", str(settings.width)]
    if method in _NOT_TRAINED:
        presets = {ZERO_SHOT: settings.preset, PAPER_ZERO_SHOT: "paper"}
        kind = ["--zero-shot", "--preset", presets[method]] if method in presets else ["--method", method]
        return {"evaluate": ["evaluate", str(scene), str(folder), *kind, *width, *device]}
    seed = ["--seed", str(settings.seed + (method == OTHER_SEED))]
    if settings.minutes is not None:
        budget = ["--minutes", f"{settings.minutes:g}", "--curve"]
    else:
        budget = ["--steps", str(settings.steps)]
    return {
        "train": ["train", str(scene), str(folder), *_kind(method, settings), *budget, *width, *device, *seed],
        "evaluate": ["evaluate", str(folder), *device],
    }


def _kind(method: str, settings: Settings) -> list[str]:
    if method in PEERS:
        return ["--method", method]
    begin = ["--from-scratch"] if settings.from_scratch else []
    if method == "paper":
        return ["--preset", "paper", *begin]
    variant = [] if method in (WHOLE, OTHER_SEED) else ["--variant", method]
    return ["--preset", settings.preset, *variant, *begin]


def compare(
    scenes: Mapping[str, Path],
    methods: Sequence[str],
    settings: Settings,
    out: Path,
    run: Runner,
    say: Callable[[str], object],
) -> None:
    """Train and evaluate what has not been evaluated yet.

    Args:
        scenes: folders by the names that the tables give them.
        methods: of `METHODS`, or variants of our network.
        settings: for all.
        out: the comparison's folder.
        run: runs a command.
        say: tells where we are.

    Raises:
        RunError: a command failed, or the folder holds results of other settings.
    """
    jobs = [(name, scene, method) for name, scene in scenes.items() for method in methods]
    for name, scene, method in jobs:
        _refuse_other_settings(out / RUNS / name / method, scene, method, settings)
    for number, (name, scene, method) in enumerate(jobs, start=1):
        folder, title = out / RUNS / name / method, f"{name}, {method} ({number} of {len(jobs)})"
        if (folder / EVALUATION_FILE).exists():
            say(f"{title}: is there")
            continue
        for step, words in commands(scene, folder, method, settings).items():
            say(f"{title}: {step}")
            shown = commands(Path("SCENE"), Path("RUN"), method, settings)[step]
            _step(folder, step, words, shown, _record(scene, method, settings), run)


def _record(scene: Path, method: str, settings: Settings) -> dict[str, object]:
    """What a result depends on; of what is not trained, no budget, and of others' methods, not how ours begin."""
    kept = asdict(settings)
    if method in _NOT_TRAINED:
        kept |= {"minutes": None, "steps": None, "seed": None}
    if method in (*PEERS, *_NOT_TRAINED):
        del kept["from_scratch"]
    return {**kept, "scene": str(scene.resolve())}


def _refuse_other_settings(folder: Path, scene: Path, method: str, settings: Settings) -> None:
    wanted, found = _record(scene, method, settings), (read_json(folder / PROCESS_FILE) or {}).get("settings")
    if found not in (None, wanted):
        was = {key: found.get(key) for key in wanted if found.get(key) != wanted[key]}
        asked = {key: wanted[key] for key in was}
        raise RunError(f"{folder} was made with {was}: expected {asked}; name another folder with --out")


def _step(
    folder: Path, name: str, words: list[str], shown: list[str], settings: dict[str, object], run: Runner
) -> None:
    """One command, unless it is a training that has ended, and what it took; kept is how it is shown."""
    record = read_json(folder / PROCESS_FILE) or {"settings": settings}
    if name == "train" and name in record:
        return
    again = ["--overwrite"] if name == "train" and (folder / RUN_FILE).exists() else []
    took = run(tidefield(*words, *again), {})
    record[name] = {"command": shlex.join(["tidefield", *shown]), **asdict(took), **describe()}
    write_json(folder / PROCESS_FILE, record)
