"""Runs and trained weights on disk.

RUN/run.json describes a run; RUN/checkpoint.safetensors holds the weights, the optimiser, the random state and, in its
header, the progress. A weights file (`tidefield pretrain`) holds the weights alone, in half precision, and a
description. Each file is replaced whole or not at all.
"""

from __future__ import annotations

import json
import re
from dataclasses import asdict, dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from tidefield import __version__
from tidefield.config import AnyConfig, Config, config_from_json, config_to_json
from tidefield.errors import RunError
from tidefield.files import completed_file, file_sha256, write_json
from tidefield.model.network import Network

RUN_FILE, CHECKPOINT_FILE, WEIGHTS_FILE = "run.json", "checkpoint.safetensors", "weights.safetensors"
SHIPPED = Path(__file__).parents[1] / "weights"
_LARGEST_RUN_FILE, _LARGEST_WEIGHTS_FILE = 1 << 24, 1 << 30


@dataclass(frozen=True)
class Run:
    """What a run is; does not change while it trains.

    Attributes:
        scene: the folder of its scene.
        width: of its photographs, pixels; None for their own.
        seed: of weights and batches.
        config: network and training.
        weights: SHA-256 of the trained weights it started from; None from scratch.
        version: of the program that started it.
    """

    scene: Path
    width: int | None
    seed: int
    config: AnyConfig
    weights: str | None = None
    version: str = __version__


@dataclass
class TrainingProgress:
    """How far a run has been trained."""

    step: int = 0
    seconds: float = 0.0
    losses: list[float] = field(default_factory=list)


def write_run(folder: Path, run: Run) -> None:
    """Write RUN/run.json."""
    data = {
        "scene": str(run.scene),
        "width": run.width,
        "seed": run.seed,
        "version": run.version,
        "config": config_to_json(run.config),
        "weights": run.weights,
    }
    write_json(folder / RUN_FILE, data)


def read_run(folder: Path) -> Run:
    """Read RUN/run.json.

    Raises:
        RunError: the folder holds no run, or one that does not fit this version.
    """
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
                "make room and continue with --resume; the checkpoint before it is untouched"
            ) from error


def load_network(folder: Path, network: nn.Module) -> TrainingProgress:
    """Read the weights of a run's checkpoint into its network.

    Raises:
        RunError: there is no checkpoint, it is damaged, or it belongs to another network.
    """
    return _load_network(folder, network)[0]


def load_training(
    folder: Path, network: nn.Module, optimizer: torch.optim.Optimizer, generator: torch.Generator
) -> TrainingProgress:
    """Read all of a run's checkpoint, so that training continues as if it had not stopped."""
    progress, tensors = _load_network(folder, network)
    state: dict[int, dict[str, Tensor]] = {}
    for name, value in tensors.items():
        if name.startswith("optimizer."):
            _, index, key = name.split(".", 2)
            state.setdefault(int(index), {})[key] = value
    optimizer.load_state_dict({"state": state, "param_groups": optimizer.state_dict()["param_groups"]})
    generator.set_state(tensors["generator"])
    return progress


def _load_network(folder: Path, network: nn.Module) -> tuple[TrainingProgress, dict[str, Tensor]]:
    """Read a checkpoint's weights into a network; returns its progress and all of its tensors."""
    path = folder / CHECKPOINT_FILE
    if not path.is_file():
        raise RunError(f"{folder} has no {CHECKPOINT_FILE}: expected a run that has trained; train it with --resume")
    try:
        header, tensors = _read_tensors(path)
        losses = [float(x) for x in header["losses"]]
        progress = TrainingProgress(int(header["step"]), float(header["seconds"]), losses)
    except (SafetensorError, KeyError, ValueError, TypeError) as error:
        raise RunError(
            f"{path} is damaged or of another program ({error}): expected a checkpoint that `tidefield train` wrote; "
            "train again into a new folder"
        ) from error
    try:
        network.load_state_dict(
            {name.removeprefix("network."): v for name, v in tensors.items() if name.startswith("network.")}
        )
    except RuntimeError as error:
        raise RunError(
            f"{path} does not fit {folder / RUN_FILE}: expected two files of one run; restore the right one"
        ) from error
    return progress, tensors


def _read_tensors(path: Path) -> tuple[Any, dict[str, Tensor]]:
    """The description in a file's header, and its tensors, in today's names."""
    with safe_open(path, framework="pt") as file:
        header = json.loads((file.metadata() or {})["tidefield"])
        return header, convert_names_0_1({name: file.get_tensor(name) for name in file.keys()})  # noqa: SIM118


_NAMES_0_1 = (
    (r"\btrust\.", "view_weight."),
    (r"\bmetric$", "log_metric"),
    (r"\btransformer\.place\.", "transformer.position."),
    (r"\bguide\.", "prior_features."),
    (r"\bmatch$", "agreement"),
    (r"\bguide_height$", "prior_height"),
    (r"\bguide_steepness$", "prior_steepness"),
    (r"\blone_steepness$", "single_view_steepness"),
)
"""Parameters' names of version 0.1 as patterns, and today's."""


def convert_names_0_1(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """Tensors of a file, with the parameter names of version 0.1 replaced by today's.

    The order of the parameters, by which a checkpoint numbers the optimiser's state, is the same in both.
    """
    if not any(re.search(r"\bstages\.\d+\.aggregate\.", name) for name in tensors):
        return tensors
    # The paper's network has one pass, whose boxes are now the network's own.
    swift = any(name.endswith("sharpen") for name in tensors)
    converted = {}
    for name, value in tensors.items():
        # Not the encoder's stages, which keep their name.
        name = re.sub(r"^(network\.)?stages\.(\d+)\.", r"\1passes.\2." if swift else r"\1", name)
        for pattern, today in _NAMES_0_1:
            name = re.sub(pattern, today, name)
        converted[name] = value
    return converted


def shipped_weights(preset: str) -> Path | None:
    """The weights of a preset that are installed, if there are any.

    `swift`'s are part of the package; `paper`'s, 54 times as large, are a package of their own.
    """
    places = [SHIPPED]
    package = find_spec("tidefield_paper_weights")
    if package is not None and package.origin is not None:
        places.append(Path(package.origin).parent)
    return next((file for place in places if (file := place / f"{preset}.safetensors").is_file()), None)


def given_or_shipped(given: Path | None, preset: str) -> Path:
    """The named weights, or else those of the preset that are installed.

    Raises:
        RunError: there are neither.
    """
    found = given or shipped_weights(preset)
    if found is None:
        raise RunError(
            f"no weights of {preset} are installed: expected --weights FILE, or the package tidefield-paper-weights "
            "(weights/paper in the repository); install it, name a file, or use --preset swift"
        )
    return found


def write_weights(path: Path, network: Network, config: Config, description: dict[str, Any]) -> None:
    """Write a network's weights in half precision, over older ones; `description` is kept with them as JSON."""
    state = network.state_dict()
    tensors = {name: value.detach().to("cpu", torch.float16).contiguous() for name, value in state.items()}
    header = {"config": config_to_json(config), "version": __version__, **description}
    with completed_file(path, overwrite=True) as partial:
        save_file(tensors, partial, metadata={"tidefield": json.dumps(header)})


def _require_weights(path: Path) -> None:
    if not path.is_file() or path.stat().st_size > _LARGEST_WEIGHTS_FILE:
        raise RunError(f"{path} is not a weights file: expected one that `tidefield pretrain` wrote; name it")


def weights_sha256(path: Path) -> str:
    """SHA-256 of a weights file, for records.

    Raises:
        RunError: there is no such file.
    """
    _require_weights(path)
    return file_sha256(path)


def read_weights_file(path: Path) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """The description in a weights file, and its tensors.

    Raises:
        RunError: there is no such file, or it is damaged.
    """
    _require_weights(path)
    try:
        header, tensors = _read_tensors(path)
        header["config"]["network"].keys()
    except (SafetensorError, KeyError, ValueError, TypeError, AttributeError) as error:
        raise RunError(
            f"{path} is damaged or of another program ({error}): expected what `tidefield pretrain` wrote; name another"
        ) from error
    return header, tensors


def read_weights(path: Path, network: Network) -> None:
    """Read a weights file into a network.

    Raises:
        RunError: there is no such file, it is damaged, or it belongs to another network.
    """
    header, tensors = read_weights_file(path)
    config = config_from_json(header["config"])
    assert isinstance(config, Config), "other methods have no weights files"
    own, theirs = _comparable(asdict(network.config)), _comparable(asdict(config.network))
    if theirs != own:
        different = ", ".join(sorted(name for name in own if theirs.get(name) != own[name]))
        raise RunError(f"{path} belongs to another network ({different} differ): expected weights of this one")
    with torch.no_grad():
        for name, value in network.state_dict().items():
            if name in tensors:
                value.copy_(tensors[name])


def _comparable(network: dict[str, Any]) -> dict[str, Any]:
    """What the weights depend on: the numbers of views and of samples along a ray are free."""
    kept = {name: value for name, value in network.items() if name not in ("views", "passes")}
    passes = [{name: value for name, value in one.items() if name != "samples"} for one in network["passes"]]
    return {**kept, "passes": passes}
