"""Products appear whole or not at all."""

import errno
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tidefield.errors import RunError
from tidefield.files import (
    LOCK_FILE,
    completed_file,
    completed_folder,
    delete_partials,
    is_locked,
    only_writer,
    read_json,
    require_writable,
)


@pytest.mark.skipif(os.name != "posix", reason="other systems have no such files")
def test_json_that_is_no_file_or_too_large_is_refused_unread(tmp_path: Path):
    assert read_json(tmp_path / "none.json") is None
    os.mkfifo(tmp_path / "pipe.json")
    (tmp_path / "device.json").symlink_to("/dev/zero")
    (tmp_path / "folder.json").mkdir()
    (tmp_path / "large.json").touch()
    os.truncate(tmp_path / "large.json", 1 << 27)
    for name in ("pipe", "device", "folder", "large"):
        with pytest.raises(RunError, match=rf"{name}\.json is not what this program wrote"):
            read_json(tmp_path / f"{name}.json")


def test_a_file_appears_when_it_is_complete(tmp_path: Path):
    path = tmp_path / "a" / "b" / "map.tif"
    with completed_file(path) as partial:
        assert partial.suffix == ".tif"
        partial.write_bytes(b"whole")
        assert not path.exists()
    assert path.read_bytes() == b"whole"
    assert os.listdir(path.parent) == ["map.tif"]


def test_a_full_disk_is_one_clear_error_and_leaves_nothing(tmp_path: Path):
    def fill() -> None:
        with completed_file(tmp_path / "map.tif") as partial:
            partial.write_bytes(b"half")
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with pytest.raises(RunError, match=r"map\.tif cannot be written \(No space left on device\)"):
        fill()
    assert os.listdir(tmp_path) == []


def test_errors_that_no_user_can_mend_pass_through(tmp_path: Path):
    def stumble() -> None:
        with completed_file(tmp_path / "map.tif"):
            raise OSError(errno.EIO, "broken disk")

    with pytest.raises(OSError, match="broken disk"):
        stumble()
    assert os.listdir(tmp_path) == []


def test_a_dangling_link_counts_as_something_that_is_there(tmp_path: Path):
    (tmp_path / "map.tif").symlink_to(tmp_path / "gone")
    with pytest.raises(RunError, match="is there already"), completed_file(tmp_path / "map.tif"):
        pytest.fail("nothing may be written")


def test_a_folder_appears_when_it_is_complete(tmp_path: Path):
    with completed_folder(tmp_path / "a" / "scene") as partial:
        (partial / "images").mkdir()
        assert not (tmp_path / "a" / "scene").exists()
    assert os.listdir(tmp_path / "a") == ["scene"]
    assert os.listdir(tmp_path / "a" / "scene") == ["images"]


def test_a_folder_that_is_there_is_left_alone_even_if_it_was_made_meanwhile(tmp_path: Path):
    (tmp_path / "old").mkdir()
    with pytest.raises(RunError, match=r"old is there already"), completed_folder(tmp_path / "old"):
        pytest.fail("nothing may be written")
    with pytest.raises(RunError, match=r"new is there already"), completed_folder(tmp_path / "new"):
        (tmp_path / "new").mkdir()
    assert sorted(os.listdir(tmp_path)) == ["new", "old"]


def test_a_folder_that_fails_leaves_nothing(tmp_path: Path):
    def fill(error: BaseException) -> None:
        with completed_folder(tmp_path / "scene") as partial:
            (partial / "half").touch()
            raise error

    with pytest.raises(RunError, match=r"scene cannot be written \(No space left on device\)"):
        fill(OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)))
    with pytest.raises(OSError, match="broken disk"):
        fill(OSError(errno.EIO, "broken disk"))
    with pytest.raises(KeyboardInterrupt):
        fill(KeyboardInterrupt())
    assert os.listdir(tmp_path) == []


def test_a_short_write_without_a_number_is_a_full_disk(tmp_path: Path):
    def fill() -> None:
        with completed_file(tmp_path / "depth.npy"):
            raise OSError("3072 requested and 992 written")  # as NumPy's tofile does

    with pytest.raises(RunError, match=r"depth\.npy cannot be written \(3072 requested and 992 written\)"):
        fill()


def test_what_fails_in_the_clean_up_does_not_hide_the_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def fill() -> None:
        with completed_file(tmp_path / "map.tif"):
            raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    def unlink(*_: object, **__: object) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    monkeypatch.setattr(Path, "unlink", unlink)
    with pytest.raises(RunError, match="Read-only file system"):
        fill()


def test_a_name_that_no_file_can_have_is_one_clear_error(tmp_path: Path):
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    (tmp_path / "file").touch()
    (tmp_path / "folder").mkdir()
    for name in ("a" * 300, "a\0b", "loop/b", "file/b", "folder"):
        for check in (lambda path: require_writable(path, overwrite=True), write):
            with pytest.raises(RunError, match=r"cannot be written|has a zero byte|is a folder"):
                check(tmp_path / name)
    with pytest.raises(RunError, match=r"cannot be written"):
        require_writable(Path("/proc/new/file"))
    assert sorted(os.listdir(tmp_path)) == ["file", "folder", "loop"]


def write(path: Path) -> None:
    with completed_file(path, overwrite=True) as partial:
        partial.touch()


def test_a_check_of_a_place_makes_nothing(tmp_path: Path):
    require_writable(tmp_path / "new" / "folder" / "map.tif")
    assert os.listdir(tmp_path) == []
    (tmp_path / "map.tif").touch()
    with pytest.raises(RunError, match="is there already"):
        require_writable(tmp_path / "map.tif")
    require_writable(tmp_path / "map.tif", overwrite=True)


def test_a_message_names_no_temporary_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def refuse(path: Path) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(path))

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(Path, "touch", refuse)
    with pytest.raises(RunError, match=r"^map\.tif cannot be written \(Read-only file system\): "):
        require_writable(Path("map.tif"))


@pytest.mark.parametrize("number", ["NaN", "-Infinity", "1e999"])
def test_json_with_numbers_that_are_not_finite_is_damaged(number: str, tmp_path: Path):
    (tmp_path / "a.json").write_text(f"[1.5, {number}]")
    with pytest.raises(RunError, match="no finite number"):
        read_json(tmp_path / "a.json")


def test_json_nested_too_deeply_is_damaged(tmp_path: Path):
    (tmp_path / "a.json").write_text("[" * 100_000)
    with pytest.raises(RunError, match="is not valid JSON"):
        read_json(tmp_path / "a.json")


@pytest.mark.parametrize("umask", [0o022, 0o077, 0o002])
def test_a_file_has_the_mode_that_the_umask_leaves_whatever_its_writer_makes_of_it(umask: int, tmp_path: Path):
    before = os.umask(umask)
    try:
        with completed_file(tmp_path / "weights") as partial:
            partial.unlink()
            os.close(os.open(partial, os.O_CREAT, 0o600))  # as safetensors does
    finally:
        os.umask(before)
    assert (tmp_path / "weights").stat().st_mode & 0o777 == 0o666 & ~umask


def test_partial_files_of_dead_processes_are_deleted_and_no_others(tmp_path: Path):
    for name in (".a-0123abcd.partial.json", ".b-0123abcd.partial.json", ".a.partial.json", "a.json"):
        (tmp_path / name).touch()
    delete_partials(tmp_path / "a.json")
    assert sorted(os.listdir(tmp_path)) == [".a.partial.json", ".b-0123abcd.partial.json", "a.json"]


def test_a_folder_has_one_writer_until_that_ends_or_dies(tmp_path: Path):
    folder = tmp_path / "a" / "run"
    code = (
        "import sys, time; from pathlib import Path; from tidefield.files import only_writer\n"
        "with only_writer(Path(sys.argv[1])):\n"
        "    (Path(sys.argv[1]) / 'x').touch(); print('locked', flush=True); time.sleep(60)"
    )
    other = subprocess.Popen([sys.executable, "-c", code, folder], stdout=subprocess.PIPE)
    assert other.stdout is not None
    with other, other.stdout:
        assert other.stdout.readline() == b"locked\n"
        with pytest.raises(RunError, match="another process is writing to"), only_writer(folder):
            pytest.fail("the other process has it")
        assert is_locked(folder)
        other.send_signal(signal.SIGKILL)
    assert sorted(os.listdir(folder)) == [LOCK_FILE, "x"]
    assert not is_locked(folder)
    with only_writer(folder):
        assert (folder / LOCK_FILE).exists()
    assert os.listdir(folder) == ["x"]
    assert not is_locked(folder)
    assert not (folder / LOCK_FILE).exists(), "asking makes none"


def test_a_lock_that_may_not_be_tried_counts_as_held(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def refuse(*_: object) -> bool:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))

    (tmp_path / LOCK_FILE).touch()
    monkeypatch.setattr(Path, "open", refuse)
    assert is_locked(tmp_path)


def test_a_folder_that_was_only_locked_leaves_no_trace(tmp_path: Path):
    with only_writer(tmp_path / "a" / "run"):
        pass
    assert os.listdir(tmp_path) == []
    with only_writer(tmp_path):
        pass
    assert tmp_path.exists()


def test_a_file_of_somebody_else_is_one_clear_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def refuse(*_: object) -> bytes:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))

    (tmp_path / "a.json").write_text("{}")
    monkeypatch.setattr(Path, "read_bytes", refuse)
    with pytest.raises(RunError, match=r"a\.json cannot be read \(Permission denied\)"):
        read_json(tmp_path / "a.json")


def test_what_a_killed_process_left_is_deleted_whatever_stage_it_was_in(tmp_path: Path):
    left = [".dsm-0123abcd.partial.tif", ".dsm-0123abcd.rough.partial.tif"]
    others = ["dsm.tif", ".dsm_sigma-0123abcd.partial.tif", ".dsm-0123abcd.partial.json"]
    for name in (*left, *others):
        (tmp_path / name).touch()
    delete_partials(tmp_path / "dsm.tif")
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(others)


def test_what_a_killed_command_has_left_of_a_folder_is_named(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    (tmp_path / ".scene-0123abcd.partial").mkdir()
    (tmp_path / ".other-0123abcd.partial").mkdir()
    with completed_folder(tmp_path / "scene"):
        pass
    (message,) = caplog.messages
    assert ".scene-0123abcd.partial: left by a command that was killed" in message
    assert (tmp_path / ".scene-0123abcd.partial").is_dir(), "another process may be writing to it"
