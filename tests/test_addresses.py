"""Files at addresses, as local copies: nothing is lost here or there."""

from __future__ import annotations

import json
import os
import shutil
import sys
from datetime import UTC, datetime
from pathlib import Path

import pytest
from fsspec.implementations.memory import MemoryFileSystem

from tidefield import addresses, cli
from tidefield.addresses import address_of, copy_of, local_word, pull, push
from tidefield.commands.common import ZeroShot
from tidefield.commands.map_ import Map, _tile_maker, open_job
from tidefield.errors import RunError
from tidefield.files import LOCK_FILE
from tidefield.progress import make_console
from tidefield.synthetic import make_survey, write_survey


@pytest.fixture
def bucket(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder that is reached as a file system of fsspec, at `local://`; copies are in a cache beside it."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    (tmp_path / "bucket").mkdir()
    return tmp_path / "bucket"


def files(folder: Path) -> dict[str, str]:
    return {path.relative_to(folder).as_posix(): path.read_text() for path in folder.rglob("*") if path.is_file()}


def write(folder: Path, **texts: str) -> None:
    for name, text in texts.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)


def touch_later(path: Path) -> None:
    """As if the file were changed some seconds later, on file systems with coarse times, too."""
    status = path.stat()
    os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns + 3_000_000_000))


def copy(bucket: Path, name: str = "scene") -> Path:
    return copy_of(f"local://{bucket}/{name}")


def test_words_with_addresses_become_paths_and_back(bucket: Path):
    word, path = local_word("s3://tides/2026/scene/")
    assert path is not None
    assert word == str(path)
    assert path.parts[-4:] == ("s3", "tides", "2026", "scene")
    assert address_of(path) == "s3://tides/2026/scene"
    assert address_of(path / "images" / "a.jpg") == "s3://tides/2026/scene/images/a.jpg"
    assert local_word("--weights=memory://w/a.safetensors")[0] == f"--weights={copy_of('memory://w/a.safetensors')}"
    assert address_of(copy(bucket)) == f"local://{bucket}/scene"
    assert address_of(bucket) is None


@pytest.mark.parametrize("word", ["ray://10.0.0.1:10001", "RAY://a:1", "a/b", "C:/scene", "D://scene", "--width"])
def test_other_words_stay(bucket: Path, word: str):
    assert local_word(word) == (word, None)


def test_an_unknown_protocol_is_refused_and_no_folder_here(bucket: Path):
    with pytest.raises(RunError, match=r"azure://flats/map has the protocol azure, which is not known: .*abfs"):
        local_word("azure://flats/map")
    assert local_word("S3://flats/map") == local_word("s3://flats/map")


@pytest.mark.parametrize(
    "address", ["s3://tides/../other", "s3://", "s3://a//b", "s3://a/\0", "s3://a/.", r"s3://a\..\b"]
)
def test_addresses_that_leave_their_folder_are_refused(bucket: Path, address: str):
    with pytest.raises(RunError, match="no file can be called"):
        local_word(address)


def test_a_copy_is_made_once_and_follows_its_address(bucket: Path):
    write(bucket, **{"scene/a.txt": "one", "scene/images/b.txt": "two"})
    path = copy(bucket)
    assert pull(path) == 6
    assert files(path) == {"a.txt": "one", "images/b.txt": "two"}
    before = (path / "images" / "b.txt").stat()
    assert before.st_mtime == pytest.approx((bucket / "scene" / "images" / "b.txt").stat().st_mtime, abs=1e-3)
    write(bucket, **{"scene/a.txt": "changed", "scene/c.txt": "new"})
    touch_later(bucket / "scene" / "a.txt")
    assert pull(path) == 10
    assert files(path) == {"a.txt": "changed", "images/b.txt": "two", "c.txt": "new"}
    assert (path / "images" / "b.txt").stat().st_mtime_ns == before.st_mtime_ns, "copied again"
    (bucket / "scene" / "c.txt").unlink()
    (path / "a.txt").unlink()
    assert pull(path) == 7, "what was deleted here is copied again"
    assert files(path) == {"a.txt": "changed", "images/b.txt": "two"}
    assert push(path) == 0


@pytest.mark.parametrize("time", [1e9, 1_000_000_000, datetime.fromtimestamp(1e9, UTC), "2001-09-09T01:46:40+00:00"])
def test_times_of_files_are_understood_in_every_form(time: object):
    assert addresses._seconds({"mtime": time}) == 1e9


def test_times_in_other_forms_are_left_out():
    assert addresses._seconds({"updated": "yesterday"}) is None


def test_results_are_sent_and_deleted_at_their_address(bucket: Path):
    path = copy(bucket, "map")
    assert pull(path) == 0
    write(path, **{"map.json": "{}", "tiles/1.npz": "tile", LOCK_FILE: "", ".map-12345678.partial.json": "half"})
    write(path, **{".tiles-12345678.partial/1.npz": "half"})
    (path / "link").symlink_to(bucket)
    assert push(path) == 2
    assert files(bucket / "map") == {"map.json": "{}", "tiles/1.npz": "tile"}
    assert push(path) == 0
    (path / "tiles" / "1.npz").unlink()
    write(path, **{"map.json": "{1}"})
    assert push(path) == 2
    assert files(bucket / "map") == {"map.json": "{1}"}
    assert pull(path) == 0


def test_a_copy_that_was_cleared_away_deletes_nothing_at_its_address(bucket: Path):
    write(bucket, **{"photos/a.jpg": "one", "photos/b.jpg": "two"})
    path = copy(bucket, "photos")
    pull(path)
    (path / "a.jpg").unlink()
    assert push(path) == 0
    assert files(bucket / "photos") == {"a.jpg": "one", "b.jpg": "two"}
    pull(path)
    assert files(path) == files(bucket / "photos")


def test_a_copy_that_is_open_elsewhere_stays_known(bucket: Path, monkeypatch: pytest.MonkeyPatch):
    write(bucket, **{"run/a.txt": "one", "run/b.txt": "two"})
    path = copy(bucket, "run")
    pull(path)
    unlink = Path.unlink

    def held(own: Path, missing_ok: bool = False) -> None:
        if own.name == "a.txt":
            raise PermissionError(13, "in use")
        unlink(own, missing_ok)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "unlink", held)
        assert addresses.clear() == [len("two")]
    assert addresses.kept() == ([path / "a.txt"], [])


def test_a_single_file_has_an_address_too(bucket: Path):
    path = copy(bucket, "videos/flight.mp4")
    assert pull(path) == 0
    write(path.parent, **{"flight.mp4": "frames"})
    assert push(path) == 1
    assert (bucket / "videos" / "flight.mp4").read_text() == "frames"
    assert pull(path) == 0
    assert push(path.parent) == 0, "known under the folder's address, too"


def test_what_was_changed_on_both_sides_is_left_alone(bucket: Path):
    write(bucket, **{"run/a.txt": "one"})
    path = copy(bucket, "run")
    pull(path)
    write(path, **{"a.txt": "here"})
    touch_later(path / "a.txt")
    assert pull(path) == 0, "changed here only"
    write(bucket, **{"run/a.txt": "there!"})
    touch_later(bucket / "run" / "a.txt")
    for move in (pull, push):
        with pytest.raises(RunError, match=r"run/a\.txt has changed since it was copied, and so has its copy"):
            move(path)
    assert (path / "a.txt").read_text() == "here"
    assert (bucket / "run" / "a.txt").read_text() == "there!"


def test_a_result_does_not_replace_one_that_came_meanwhile(bucket: Path):
    path = copy(bucket, "run")
    pull(path)
    write(path, **{"a.txt": "here"})
    write(bucket, **{"run/a.txt": "there"})
    with pytest.raises(RunError, match="so has its copy"):
        push(path)
    assert (bucket / "run" / "a.txt").read_text() == "there"


def test_equal_files_of_an_interrupted_copy_are_no_conflict(bucket: Path):
    write(bucket, **{"scene/a.txt": "one"})
    path = copy(bucket)
    write(path, **{"a.txt": "one"})
    pull(path)
    assert push(path) == 0
    write(bucket, **{"scene/a.txt": "two"})
    touch_later(bucket / "scene" / "a.txt")
    pull(path)
    assert files(path) == {"a.txt": "two"}


def test_a_deleted_file_that_was_changed_here_stays(bucket: Path):
    write(bucket, **{"run/a.txt": "one", "run/b.txt": "two"})
    path = copy(bucket, "run")
    pull(path)
    write(path, **{"a.txt": "changed"})
    touch_later(path / "a.txt")
    for name in ("a.txt", "b.txt"):
        (bucket / "run" / name).unlink()
    pull(path)
    assert files(path) == {"a.txt": "changed"}


def test_emptying_the_cache_keeps_what_was_not_sent_and_deletes_nothing_there(bucket: Path):
    write(bucket, **{"run/a.txt": "one", "run/b.txt": "two"})
    path = copy(bucket, "run")
    pull(path)
    write(path, **{"a.txt": "changed"})
    touch_later(path / "a.txt")
    assert addresses.kept() == ([path / "b.txt"], [path / "a.txt"])
    addresses.clear()
    assert files(path) == {"a.txt": "changed"}
    assert push(path) == 1
    assert files(bucket / "run") == {"a.txt": "changed", "b.txt": "two"}


def test_names_from_outside_cannot_leave_the_copy(bucket: Path, monkeypatch: pytest.MonkeyPatch):
    info = {"type": "file", "size": 1, "mtime": 1.0}
    monkeypatch.setattr(
        MemoryFileSystem, "find", lambda self, root, detail: {f"{root}/../../x": {"name": f"{root}/../../x", **info}}
    )
    with pytest.raises(RunError, match="no file can be called"):
        pull(copy_of("memory://scene"))


def test_a_file_system_without_versions_is_refused(bucket: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(MemoryFileSystem, "find", lambda self, root, detail: {f"{root}/x": {"type": "file", "size": 1}})
    with pytest.raises(RunError, match="does not tell when files change"):
        pull(copy_of("memory://scene"))


def test_a_single_file_that_is_listed_without_its_size_is_copied(bucket: Path, monkeypatch: pytest.MonkeyPatch):
    memory = MemoryFileSystem()
    memory.pipe("/alone.tif", b"heights")
    monkeypatch.setattr(MemoryFileSystem, "find", lambda self, root, detail: {root: {}})
    path = copy_of("memory://alone.tif")
    pull(path)
    assert path.read_bytes() == b"heights"


def test_more_than_the_disk_has_room_for_is_not_copied(bucket: Path, monkeypatch: pytest.MonkeyPatch):
    write(bucket, **{"scene/a.txt": "one"})
    monkeypatch.setattr(addresses.shutil, "disk_usage", lambda path: type("Usage", (), {"free": 2}))
    with pytest.raises(RunError, match="expected room for them"):
        pull(copy(bucket))
    assert not copy(bucket).exists()


def test_errors_of_a_file_system_are_one_clear_error(bucket: Path, monkeypatch: pytest.MonkeyPatch):
    def refuse(*_: object, **__: object) -> None:
        raise PermissionError("Forbidden")

    monkeypatch.setattr(MemoryFileSystem, "find", refuse)
    with pytest.raises(RunError, match=r"memory://scene cannot be reached \(Forbidden\)"):
        pull(copy_of("memory://scene"))


def test_a_missing_package_of_a_file_system_is_named(bucket: Path, monkeypatch: pytest.MonkeyPatch):
    def missing(address: str) -> None:
        raise ImportError("Install s3fs to access S3")

    monkeypatch.setattr("fsspec.core.url_to_fs", missing)
    with pytest.raises(RunError, match="Install s3fs to access S3"):
        pull(copy_of("s3://tides/scene"))


def call(*arguments: object) -> None:
    """Run a command in this process."""
    sys.argv = ["tidefield", *map(str, arguments)]
    cli.main()


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("flat") / "scene"
    write_survey(make_survey("vegetation", seed=1, views=9, width=64, supersample=1), folder)
    return folder


@pytest.mark.thorough
def test_commands_read_and_write_at_addresses(
    bucket: Path, scene: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    shutil.copytree(scene, bucket / "scene")
    at, cpu = f"local://{bucket}", ("--device", "cpu", "-q")
    call("train", f"{at}/scene", f"{at}/run", "--steps", 1, *cpu)
    assert json.loads((bucket / "run" / "run.json").read_text())["scene"] == f"{at}/scene"
    monkeypatch.setenv("XDG_CACHE_HOME", str(bucket.parent / "another machine"))
    still = ("render", f"{at}/run", f"{at}/views/a.png", "--camera", "vegetation_0001.png", *cpu)
    call(*still)
    assert {path.name for path in (bucket / "views").iterdir()} == {"a.png", "a_depth.npy", "a_depth.png"}
    with pytest.raises(SystemExit) as ended:
        call(*still)
    assert ended.value.code == 2
    assert f"tidefield: {at}/views/a.png is there already" in capsys.readouterr().err
    monkeypatch.setenv("XDG_CACHE_HOME", str(bucket.parent / "a third"))
    before = (bucket / "views" / "a_depth.npy").stat().st_mtime_ns
    call(*still, "--overwrite")
    assert (bucket / "views" / "a_depth.npy").stat().st_mtime_ns > before
    assert not (bucket / "views" / LOCK_FILE).exists()


def test_what_failed_is_not_sent_and_what_was_not_sent_is_shown(bucket: Path, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit):
        call("train", f"local://{bucket}/none", f"local://{bucket}/run", "--steps", 1)
    assert f"tidefield: local://{bucket}/none is missing" in capsys.readouterr().err
    assert not list(bucket.iterdir())
    write(bucket, **{"run/a.txt": "one"})
    pull(copy(bucket, "run"))
    write(copy(bucket, "run"), **{"b.txt": "not sent"})
    call("cache", "--clear")
    shown = capsys.readouterr().out
    assert "deleted: 1 file, 0 MB" in shown
    assert "not sent yet: 1 file, 0 MB" in shown


@pytest.mark.thorough
def test_a_worker_with_an_empty_cache_copies_the_scene_and_sends_its_tiles(bucket: Path, scene: Path):
    shutil.copytree(scene, bucket / "scene")
    options = Map(copy(bucket), copy(bucket, "map"), device="cpu", zero=ZeroShot(zero_shot=True))
    pull(options.source)
    with open_job(options, make_console(quiet=True)) as (job, _, _):
        key = job.key
    sent = []
    for _ in range(2):  # two machines, one after the other
        shutil.rmtree(bucket.parent / "cache")
        with _tile_maker(options, key) as block:
            assert list(block((0,))) == [0]
        sent.append({path.name: path.stat().st_mtime_ns for path in (bucket / "map" / "tiles").iterdir()})
    assert len(sent[0]) == 1
    assert sent[0] == sent[1], "the second made it again"
