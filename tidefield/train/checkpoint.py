"""Runs on disk: what was trained, on what, and how far.

RUN/run.json says what the run is; RUN/checkpoint.safetensors holds the weights, the optimiser, the random state and, in
its header, how far training got. Each is replaced whole or not at all.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from tidefield import __version__
from tidefield.config import AnyConfig, config_from_json, config_to_json
from tidefield.errors import RunError
from tidefield.files import completed_file

RUN_FILE, CHECKPOINT_FILE = "run.json", "checkpoint.safetensors"
_LARGEST_RUN_FILE = 1 << 24


@dataclass(frozen=True)
class Run:
    """What a run is; does not change while it trains.

    Attributes:
        scene: the folder of its scene.
        width: of its photographs, pixels; None for their own.
        seed: of weights and batches.
        config: network and training.
        weights: SHA-256 of the trained weights that it began with; None from scratch.
        version: of the program that began it.
    """

    scene: Path
    width: int | None
    seed: int
    config: AnyConfig
    weights: str | None = None
    version: str = __version__


@dataclass
class TrainingProgress:
    """How far a run has trained."""

    step: int = 0
    seconds: float = 0.0
    losses: list[float] = field(default_factory=list)


def write_run(folder: Path, run: Run) -> None:
    data = {
        "scene": str(run.scene),
        "width": run.width,
        "seed": run.seed,
        "version": run.version,
        "config": config_to_json(run.config),
        "weights": run.weights,
    }
    with completed_file(folder / RUN_FILE, overwrite=True) as partial:
        partial.write_text(json.dumps(data, indent=2) + "\n", encoding="utf-8")


def read_run(folder: Path) -> Run:
    """Raises: RunError when the folder holds no run or one of another kind."""
    path = folder / RUN_FILE
    if not path.is_file():
        raise RunError(
            f"{folder} holds no run (no {RUN_FILE}): expected a folder that `tidefield train` wrote; train one"
        )
    if path.stat().st_size > _LARGEST_RUN_FILE:
        raise RunError(f"{path} has {path.stat().st_size} bytes: expected a small file that `tidefield train` wrote")
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        keys = {"scene", "width", "seed", "version", "config", "weights"}
        if not isinstance(data, dict) or set(data) != keys:
            raise ValueError(f"expected the keys {sorted(keys)}")
        config = config_from_json(data["config"])
        return Run(Path(data["scene"]), data["width"], data["seed"], config, data["weights"], data["version"])
    except (ValueError, TypeError) as error:
        raise RunError(f"{path} cannot be read as a run ({error}): expected what `tidefield train` wrote") from error


def save_checkpoint(
    folder: Path,
    network: nn.Module,
    optimizer: torch.optim.Optimizer,
    generator: torch.Generator,
    progress: TrainingProgress,
) -> None:
    """Replace the run's checkpoint."""
    tensors = {f"network.{name}": value for name, value in network.state_dict().items()}
    for index, state in optimizer.state_dict()["state"].items():
        tensors |= {f"optimizer.{index}.{name}": torch.as_tensor(value) for name, value in state.items()}
    tensors["generator"] = generator.get_state()
    tensors = {name: value.detach().cpu().contiguous() for name, value in tensors.items()}
    header = {"step": progress.step, "seconds": progress.seconds, "losses": progress.losses, "version": __version__}
    with completed_file(folder / CHECKPOINT_FILE, overwrite=True) as partial:
        try:
            save_file(tensors, partial, metadata={"tidefield": json.dumps(header)})
        except SafetensorError as error:
            # The library hides the system's error number in its text.
            raise RunError(
                f"{folder / CHECKPOINT_FILE} cannot be written ({error}): expected a folder of yours with free space; "
                "make room and go on with --resume; the checkpoint before it is untouched"
            ) from error


def load_network(folder: Path, network: nn.Module) -> TrainingProgress:
    """Read the weights of a run's checkpoint into its network.

    Raises:
        RunError: there is none, it is damaged, or it belongs to another network.
    """
    tensors, progress = _read(folder)
    _load_weights(folder, network, tensors)
    return progress


def load_training(
    folder: Path, network: nn.Module, optimizer: torch.optim.Optimizer, generator: torch.Generator
) -> TrainingProgress:
    """Read all of a run's checkpoint, so that training goes on as if it had not stopped."""
    tensors, progress = _read(folder)
    _load_weights(folder, network, tensors)
    state: dict[int, dict[str, Tensor]] = {}
    for name, value in tensors.items():
        if name.startswith("optimizer."):
            _, index, key = name.split(".", 2)
            state.setdefault(int(index), {})[key] = value
    optimizer.load_state_dict({"state": state, "param_groups": optimizer.state_dict()["param_groups"]})
    generator.set_state(tensors["generator"])
    return progress


def _read(folder: Path) -> tuple[dict[str, Tensor], TrainingProgress]:
    path = folder / CHECKPOINT_FILE
    if not path.is_file():
        raise RunError(f"{folder} has no {CHECKPOINT_FILE}: expected a run that has trained; train it with --resume")
    try:
        with safe_open(path, framework="pt") as file:
            header: Any = json.loads((file.metadata() or {})["tidefield"])
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        return tensors, TrainingProgress(
            int(header["step"]), float(header["seconds"]), [float(x) for x in header["losses"]]
        )
    except (SafetensorError, KeyError, ValueError, TypeError) as error:
        raise RunError(
            f"{path} is damaged or of another program ({error}): expected a checkpoint that `tidefield train` wrote; "
            "train again into a new folder"
        ) from error


def _load_weights(folder: Path, network: nn.Module, tensors: dict[str, Tensor]) -> None:
    weights = {name.removeprefix("network."): v for name, v in tensors.items() if name.startswith("network.")}
    try:
        network.load_state_dict(weights)
    except RuntimeError as error:
        raise RunError(
            f"{folder / CHECKPOINT_FILE} does not fit {folder / RUN_FILE}: expected two files of one run; restore the "
            "right one"
        ) from error
