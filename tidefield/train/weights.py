"""Trained weights as a file to hand on: half precision, and what they are.

Those that ship with Tidefield lie in `tidefield/weights/`, beside a card that says what they were trained on.
"""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from tidefield import __version__
from tidefield.config import Config, config_to_json
from tidefield.errors import RunError
from tidefield.files import completed_file, file_sha256
from tidefield.model.network import Network

WEIGHTS_FILE = "weights.safetensors"
SHIPPED = Path(__file__).parents[1] / "weights"
_LARGEST_FILE = 1 << 30


def shipped(preset: str) -> Path | None:
    """The weights of a preset that came with Tidefield, if there are some."""
    file = SHIPPED / f"{preset}.safetensors"
    return file if file.is_file() else None


def given_or_shipped(given: Path | None, preset: str) -> Path:
    """Weights that are named, else those of the preset that came with Tidefield.

    Raises:
        RunError: there are neither.
    """
    found = given or shipped(preset)
    if found is None:
        raise RunError(f"no weights of {preset} came with Tidefield: expected --weights; train some, or use swift")
    return found


def write_weights(path: Path, network: Network, config: Config, about: dict[str, Any]) -> None:
    """Write a network's weights in half precision, over older ones.

    Args:
        path: the file.
        network: whose weights.
        config: what it was made from.
        about: what else to tell of them, for JSON.
    """
    state = network.state_dict()
    tensors = {name: value.detach().to("cpu", torch.float16).contiguous() for name, value in state.items()}
    header = {"config": config_to_json(config), "version": __version__, **about}
    with completed_file(path, overwrite=True) as partial:
        save_file(tensors, partial, metadata={"tidefield": json.dumps(header)})


def sha256(path: Path) -> str:
    """Of a file, for the record.

    Raises:
        RunError: it is not there.
    """
    _refuse_others(path)
    return file_sha256(path)


def about(path: Path) -> dict[str, Any]:
    """What is told of weights in their file.

    Raises:
        RunError: there are none, or they are damaged.
    """
    return _read(path)[0]


def _refuse_others(path: Path) -> None:
    if not path.is_file() or path.stat().st_size > _LARGEST_FILE:
        raise RunError(f"{path} is no file of weights: expected one that `tidefield pretrain` wrote; name it")


def _read(path: Path) -> tuple[dict[str, Any], dict[str, Tensor]]:
    _refuse_others(path)
    try:
        with safe_open(path, framework="pt") as file:
            header = json.loads((file.metadata() or {})["tidefield"])
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        _comparable(header["config"]["network"])
    except (SafetensorError, KeyError, ValueError, TypeError, AttributeError) as error:
        raise RunError(
            f"{path} is damaged or of another program ({error}): expected what `tidefield pretrain` wrote; name others"
        ) from error
    return header, tensors


def read_weights(path: Path, network: Network) -> None:
    """Give a network trained weights; a per-scene field, which they do not have, stays as it is.

    Raises:
        RunError: there are none, they are damaged, or they belong to another network.
    """
    header, tensors = _read(path)
    trained_as = header["config"]["network"]
    own, theirs = _comparable(json.loads(json.dumps(asdict(network.config)))), _comparable(trained_as)
    if theirs != own:
        different = ", ".join(sorted(name for name in own if theirs.get(name) != own[name]))
        raise RunError(f"{path} belongs to another network ({different} differ): expected weights of this one")
    with torch.no_grad():
        for name, value in network.state_dict().items():
            if name in tensors:
                value.copy_(tensors[name])


def _comparable(network: dict[str, Any]) -> dict[str, Any]:
    """What the weights depend on: how many views are read, samples along a ray and the per-scene field are free."""
    kept = {name: value for name, value in network.items() if name not in ("views", "field", "stages")}
    stages = [{name: value for name, value in stage.items() if name != "samples"} for stage in network["stages"]]
    return {**kept, "stages": stages}
