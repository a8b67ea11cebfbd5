"""Compute LPIPS (Zhang et al., 2018) with AlexNet and VGG backbones if their published weights are on this machine.

torchmetrics has the method and its small linear layers; the backbones' architectures come from torchvision (an
optional extra), their weights from two files in torch hub's folder. Nothing is downloaded unless
`download_lpips_weights` is called, and only the published files are used.
"""

from __future__ import annotations

import os
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
from tidefield.machine import memory_bytes

BACKBONES: dict[str, tuple[Literal["alex", "vgg"], str]] = {
    "lpips_alex": ("alex", "alexnet-owt-7be5be79.pth"),
    "lpips_vgg": ("vgg", "vgg16-397923af.pth"),
}
"""By metric: torchmetrics' name of the backbone, and its weights file, named with the start of its SHA-256."""
WEIGHTS_URL = "https://download.pytorch.org/models/"
SMALLEST_PX = 32  # AlexNet's poolings leave nothing of a smaller image
PIXEL_BYTES = {"lpips_alex": 150, "lpips_vgg": 1500}
"""Memory for each pixel: all layers' features of the truth, and those of the image as they are and of unit length."""
_MEMORY_SHARE = 0.5


def too_large(metric: str, width: int, height: int) -> str | None:
    """The reason why LPIPS cannot be computed of images of a size in this machine's memory; None if it can."""
    needed = PIXEL_BYTES[metric] * width * height
    if needed <= _MEMORY_SHARE * memory_bytes():
        return None
    return (
        f"LPIPS of {width} x {height} pixels takes {needed / 1e9:.1f} GB, more than half of this machine's memory; "
        "evaluate at a smaller width"
    )


class Lpips:
    """LPIPS with one backbone, on CPU; `sha256` is that of the file of its weights."""

    def __init__(self, backbone: Literal["alex", "vgg"], weights: Path, sha256: str) -> None:
        from torchmetrics.functional.image.lpips import _LPIPS

        # The backbone is built with random weights, which must not disturb a training that continues afterwards; they
        # are replaced here and not by torchvision, whose loader would download a missing file.
        with torch.random.fork_rng(devices=[]):
            self._network = _LPIPS(net=backbone, pnet_rand=True)
        loaded = torch.load(weights, map_location="cpu", weights_only=True)
        self.sha256 = sha256
        features = self._network.net
        # torchmetrics cuts torchvision's `features` into slices: slice3.6.weight is features.6.weight.
        features.load_state_dict({name: loaded["features." + name.split(".", 1)[1]] for name in features.state_dict()})
        self._truth: Tensor | None = None
        self._truth_features: list[Tensor] = []

    @torch.no_grad()
    def __call__(
        self, image: UInt8[Tensor, "H W 3"], truth: UInt8[Tensor, "H W 3"], masks: Sequence[Bool[Tensor, "H W"]]
    ) -> list[float]:
        """Return the distance between two images over each mask; over a full mask it is LPIPS as usually reported.

        In each layer the mean over its cells is weighted with the share of the mask in each cell.
        """
        if truth is not self._truth:  # several images are compared with each
            self._truth, self._truth_features = truth, self._features(truth)
        layers = zip(self._network.lins, self._features(image), self._truth_features, strict=True)
        maps = [lin((found - expected).square())[0, 0] for lin, found, expected in layers]

        def weighted_mean(layer: Float[Tensor, "h w"], mask: Bool[Tensor, "H W"]) -> float:
            share = F.adaptive_avg_pool2d(mask[None].float(), (layer.shape[0], layer.shape[1]))[0]
            return float((layer * share).sum() / share.sum())

        return [sum(weighted_mean(layer, mask) for layer in maps) for mask in masks]

    def _features(self, image: UInt8[Tensor, "H W 3"]) -> list[Tensor]:
        """Return each layer's features, of unit length in every cell."""
        batch = image.permute(2, 0, 1)[None] / 255
        scaled = self._network.scaling_layer(2 * batch - 1)
        return [x / torch.sqrt(1e-8 + x.square().sum(1, keepdim=True)) for x in self._network.net(scaled)]


def load_lpips() -> dict[str, Lpips | str]:
    """Load each metric's network, or give the reason why there is none and how to get it; never downloads or raises."""
    unusable = prepare_torchvision()
    if unusable is not None:
        return dict.fromkeys(BACKBONES, unusable)
    return {metric: _load(backbone, weights_folder() / file) for metric, (backbone, file) in BACKBONES.items()}


def _load(backbone: Literal["alex", "vgg"], path: Path) -> Lpips | str:
    # Results are kept and passed on, and should not contain the name of a home folder.
    home = Path(os.path.expanduser("~"))  # "~" itself where the system knows none
    shown = f"$HOME/{path.relative_to(home).as_posix()}" if path.is_relative_to(home) else path
    how_to_get = (
        "run `tidefield evaluate` once with --download-lpips, or: "
        f'curl --create-dirs --output "{shown}" {WEIGHTS_URL}{path.name}'
    )
    if not path.is_file():
        return f"the backbone's weights are not on this machine; {how_to_get}"
    try:
        sha256 = file_sha256(path)
    except OSError as error:
        return f"{path.name} cannot be read ({error.strerror}); {how_to_get}"
    if not sha256.startswith(hash_prefix(path.name)):
        return f"{path.name} is not the published file (its SHA-256 starts with {sha256[:8]}); {how_to_get}"
    return Lpips(backbone, path, sha256)


def weights_folder() -> Path:
    """Return torch hub's folder of weights on this machine."""
    return Path(torch.hub.get_dir()) / "checkpoints"


def download_lpips_weights() -> list[Path]:
    """Download the backbones' weights (233 MB and 528 MB) unless the published files are there; check their hashes.

    Raises:
        RunError: without a connection, or when another file than the published one arrives.
    """
    paths = [weights_folder() / file for _, file in BACKBONES.values()]
    for path in paths:
        if path.is_file() and file_sha256(path).startswith(hash_prefix(path.name)):
            continue
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            torch.hub.download_url_to_file(WEIGHTS_URL + path.name, str(path), hash_prefix(path.name))
        except (OSError, URLError, RuntimeError) as error:
            raise RunError(
                f"{WEIGHTS_URL}{path.name} could not be downloaded ({error}): expected a connection and room in "
                f"{path.parent}; try again, or copy the file there from another machine"
            ) from error
    return paths


def hash_prefix(file: str) -> str:
    """The start of a published file's SHA-256, which PyTorch puts into its name: NAME-HASH.pth."""
    return Path(file).stem.rsplit("-", 1)[1]


def prepare_torchvision() -> str | None:
    """Import torchvision so that torchmetrics can; return None, or the reason why it cannot be imported.

    torchvision's compiled half does not load with a PyTorch built for other hardware (a CPU build and the usual
    torchvision wheel), and its import then fails where it registers two operators of that half. LPIPS uses neither:
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
