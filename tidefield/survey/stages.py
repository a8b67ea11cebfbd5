"""Stages of a pipeline: each is done once, and again only when what it depends on has changed.

A stage's key is a digest of its options and of the key of the stage before it, so that a changed option redoes that
stage and what follows. What a stage found (its facts) is kept as JSON beside the key.
"""

from __future__ import annotations

import hashlib
import json
import logging
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from concurrent.futures import TimeoutError as NotYet
from pathlib import Path
from typing import Any, TypeVar

import pycolmap

from tidefield.errors import RunError
from tidefield.files import completed_file, writing_to

log = logging.getLogger(__name__)

Facts = dict[str, Any]
Result = TypeVar("Result")


class Stages:
    """The stages of one working folder, and how far they are.

    Args:
        folder: where `stages.json` and the stages' files live; made if it is not there.
        source: what the first stage depends on (any JSON).
        redo: name of a stage to do again with all that follow, even if nothing has changed.

    Raises:
        RunError: the folder cannot be written to.
    """

    def __init__(self, folder: Path, source: object, redo: str | None = None) -> None:
        with writing_to(folder.parent):
            folder.mkdir(parents=True, exist_ok=True)
        self._file, self._folder = folder / "stages.json", folder
        self._records: dict[str, Facts] = self._read()
        self._key, self._redo, self._redoing = _digest(source), redo, False
        self.seconds: dict[str, float] = {}

    def run(self, name: str, options: object, outputs: Sequence[Path], job: Callable[[bool], Facts]) -> Facts:
        """Do a stage unless it is done.

        Args:
            options: all that its result depends on, besides the stages before it (any JSON).
            outputs: files or folders that must be there for the stage to count as done.
            job: does it, given whether an unfinished attempt of the very same stage is there to go on with; returns
                the facts to keep (JSON).

        Returns:
            What the job returned, now or then.
        """
        self._key = _digest([self._key, name, options])
        self._redoing = self._redoing or name == self._redo
        record = self._records.get(name, {})
        same = record.get("key") == self._key and not self._redoing
        if same and record.get("done") and all(path.exists() for path in outputs):
            self.seconds[name] = record["seconds"]
            log.info(f"{name}: is there")
            return record["facts"]
        before = record.get("seconds", 0.0) if same else 0.0
        self._records[name] = {"key": self._key, "done": False, "seconds": before}
        self._write()
        start = time.monotonic()
        try:
            with writing_to(self._folder.parent):
                facts = job(same)
        finally:
            self._records[name]["seconds"] = before + time.monotonic() - start
            self._write()
        self._records[name] |= {"done": True, "facts": facts}
        self._write()
        self.seconds[name] = self._records[name]["seconds"]
        return facts

    def _read(self) -> dict[str, Facts]:
        if not self._file.exists():
            return {}
        try:
            records = json.loads(self._file.read_text(encoding="utf-8"))
            if not isinstance(records, dict) or not all(isinstance(r, dict) for r in records.values()):
                raise ValueError("no table of stages")
        except ValueError as error:
            raise RunError(
                f"{self._file} is damaged ({error}): expected what an earlier run wrote; remove {self._folder} to "
                "begin anew"
            ) from error
        return records

    def _write(self) -> None:
        with completed_file(self._file, overwrite=True) as partial:
            partial.write_text(json.dumps(self._records, indent=1, allow_nan=False), encoding="utf-8")


def interruptible(job: Callable[[pycolmap.CancellationToken], Result]) -> Result:
    """Run a long job of pycolmap so that Ctrl-C reaches it: in a thread, with a token that tells it to stop."""
    token = pycolmap.CancellationToken()
    with ThreadPoolExecutor(1) as pool:
        future = pool.submit(job, token)
        try:
            while True:
                try:
                    return future.result(timeout=0.2)
                except NotYet:
                    if future.done():  # the job's own time-out, not ours
                        raise
        except BaseException:
            token.cancel()
            raise


def _digest(value: object) -> str:
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:16]
