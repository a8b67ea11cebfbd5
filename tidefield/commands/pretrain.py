"""`tidefield pretrain`: learn across scenes, for weights that work on new ones."""

from __future__ import annotations

import logging
from contextlib import nullcontext
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import OmitArgPrefixes, Positional, arg

from tidefield.commands.common import Device, Preset, Verbosity
from tidefield.commands.train import USED_BEFORE, report_end
from tidefield.config import PRESETS, Budget, Config, checked_seed, from_json, vary
from tidefield.errors import RunError
from tidefield.files import delete_partials, is_empty, only_writer, read_json, write_json

if TYPE_CHECKING:
    import torch
    from rich.console import Console

log = logging.getLogger(__name__)
PRETRAINING_FILE = "pretraining.json"
"""What a training across scenes was started with."""


@dataclass(frozen=True)
class Pretrain:
    """Train across scenes, procedural tidal flats and real ones, for weights that work without training on a scene.

    Writes OUT/weights.safetensors. Ctrl-C saves before it stops; --resume continues from there. Several GPUs or
    machines train together under torchrun: `torchrun --nproc-per-node 4 -m tidefield.cli pretrain OUT --steps 100000`.
    """

    out: Annotated[Positional[Path], arg(metavar="OUT")]
    """Folder for the result; must be new, unless --resume is given."""
    real: tuple[Path, ...] = ()
    """Scenes whose training photographs are learned from, too. Two held-out ones of each are validated on."""
    preset: Preset = "swift"
    variant: str | None = None
    """Of the preset, as `tidefield ablate` names them, to find out what a part brings."""
    budget: OmitArgPrefixes[Budget] = Budget()
    seed: int = 0
    """Of the weights, the scenes and their order."""
    device: Device = "auto"
    resume: bool = False
    """Continue the training in the folder, with the options that it was started with, to the end of its budget or of a
    new one, which counts from its start."""
    verbosity: OmitArgPrefixes[Verbosity] = Verbosity()


def pretrain(options: Pretrain, console: Console) -> None:
    """Run `tidefield pretrain`."""
    from rich.console import Console

    from tidefield.device import choose_device
    from tidefield.train import pretrain as across

    budget, folder = options.budget.checked(), options.out
    seed = checked_seed(options.seed)
    occupied = folder.exists() and (not folder.is_dir() or not is_empty(folder))
    device = across.join(choose_device(options.device))  # all processes have looked before one of them writes
    if options.resume:
        _require_same(folder, options)
        if options.budget == Budget():
            budget = _budget_of(folder) or budget
    if occupied and not options.resume:
        raise RunError(f"{folder} is not empty: expected a new folder; choose another, or continue it with --resume")
    if not across.is_main_process():
        console = Console(quiet=True)
    if across.is_distributed() and budget.steps is None:
        raise RunError("several processes were started with --minutes: expected --steps, which all of them can count")
    with only_writer(folder) if across.is_main_process() else nullcontext():
        _pretrain(options, budget, seed, device, console)


def _pretrain(options: Pretrain, budget: Budget, seed: int, device: torch.device, console: Console) -> None:
    from tidefield import machine
    from tidefield.data.load import read_posed
    from tidefield.train import pretrain as across
    from tidefield.train.checkpoint import CHECKPOINT_FILE, WEIGHTS_FILE, write_weights
    from tidefield.train.loop import train
    from tidefield.train.stream import Stream

    folder, config = options.out, PRESETS[options.preset]
    if options.variant is not None:
        varied = vary(config, options.variant)
        if not isinstance(varied, Config):
            raise RunError(f"--variant {options.variant} has no neighbouring views to learn from: choose another")
        config = varied
    if across.is_main_process():
        names = (PRETRAINING_FILE, CHECKPOINT_FILE, WEIGHTS_FILE, across.VALIDATION_FILE)
        delete_partials(*(folder / name for name in names))
        for scene in options.real:  # a name that is mistyped leaves the folder as it is
            read_posed(scene, allow_missing=False)
        if not options.resume:
            write_json(folder / PRETRAINING_FILE, _whole_record(options, budget))
    validation = across.Validation(across.validation_scenes(folder, options.real, console), folder)
    with Stream(folder / "scenes", options.real, across.process_seed(seed), config) as stream:
        shown = next(iter(validation.scenes.values()))
        trainer = across.Pretrainer(config, stream, shown, seed, device)
        if options.resume:
            trainer.resume(folder)
            validation.resume(trainer.progress.step)
            if trainer.is_main_process:  # an older one may lack it
                write_json(folder / PRETRAINING_FILE, _whole_record(options, budget))
            if budget.share(trainer.progress.step, trainer.progress.seconds) >= 1:
                console.print(USED_BEFORE, highlight=False)
        stopped = train(trainer, folder, budget, console, validation)
    if trainer.is_main_process:
        done = trainer.progress
        description = {
            "steps": done.step,
            "seconds": done.seconds,
            "seed": seed,
            "real": [scene.resolve().name for scene in options.real],
            **machine.describe(),
            "processes": across.world_size(),
            "validation": validation.points,
        }
        write_weights(folder / WEIGHTS_FILE, trainer.network, trainer.config, description)
    report_end(trainer.progress, stopped, folder, console, budget)


def _record(options: Pretrain) -> dict[str, Any]:
    """What must not change while a training is continued: its weights tell what they learned from."""
    real = sorted(_places(options))
    return {"preset": options.preset, "variant": options.variant, "seed": options.seed, "real": real}


def _whole_record(options: Pretrain, budget: Budget) -> dict[str, Any]:
    places = _places(options)
    order = {"order": places} if places != sorted(places) else {}
    return {**_record(options), **order, "budget": asdict(budget)}


def _places(options: Pretrain) -> list[str]:
    """The real scenes in their order, by which they are drawn."""
    from tidefield.addresses import address_of

    return [address_of(scene) or str(scene.resolve()) for scene in options.real]


def _budget_of(folder: Path) -> Budget | None:
    """The budget that a training was started or last continued with; None where an older one states none."""
    found = read_json(folder / PRETRAINING_FILE)
    stated = found.get("budget") if isinstance(found, dict) else None
    if stated is None:
        return None
    return from_json(Budget, stated, f"{folder / PRETRAINING_FILE}: budget").checked()


def _require_same(folder: Path, options: Pretrain) -> None:
    """Raises: RunError when the folder holds no training across scenes, or one with other options."""
    from tidefield.train.checkpoint import CHECKPOINT_FILE, RUN_FILE

    found = read_json(folder / PRETRAINING_FILE)
    if found is None and (folder / CHECKPOINT_FILE).exists() and not (folder / RUN_FILE).exists():
        log.warning(f"{folder} does not state its options, as older ones do not: they are taken to be those given now")
        return
    if not isinstance(found, dict):
        raise RunError(
            f"{folder} holds no training of `tidefield pretrain` (no {PRETRAINING_FILE}): expected one to continue; "
            "name it, or leave --resume out"
        )
    record, order = _record(options), _places(options)
    names = sorted(Path(scene).name for scene in order)
    if found.get("real") == names:  # all that older ones have
        record = {**record, "real": names}
    wrong = [f"{name} {found.get(name)}, not {value}" for name, value in record.items() if found.get(name) != value]
    if not wrong and found["real"] != names and found.get("order", found["real"]) != order:
        wrong = [f"--real in the order {found.get('order', found['real'])}"]
    if wrong:
        raise RunError(
            f"{folder} was started with {'; '.join(wrong)}: expected the same options to continue it; repeat them"
        )
