"""Run the stages of a scene one after the other, with their state in `SCENE/prepare/stages.json`.

The file has the result of each stage, the files it wrote, and a key, which is a digest of its options and of the key of
the stage before it, so that a changed option repeats that stage and all that follow. The names of the stages, their
options and the keys of their results are a file format: a change makes earlier scenes start again.
"""

from __future__ import annotations

import hashlib
import json
import logging
import math
import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

from tidefield.errors import RunError, SceneError
from tidefield.files import write_json, writing_to

log = logging.getLogger(__name__)

Result = TypeVar("Result")
Facts = dict[str, Any]
"""Result of a stage, as JSON."""

_OWN_FOLDERS = ("prepare", "sparse", "images", "masks")
_DAMAGE = (
    ValueError,
    LookupError,
    TypeError,
    AttributeError,
    ArithmeticError,
    RecursionError,
    RuntimeError,
    SceneError,
)
_MEGABYTES = 1000  # 5000 photographs have 5 MB


class Stages:
    """The stages of one scene and their state.

    Nothing is written or removed through a link, and of the scene's files only those are removed that an earlier run
    of the same stage wrote.

    Args:
        folder: SCENE/prepare, which contains `stages.json`; created if it does not exist.
        source: what the first stage depends on (any JSON).
        redo: name of a stage to repeat, with all that follow, even if nothing has changed.

    Attributes:
        seconds: run time of each stage, including interrupted attempts.

    Raises:
        RunError: the folder cannot be written to, a folder of the scene is a link, or `stages.json` is damaged.
    """

    def __init__(self, folder: Path, source: object, redo: str | None = None) -> None:
        self._scene, self._folder, self._file = folder.parent, folder, folder / "stages.json"
        with writing_to(self._scene):
            _refuse_links(self._scene)
            folder.mkdir(parents=True, exist_ok=True)
            self._records = self._read() if self._file.exists() else {}
        if all(record["done"] for record in self._records.values()):
            for record in self._records.values():
                record.pop("redone", None)
        self._key, self._redo, self._is_redoing, self._is_forced = _digest(source), redo, False, False
        self.seconds: dict[str, float] = {}

    def run(
        self,
        name: str,
        options: object,
        outputs: Sequence[Path],
        job: Callable[[bool], Facts],
        read: Callable[[Facts], Result] = lambda facts: facts,
        *,
        inputs: object = None,
    ) -> Result:
        """Run a stage unless it is complete, and then all that follow, too.

        Args:
            options: everything its result depends on, besides the previous stages (any JSON).
            outputs: all files that it writes; they must exist for the stage to count as complete.
            job: runs the stage; called with whether it can continue from what an earlier run left: one with the same
                key that was interrupted, or any with the same inputs.
            read: converts the job's result, and checks the files; the stage is repeated if those of an earlier run are
                damaged.
            inputs: what each part of the result depends on, where that is less than the key (any JSON): a repeated
                stage continues from an earlier run's parts unless the repetition was requested or they are damaged.

        Returns:
            The result, of this run or of an earlier one.
        """
        self._key = _digest([self._key, name, options])
        record = self._records.get(name, {})
        # A repetition that was interrupted goes on.
        self._is_forced = self._is_forced or (name == self._redo and not record.get("redone"))
        self._is_redoing = self._is_redoing or self._is_forced
        is_same = record.get("key") == self._key and not self._is_redoing
        of = None if inputs is None else _digest(inputs)
        continues = is_same or (of is not None and record.get("inputs") == of and not self._is_forced)
        with writing_to(self._scene):
            is_complete = is_same and record["done"] and all(path.exists() for path in outputs)
        if is_complete:
            try:
                result = read(record["facts"])
            except _DAMAGE as error:
                log.warning(f"{self._folder}: what the stage {name} wrote is damaged ({error}): it is done again")
                is_same = continues = False
            else:
                self.seconds[name] = record["seconds"]
                if of is not None and "inputs" not in record:  # of an earlier version
                    record["inputs"] = of
                    write_json(self._file, self._records)
                log.info(f"{name}: complete already")
                return result
        self._is_redoing = True
        files = [path.relative_to(self._scene).as_posix() for path in outputs]
        stale = set(record.get("files", ())) - set(files)
        earlier = record["seconds"] if is_same else 0.0
        record = {"key": self._key, "done": False, "seconds": earlier, "files": [*files, *sorted(stale)]}
        if of is not None:
            record["inputs"] = of
        if name == self._redo:
            record["redone"] = True
        self._records[name] = record
        # Their files may be changed from now on, even if this run ends before they are repeated.
        for later in self._records.keys() - {name, *self.seconds}:
            self._records[later] |= {"key": None, "done": False} | ({"inputs": None} if self._is_forced else {})
        write_json(self._file, self._records)
        log.info(f"{name}: started")
        start = time.monotonic()
        try:
            with writing_to(self._scene):
                for file in stale:
                    self._remove(file)
                facts = job(continues)
            record |= {"done": True, "facts": facts, "files": files}
            log.info(f"{name}: done in {time.monotonic() - start:.1f} s")
        finally:
            self.seconds[name] = record["seconds"] = earlier + time.monotonic() - start
            write_json(self._file, self._records)
        return read(facts)

    def has_run(self, name: str) -> bool:
        """Whether a stage was started, in this run or in an earlier one."""
        return name in self._records

    def _read(self) -> dict[str, Facts]:
        try:
            # One more is read than allowed, so that a device without an end is refused, too.
            with self._file.open("rb") as file:
                text = file.read(_MEGABYTES * 1_000_000 + 1) if self._file.is_file() else b""
            if len(text) > _MEGABYTES * 1_000_000:
                raise ValueError(f"it has more than {_MEGABYTES} MB")
            records = json.loads(text)
            if not isinstance(records, dict):
                raise ValueError("no table of stages")
        except (ValueError, RecursionError) as error:
            raise RunError(
                f"{self._file} is damaged ({error}): expected what an earlier run wrote; remove {self._scene}, or "
                "name a new folder, to start again"
            ) from error
        damaged = [name for name, record in records.items() if not _is_record(record)]
        if damaged:
            log.warning(f"{self._file} is damaged: {', '.join(damaged)} and what follows are done again")
        return {name: record for name, record in records.items() if name not in damaged}

    def _remove(self, file: str) -> None:
        """Remove a file of the scene, unless a link leads to it, and the folders that it leaves empty."""
        path, scene = self._scene / file, os.path.realpath(self._scene)
        if os.path.realpath(path) != os.path.join(scene, *Path(file).parts) or not Path(scene) < Path(scene, file):
            return
        path.unlink(missing_ok=True)
        for parent in path.parents:
            if parent == self._scene or not parent.is_dir() or any(parent.iterdir()):
                break
            parent.rmdir()


def _refuse_links(scene: Path) -> None:
    """Raise a RunError if one of the folders that are written to is a link or contains one."""
    real = os.path.realpath(scene)
    for folder in (*(scene / name for name in _OWN_FOLDERS), *scene.glob("images_*"), *scene.glob("masks_*")):
        for path in (folder, *folder.rglob("*")):
            if os.path.realpath(path) != os.path.join(real, path.relative_to(scene)):
                raise RunError(
                    f"{path} is a link to {os.path.realpath(path)}: expected a folder or file of the scene itself, "
                    "because it would be written over; remove the link, or name a new scene"
                )


def _is_record(record: object) -> bool:
    return (
        isinstance(record, dict)
        and isinstance(record.get("done"), bool)
        and isinstance(seconds := record.get("seconds"), int | float)
        and abs(seconds) < math.inf
        and isinstance(record.get("facts", {}), dict)
        and isinstance(files := record.get("files", []), list)
        and all(isinstance(file, str) for file in files)
        and _is_finite(record)
    )


def _is_finite(value: object) -> bool:
    """Whether all numbers in a record are finite; this program writes no others."""
    try:
        json.dumps(value, allow_nan=False)
    except ValueError:
        return False
    return True


def _digest(value: object) -> str:
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:16]
