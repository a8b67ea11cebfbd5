import math
import tracemalloc

import numpy as np
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from tidefield.evaluation.lpips import BACKBONES
from tidefield.evaluation.metrics import (
    METRICS,
    PSNR_LIMIT_DB,
    SUFFIXES,
    fit_colours,
    flip_map,
    psnr,
    psnr_from_mse,
    score,
    similarity,
    ssim_map,
)

NO_LPIPS = dict.fromkeys(BACKBONES, "no weights here")


def noise(height: int = 24, width: int = 32, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randint(0, 256, (height, width, 3), generator=generator, dtype=torch.uint8)


def full(image: torch.Tensor) -> torch.Tensor:
    return torch.ones(image.shape[:2], dtype=torch.bool)


def left_half(image: torch.Tensor) -> torch.Tensor:
    mask = full(image)
    mask[:, image.shape[1] // 2 :] = False
    return mask


def test_psnr_of_a_known_offset():
    truth = torch.full((10, 12, 3), 100, dtype=torch.uint8)
    assert psnr(truth + 10, truth, full(truth)) == pytest.approx(20 * math.log10(255 / 10))


def test_psnr_of_an_mse_is_limited_and_keeps_nan():
    assert psnr_from_mse(0.01) == pytest.approx(20)
    assert psnr_from_mse(1.0) == 0
    assert psnr_from_mse(0.0) == psnr_from_mse(1e-300) == PSNR_LIMIT_DB
    assert math.isnan(psnr_from_mse(math.nan)), "a diverged training must not look perfect"


def test_a_masked_psnr_counts_the_masked_pixels_only():
    truth = torch.full((10, 12, 3), 100, dtype=torch.uint8)
    image = truth.clone()
    image[:, :6] += 10
    image[:, 6:] += 90
    assert psnr(image, truth, left_half(truth)) == pytest.approx(20 * math.log10(255 / 10))
    assert psnr(image, truth) == psnr(image, truth, full(truth)) == pytest.approx(10 * math.log10(255**2 / 4100))


def brute_force_ssim(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Eq. 13 written out: an 11x11 Gaussian window around each pixel of one channel, borders mirrored."""
    offsets = np.arange(-5, 6)
    window = np.exp(-(offsets[:, None] ** 2 + offsets[None] ** 2) / (2 * 1.5**2))
    window /= window.sum()
    x, y = (np.pad(v, 5, mode="reflect") for v in (x, y))
    result = np.empty((x.shape[0] - 10, x.shape[1] - 10))
    for row, column in np.ndindex(*result.shape):
        a, b = x[row : row + 11, column : column + 11], y[row : row + 11, column : column + 11]
        mean_a, mean_b = (window * a).sum(), (window * b).sum()
        var_a, var_b = (window * (a - mean_a) ** 2).sum(), (window * (b - mean_b) ** 2).sum()
        cov = (window * (a - mean_a) * (b - mean_b)).sum()
        luminance = (2 * mean_a * mean_b + 0.01**2) / (mean_a**2 + mean_b**2 + 0.01**2)
        result[row, column] = luminance * (2 * cov + 0.03**2) / (var_a + var_b + 0.03**2)
    return result


def test_ssim_is_the_formula_with_an_11_by_11_gaussian():
    image, truth = noise(13, 15, seed=1), noise(13, 15, seed=2)
    image = (image // 2 + truth // 2).to(torch.uint8)
    expected = [brute_force_ssim(image[..., c].numpy() / 255, truth[..., c].numpy() / 255) for c in range(3)]
    np.testing.assert_allclose(ssim_map(image, truth).numpy(), np.mean(expected, axis=0), atol=1e-6)


def test_ssim_is_what_the_differentiable_one_is_on_bright_even_ground_too():
    pair = [(230 + noise(40, 50, seed=seed) // 64).to(torch.uint8) for seed in (1, 2)]
    first, second = (image.permute(2, 0, 1)[None].double() / 255 for image in pair)
    np.testing.assert_allclose(ssim_map(*pair), similarity(first, second)[0].mean(0), atol=1e-7)


def test_flip_is_largest_where_the_images_differ():
    truth = torch.full((40, 60, 3), 120, dtype=torch.uint8)
    image = truth.clone()
    image[15:25, 25:35] = torch.tensor([250, 20, 20], dtype=torch.uint8)
    difference = flip_map(image, truth)
    assert difference[17:23, 27:33].min() > 0.5
    assert difference[:, :10].max() < 0.01


def test_the_colour_fit_recovers_a_known_colour_map():
    image = noise() // 2 + 50
    mixing = torch.tensor([[0.8, 0.1, 0.05], [0.05, 0.7, 0.1], [0.0, 0.1, 0.9]], dtype=torch.double)
    truth = (image.double() @ mixing + torch.tensor([5.0, -7.0, 3.0])).round().to(torch.uint8)
    assert (fit_colours(image, truth, full(image)).int() - truth.int()).abs().max() <= 1


def test_the_colour_fit_sees_the_masked_pixels_only():
    image = noise() // 2
    truth = image.clone()
    mask = left_half(image)
    truth[~mask] = 255
    assert torch.equal(fit_colours(image, truth, mask), image)


def test_the_colour_fit_of_one_flat_colour_is_the_mean_of_the_truth():
    truth = noise()
    flat = torch.full_like(truth, 77)
    expected = truth.double().mean((0, 1)).round().to(torch.uint8).expand_as(truth)
    assert torch.equal(fit_colours(flat, truth, full(truth)), expected)


@pytest.mark.parametrize("kind", ["colours", "nearly grey", "grey", "two colours"])
def test_the_colour_fit_is_the_least_squares_of_least_norm(kind: str):
    image, truth = noise(150, 90, seed=1), noise(150, 90, seed=2)
    grey = image[..., :1].expand_as(image).clone()
    if kind == "nearly grey":
        grey[40, 50] = grey[40, 50] ^ torch.tensor([0, 1, 0], dtype=torch.uint8)
    image = {"colours": image, "two colours": image[..., [0, 1, 1]] // 128 * 100 + 20}.get(kind, grey)
    truth, mask = (image // 3 + truth // 2).to(torch.uint8), truth[..., 0] > 60
    design = torch.nn.functional.pad(image.double(), (0, 1), value=1.0)
    fit = np.linalg.lstsq(design[mask].numpy(), truth[mask].double().numpy(), rcond=None)[0]
    expected = (design.numpy() @ fit).clip(0, 255)
    found = fit_colours(image, truth, mask).double().numpy()
    assert np.abs(found - expected).max() < 0.5 + 1e-6


class Largest(TorchDispatchMode):
    """Measures the largest tensor, in bytes."""

    bytes = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        out = func(*args, **(kwargs or {}))
        self.bytes = max(self.bytes, out.nbytes if isinstance(out, torch.Tensor) else 0)
        return out


def test_large_photographs_take_little_memory():
    image, truth = noise(1000, 200, seed=1), noise(1000, 200, seed=2)
    pixels = 1000 * 200
    with Largest() as largest:
        fit_colours(image, truth, left_half(image))
    assert largest.bytes < 4 * pixels
    tracemalloc.start()
    ssim_map(image, truth)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 100 * pixels


def test_a_full_mask_changes_no_metric():
    scores = score(noise(seed=1), noise(seed=2), full(noise()), NO_LPIPS)
    for metric in ("psnr", "ssim", "flip"):
        assert scores.values[metric + "_seen"] == scores.values[metric]
        assert scores.values[metric + "_seen_cc"] == scores.values[metric + "_cc"]


def test_masked_metrics_are_the_mean_of_the_map_over_the_mask():
    image, truth = noise(seed=1), noise(seed=2)
    mask = left_half(image)
    scores = score(image, truth, mask, NO_LPIPS).values
    assert scores["ssim_seen"] == pytest.approx(float(ssim_map(image, truth)[:, :16].mean()))
    assert scores["flip_seen"] == pytest.approx(float(flip_map(image, truth)[:, :16].mean()))
    fitted = fit_colours(image, truth, mask)
    assert scores["psnr_seen_cc"] == pytest.approx(psnr(fitted, truth, mask))


def test_exactly_the_missing_values_have_a_reason():
    nothing_seen = torch.zeros(24, 32, dtype=torch.bool)
    scores = score(noise(seed=1), noise(seed=2), nothing_seen, NO_LPIPS)
    assert set(scores.values) == {metric + suffix for metric in METRICS for suffix in SUFFIXES}
    assert set(scores.reasons) == {name for name, value in scores.values.items() if value is None}
    assert scores.values["psnr_seen"] is None
    assert "none of this photograph's pixels" in scores.reasons["psnr_seen"]
    assert scores.values["psnr_cc"] is not None
    assert "at least 32 pixels" in scores.reasons["lpips_alex"]


def test_masked_pixels_count_in_no_metric():
    image, truth = noise(seed=1), noise(seed=2)
    used = left_half(image)
    found = score(image, truth, full(image), NO_LPIPS, used).values
    expected = score(image, truth, used, NO_LPIPS).values
    for name, value in expected.items():
        if name.removesuffix("_cc").endswith("_seen"):
            assert found[name] == found[name.replace("_seen", "")] == value


def test_a_photograph_that_is_masked_altogether_has_no_values_but_a_reason():
    scores = score(noise(seed=1), noise(seed=2), full(noise()), NO_LPIPS, ~full(noise()))
    assert all(value is None for value in scores.values.values())
    assert "the mask leaves none" in scores.reasons["ssim_cc"]
