"""LPIPS (Zhang et al., 2018) with AlexNet and VGG backbones, when its weights are on this machine.

torchmetrics brings the method and its small linear layers; the backbones' architectures come from torchvision (an
optional extra), their weights from two files in torch hub's folder. Nothing is ever downloaded unless
`download_lpips_weights` is called.
"""

from __future__ import annotations

import pickle
import sys
from collections.abc import Sequence
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Literal
from urllib.error import URLError

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from tidefield.errors import RunError
from tidefield.files import file_sha256

BACKBONES: dict[str, tuple[Literal["alex", "vgg"], str]] = {
    "lpips_alex": ("alex", "alexnet-owt-7be5be79.pth"),
    "lpips_vgg": ("vgg", "vgg16-397923af.pth"),
}
"""By metric: torchmetrics' name of the backbone, and its weights file, named with the start of its SHA-256."""
WEIGHTS_URL = "https://download.pytorch.org/models/"
SMALLEST_PX = 32  # AlexNet's poolings leave nothing of a smaller image


class Lpips:
    """One backbone, ready for use; on CPU.

    Attributes:
        sha256: of the file of its weights.
    """

    def __init__(self, backbone: Literal["alex", "vgg"], weights: Path) -> None:
        from torchmetrics.functional.image.lpips import _LPIPS

        # The backbone is built with random weights, which must not disturb a training that goes on afterwards; they
        # are replaced here rather than by torchvision, whose loader would download what is missing.
        with torch.random.fork_rng(devices=[]):
            self._network = _LPIPS(net=backbone, pnet_rand=True)
        loaded = torch.load(weights, map_location="cpu", weights_only=True)
        self.sha256 = file_sha256(weights)
        features = self._network.net
        # torchmetrics cuts torchvision's `features` into slices: slice3.6.weight is features.6.weight.
        features.load_state_dict({name: loaded["features." + name.split(".", 1)[1]] for name in features.state_dict()})
        self._truth: Tensor | None = None
        self._expected: list[Tensor] = []

    @torch.no_grad()
    def __call__(
        self, image: UInt8[Tensor, "H W 3"], truth: UInt8[Tensor, "H W 3"], masks: Sequence[Bool[Tensor, "H W"]]
    ) -> list[float]:
        """The distance between two images over each mask: of a full mask, LPIPS as it is usually given.

        In every layer the mean over its cells is weighted with the share of the mask in each cell.
        """
        if truth is not self._truth:  # several images are compared with each
            self._truth, self._expected = truth, self._features(truth)
        layers = zip(self._network.lins, self._features(image), self._expected, strict=True)
        maps = [lin((found - expected).square())[0, 0] for lin, found, expected in layers]
        return [sum(_weighted_mean(layer, mask) for layer in maps) for mask in masks]

    def _features(self, image: UInt8[Tensor, "H W 3"]) -> list[Tensor]:
        """Of each layer, every cell's of unit length."""
        scaled = self._network.scaling_layer(2 * _batch(image) - 1)
        return [x / torch.sqrt(1e-8 + x.square().sum(1, keepdim=True)) for x in self._network.net(scaled)]


def load_lpips() -> dict[str, Lpips | str]:
    """By metric the network, or the reason why there is none and how to get it. Never downloads, never raises."""
    networks: dict[str, Lpips | str] = {}
    missing = prepare_torchvision()
    for metric, (backbone, file) in BACKBONES.items():
        path = weights_folder() / file
        if missing is not None:
            networks[metric] = missing
        elif not path.is_file():
            networks[metric] = f"the backbone's weights are not on this machine; {_how_to_get(path)}"
        else:
            try:
                networks[metric] = Lpips(backbone, path)
            except (OSError, EOFError, pickle.UnpicklingError, RuntimeError, ValueError, KeyError) as error:
                what = str(error).splitlines()[0] if str(error) else type(error).__name__
                networks[metric] = f"{path.name} does not hold the backbone's weights ({what}); {_how_to_get(path)}"
    return networks


def weights_folder() -> Path:
    """Where torch hub keeps weights on this machine."""
    return Path(torch.hub.get_dir()) / "checkpoints"


def download_lpips_weights() -> list[Path]:
    """Fetch the backbones' weights (233 MB and 528 MB) that are not there yet, and check their hashes.

    Raises:
        RunError: without a connection, or when what came is not what was asked for.
    """
    paths = [weights_folder() / file for _, file in BACKBONES.values()]
    for path in paths:
        if path.is_file():
            continue
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            torch.hub.download_url_to_file(WEIGHTS_URL + path.name, str(path), hash_prefix=path.stem.rsplit("-", 1)[1])
        except (OSError, URLError, RuntimeError) as error:
            raise RunError(
                f"{WEIGHTS_URL}{path.name} could not be fetched ({error}): expected a connection and room in "
                f"{path.parent}; try again, or bring the file there from another machine"
            ) from error
    return paths


def prepare_torchvision() -> str | None:
    """Import torchvision so that torchmetrics can; None, or the reason why it cannot be had.

    torchvision's compiled half does not load beside a PyTorch built for other hardware (a CPU build and the usual
    torchvision wheel), and its import then fails where it registers two of that half's operators. LPIPS uses neither:
    declaring them is enough. Without this even torchmetrics could not be imported, since it imports torchvision
    wherever it is installed.
    """
    if find_spec("torchvision") is None:
        return "torchvision is not installed; pip install 'tidefield[lpips]'"
    try:
        import_module("torchvision")
    except RuntimeError as error:
        if "torchvision::nms does not exist" not in str(error):
            return f"torchvision does not fit this PyTorch ({error}); pip install --upgrade torch torchvision"
        for name in [name for name in sys.modules if name.partition(".")[0] == "torchvision"]:
            del sys.modules[name]
        for operator in ("nms", "qnms"):
            torch.library.define(
                f"torchvision::{operator}", "(Tensor dets, Tensor scores, float iou_threshold) -> Tensor"
            )
        import_module("torchvision")
    return None


def _how_to_get(path: Path) -> str:
    # Results are kept and handed on: whose home folder it was is nobody's business.
    home = Path.home()
    told = f"$HOME/{path.relative_to(home).as_posix()}" if path.is_relative_to(home) else path
    return (
        "run `tidefield evaluate` once with --download-lpips, or: "
        f'curl --create-dirs --output "{told}" {WEIGHTS_URL}{path.name}'
    )


def _batch(image: UInt8[Tensor, "H W 3"]) -> Float[Tensor, "1 3 H W"]:
    return image.permute(2, 0, 1)[None] / 255


def _weighted_mean(layer: Float[Tensor, "h w"], mask: Bool[Tensor, "H W"]) -> float:
    share = F.adaptive_avg_pool2d(mask[None].float(), (layer.shape[0], layer.shape[1]))[0]
    return float((layer * share).sum() / share.sum())
