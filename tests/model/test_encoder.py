from itertools import pairwise

import pytest
import torch
from random_weights import randomise
from torch import Tensor, nn
from torch.nn import functional as F

from tidefield.config import PAPER, PRESETS, SWIFT, EncoderConfig
from tidefield.model.encoder import Encoder, double

SMALL = EncoderConfig(widths=(4, 4, 6, 8), blocks=(1, 1, 1), instance_norm=False)
ALL = ((4, 5), (2, 4), (1, 3))


def paper() -> Encoder:
    """Without memory: shapes only."""
    stage = PAPER.network.passes[0]
    with torch.device("meta"):
        return Encoder(PAPER.network.encoder, ((stage.feature_stride, stage.feature_channels),))


def test_the_paper_preset_is_table_1_for_a_640_x_480_image():
    encoder, seen = paper(), {}
    layers = {"1": encoder.stem, **{str(k + 2): s for k, s in enumerate(encoder.stages)}}
    layers |= {"7": encoder.up[0], "9": encoder.up[1]}
    for name, layer in layers.items():
        layer.register_forward_hook(lambda _, __, out, name=name: seen.update({name: tuple(out.shape[1:])}))
    (out,) = encoder(torch.empty(1, 3, 480, 640, device="meta"))
    assert seen == {
        "1": (64, 240, 320),
        "2": (64, 120, 160),
        "3": (128, 60, 80),
        "4": (256, 30, 40),
        "7": (128, 60, 80),
        "9": (64, 120, 160),
    }
    assert out.shape == (1, 64, 120, 160)


def test_the_paper_preset_has_resnet_34s_blocks_and_table_1s_kernels():
    encoder = paper()
    assert [len(list(stage.children())) for stage in encoder.stages] == [3, 4, 6]
    three_by_three = [
        sum(isinstance(m, nn.Conv2d) and m.kernel_size == (3, 3) for m in s.modules()) for s in encoder.stages
    ]
    assert three_by_three == [6, 8, 12]
    stem = [m for m in encoder.stem.modules() if isinstance(m, nn.Conv2d)]
    assert [(m.kernel_size, m.stride, m.out_channels) for m in stem] == [((7, 7), (2, 2), 64)]
    assert [m.kernel_size for m in encoder.out if isinstance(m, nn.Conv2d)] == [(1, 1)]


def kinds(encoder: nn.Module) -> set[str]:
    return {type(m).__name__ for m in encoder.modules()}


def test_every_norm_of_the_paper_preset_is_an_instance_norm_and_nothing_pools():
    encoder = paper()
    assert not [k for k in kinds(encoder) if "BatchNorm" in k or "Pool" in k]
    norms = [m for m in encoder.modules() if isinstance(m, nn.InstanceNorm2d)]
    convolutions = [m for m in encoder.modules() if isinstance(m, nn.Conv2d)]
    assert len(norms) == len(convolutions) - 1, "every convolution but the last has a norm"
    assert not any(m.track_running_stats for m in norms)


def test_the_swift_preset_has_no_norms():
    encoder = Encoder(SWIFT.network.encoder, ALL)
    assert not [k for k in kinds(encoder) if "Norm2d" in k or "Pool" in k]


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize(("height", "width"), [(64, 48), (75, 101), (33, 50), (17, 31)])
def test_any_size_gives_maps_of_its_size_over_the_stride_rounded_up(preset: str, height: int, width: int):
    with torch.device("meta"):
        encoder = Encoder(PRESETS[preset].network.encoder, ALL)
    maps = encoder(torch.empty(2, 3, height, width, device="meta"))
    assert [m.shape for m in maps] == [(2, c, -(-height // s), -(-width // s)) for s, c in ALL]


@pytest.mark.parametrize("outputs", [((4, 6),), ((2, 6),), ((1, 6),), ((4, 6), (1, 2))])
def test_any_choice_of_outputs_can_be_had_and_is_finite(outputs: tuple[tuple[int, int], ...]):
    encoder = randomise(Encoder(SMALL, outputs))
    maps = encoder(picture(40, 24))
    assert [m.shape for m in maps] == [(1, c, 40 // s, 24 // s) for s, c in outputs]
    sum(m.square().mean() for m in maps).backward()  # type: ignore[union-attr]
    for name, parameter in encoder.named_parameters():
        assert parameter.grad is not None, f"{name} takes no part"
        assert parameter.grad.isfinite().all(), name


def picture(height: int, width: int) -> Tensor:
    return torch.rand(1, 3, height, width, generator=torch.Generator().manual_seed(0))


def test_a_crop_gives_the_whole_photographs_features_far_from_its_border():
    """Without norms nothing depends on how much is encoded. The corner is a multiple of the coarsest stride."""
    encoder = randomise(Encoder(SMALL, ALL))
    whole, (top, left), side, border = picture(320, 304), (32, 16), 256, 112
    crop = whole[:, :, top : top + side, left : left + side]
    with torch.inference_mode():
        for (stride, _), full, part in zip(ALL, encoder(whole), encoder(crop), strict=True):
            same = full[:, :, top // stride :, left // stride :][:, :, : side // stride, : side // stride]
            inner = slice(border // stride, (side - border) // stride)
            assert part[:, :, inner, inner].std() > 1e-3
            torch.testing.assert_close(part[:, :, inner, inner], same[:, :, inner, inner], atol=1e-5, rtol=1e-4)


def test_photographs_of_a_batch_do_not_know_of_each_other():
    for config in (SMALL, EncoderConfig(widths=(4, 4, 6, 8), blocks=(1, 1, 1), instance_norm=True)):
        encoder = randomise(Encoder(config, ALL))
        images = torch.rand(3, 3, 32, 48, generator=torch.Generator().manual_seed(1))
        for together, alone in zip(encoder(images), encoder(images[1:2]), strict=True):
            torch.testing.assert_close(together[1:2], alone, atol=1e-5, rtol=1e-4)


def test_instance_norms_take_away_contrast():
    encoder = randomise(Encoder(EncoderConfig((4, 4, 6, 8), (1, 1, 1), instance_norm=True), ((4, 5),)))
    image = picture(64, 64)
    with torch.inference_mode():
        (before,), (after,) = encoder(image), encoder(0.5 + (image - 0.5) * 0.6)
    # The last convolution sees the input only through norms where no skip leads past them, as at stride 4.
    torch.testing.assert_close(before, after, atol=2e-2, rtol=0)
    assert before.std() > 0.1


def test_finer_outputs_hold_finer_detail():
    """Stripes one pixel wide can be distinguished from grey only by a map that reads the input at full resolution."""
    encoder = randomise(Encoder(SMALL, ALL))
    stripes = picture(64, 64).clone()
    stripes[..., ::2], stripes[..., 1::2] = 0.2, 0.8
    with torch.inference_mode():
        rough = [
            m[..., 24 // s : 40 // s, 24 // s : 40 // s].diff(dim=-1).abs().mean()
            for m, (s, _) in zip(encoder(stripes), ALL, strict=True)
        ]
    assert all(coarse < 0.1 * fine for coarse, fine in pairwise(rough[1:]))


def test_the_basic_block_is_resnets_layer_by_layer():
    """conv, norm, ReLU, conv, norm, plus the shortcut, then ReLU (He et al., 2016, Figure 2)."""
    block = Encoder(EncoderConfig((4, 4, 6, 8), (1, 1, 1), True), ((4, 5),)).stages[0][0]
    x = torch.randn(1, 4, 12, 16, generator=torch.Generator().manual_seed(0))
    hidden = F.relu(block.first[1](block.first[0](x)))
    expected = F.relu(block.second[1](block.second[0](hidden)) + block.shortcut(x))
    torch.testing.assert_close(block(x), expected)


@pytest.mark.parametrize("outputs", [((4, 6),), ((4, 6), (1, 2))])
def test_features_stay_where_they_were_computed(outputs: tuple[tuple[int, int], ...]):
    """With kernels that are symmetric, the features of a photograph upside down are those of the photograph, upside
    down; if a step displaced them, they would be displaced the other way."""
    encoder = randomise(Encoder(SMALL, outputs)).double()
    for module in encoder.modules():
        if isinstance(module, nn.Conv2d):
            module.weight.data = (module.weight + module.weight.flip(-1, -2)).data / 2
    # 16 k + 1 pixels: the texels of every stride then lie symmetrically.
    image = torch.rand(1, 3, 65, 97, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    with torch.no_grad():
        for upright, turned in zip(encoder(image), encoder(image.flip(-1, -2)), strict=True):
            torch.testing.assert_close(turned.flip(-1, -2), upright)


def test_doubled_maps_have_their_texels_at_every_second_place():
    ramp = torch.arange(5.0)[:, None] + 10 * torch.arange(4.0)
    doubled = double(ramp[None, None])[0, 0]
    assert doubled.shape == (10, 8)
    torch.testing.assert_close(doubled[::2, ::2], ramp)
    torch.testing.assert_close(doubled[1:-1:2, :-1], (doubled[:-2:2, :-1] + doubled[2::2, :-1]) / 2)
