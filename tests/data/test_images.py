import errno
import os
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from tidefield.data import cache as user_cache
from tidefield.data import images
from tidefield.data.cache import cache_folder, kept_arrays
from tidefield.data.images import PhotographFile, open_photographs
from tidefield.data.pictures import read_header
from tidefield.errors import SceneError
from tidefield.geometry.lenses import Lens

WHITE = (1.0, 1.0, 1.0)


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "tidefield"


def save(path: Path, width: int, height: int, channels: int = 3, seed: int = 0, **options: object) -> PhotographFile:
    pixels = np.random.default_rng(seed).integers(0, 256, (height, width, channels), dtype=np.uint8)
    Image.fromarray(pixels).save(path, **options)
    lens = Lens(width, height, 50.0, 50.0, width / 2, height / 2)
    return PhotographFile(path, lens, width, height, has_alpha=channels == 4)


@pytest.fixture
def files(tmp_path: Path) -> tuple[PhotographFile, ...]:
    return tuple(save(tmp_path / f"{i}.png", 30 + i, 20 + 2 * i, seed=i) for i in range(5))


def refuse_to_decode(*_: object) -> np.ndarray:
    raise AssertionError("decoded again")


def test_photographs_of_different_sizes_are_read_unchanged(cache: Path, files: tuple[PhotographFile, ...]) -> None:
    photographs = open_photographs(files, WHITE)
    assert len(photographs) == 5
    for i, file in enumerate(files):
        assert (photographs[i].numpy() == np.asarray(Image.open(file.path))).all()
        assert photographs.alpha(i) is None
    once, twice = photographs[1], photographs[1]
    assert once.data_ptr() == twice.data_ptr()  # views, not copies
    assert len(list(cache.iterdir())) == 1


def test_a_scene_opened_again_is_not_decoded_again(
    cache: Path, files: tuple[PhotographFile, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[tuple[int, int]] = []
    first = open_photographs(files, WHITE, lambda done, count: calls.append((done, count)))
    assert calls == [(i, 5) for i in range(1, 6)]
    monkeypatch.setattr(images, "_decode", refuse_to_decode)
    again = open_photographs(files, WHITE, lambda done, count: calls.append((done, count)))
    assert len(calls) == 5
    assert all(torch.equal(first[i], again[i]) for i in range(5))


def test_the_cache_key_covers_everything_that_determines_the_pixels(
    cache: Path, files: tuple[PhotographFile, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    open_photographs(files, WHITE)
    smaller = tuple(replace(file, width=15, height=10) for file in files)
    other_lens = tuple(replace(file, lens=replace(file.lens, k1=0.1)) for file in files)
    for count, changed in enumerate([smaller, other_lens, files[::-1], files[:3]], start=2):
        open_photographs(changed, WHITE)
        assert len(list(cache.iterdir())) == count
    open_photographs(files, (0.0, 0.0, 0.0))
    assert len(list(cache.iterdir())) == 6
    os.utime(files[0].path, ns=(1, 1))
    monkeypatch.setattr(images, "_decode", refuse_to_decode)
    with pytest.raises(AssertionError, match="decoded again"):
        open_photographs(files, WHITE)


def test_writing_into_a_view_does_not_reach_the_store(cache: Path, files: tuple[PhotographFile, ...]) -> None:
    photographs = open_photographs(files, WHITE)
    before = photographs[0].clone()
    photographs[0].zero_()
    assert torch.equal(open_photographs(files, WHITE)[0], before)


def test_a_store_that_was_cut_short_is_made_again(cache: Path, files: tuple[PhotographFile, ...]) -> None:
    before = open_photographs(files, WHITE)[4].clone()
    (store,) = cache.iterdir()
    os.truncate(store, store.stat().st_size - 1)
    assert torch.equal(open_photographs(files, WHITE)[4], before)


def test_transparent_photographs_are_composited_on_the_background(cache: Path, tmp_path: Path) -> None:
    pixels = np.zeros((2, 3, 4), np.uint8)
    pixels[0] = (200, 100, 0, 255)
    pixels[1] = (200, 100, 0, 51)  # a fifth
    Image.fromarray(pixels).save(tmp_path / "a.png")
    lens = Lens(3, 2, 5.0, 5.0, 1.5, 1.0)
    photographs = open_photographs([PhotographFile(tmp_path / "a.png", lens, 3, 2, has_alpha=True)], WHITE)
    assert photographs[0][0, 0].tolist() == [200, 100, 0]
    assert photographs[0][1, 0].tolist() == [244, 224, 204]
    alpha = photographs.alpha(0)
    assert alpha is not None
    assert alpha[:, 0].tolist() == [255, 51]


def test_exif_orientation_is_not_applied(cache: Path, tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6
    file = save(tmp_path / "turned.jpg", 30, 20, exif=exif)
    assert read_header(file.path) == (30, 20, False)
    assert open_photographs([file], WHITE)[0].shape == (20, 30, 3)


def test_grey_photographs_become_three_equal_channels(cache: Path, tmp_path: Path) -> None:
    Image.fromarray(np.arange(600, dtype=np.uint8).reshape(20, 30)).save(tmp_path / "grey.png")
    lens = Lens(30, 20, 50.0, 50.0, 15.0, 10.0)
    picture = open_photographs([PhotographFile(tmp_path / "grey.png", lens, 30, 20, has_alpha=False)], WHITE)[0]
    assert (picture == picture[..., :1]).all()


def test_a_truncated_jpeg_is_named_and_not_cached(cache: Path, tmp_path: Path) -> None:
    whole = [save(tmp_path / f"{i}.jpg", 200, 150, seed=i) for i in range(3)]
    content = whole[1].path.read_bytes()
    whole[1].path.write_bytes(content[: len(content) // 2])
    with pytest.raises(SceneError, match=r"1\.jpg cannot be read as a photograph \(.*truncated"):
        open_photographs(whole, WHITE)
    assert list(cache.iterdir()) == []


@pytest.mark.parametrize("content", [b"", b"no picture", b"\x89PNG\r\n\x1a\n" + bytes(40)])
def test_files_that_are_no_pictures_are_named(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "no.png").write_bytes(content)
    with pytest.raises(SceneError, match=r"no\.png cannot be read"):
        read_header(tmp_path / "no.png")


def test_sixteen_bits_per_colour_are_refused(tmp_path: Path) -> None:
    Image.fromarray(np.zeros((4, 5), np.uint16)).save(tmp_path / "deep.png")
    with pytest.raises(SceneError, match=r"deep\.png has pixels of the mode I;16.*8 bits"):
        read_header(tmp_path / "deep.png")


def test_a_full_disk_is_one_error_and_leaves_no_files(
    cache: Path, files: tuple[PhotographFile, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(SceneError, match=r"disk of .* is full: 0 MB .*XDG_CACHE_HOME"):
        open_photographs(files, WHITE)
    assert list(cache.iterdir()) == []


def test_without_a_writable_cache_photographs_are_held_in_memory(
    cache: Path, files: tuple[PhotographFile, ...], caplog: pytest.LogCaptureFixture
) -> None:
    kept = open_photographs(files, WHITE)
    cache.rename(cache.with_name("elsewhere"))
    cache.write_text("a file where the folder should be")
    held = open_photographs(files, WHITE)
    assert "cannot be used" in caplog.text
    assert all(torch.equal(held[i], kept[i]) for i in range(5))


@pytest.mark.skipif(os.name != "posix", reason="other systems have no such permissions")
def test_pixels_of_a_cache_that_others_can_write_to_are_not_used(
    cache: Path, files: tuple[PhotographFile, ...], caplog: pytest.LogCaptureFixture
) -> None:
    kept = [picture.clone() for picture in open_photographs(files, WHITE).colours]
    assert cache.stat().st_mode & 0o077 == 0
    (store,) = cache.iterdir()
    store.write_bytes(bytes(store.stat().st_size))
    cache.chmod(0o777)
    assert all(torch.equal(held, own) for held, own in zip(open_photographs(files, WHITE).colours, kept, strict=True))
    assert "others own it or can write to it" in caplog.text


def test_unused_stores_are_deleted(cache: Path, files: tuple[PhotographFile, ...]) -> None:
    open_photographs(files, WHITE)
    open_photographs(files[:2], WHITE)
    old, young = sorted(cache.iterdir(), key=lambda store: -store.stat().st_size)
    used(old, 100)
    open_photographs(files[:3], WHITE)
    assert young.exists()
    assert not old.exists()


def used(store: Path, days_ago: float) -> None:
    then = time.time() - days_ago * 86400
    os.utime(store, (then, then))


def test_what_was_used_first_is_deleted_when_the_cache_is_full(
    cache: Path, files: tuple[PhotographFile, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TIDEFIELD_CACHE_GB", str(sum(file.bytes for file in files[:3]) / 1e9))
    stores = []
    for days, file in zip((3, 2, 1), files, strict=False):
        photograph = open_photographs([file], WHITE)[0].clone()
        (store,) = set(cache.iterdir()) - set(stores)
        used(store, days)
        stores.append(store)
    mapped = open_photographs([files[1]], WHITE)[0]
    used(stores[1], 2)
    open_photographs([files[0]], WHITE)  # is now the last one used
    open_photographs([files[3]], WHITE)
    assert [store.exists() for store in stores] == [True, False, False]  # the fourth is larger than the third
    assert torch.equal(mapped, torch.from_numpy(np.asarray(Image.open(files[1].path)).copy()))
    photographs = open_photographs(files, WHITE)  # larger than the limit: kept alone
    assert len(list(cache.iterdir())) == 1
    assert torch.equal(photographs[2], photograph)


def test_a_file_that_is_being_written_is_not_deleted(
    cache: Path, files: tuple[PhotographFile, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TIDEFIELD_CACHE_GB", "0")
    cache.mkdir(mode=0o700, parents=True)
    written, killed = (cache / f".{name}-01234567.partial.photographs" for name in ("written", "killed"))
    for partial, days in ((written, 0), (killed, 1)):
        partial.write_bytes(b"half")
        used(partial, days)
    open_photographs(files, WHITE)
    assert written.exists()
    assert not killed.exists()
    assert len(list(cache.iterdir())) == 2


@pytest.mark.parametrize("limit", ["much", "-1", "nan"])
def test_a_limit_of_the_cache_that_is_no_number_is_refused(
    limit: str, cache: Path, files: tuple[PhotographFile, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TIDEFIELD_CACHE_GB", limit)
    with pytest.raises(SceneError, match="TIDEFIELD_CACHE_GB is"):
        open_photographs(files, WHITE)


def test_without_a_chosen_cache_folder_the_systems_own_is_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("LOCALAPPDATA", str(tmp_path))
    for value in ("", None):
        if value is None:
            monkeypatch.delenv("XDG_CACHE_HOME")
        else:
            monkeypatch.setenv("XDG_CACHE_HOME", value)
        folder = cache_folder()
        assert folder.is_relative_to(tmp_path)
        assert "tidefield" in folder.parts


def test_without_a_home_folder_photographs_are_held_in_memory(
    files: tuple[PhotographFile, ...], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    def has_no_home(*_: object, **__: object) -> Path:
        raise RuntimeError("could not determine the home directory")

    monkeypatch.setenv("XDG_CACHE_HOME", "")
    monkeypatch.chdir(tmp_path)
    before = sorted(tmp_path.iterdir())
    for folder in (has_no_home, lambda *_, **__: Path("~/.cache/tidefield")):  # of platformdirs from 4.5, and before
        monkeypatch.setattr(user_cache, "user_cache_path", folder)
        assert len(open_photographs(files, (1.0, 1.0, 1.0))) == len(files)
    assert ["no home folder" in record.message for record in caplog.records] == [True, True]
    assert sorted(tmp_path.iterdir()) == before


def test_a_cache_that_can_only_be_read_is_read(
    cache: Path, files: tuple[PhotographFile, ...], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise OSError(errno.EROFS, "Read-only file system")

    first = open_photographs(files, WHITE)
    kept = kept_arrays("one.points", cache, lambda: {"xyz": np.arange(3)})
    monkeypatch.setattr(os, "utime", refuse)
    monkeypatch.setattr(images, "_decode", refuse_to_decode)
    assert all(torch.equal(first[i], colours) for i, colours in enumerate(open_photographs(files, WHITE).colours))
    assert (kept_arrays("one.points", cache, dict)["xyz"] == kept["xyz"]).all()
    assert not caplog.records


def test_a_file_of_the_cache_that_vanishes_is_made_again(
    cache: Path, files: tuple[PhotographFile, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Path, "is_file", lambda path: True)  # another program deletes it afterwards
    assert len(open_photographs(files, WHITE)) == 5
    assert kept_arrays("one.points", cache, lambda: {"xyz": np.arange(3)})["xyz"].tolist() == [0, 1, 2]
    assert len(list(cache.iterdir())) == 2
