import textured_wall as wall
import torch

from tidefield.baselines.gather import fill_unseen, read_photograph


def test_reading_at_pixel_centres_gives_the_pixels_at_the_common_exposure():
    scene = wall.scene(wall.with_gains(wall.cameras(2)))
    uv = torch.tensor([[0.5, 0.5], [47.5, 35.5], [10.5, 20.5]])
    pixels = scene.photographs[0][[0, 35, 20], [0, 47, 10]].float() / 255
    torch.testing.assert_close(read_photograph(scene, 0, uv), pixels / scene.cameras.gain[0])


def test_reading_between_pixels_is_bilinear_and_stops_at_the_border():
    scene = wall.scene(wall.cameras(2))
    image = scene.photographs[0].float() / 255
    between = read_photograph(scene, 0, torch.tensor([[5.75, 8.0]]))[0]
    expected = (image[7, 5] + image[8, 5]) / 2 * 0.75 + (image[7, 6] + image[8, 6]) / 2 * 0.25
    torch.testing.assert_close(between, expected)
    torch.testing.assert_close(read_photograph(scene, 0, torch.tensor([[0.1, 0.1]]))[0], image[0, 0])


def test_filling_keeps_what_was_seen_and_continues_it():
    colour = torch.rand(9, 13, 3, generator=torch.Generator().manual_seed(0))
    seen = torch.ones(9, 13, dtype=torch.bool)
    assert torch.equal(fill_unseen(colour, seen), colour)
    seen[:, 4:] = False
    colour[:, :4] = 0.25
    filled = fill_unseen(colour, seen)
    torch.testing.assert_close(filled, torch.full_like(filled, 0.25))


def test_nothing_seen_is_grey():
    filled = fill_unseen(torch.rand(4, 5, 3), torch.zeros(4, 5, dtype=torch.bool))
    assert (filled == 0.5).all()
