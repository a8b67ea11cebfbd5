import numpy as np
import torch

from tidefield.train.pictures import GAP_PX, STRIP_PX, WIDEST_PANEL_PX, Panel, Scale, colours, depth_panel, side_by_side


def test_a_colour_map_runs_from_its_low_to_its_high_end_and_clips():
    scale = Scale("viridis", 2.0, 4.0)
    picture = colours(torch.tensor([[0.0, 2.0, 3.0, 4.0, 9.0]]), scale)[0]
    assert torch.equal(picture[0], picture[1])
    assert torch.equal(picture[3], picture[4])
    # Viridis starts in dark violet and ends in yellow.
    assert (picture[0] - torch.tensor([68, 1, 84])).abs().max() <= 2
    assert (picture[4] - torch.tensor([253, 231, 36])).abs().max() <= 2


def test_depth_panels_span_the_depths_but_for_the_outermost_percent():
    depth = torch.linspace(10, 20, 10_000).reshape(100, 100)
    depth[0, 0] = 1e6
    panel = depth_panel("depth", depth, " m")
    assert panel.scale is not None
    np.testing.assert_allclose([panel.scale.low, panel.scale.high], [10.1, 19.9], atol=0.01)


def test_panels_stand_side_by_side_under_their_labels():
    red, blue = torch.zeros(2, 30, 120, 3, dtype=torch.uint8)
    red[..., 0], blue[..., 2] = 255, 255
    sheet = np.asarray(side_by_side([Panel("left", red), Panel("right", blue)]))
    assert sheet.shape == (30 + STRIP_PX, 240 + GAP_PX, 3)
    assert (sheet[STRIP_PX:, :120] == [255, 0, 0]).all()
    assert (sheet[STRIP_PX:, 120 + GAP_PX :] == [0, 0, 255]).all()
    for label in (sheet[:STRIP_PX, :120], sheet[:STRIP_PX, 120 + GAP_PX :]):
        assert (label < 128).any(), "a label is written"


def test_a_scale_adds_a_bar_below():
    scale = Scale("magma", 0.0, 1.0)
    image = colours(torch.rand(30, 300, generator=torch.Generator().manual_seed(0)), scale)
    sheet = np.asarray(side_by_side([Panel("plain", image), Panel("error", image, scale)]))
    assert sheet.shape[0] == 30 + 2 * STRIP_PX
    bar = sheet[-STRIP_PX // 2, 300 + GAP_PX :]
    assert {tuple(colour) for colour in colours(torch.tensor([[0.0, 1.0]]), scale)[0].tolist()} <= {
        tuple(pixel) for pixel in bar.tolist()
    }


def test_wide_panels_are_made_smaller():
    image = torch.zeros(600, 1600, 3, dtype=torch.uint8)
    assert side_by_side([Panel("wide", image)]).size == (WIDEST_PANEL_PX, 300 + STRIP_PX)
