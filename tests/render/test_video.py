"""Videos and stills: decoded frames are those that were written, and no partial file has the final name."""

import itertools
import json
import os
import tracemalloc
from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pytest
import textured_wall as wall
import torch
from PIL import Image

from tidefield import __version__
from tidefield.errors import RunError
from tidefield.model.rendering import Rendering
from tidefield.render.stills import colour_picture, depth_picture, depth_range, describe_view, title, write_still
from tidefield.render.video import write_video

COLOURS = [(200, 30, 40), (30, 180, 60), (40, 60, 210), (128, 128, 128), (250, 240, 230)]


def flat(colour: tuple[int, int, int], height: int = 48, width: int = 64) -> np.ndarray:
    return np.broadcast_to(np.array(colour, dtype=np.uint8), (height, width, 3)).copy()


def rendering(height: int = 24, width: int = 32) -> Rendering:
    generator = torch.Generator().manual_seed(0)
    depth = torch.linspace(2.0, 8.0, width).expand(height, width).clone()
    opacity = torch.ones(height, width)
    opacity[:, -4:] = 0.1
    return Rendering(torch.rand(height, width, 3, generator=generator), depth, opacity)


def decode(path: Path) -> list[np.ndarray]:
    with av.open(str(path)) as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


def test_a_decoded_video_has_its_frames_size_speed_and_colours(tmp_path: Path):
    path = tmp_path / "new" / "clip.mp4"
    done: list[int] = []
    count = write_video((flat(c) for c in COLOURS), path, 25.0, progress=done.append)
    assert count == len(COLOURS)
    assert done == [1, 2, 3, 4, 5]
    frames = decode(path)
    assert len(frames) == len(COLOURS)
    for frame, colour in zip(frames, COLOURS, strict=True):
        assert frame.shape == (48, 64, 3)
        assert np.abs(frame.astype(int) - colour).max() <= 4
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        context = stream.codec_context
        assert (context.name, context.pix_fmt) == ("h264", "yuv420p")
        assert (context.colorspace, context.color_primaries, context.color_range) == (1, 1, 1)
        assert stream.average_rate == 25
        assert float(stream.duration * stream.time_base) == pytest.approx(0.2)


@pytest.mark.skipif(os.name == "nt", reason="a name on Windows has no colon")
def test_a_name_with_a_colon_is_no_protocol(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    write_video([flat(COLOURS[0])], Path("2024-06-01T10:30.mp4"), 25.0)
    assert len(decode(tmp_path / "2024-06-01T10:30.mp4")) == 1


def test_the_index_comes_before_the_frames_so_that_browsers_can_start(tmp_path: Path):
    write_video((flat(c) for c in COLOURS), tmp_path / "clip.mp4", 24.0)
    content = (tmp_path / "clip.mp4").read_bytes()
    assert 0 < content.index(b"moov") < content.index(b"mdat")


def test_renderings_are_frames_and_odd_sizes_are_made_even(tmp_path: Path):
    view = Rendering(torch.full((33, 47, 3), 0.5), torch.ones(33, 47), torch.ones(33, 47))
    write_video([view, view], tmp_path / "odd.mp4", 29.97)
    frames = decode(tmp_path / "odd.mp4")
    assert [frame.shape for frame in frames] == [(34, 48, 3)] * 2
    assert np.abs(frames[0].astype(int) - 128).max() <= 4


def test_an_existing_video_is_only_overwritten_on_request(tmp_path: Path):
    path = tmp_path / "clip.mp4"
    path.write_bytes(b"precious")

    def untouched():
        yield pytest.fail("no frame should be rendered for a name that is taken")

    with pytest.raises(RunError, match=r"clip\.mp4 is there already.*--overwrite"):
        write_video(untouched(), path, 24.0)
    assert path.read_bytes() == b"precious"
    write_video([flat(COLOURS[0])], path, 24.0, overwrite=True)
    assert len(decode(path)) == 1


@pytest.mark.parametrize("interruption", [KeyboardInterrupt, ValueError])
def test_an_interruption_leaves_no_partial_file_and_keeps_the_old_one(tmp_path: Path, interruption: type):
    path = tmp_path / "clip.mp4"
    path.write_bytes(b"precious")

    def frames():
        yield flat(COLOURS[0])
        yield flat(COLOURS[1])
        raise interruption

    with pytest.raises(interruption):
        write_video(frames(), path, 24.0, overwrite=True)
    assert os.listdir(tmp_path) == ["clip.mp4"]
    assert path.read_bytes() == b"precious"


def test_no_frames_and_other_formats_are_refused(tmp_path: Path):
    with pytest.raises(RunError, match="no frames"):
        write_video([], tmp_path / "clip.mp4", 24.0)
    with pytest.raises(RunError, match=r"clip\.avi: expected a name that ends in \.mp4"):
        write_video([flat(COLOURS[0])], tmp_path / "clip.avi", 24.0)
    assert os.listdir(tmp_path) == []


def test_an_impossible_folder_is_one_clear_error(tmp_path: Path):
    (tmp_path / "file").write_text("not a folder")
    with pytest.raises(RunError, match="cannot be written"):
        write_video([flat(COLOURS[0])], tmp_path / "file" / "clip.mp4", 24.0)


def test_memory_does_not_grow_with_the_number_of_frames(tmp_path: Path):
    picture = flat(COLOURS[0], 90, 160)
    peaks = []
    for count in (20, 200):
        tracemalloc.start()
        write_video((picture + 0 for _ in itertools.repeat(None, count)), tmp_path / f"{count}.mp4", 24.0)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < peaks[0] + 2 * picture.nbytes


def test_a_still_comes_with_its_depth_in_world_units(tmp_path: Path):
    view = rendering()
    colour, depths, look = write_still(view, tmp_path / "DJI_0001.png")
    assert [p.name for p in (colour, depths, look)] == ["DJI_0001.png", "DJI_0001_depth.npy", "DJI_0001_depth.png"]
    assert np.array_equal(np.asarray(Image.open(colour)), colour_picture(view))
    depth = np.load(depths)
    assert depth.dtype == np.float32
    assert np.isnan(depth[:, -4:]).all()
    assert np.array_equal(depth[:, :-4], view.depth.numpy()[:, :-4])
    with Image.open(look) as picture:
        assert 2.0 <= float(picture.text["near"]) < 2.2
        assert 7.0 < float(picture.text["far"]) <= 8.0
        assert picture.size == (32, 24)
    assert sorted(os.listdir(tmp_path)) == ["DJI_0001.png", "DJI_0001_depth.npy", "DJI_0001_depth.png"]


def test_a_still_tells_what_made_it_of_which_scene_and_from_where(tmp_path: Path):
    scene = wall.scene(wall.cameras(3))
    scene = replace(scene, root=tmp_path / "Königshafen", origin_world=torch.tensor([4e5, 6e6, 0.1]).double())
    bent = replace(scene.cameras, residual=torch.full((3, 6, 2), 0.25))
    camera = bent["02"].resized(24, 18)
    write_still(rendering(), tmp_path / "view.png", about=describe_view(scene, camera))
    for name in ("view.png", "view_depth.png"):
        with Image.open(tmp_path / name) as picture:
            text = picture.text
        assert text["Software"] == f"tidefield {__version__}"
        assert text["Title"] == "Königshafen, 02.jpg"
        own = json.loads(text["Camera"])
        assert [own[key] for key in ("scene", "photograph", "width", "height")] == ["Königshafen", "02.jpg", 24, 18]
        assert (own["focal_px"], own["principal_px"]) == ([24, 24], [12, 9])
        assert own["residual"] == [[0.25, 0.25]] * 6
        expected = np.hstack([np.eye(3), [[4e5 + 0.3], [6e6], [0.1]]])
        np.testing.assert_allclose(own["T_world_camera"], expected, rtol=0, atol=1e-6)
        assert "OpenCV" in own["convention"]
        assert str(tmp_path) not in str(text)
    assert title(replace(scene, root=Path("caf\udce9")), None) == "caf?"  # a name that is no UTF-8


def test_a_video_tells_its_title_and_what_made_it(tmp_path: Path):
    scene = replace(wall.scene(wall.cameras(3)), root=tmp_path / "Königshafen")
    write_video([rendering()], tmp_path / "a.mp4", 24.0, title=title(scene, "orbit"))
    with av.open(str(tmp_path / "a.mp4")) as container:
        metadata = container.metadata
    assert (metadata["title"], metadata["comment"]) == ("Königshafen, orbit", f"tidefield {__version__}")


def test_depth_goes_from_red_to_blue_and_empty_pixels_are_black():
    picture = depth_picture(rendering(), *depth_range(rendering())).astype(int)
    assert picture[0, 0, 0] > picture[0, 0, 2]
    assert picture[0, -6, 2] > picture[0, -6, 0]
    assert (picture[:, -4:] == 0).all()
    empty = Rendering(torch.zeros(2, 2, 3), torch.zeros(2, 2), torch.zeros(2, 2))
    assert (depth_picture(empty, *depth_range(empty)) == 0).all()


def test_existing_stills_are_only_overwritten_on_request(tmp_path: Path):
    (tmp_path / "view_depth.npy").write_bytes(b"precious")
    with pytest.raises(RunError, match=r"view_depth\.npy is there already"):
        write_still(rendering(), tmp_path / "view.png")
    assert os.listdir(tmp_path) == ["view_depth.npy"]
    write_still(rendering(), tmp_path / "view.png", overwrite=True)
    assert len(os.listdir(tmp_path)) == 3
    with pytest.raises(RunError, match=r"view\.jpg: expected a name that ends in \.png"):
        write_still(rendering(), tmp_path / "view.jpg")


def test_colours_are_rounded_to_8_bits_and_must_be_finite():
    colour = torch.tensor([[[0.0, 1.0, 0.5], [1.7, -0.3, 0.4999 / 255]]])
    view = Rendering(colour, torch.ones(1, 2), torch.ones(1, 2))
    assert colour_picture(view).tolist() == [[[0, 255, 128], [255, 0, 0]]]
    with pytest.raises(AssertionError, match="not finite"):
        colour_picture(replace(view, colour=colour * torch.nan))
