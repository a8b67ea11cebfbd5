"""Runs and trained weights on disk.

RUN/run.json describes a run; RUN/checkpoint.safetensors holds the weights, the optimiser, the random state and, in its
header, the progress. A weights file (`tidefield pretrain`) holds the weights alone, in half precision, and a
description. Each file is replaced whole or not at all, has the SHA-256 of what it holds, and must fit the network
exactly. The files of a run have its random id, so that those of another run are not taken for its own.
"""

from __future__ import annotations

import hashlib
import json
import re
import secrets
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
from jaxtyping import UInt8
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from tidefield import __version__
from tidefield.addresses import address_of, path_of, pull
from tidefield.config import (
    AnyConfig,
    Budget,
    Config,
    ExternalConfig,
    Range,
    Seed,
    config_from_json,
    config_to_json,
    from_json,
)
from tidefield.data.scene import Scene, poses_key
from tidefield.errors import RunError
from tidefield.files import completed_file, file_sha256, read_json, reading_from, write_json
from tidefield.model.network import Network

RUN_FILE, CHECKPOINT_FILE, WEIGHTS_FILE = "run.json", "checkpoint.safetensors", "weights.safetensors"
SHIPPED = Path(__file__).parents[1] / "weights"
_LARGEST_WEIGHTS_FILE = 1 << 30
_FLOATS = (torch.float16, torch.bfloat16, torch.float32, torch.float64)
_RUN = {
    "scene": str,
    "width": Annotated[int | None, Range(1, 1 << 20)],
    "seed": Seed,
    "version": str,
    "weights": str | None,
    "variant": str | None,
    "id": str | None,
    "budget": Budget | None,
    "poses": str | None,
    "held_out": tuple[str, ...] | None,
}
_PROGRESS = {
    "step": Annotated[int, Range(0, (1 << 63) - 1)],
    "seconds": Annotated[float, Range(0, 1e12)],
    "losses": tuple[Annotated[float, Range(0, 1e38)], ...],
    "cpu_precision": Literal["bfloat16", "float32"] | None,
}
"""Types of what run.json and the header of a checkpoint hold."""


@dataclass(frozen=True)
class Run:
    """What a run is; does not change while it trains, but for a new budget with which it is continued.

    Attributes:
        scene: the folder of its scene.
        width: of its photographs, pixels; None for their own.
        seed: of weights and batches.
        config: network and training.
        variant: the part of its preset that was changed, by the name that was given; None for none, and in runs of
            version 0.1.
        weights: SHA-256 of the trained weights it started from; None from scratch.
        version: of the program that started it.
        id: random; None in runs of version 0.1.
        budget: of the training, from its start; None in runs of version 0.1.
        poses: identifies those it was trained on (`poses_key`); None in runs of version 0.1.
        held_out: photographs that it did not learn from; None in runs of version 0.1.
    """

    scene: Path
    width: int | None
    seed: int
    config: AnyConfig
    weights: str | None = None
    variant: str | None = None
    version: str = __version__
    id: str | None = field(default_factory=lambda: secrets.token_hex(8))
    budget: Budget | None = None
    poses: str | None = None
    held_out: tuple[str, ...] | None = None


@dataclass
class TrainingProgress:
    """How far a run has been trained, and the precision that it was trained in if that was on a CPU."""

    step: int = 0
    seconds: float = 0.0
    losses: list[float] = field(default_factory=list)
    cpu_precision: Literal["bfloat16", "float32"] | None = None


def write_run(folder: Path, run: Run) -> None:
    """Write RUN/run.json."""
    data = asdict(run) | {"scene": address_of(run.scene) or str(run.scene), "config": config_to_json(run.config)}
    write_json(folder / RUN_FILE, data)


def read_run(folder: Path) -> Run:
    """Read RUN/run.json.

    Raises:
        RunError: the folder holds no run, or one that does not fit this version.
    """
    path = folder / RUN_FILE
    data = read_json(path)
    if data is None:
        what = "is missing" if not folder.exists() else f"holds no run (no {RUN_FILE})"
        raise RunError(f"{folder} {what}: expected a folder that `tidefield train` wrote; train one")
    keys = {*_RUN, "config"}
    if not isinstance(data, dict) or not keys - {"variant", "id", "budget", "poses", "held_out"} <= set(data) <= keys:
        raise RunError(f"{path} is damaged: expected the keys {sorted(keys)}, as `tidefield train` wrote; restore it")
    values = {name: from_json(kind, data.get(name), f"{path}: {name}") for name, kind in _RUN.items()}
    config = config_from_json(data["config"], f"{path}: config")
    return Run(**{**values, "scene": path_of(values["scene"])}, config=config)


def may_move(run: Run) -> bool:
    """Whether a run can go on with a scene in another place: it must know by which poses to recognise it."""
    return run.poses is not None and run.held_out is not None and not isinstance(run.config, ExternalConfig)


def scene_of(folder: Path, run: Run) -> Path:
    """The scene of the run in a folder, fetched if it is in an object store.

    Raises:
        RunError: it is not where it was.
    """
    pull(run.scene)
    if not run.scene.exists():
        instead = f", or name its new place with `tidefield train SCENE {folder} --resume`" if may_move(run) else ""
        raise RunError(
            f"{folder} was trained on {run.scene}, which is missing: expected its scene, from whose photographs it "
            f"renders; put it back{instead}"
        )
    return run.scene


def is_of(run: Run, scene: Scene) -> bool:
    """Whether a scene has the poses that a run was trained on, and holds out the same photographs, if any."""
    if run.poses is None or run.held_out is None:
        return True
    key = poses_key(scene.names, scene.cameras.T_world_camera, run.held_out)
    return run.poses == key and (not scene.test or {*scene.held_out} == {*run.held_out})


def _run_id(folder: Path) -> str | None:
    """The id of the run in a folder; None where a pretraining is."""
    return read_run(folder).id if (folder / RUN_FILE).exists() else None


def save_checkpoint(
    folder: Path,
    network: nn.Module,
    optimizer: torch.optim.Optimizer,
    random_state: UInt8[Tensor, " B"],
    progress: TrainingProgress,
) -> None:
    """Replace the run's checkpoint; `random_state` is that of the generator of the batches to come."""
    tensors = {f"network.{name}": value for name, value in network.state_dict().items()}
    for index, state in optimizer.state_dict()["state"].items():
        tensors |= {f"optimizer.{index}.{name}": torch.as_tensor(value) for name, value in state.items()}
    tensors["generator"] = random_state
    header = {"run": _run_id(folder), **asdict(progress), "version": __version__}
    _write_tensors(folder / CHECKPOINT_FILE, tensors, header)


def load_network(folder: Path, network: nn.Module) -> TrainingProgress:
    """Read the weights of a run's checkpoint into its network.

    Raises:
        RunError: there is no checkpoint, it is damaged, or it belongs to another run or network.
    """
    progress, tensors = _read_checkpoint(folder)
    state = {name: value for name, value in tensors.items() if name.startswith("network.")}
    _require_fit(folder / CHECKPOINT_FILE, state, _named(network))
    network.load_state_dict({name.removeprefix("network."): value for name, value in state.items()})
    return progress


def load_training(
    folder: Path, network: nn.Module, optimizer: torch.optim.Optimizer, generator: torch.Generator
) -> TrainingProgress:
    """Read all of a run's checkpoint, so that training continues as if it had not stopped.

    Raises:
        RunError: as `load_network`.
    """
    progress, tensors = _read_checkpoint(folder)
    parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    stored = {name.split(".")[1] for name in tensors if name.startswith("optimizer.")}  # not of unused parameters
    expected = {**_named(network), "generator": generator.get_state()}
    for index, value in enumerate(parameters):
        if str(index) in stored:
            state = {"step": torch.zeros(()), "exp_avg": value, "exp_avg_sq": value}
            expected |= {f"optimizer.{index}.{name}": tensor for name, tensor in state.items()}
    path = folder / CHECKPOINT_FILE
    _require_fit(path, tensors, expected)
    try:
        generator.set_state(tensors["generator"])
    except RuntimeError as error:
        raise RunError(f"{path} is damaged ({error}): expected the state of a random generator; train again") from error
    network.load_state_dict({name: tensors[f"network.{name}"] for name in network.state_dict()})
    moments = {
        index: {name: tensors[f"optimizer.{index}.{name}"] for name in ("step", "exp_avg", "exp_avg_sq")}
        for index in map(int, stored)
    }
    optimizer.load_state_dict({"state": moments, "param_groups": optimizer.state_dict()["param_groups"]})
    return progress


def _named(network: nn.Module) -> dict[str, Tensor]:
    return {f"network.{name}": value for name, value in network.state_dict().items()}


def require_checkpoint(folder: Path) -> Path:
    """Return the checkpoint of a run.

    Raises:
        RunError: there is none.
    """
    path = folder / CHECKPOINT_FILE
    with reading_from(path):
        there = path.is_file()
    if not there:
        raise RunError(f"{folder} has no {CHECKPOINT_FILE}: expected a run that has trained; train it with --resume")
    return path


def _read_checkpoint(folder: Path) -> tuple[TrainingProgress, dict[str, Tensor]]:
    """The progress in a run's checkpoint, and its tensors."""
    path = require_checkpoint(folder)
    header, tensors = _read_tensors(path, "a checkpoint that `tidefield train` wrote; train again into a new folder")
    if header.get("run") != _run_id(folder):
        raise RunError(
            f"{path} is of another run than {RUN_FILE}: expected two files of one run; restore the right one"
        )
    if "network.radius" in tensors:  # of classical NeRF; earlier ones reached to 1
        tensors.setdefault("network.headroom", torch.ones(3))
    values = {name: from_json(kind, header.get(name), f"{path}: {name}") for name, kind in _PROGRESS.items()}
    return TrainingProgress(**{**values, "losses": list(values["losses"])}), tensors


def _write_tensors(path: Path, tensors: Mapping[str, Tensor], header: dict[str, Any]) -> None:
    """Replace a file of tensors, whose header is a description."""
    stored = {name: value.detach().cpu().contiguous() for name, value in tensors.items()}
    text = json.dumps({**header, "sha256": _sha256(stored, header)})
    with completed_file(path, overwrite=True) as partial:
        try:
            save_file(stored, partial, metadata={"tidefield": text})
        except SafetensorError as error:
            # The library hides the system's error number in its text.
            raise RunError(
                f"{path} cannot be written ({error}): expected a folder of yours with free space; make room and "
                "continue with --resume; what was saved before is untouched"
            ) from error


def _read_tensors(path: Path, expected: str) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """The description in a file's header, and its tensors, in today's names.

    Raises:
        RunError: it is damaged.
    """
    with reading_from(path):
        path.open("rb").close()  # safetensors says of a file that may not be read that there is none
    try:
        with safe_open(path, framework="pt") as file:
            header = json.loads((file.metadata() or {})["tidefield"])
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        stored = header.pop("sha256", None)
        if stored is None and header["version"] != "0.1.0":
            raise ValueError("without a SHA-256")
        if stored is not None and stored != _sha256(tensors, header):
            raise ValueError("its SHA-256 is not that of what it holds")
    except (
        *(SafetensorError, KeyError, ValueError, TypeError, AttributeError),
        *(OverflowError, RecursionError),
    ) as error:
        raise RunError(f"{path} is damaged or of another program ({error}): expected {expected}") from error
    return header, convert_names_0_1(tensors)


def _sha256(tensors: Mapping[str, Tensor], header: Mapping[str, Any]) -> str:
    """SHA-256 of a description, and of the names, types, shapes and values of tensors."""
    digest = hashlib.sha256(json.dumps(header, sort_keys=True).encode())
    for name, value in sorted(tensors.items()):
        digest.update(f"{name} {value.dtype} {tuple(value.shape)}".encode())
        digest.update(value.reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()


def _require_fit(path: Path, tensors: Mapping[str, Tensor], expected: Mapping[str, Tensor]) -> None:
    """Raises: RunError unless these are exactly the expected tensors, and finite."""
    for name in sorted({*tensors, *expected}):
        fault = _fault(tensors.get(name), expected.get(name))
        if fault is not None:
            raise RunError(
                f"{path} does not fit: {name} {fault}; expected exactly the tensors of its network; restore the right "
                "file, or train again"
            )


def _fault(found: Tensor | None, wanted: Tensor | None) -> str | None:
    """What is wrong with one tensor of a file."""
    if wanted is None or found is None:
        return "is missing" if found is None else "is not known"
    if found.shape != wanted.shape:
        return f"has the shape {tuple(found.shape)} instead of {tuple(wanted.shape)}"
    if found.dtype != wanted.dtype and not (found.dtype in _FLOATS and wanted.dtype in _FLOATS):
        return f"has the type {found.dtype} instead of {wanted.dtype}"
    if found.dtype in _FLOATS and not found.to(wanted.dtype).isfinite().all():
        return "is not finite"
    return None


_NAMES_0_1 = ((r"\btrust\.", "view_weight."), (r"\btransformer\.place\.", "transformer.position."))
"""Parameters' names of version 0.1 as patterns, and today's."""


def convert_names_0_1(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """Tensors of a file, with the parameter names that version 0.1 gave the paper's network replaced by today's.

    The order of the parameters, by which a checkpoint numbers the optimiser's state, is the same in both.

    Raises:
        RunError: they are of the preset `swift`, whose network was another.
    """
    if not any(re.search(r"\bstages\.\d+\.aggregate\.", name) for name in tensors):
        return tensors
    if any(name.endswith("sharpen") for name in tensors):
        raise RunError(
            "these weights are of the preset swift of Tidefield 0.1, whose network was another: expected newer ones; "
            "train it again"
        )
    converted = {}
    for name, value in tensors.items():
        # The one pass of the paper's network, whose boxes are now its own; not the encoder's stages.
        name = re.sub(r"^(network\.)?stages\.\d+\.", r"\1", name)
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
    tensors = {name: value.to(torch.float16) for name, value in network.state_dict().items()}
    _write_tensors(path, tensors, {"config": config_to_json(config), "version": __version__, **description})


def _require_weights(path: Path) -> None:
    with reading_from(path):
        usable = path.is_file() and path.stat().st_size <= _LARGEST_WEIGHTS_FILE
    if not usable:
        raise RunError(f"{path} is not a weights file: expected one that `tidefield pretrain` wrote; name it")


def weights_sha256(path: Path) -> str:
    """SHA-256 of a weights file, for records.

    Raises:
        RunError: there is no such file.
    """
    _require_weights(path)
    with reading_from(path):
        return file_sha256(path)


def read_weights_file(path: Path) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """The description in a weights file, and its tensors.

    Raises:
        RunError: there is no such file, or it is damaged.
    """
    _require_weights(path)
    header, tensors = _read_tensors(path, "what `tidefield pretrain` wrote; name another")
    if "config" not in header:
        raise RunError(f"{path} is not a weights file: expected one that `tidefield pretrain` wrote; name it")
    return header, tensors


def read_weights(path: Path, network: Network) -> None:
    """Read a weights file into a network.

    Raises:
        RunError: there is no such file, it is damaged, or it belongs to another network.
    """
    header, tensors = read_weights_file(path)
    config = config_from_json(header["config"], f"{path}: config")
    if not isinstance(config, Config):
        raise RunError(f"{path} is of {config.method}: expected weights of a preset; name others")
    own, theirs = _comparable(asdict(network.config)), _comparable(asdict(config.network))
    if theirs != own:
        different = ", ".join(sorted(name for name in own if theirs.get(name) != own[name]))
        raise RunError(f"{path} belongs to another network ({different} differ): expected weights of this one")
    _require_fit(path, tensors, network.state_dict())
    network.load_state_dict(tensors)


def _comparable(network: dict[str, Any]) -> dict[str, Any]:
    """What the weights depend on: the numbers of views and of samples along a ray are free."""
    kept = {name: value for name, value in network.items() if name not in ("views", "passes")}
    passes = [{name: value for name, value in one.items() if name != "samples"} for one in network["passes"]]
    return {**kept, "passes": passes}
