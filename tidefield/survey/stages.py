"""Run the stages of a pipeline once each, and again only when their inputs change.

The key of a stage is a digest of its options and of the key of the stage before it: a changed option repeats that stage
and all that follow. The result of a stage is kept as JSON next to its key, in `stages.json`.
"""

from __future__ import annotations

import hashlib
import json
import logging
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from concurrent.futures import TimeoutError as NotReady
from pathlib import Path
from typing import Any, TypeVar

import pycolmap

from tidefield.errors import RunError
from tidefield.files import write_json, writing_to

log = logging.getLogger(__name__)

Facts = dict[str, Any]
"""Result of a stage, as JSON."""
Result = TypeVar("Result")


class Stages:
    """The stages of one working folder and their state.

    Args:
        folder: contains `stages.json` and the stages' files; created if it does not exist.
        source: what the first stage depends on (any JSON).
        redo: name of a stage to repeat, with all that follow, even if nothing has changed.

    Attributes:
        seconds: run time of each stage, including interrupted attempts.

    Raises:
        RunError: the folder cannot be written to, or `stages.json` is damaged.
    """

    def __init__(self, folder: Path, source: object, redo: str | None = None) -> None:
        with writing_to(folder.parent):
            folder.mkdir(parents=True, exist_ok=True)
        self._folder, self._file = folder, folder / "stages.json"
        self._records = self._read()
        self._key, self._redo, self._is_redoing = _digest(source), redo, False
        self.seconds: dict[str, float] = {}

    def run(self, name: str, options: object, outputs: Sequence[Path], job: Callable[[bool], Facts]) -> Facts:
        """Run a stage unless it is complete.

        Args:
            options: everything its result depends on, besides the previous stages (any JSON).
            outputs: files or folders that must exist for the stage to count as complete.
            job: runs the stage; called with whether an interrupted attempt with the same key can be continued.

        Returns:
            The job's result, of this run or of an earlier one.
        """
        self._key = _digest([self._key, name, options])
        self._is_redoing = self._is_redoing or name == self._redo
        record = self._records.get(name, {})
        is_same = record.get("key") == self._key and not self._is_redoing
        if is_same and record.get("done") and all(path.exists() for path in outputs):
            self.seconds[name] = record["seconds"]
            log.info(f"{name}: complete already")
            return record["facts"]
        earlier = record.get("seconds", 0.0) if is_same else 0.0
        record = self._records[name] = {"key": self._key, "done": False, "seconds": earlier}
        write_json(self._file, self._records)
        start = time.monotonic()
        try:
            with writing_to(self._folder.parent):
                facts = job(is_same)
            record |= {"done": True, "facts": facts}
        finally:
            self.seconds[name] = record["seconds"] = earlier + time.monotonic() - start
            write_json(self._file, self._records)
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
                "start again"
            ) from error
        return records


def interruptible(job: Callable[[pycolmap.CancellationToken], Result]) -> Result:
    """Run a long job of pycolmap in a thread and cancel it on Ctrl-C, which it would not notice itself."""
    token = pycolmap.CancellationToken()
    with ThreadPoolExecutor(1) as pool:
        future = pool.submit(job, token)
        try:
            while True:
                try:
                    return future.result(timeout=0.2)
                except NotReady:
                    if future.done():  # the job itself raised it
                        raise
        except BaseException:
            token.cancel()
            raise


def _digest(value: object) -> str:
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:16]
