"""Masked pixels of photographs: read from where others keep masks, and used by nothing."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import textured_wall as wall
import torch
from PIL import Image
from scenes_on_disk import BARREL, PINHOLE, Truth, survey, write_colmap, write_transforms

from tidefield.config import PAPER, SWIFT
from tidefield.data.batches import draw_batch
from tidefield.data.depth_prior import DepthPriors
from tidefield.data.load import at_twice_the_size, load_scene
from tidefield.data.neighbours import choose_neighbours
from tidefield.data.pictures import fill_masked
from tidefield.data.pyramid import PER_OCTAVE, Pyramid
from tidefield.data.scene import Scene
from tidefield.data.surface import doubly_seen
from tidefield.errors import SceneError


def left_half(width: int = 64, height: int = 48) -> np.ndarray:
    """Black (not to be used) in the left half, as in the files."""
    mask = np.full((height, width), 255, dtype=np.uint8)
    mask[:, : width // 2] = 0
    return mask


def write_masks(root: Path, truth: Truth, which: range = range(9)) -> None:
    for i in which:
        file = root / "masks" / f"{truth.names[i]}.png"
        file.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(left_half(truth.lenses[i].width, truth.lenses[i].height)).save(file)


def with_noise_under_the_masks(truth: Truth) -> Truth:
    random = np.random.default_rng(3)
    pictures = [p.copy() for p in truth.pictures]
    for picture in pictures:
        half = picture[:, : picture.shape[1] // 2]
        half[:] = random.integers(0, 256, half.shape)
    return replace(truth, pictures=tuple(pictures))


def load(root: Path, **options: object) -> Scene:
    return load_scene(root, cache=root.parent / "cache", **options)


@pytest.mark.parametrize("width", [None, 32])
def test_no_colour_of_a_scene_depends_on_what_is_masked(tmp_path: Path, width: int | None) -> None:
    truth, scenes = survey(BARREL), []
    for name, own in (("a", truth), ("b", with_noise_under_the_masks(truth))):
        write_colmap(tmp_path / name, own)
        write_masks(tmp_path / name, own)
        scenes.append(load(tmp_path / name, width=width))
    for i in range(9):
        assert torch.equal(scenes[0].photographs[i], scenes[1].photographs[i])
    assert torch.equal(scenes[0].cameras.gain, scenes[1].cameras.gain)
    assert "masks" in repr(scenes[0])


def test_a_mask_is_undistorted_and_resized_as_its_photograph(tmp_path: Path) -> None:
    truth = survey(BARREL)
    black = np.where(left_half()[..., None] > 0, np.uint8(200), np.zeros(3, np.uint8))
    truth = replace(truth, pictures=(black,) * 9)
    write_colmap(tmp_path / "plain", truth)
    write_colmap(tmp_path / "masked", truth)
    write_masks(tmp_path / "masked", truth, range(4))
    plain, masked = load(tmp_path / "plain", width=32), load(tmp_path / "masked", width=32)
    assert plain.photographs.masks == ()
    index = masked.names.index(truth.names[0])
    used, dark = masked.photographs.used(index), plain.photographs[index][..., 0] < 190
    assert not (used & dark).any()
    assert (~used & ~dark).float().mean() < 0.05  # one column at most that the filters reach from
    assert masked.photographs.used(masked.names.index(truth.names[8])).all()
    assert masked.photographs.masks[masked.names.index(truth.names[8])] is None


def test_a_mask_that_changes_is_read_again(tmp_path: Path) -> None:
    write_colmap(tmp_path / "a", truth := survey(PINHOLE))
    write_masks(tmp_path / "a", truth)
    assert not load(tmp_path / "a").photographs.used(0)[0, 0]
    Image.new("L", (64, 48), 255).save(tmp_path / "a" / "masks" / f"{sorted(truth.names)[0]}.png")
    assert load(tmp_path / "a").photographs.used(0).all()


def test_masked_pixels_get_the_colour_of_the_nearest_used_one() -> None:
    random = np.random.default_rng(0)
    pixels, mask = random.integers(0, 256, (12, 15, 3), dtype=np.uint8), random.random((12, 15)) < 0.2
    filled, used = fill_masked(pixels, mask), np.argwhere(mask)
    for row, column in np.ndindex(mask.shape):
        apart = np.hypot(*(used - (row, column)).T)
        nearest = used[apart <= apart.min() + 0.3]  # OpenCV's distances are approximate
        assert any((pixels[r, c] == filled[row, column]).all() for r, c in nearest)
    assert (filled[mask] == pixels[mask]).all()
    assert (fill_masked(pixels, np.zeros_like(mask)) == pixels).all()


def test_masks_of_transforms_json_are_read_by_their_paths(tmp_path: Path) -> None:
    truth = survey(PINHOLE)
    file = write_transforms(tmp_path / "a", truth)
    write_masks(tmp_path / "a", truth)
    assert load(tmp_path / "a").photographs.masks == ()  # as in nerfstudio, only where the file names them
    description = json.loads(file.read_text())
    for frame, name in zip(description["frames"], truth.names, strict=True):
        frame["mask_path"] = f"masks/{name}.png"
    file.write_text(json.dumps(description))
    scene = load(tmp_path / "a")
    assert all(torch.equal(scene.photographs.used(i), torch.from_numpy(left_half() > 0)) for i in range(9))
    (tmp_path / "a" / "masks" / f"{truth.names[2]}.png").unlink()
    with pytest.raises(SceneError, match=r"names the mask masks/strip_0/photo_6.png\.png, which is missing: add it"):
        load(tmp_path / "a")
    scene = load(tmp_path / "a", allow_missing=True)
    assert scene.photographs.masks[scene.index(truth.names[2])] is None


def test_a_mask_of_another_size_is_refused(tmp_path: Path) -> None:
    write_colmap(tmp_path / "a", truth := survey(PINHOLE))
    (tmp_path / "a" / "masks" / "strip_0").mkdir(parents=True)
    Image.fromarray(left_half(32, 24)).save(tmp_path / "a" / "masks" / f"{truth.names[0]}.png")
    with pytest.raises(SceneError, match=r"has 32 x 24 pixels, but its photograph .* has 64 x 48: expected a mask of"):
        load(tmp_path / "a")


def test_points_lose_the_observations_in_masked_pixels(tmp_path: Path) -> None:
    write_colmap(tmp_path / "plain", truth := survey(PINHOLE))
    write_colmap(tmp_path / "masked", truth)
    write_masks(tmp_path / "masked", truth)
    plain, masked = load(tmp_path / "plain").points, load(tmp_path / "masked").points
    assert plain is not None
    assert masked is not None
    kept = plain.uv_px[:, 0] >= 32
    assert torch.equal(masked.uv_px, plain.uv_px[kept])
    assert torch.equal(masked.xyz_world[masked.point_index], plain.xyz_world[plain.point_index[kept]])
    assert len(masked.xyz_world) == len(masked.point_index.unique())


def masked_wall(count: int = 7, masked: tuple[int, ...] = (2,)) -> Scene:
    return wall.with_left_halves_masked(wall.scene(wall.cameras(count), (1,)), masked)


@pytest.mark.parametrize("config", [SWIFT.train, PAPER.train])
def test_masked_pixels_of_targets_weigh_nothing(config) -> None:
    config = replace(config, tile_px=8, tiles=12, crop_px=config.crop_px and 20, unseen_weight=1.0)
    own = masked_wall(masked=tuple(range(7)))
    batch = draw_batch(own, DepthPriors(own), config, 3, torch.Generator().manual_seed(0))
    column = batch.corner_px[:, :1] + torch.arange(8).repeat(8)
    assert torch.equal(batch.weight, (column >= 24).float())
    assert len(batch.image_used) == len(batch.images)
    for used, corner in zip(batch.image_used[0], batch.image_corner_px[0], strict=True):
        left = corner[0] + torch.arange(used.shape[-1])
        assert torch.equal(used[0], (left >= 24).float().expand(used.shape[1:]))


def test_surface_seen_through_masks_only_is_not_doubly_seen() -> None:
    plain, own = wall.scene(wall.cameras(3), (1,)), masked_wall(3, masked=(0,))
    both, fewer = doubly_seen(plain, plain.cameras[1]), doubly_seen(own, own.cameras[1])
    assert not (fewer & ~both).any()
    # The mask's edge is seen from the camera to the right of it, 0.3 m away at a focal length of 48 px and 5 m.
    assert torch.equal(fewer, both & (torch.arange(48) + 0.5 >= 24 - 48 * 0.3 / 5))


def test_photographs_that_are_masked_there_are_no_neighbours() -> None:
    own = masked_wall(7, masked=(2, 4))
    prior, corner = DepthPriors(own)[3].cells, torch.tensor([2.0, 10.0])
    found = choose_neighbours(own.cameras[3], prior, corner, (1, 1), 8, own, 2, "view")
    weighty = found.index[found.blend_weight.amax(-1) > 1e-3]
    assert not torch.isin(weighty, torch.tensor([2, 4])).any()


def test_what_is_open_at_twice_the_size_is_not_decoded_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    truth = survey(BARREL)
    write_colmap(tmp_path / "a", truth)
    write_masks(tmp_path / "a", truth, range(4))
    scene = load(tmp_path / "a", width=32)
    decoded = [Pyramid(scene).read(photograph, PER_OCTAVE) for photograph in range(9)]
    pyramid = Pyramid(scene, at_twice_the_size(scene, cache=tmp_path / "cache"))

    def refuse(*_: object) -> None:
        raise AssertionError("decoded again")

    monkeypatch.setattr("tidefield.data.pyramid.read_at_size", refuse)
    for photograph, (expected, where) in enumerate(decoded):
        colours, mask = pyramid.read(photograph, PER_OCTAVE)
        assert torch.equal(colours, expected)
        assert (mask is None) == (where is None)
        assert mask is None or torch.equal(mask, where)
    assert sum(mask is not None for _, mask in decoded) == 4
    with pytest.raises(AssertionError, match="decoded again"):
        pyramid.read(4, PER_OCTAVE - 1)
