"""Masked pixels of photographs: read from where others keep masks, and used by nothing."""

import json
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pycolmap
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


def renamed(root: Path, truth: Truth, suffix: str) -> Truth:
    """A COLMAP model in which every photograph has another suffix."""
    truth = replace(truth, names=tuple(str(Path(name).with_suffix(suffix)) for name in truth.names))
    write_colmap(root, truth)
    return truth


def with_noise_under_the_masks(truth: Truth) -> Truth:
    random = np.random.default_rng(3)
    pictures = [p.copy() for p in truth.pictures]
    for picture in pictures:
        half = picture[:, : picture.shape[1] // 2]
        half[:] = random.integers(0, 256, half.shape)
    return replace(truth, pictures=tuple(pictures))


def disturb_left_halves(model: Path) -> None:
    """Move all observations in the left halves of the photographs to another place there."""
    random, read = np.random.default_rng(4), pycolmap.Reconstruction(str(model))
    for image in read.images.values():
        for point in image.points2D:
            if point.xy[0] < 27:
                point.xy = point.xy + random.uniform(-4, 4, 2)
    read.write_binary(str(model))


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


def test_a_mask_may_have_the_stem_of_its_photograph(tmp_path: Path) -> None:
    truth = renamed(tmp_path / "a", survey(PINHOLE), ".jpg")
    write_masks(tmp_path / "a", replace(truth, names=tuple(name.removesuffix(".jpg") for name in truth.names)))
    scene = load(tmp_path / "a")
    assert all(torch.equal(scene.photographs.used(i), torch.from_numpy(left_half() > 0)) for i in range(9))
    Image.new("L", (64, 48), 255).save(tmp_path / "a" / "masks" / f"{scene.names[0]}.png")
    assert load(tmp_path / "a").photographs.used(0).all(), "the whole name is the better one"


def test_a_stem_that_fits_two_photographs_names_no_mask(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    truth = renamed(tmp_path / "a", survey(PINHOLE), ".jpg")
    write_masks(tmp_path / "a", replace(truth, names=tuple(name.removesuffix(".jpg") for name in truth.names)))
    other = Path(truth.names[0]).with_suffix(".png")
    Image.new("RGB", (64, 48)).save(tmp_path / "a" / "images" / other)
    scene = load(tmp_path / "a")
    assert [scene.photographs.masks[scene.index(name)] is None for name in truth.names] == [True] + [False] * 8
    assert f"1 of the 9 pictures in {tmp_path / 'a' / 'masks'} belong to no photograph" in caplog.text
    assert f"{other}; expected names such as strip_0/photo_8.jpg.png" in caplog.text


def test_masks_of_no_photograph_are_refused_and_some_are_counted(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    write_colmap(tmp_path / "a", truth := survey(PINHOLE))
    write_masks(tmp_path / "a", replace(truth, names=tuple(f"{name}_mask" for name in truth.names)))
    with pytest.raises(
        SceneError, match=r"no mask of any photograph \(found: strip_0/photo_6.png_mask.png, .* and 4 more"
    ):
        load(tmp_path / "a")
    write_masks(tmp_path / "a", truth, range(3))
    assert sum(mask is not None for mask in load(tmp_path / "a").photographs.masks) == 3
    assert "9 of the 12 pictures" in caplog.text


def test_masks_of_photographs_without_a_pose_are_not_counted(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    write_colmap(tmp_path / "a", truth := survey(PINHOLE))
    for name in ("left_out.jpg", "strip_9/left_out.png"):
        file = tmp_path / "a" / "images" / name
        file.parent.mkdir(exist_ok=True)
        Image.new("RGB", (64, 48)).save(file)
    for name in ("left_out.jpg.png", "strip_9/left_out.png"):
        file = tmp_path / "a" / "masks" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        Image.new("L", (64, 48)).save(file)
    (tmp_path / "a" / "masks" / "README.txt").touch()
    assert load(tmp_path / "a").photographs.masks == ()
    write_masks(tmp_path / "a", truth)
    (tmp_path / "a" / "images" / truth.names[0]).unlink()
    assert len(load(tmp_path / "a", allow_missing=True).photographs.masks) == 8
    assert "masks" not in caplog.text


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


def test_points_lose_the_observations_in_masked_pixels_and_need_two_others(tmp_path: Path) -> None:
    write_colmap(tmp_path / "plain", truth := survey(PINHOLE))
    write_colmap(tmp_path / "masked", truth)
    write_masks(tmp_path / "masked", truth)
    plain, masked = load(tmp_path / "plain").points, load(tmp_path / "masked").points
    assert plain is not None
    assert masked is not None
    kept = plain.uv_px[:, 0] >= 32
    count = plain.point_index[kept].bincount(minlength=len(plain.xyz_world))
    assert (count == 1).any()
    kept &= (count >= 2)[plain.point_index]
    assert torch.equal(masked.uv_px, plain.uv_px[kept])
    xyz, placed_by_all = masked.xyz_world[masked.point_index], plain.xyz_world[plain.point_index[kept]]
    torch.testing.assert_close(xyz, placed_by_all, rtol=0, atol=2e-5)
    assert len(masked.xyz_world) == len(masked.point_index.unique())


def test_points_are_placed_by_the_observations_that_are_not_masked(tmp_path: Path) -> None:
    """Masked observations are moved by up to 5 px in one of two scenes that are the same otherwise."""
    truth, found = survey(BARREL), []
    for name in ("right", "wrong"):
        model = write_colmap(tmp_path / name, truth)
        write_masks(tmp_path / name, truth)
        if name == "wrong":
            disturb_left_halves(model)
        found.append(load(tmp_path / name).points)
    right, wrong = found
    assert right is not None
    assert wrong is not None
    for field in fields(right):
        assert torch.equal(getattr(right, field.name), getattr(wrong, field.name)), field.name


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
