"""Measure how close a rendering is to its photograph: PSNR, SSIM, LPIPS and FLIP of 8-bit images.

Every metric is taken over all pixels and over a mask. SSIM, LPIPS and FLIP use windows, so a masked value is the mean
of the metric's map over the mask; at its border the windows reach a little beyond it, for every method alike. Equation
numbers are those of the paper. Libraries are imported where they are used: torchmetrics alone takes seconds.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from scipy.ndimage import gaussian_filter
from torch import Tensor

from tidefield.evaluation.lpips import BACKBONES, SMALLEST_PX, Lpips, prepare_torchvision, too_large

SUFFIXES = ("", "_seen", "_cc", "_seen_cc")
"""Over all pixels, over the doubly seen ones, and both after a colour fit to the same pixels."""
PSNR_LIMIT_DB = 100.0
"""PSNR of identical images, which is infinite and has no place in JSON; 8-bit images that differ stay far below it."""

ROWS_AT_ONCE = 64
"""Rows of an image whose colours are fitted at once, in double precision: all of a large photograph take gigabytes."""
UNDETERMINED = 1e-14
"""Eigenvalues of the fit's normal matrix that count as zero, as a share of the largest: those of rounding are 1e-16."""

Image8 = UInt8[Tensor, "H W 3"]


@dataclass(frozen=True)
class Metric:
    """One metric, as evaluation measures it and tables show it.

    Attributes:
        title: of its rows and columns.
        style: format of its values.
        more_is_better: or less.
        pixel_map: its value around each pixel, of (image, truth); a masked value is the mean over the mask. None where
            `_score_image` measures it in another way.
    """

    title: str
    style: str
    more_is_better: bool
    pixel_map: Callable[[Image8, Image8], Float[Tensor, "H W"]] | None = None


@dataclass
class Scores:
    """Metrics of one photograph, by name with suffix.

    Attributes:
        values: None where a metric could not be measured.
        reasons: why, for exactly the names whose value is None.
    """

    values: dict[str, float | None] = field(default_factory=dict)
    reasons: dict[str, str] = field(default_factory=dict)


def score(
    rendering: Image8,
    truth: Image8,
    seen: Bool[Tensor, "H W"],
    networks: Mapping[str, Lpips | str],
    used: Bool[Tensor, "H W"] | None = None,
) -> Scores:
    """Measure all metrics with all suffixes.

    Args:
        rendering, truth: to compare.
        seen: the doubly seen pixels.
        networks: from `load_lpips`.
        used: the pixels that are not masked, and alone count; all if None.
    """
    everywhere, scores = torch.ones_like(seen) if used is None else used, Scores()
    seen = seen & everywhere
    _score_image(scores, rendering, truth, {"": everywhere, "_seen": seen}, networks)
    for suffix, mask in {"_cc": everywhere, "_seen_cc": seen}.items():
        _score_image(scores, fit_colours(rendering, truth, mask), truth, {suffix: mask}, networks)
    return scores


def _score_image(
    scores: Scores,
    image: Image8,
    truth: Image8,
    masks: dict[str, Bool[Tensor, "H W"]],
    networks: Mapping[str, Lpips | str],
) -> None:
    """Add one image's metrics over each mask, under the mask's suffix."""

    def add_missing(metric: str, suffix: str, reason: str) -> None:
        scores.values[metric + suffix], scores.reasons[metric + suffix] = None, reason

    for suffix in [suffix for suffix, mask in masks.items() if not mask.any()]:
        del masks[suffix]
        reason = "two training photographs see none of this photograph's pixels"
        if not suffix.startswith("_seen"):
            reason = "the mask leaves none of this photograph's pixels"
        for metric in METRICS:
            add_missing(metric, suffix, reason)
    if not masks:
        return
    for suffix, mask in masks.items():
        scores.values["psnr" + suffix] = psnr(image, truth, mask)
    for name, metric in METRICS.items():
        if metric.pixel_map is not None:
            values = metric.pixel_map(image, truth)
            scores.values.update({name + suffix: float(values[mask].mean()) for suffix, mask in masks.items()})
    for metric in BACKBONES:
        network = networks[metric]
        if min(image.shape[:2]) < SMALLEST_PX:
            network = f"LPIPS needs images of at least {SMALLEST_PX} pixels each way; evaluate at a larger width"
        elif not isinstance(network, str):
            network = too_large(metric, image.shape[1], image.shape[0]) or network
        if isinstance(network, str):
            for suffix in masks:
                add_missing(metric, suffix, network)
        else:
            values = network(image, truth, list(masks.values()))
            scores.values.update({metric + suffix: value for suffix, value in zip(masks, values, strict=True)})


def psnr_from_mse(mse: float, peak: float = 1.0) -> float:
    """Return the PSNR of a mean squared error of values up to `peak` (eq. 12), dB, at most `PSNR_LIMIT_DB`."""
    return PSNR_LIMIT_DB if mse <= 0 else min(10 * math.log10(peak**2 / mse), PSNR_LIMIT_DB)


def psnr(image: Image8, truth: Image8, mask: Bool[Tensor, "H W"] | None = None) -> float:
    """Return the PSNR over the masked pixels, or over all (eqs. 11-12), dB, at most `PSNR_LIMIT_DB`."""
    error = image.double() - truth.double()
    return psnr_from_mse(float((error if mask is None else error[mask]).square().mean()), peak=255.0)


def ssim_map(image: Image8, truth: Image8) -> Float[Tensor, "H W"]:
    """Return the SSIM (eq. 13) around each pixel, mean over the channels, as `similarity` has it to 1e-13.

    SciPy's separable filters take a fiftieth of the time that `similarity` takes in double precision on CPUs; in single
    precision bright, even ground is off by up to 2e-3.
    """
    c1, c2 = 0.01**2, 0.03**2

    def mean(values: np.ndarray) -> np.ndarray:
        return gaussian_filter(values, 1.5, radius=5, mode="mirror")

    def of_channel(first: np.ndarray, second: np.ndarray) -> np.ndarray:
        means = mean(first), mean(second)
        variances = mean(first * first) - means[0] ** 2 + mean(second * second) - means[1] ** 2
        covariance = mean(first * second) - means[0] * means[1]
        light = (2 * means[0] * means[1] + c1) / (means[0] ** 2 + means[1] ** 2 + c1)
        return light * (2 * covariance + c2) / (variances + c2)

    total = sum(of_channel(*(x[..., k].double().numpy() / 255 for x in (image, truth))) for k in range(3))
    return torch.from_numpy(total / 3).float()


def similarity(first: Float[Tensor, "T C H W"], second: Float[Tensor, "T C H W"]) -> Float[Tensor, "T C H W"]:
    """Return the SSIM (eq. 13) around each value, differentiable: 11x11 Gaussian, sigma 1.5, data range 1.

    Borders are reflected, as torchmetrics does, so that every pixel has a value. scikit-image leaves 5 pixels out at
    each border instead: inside these both maps are equal to 3e-8, but their means differ by about 0.002.
    """
    prepare_torchvision()
    from torchmetrics.functional.image import structural_similarity_index_measure

    result = structural_similarity_index_measure(
        first, second, sigma=1.5, kernel_size=11, data_range=1.0, return_full_image=True
    )
    assert isinstance(result, tuple)
    return result[1]


def flip_map(image: Image8, truth: Image8) -> Float[Tensor, "H W"]:
    """Return each pixel's LDR-FLIP (Andersson et al., 2020), 0 to 1, at its default distance (67 pixels/degree)."""
    import flip_evaluator

    reference, test = (np.ascontiguousarray(x.numpy(), dtype=np.float32) / 255 for x in (truth, image))
    result, _, _ = flip_evaluator.evaluate(
        reference, test, "LDR", applyMagma=False, computeMeanError=False, parameters={}
    )
    return torch.from_numpy(np.array(result[..., 0]))


def fit_colours(image: Image8, truth: Image8, mask: Bool[Tensor, "H W"]) -> Image8:
    """Apply the affine map of colours (3x4) that brings an image closest to the truth over the mask.

    Least squares on the 8-bit values, so it can be repeated from the pictures on disk; of least norm if the masked
    colours do not determine it. Unchanged for an empty mask.
    """
    if not mask.any():
        return image

    def design(part: UInt8[Tensor, "*N 3"]) -> Float[Tensor, "*N 4"]:
        return torch.nn.functional.pad(part.double(), (0, 1), value=1.0)

    normal = torch.zeros(4, 7, dtype=torch.double)  # sums of whole numbers, which are exact
    for part, wanted, counted in zip(*(x.split(ROWS_AT_ONCE) for x in (image, truth, mask)), strict=True):
        x = design(part[counted])
        normal += x.T @ torch.cat([x, wanted[counted].double()], dim=1)
    left, right = normal.split([4, 3], dim=1)
    fit = torch.from_numpy(np.linalg.lstsq(left.numpy(), right.numpy(), rcond=UNDETERMINED)[0])
    parts = ((design(part) @ fit).clamp(0, 255).round().to(torch.uint8) for part in image.split(ROWS_AT_ONCE))
    return torch.cat(list(parts))


METRICS = {
    "psnr": Metric("PSNR, dB", "{:.2f}", more_is_better=True),
    "ssim": Metric("SSIM", "{:.3f}", more_is_better=True, pixel_map=ssim_map),
    "lpips_alex": Metric("LPIPS, AlexNet", "{:.3f}", more_is_better=False),
    "lpips_vgg": Metric("LPIPS, VGG", "{:.3f}", more_is_better=False),
    "flip": Metric("FLIP", "{:.3f}", more_is_better=False, pixel_map=flip_map),
}
"""The metrics by name, in the order of the tables."""
