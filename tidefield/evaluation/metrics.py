"""How close a rendering is to its photograph: PSNR, SSIM, LPIPS and FLIP on 8-bit images.

Every metric is taken over all pixels and over a mask. SSIM, LPIPS and FLIP look at windows, so a masked value is the
mean of the metric's map over the mask; at its border the windows see a little beyond it, for every method alike.
Libraries are imported where they are used: torchmetrics alone takes seconds.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from tidefield.evaluation.lpips import BACKBONES, SMALLEST_PX, Lpips, prepare_torchvision

METRICS = ("psnr", "ssim", "lpips_alex", "lpips_vgg", "flip")
SUFFIXES = ("", "_seen", "_cc", "_seen_cc")
"""Over all pixels, over the doubly seen ones, and both after a colour fit to the same pixels."""
PSNR_LIMIT_DB = 100.0
"""PSNR of identical images, which is infinite and has no place in JSON; 8-bit images that differ stay far below it."""

Image8 = UInt8[Tensor, "H W 3"]


@dataclass
class Scores:
    """Metrics of one photograph, by name with suffix.

    Attributes:
        values: None where a metric could not be had.
        reasons: why, for exactly the names whose value is None.
    """

    values: dict[str, float | None] = field(default_factory=dict)
    reasons: dict[str, str] = field(default_factory=dict)


def score(rendering: Image8, truth: Image8, seen: Bool[Tensor, "H W"], networks: Mapping[str, Lpips | str]) -> Scores:
    """All metrics with all suffixes.

    Args:
        rendering: 8-bit colours.
        truth: the photograph.
        seen: the doubly seen pixels.
        networks: what `load_lpips` gave.
    """
    everywhere = torch.ones_like(seen)
    scores = Scores()
    _score_image(scores, rendering, truth, {"": everywhere, "_seen": seen}, networks)
    for suffix, mask in {"_cc": everywhere, "_seen_cc": seen}.items():
        _score_image(scores, colour_fitted(rendering, truth, mask), truth, {suffix: mask}, networks)
    return scores


def _score_image(
    scores: Scores,
    image: Image8,
    truth: Image8,
    masks: dict[str, Bool[Tensor, "H W"]],
    networks: Mapping[str, Lpips | str],
) -> None:
    """Add one image's metrics over each mask, under the mask's suffix."""
    for suffix in [suffix for suffix, mask in masks.items() if not mask.any()]:
        del masks[suffix]
        for metric in METRICS:
            scores.values[metric + suffix] = None
            scores.reasons[metric + suffix] = "two training photographs see none of this photograph's pixels"
    if not masks:
        return
    alike, difference = ssim_map(image, truth), flip_map(image, truth)
    for suffix, mask in masks.items():
        scores.values["psnr" + suffix] = psnr(image, truth, mask)
        scores.values["ssim" + suffix] = float(alike[mask].mean())
        scores.values["flip" + suffix] = float(difference[mask].mean())
    for metric in BACKBONES:
        network = networks[metric]
        if min(image.shape[:2]) < SMALLEST_PX:
            network = f"LPIPS needs images of at least {SMALLEST_PX} pixels each way; evaluate at a larger width"
        if isinstance(network, str):
            scores.values.update({metric + suffix: None for suffix in masks})
            scores.reasons.update({metric + suffix: network for suffix in masks})
        else:
            values = network(image, truth, list(masks.values()))
            scores.values.update({metric + suffix: value for suffix, value in zip(masks, values, strict=True)})


def psnr(image: Image8, truth: Image8, mask: Bool[Tensor, "H W"]) -> float:
    """Eqs. 11-12 over the masked pixels, dB, at most `PSNR_LIMIT_DB`."""
    error = image[mask].double() - truth[mask].double()
    mean_square = float(error.square().mean())
    return min(10 * math.log10(255**2 / mean_square), PSNR_LIMIT_DB) if mean_square > 0 else PSNR_LIMIT_DB


def psnr_from_mse(mean_square: float) -> float:
    """Decibels of a mean squared error of values in [0, 1] (eq. 12), at most `PSNR_LIMIT_DB`."""
    return min(-10 * math.log10(mean_square), PSNR_LIMIT_DB) if mean_square > 0 else PSNR_LIMIT_DB


def ssim_map(image: Image8, truth: Image8) -> Float[Tensor, "H W"]:
    """Eq. 13 around each pixel, mean over the channels."""
    first, second = (x.permute(2, 0, 1)[None].double() / 255 for x in (image, truth))
    return similarity(first, second)[0].mean(0).float()


def similarity(first: Float[Tensor, "T C H W"], second: Float[Tensor, "T C H W"]) -> Float[Tensor, "T C H W"]:
    """Eq. 13 around each value: 11x11 Gaussian, sigma 1.5, data range 1, reflected borders; differentiable."""
    prepare_torchvision()
    from torchmetrics.functional.image import structural_similarity_index_measure

    result = structural_similarity_index_measure(
        first, second, sigma=1.5, kernel_size=11, data_range=1.0, return_full_image=True
    )
    assert isinstance(result, tuple)
    return result[1]


def flip_map(image: Image8, truth: Image8) -> Float[Tensor, "H W"]:
    """LDR-FLIP (Andersson et al., 2020) of each pixel, 0 to 1, at its default viewing distance (67 pixels/degree)."""
    import flip_evaluator

    first, second = (np.ascontiguousarray(x.numpy(), dtype=np.float32) / 255 for x in (truth, image))
    result, _, _ = flip_evaluator.evaluate(
        first, second, "LDR", applyMagma=False, computeMeanError=False, parameters={}
    )
    return torch.from_numpy(np.array(result[..., 0]))


def colour_fitted(image: Image8, truth: Image8, mask: Bool[Tensor, "H W"]) -> Image8:
    """The image after the affine map of its colours (3x4) that brings it closest to the truth over the mask.

    Least squares on the 8-bit values, so it can be repeated from the pictures on disk; of least norm where the masked
    colours do not determine it. Unchanged for an empty mask.
    """
    if not mask.any():
        return image
    design = torch.nn.functional.pad(image.double(), (0, 1), value=1.0)
    fit = np.linalg.lstsq(design[mask].numpy(), truth[mask].double().numpy(), rcond=None)[0]
    return (design @ torch.from_numpy(fit)).clamp(0, 255).round().to(torch.uint8)
