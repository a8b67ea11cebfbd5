"""Give damaged files to everything that reads files, and keep those that it neither accepts nor refuses properly.

A finding is a file on which a reader raises anything but the project's own error, ends its process, or needs too much
time or memory. Readers run in a process of their own, which is started again after each end. A file depends on the
seed, the reader and its number alone.
"""

from __future__ import annotations

import faulthandler
import logging
import multiprocessing
import os
import re
import resource
import shutil
import signal
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from pathlib import Path
from random import Random
from typing import Any
from unittest.mock import patch

from benchmarks.readers import READERS, Reader, make_seeds
from benchmarks.records import say, show
from tidefield.compare.tables import Table
from tidefield.errors import RunError, TidefieldError
from tidefield.files import write_json
from tidefield.machine import describe

FUZZ_FILE = "fuzz.json"
WAITING_SECONDS = 120.0
"""That a reader may take for a file on a busy machine."""
MOST_BYTES = 1 << 30
"""Of memory that a reader may need for a file; the files are of kilobytes."""
_ADDRESSES = 8 << 30
"""Beyond what the libraries map: the end of a reader that would take all of the machine's memory."""


@dataclass
class Count:
    """What happened to the files of a reader; `findings` by kind and place, with their number."""

    files: int = 0
    accepted: int = 0
    refused: int = 0
    slowest_seconds: float = 0.0
    findings: dict[str, int] = field(default_factory=dict)


def fuzz(
    minutes: float = 10.0,
    runs: Path | None = None,
    kept: Path = Path("runs/fuzz"),
    readers: tuple[str, ...] = (),
    seed: int = 0,
) -> None:
    """Give damaged files to readers, and print what happened.

    Args:
        minutes: For all readers together, each for the same time.
        runs: Store the counts in this folder's fuzz.json.
        kept: Folder for the findings: the files and their tracebacks.
        readers: Names of readers, as the table shows them; all if not given.
        seed: Of the damage.

    Raises:
        RunError: there are findings, a reader is not known, or some readers' counts would be stored as all.
    """
    if readers and runs is not None:
        raise RunError("--readers was given with --runs: the record is of all readers; leave one of them out")
    names = [reader.name for reader in READERS]
    unknown = next((name for name in readers if name not in names), None)
    if unknown is not None:
        raise RunError(f"there is no reader {unknown!r}: expected one of {'; '.join(names)}; choose one of these")
    chosen = [reader for reader in READERS if not readers or reader.name in readers]
    counts = measure_fuzz(chosen, minutes, seed, kept, runs)
    show([fuzz_table({name: vars(count) for name, count in counts.items()})])
    if any(count.findings for count in counts.values()):
        raise RunError(f"there are findings: expected none; their files and tracebacks are in {kept}")


def measure_fuzz(
    readers: Sequence[Reader],
    minutes: float,
    seed: int,
    kept: Path,
    runs: Path | None,
    seeds: Callable[[Path], object] = make_seeds,
) -> dict[str, Count]:
    """Damage files of every reader for an equal time, and count what happens; `seeds` writes the whole files.

    Raises:
        RunError: a reader does not accept its whole files.
    """
    counts = {}
    with ExitStack() as stack:
        work = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="fuzz-")))
        stack.enter_context(patch.dict(os.environ, XDG_CACHE_HOME=str(work / "cache")))
        say("writing whole files")
        seeds(work / "seeds")
        worker = stack.enter_context(_Worker(work))
        for reader in readers:
            counts[reader.name] = count = Count()
            _fuzz(reader, 60 * minutes / len(readers), seed, worker, kept, count)
            shutil.rmtree(work / "cache", ignore_errors=True)
            say(f"{reader.name}: {count.files} files, {sum(count.findings.values())} findings")
    if runs is not None:
        record = {name: vars(count) for name, count in counts.items()}
        command = f"python -m benchmarks fuzz --minutes {minutes:g} --seed {seed}"
        write_json(runs / FUZZ_FILE, {"command": command, "readers": record, **describe()})
    return counts


def fuzz_table(readers: Mapping[str, Mapping[str, Any]]) -> Table:
    """What happened to the damaged files of every reader, and of all."""
    rows = [
        (
            name,
            *(f"{count[key]:,}" for key in ("files", "accepted", "refused")),
            str(sum(count["findings"].values())),
            f"{count['slowest_seconds']:.2f}",
        )
        for name, count in readers.items()
    ]
    sums = [sum(count[key] for count in readers.values()) for key in ("files", "accepted", "refused")]
    found = sum(sum(count["findings"].values()) for count in readers.values())
    slowest = max((count["slowest_seconds"] for count in readers.values()), default=0.0)
    rows.append(("all", *(f"{total:,}" for total in sums), str(found), f"{slowest:.2f}"))
    return Table("Damaged files", ["reader", "files", "accepted", "refused", "findings", "slowest, s"], rows)


def _fuzz(reader: Reader, seconds: float, seed: int, worker: _Worker, kept: Path, count: Count) -> None:
    # Twice: what is loaded at the first time counts for no file.
    for outcome in [*worker.read(reader, seed, None, 0.0), *worker.read(reader, seed, None, 0.0)]:
        if outcome["kind"] != "accepted":
            raise RunError(
                f"{reader.name}: its whole files gave {outcome['kind']}, expected acceptance: {outcome['text']}"
            )
    end = time.monotonic() + seconds
    while count.files == 0 or time.monotonic() < end:
        for outcome in worker.read(reader, seed, count.files, end - time.monotonic()):
            count.files += 1
            count.slowest_seconds = round(max(count.slowest_seconds, outcome["seconds"]), 2)
            if outcome["kind"] == "accepted":
                count.accepted += 1
            elif outcome["kind"] == "refused":
                count.refused += 1
            else:
                place = f"{outcome['kind']}: {_place(outcome['text'])}"
                if place not in count.findings:
                    _keep(kept, reader, count.files - 1, outcome)
                count.findings[place] = count.findings.get(place, 0) + 1


def _place(text: str) -> str:
    """The last line of the project's own in a traceback, and the error."""
    own = re.findall(r'/(tidefield/[^"]*)", line (\d+)', text)
    last = text.strip().splitlines()[-1][:100] if text.strip() else ""
    return f"{own[-1][0]}:{own[-1][1]} {last.partition(':')[0]}" if own else last


def _keep(kept: Path, reader: Reader, number: int, outcome: dict[str, Any]) -> None:
    folder = kept / re.sub(r"\W+", "-", reader.name.lower()) / str(number)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / outcome["file"]).write_bytes(outcome["content"])
    (folder / "traceback.txt").write_text(f"{reader.name}: {outcome['kind']}\n{outcome['text']}\n")


class _Worker:
    """The process that reads, which is started again when it has ended."""

    def __init__(self, work: Path) -> None:
        self.work, self._log = work, work / "log"
        self._process: SpawnProcess | None = None

    def __enter__(self) -> _Worker:
        return self

    def __exit__(self, *_: object) -> None:
        self._end()

    def read(self, reader: Reader, seed: int, first: int | None, seconds: float) -> Iterator[dict[str, Any]]:
        """What a reader does with damaged files from this number on, for a while, or with whole files."""
        process = self._process or self._start()
        number = first
        try:
            self._pipe.send((reader, seed, first, seconds))
            while self._pipe.poll(WAITING_SECONDS):
                outcome = self._pipe.recv()
                if outcome is None:
                    return
                yield outcome
                number = None if number is None else number + 1
            status = "it waits"
        except (EOFError, OSError):
            process.join()
            code = process.exitcode or 0
            status = "its process ended by " + (signal.Signals(-code).name if code < 0 else f"status {code}")
        self._end()
        kind = "time" if status.endswith("SIGPROF") or status == "it waits" else "end"
        text = self._log.read_text(errors="replace")[-20_000:]
        file = damage(reader, self.work / "seeds" / reader.seed, seed, number)
        yield _outcome(kind, reader.cpu_seconds if kind == "time" else 0.0, f"{text}\n{status}", *file)

    def _start(self) -> SpawnProcess:
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        process = context.Process(target=_serve, args=(theirs, self.work, self._log))
        process.start()
        theirs.close()
        self._process = process
        return process

    def _end(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.join()
            self._pipe.close()
        self._process = None


def _serve(pipe: Connection, work: Path, log: Path) -> None:
    """Read what is asked for, until the other side is gone."""
    with log.open("wb", buffering=0) as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    faulthandler.enable()
    faulthandler.register(signal.SIGPROF, chain=True)  # which ends the process
    logging.disable(logging.CRITICAL)
    warnings.simplefilter("ignore")
    import torch

    torch.set_num_threads(1)
    mapped = 4096 * int(Path("/proc/self/statm").read_text().split()[0])
    resource.setrlimit(resource.RLIMIT_AS, (mapped + _ADDRESSES, mapped + _ADDRESSES))
    while True:
        try:
            reader, seed, first, seconds = pipe.recv()
        except EOFError:
            return
        end, number = time.monotonic() + seconds, first
        while True:
            pipe.send(_read(reader, seed, number, work, log))
            if number is None or time.monotonic() > end:
                break
            number += 1
        pipe.send(None)


def damage(reader: Reader, whole: Path, seed: int, number: int | None) -> tuple[str, bytes]:
    """The path below a folder of whole files, and the content, of the damaged file of a number."""
    random = Random(f"{seed} {reader.name} {number}")
    file = random.choice(sorted(path for pattern in reader.files for path in whole.glob(pattern)))
    content = file.read_bytes()
    return file.relative_to(whole).as_posix(), content if number is None else reader.damage(content, random)


def _outcome(kind: str, seconds: float, text: str, file: str, content: bytes) -> dict[str, Any]:
    is_finding = kind not in ("accepted", "refused")
    kept = {"file": Path(file).name, "content": content} if is_finding else {}
    return {"kind": kind, "seconds": seconds, "text": text[-20_000:], **kept}


def _read(reader: Reader, seed: int, number: int | None, work: Path, log: Path) -> dict[str, Any]:
    """Read a fresh copy of a reader's files, one of them damaged."""
    folder, whole = work / "case" / "files", work / "seeds" / reader.seed
    shutil.rmtree(folder.parent, ignore_errors=True)
    shutil.copytree(whole, folder)
    file, content = damage(reader, whole, seed, number)
    if number is not None:
        (folder / file).write_bytes(content)
    os.truncate(log, 0)
    before = _reset_peak()
    kind, text, start = "accepted", "", time.process_time()
    signal.setitimer(signal.ITIMER_PROF, reader.cpu_seconds)
    try:
        reader.read(folder)
    except TidefieldError as error:
        kind, text = "refused", str(error)
    except BaseException:
        kind, text = "error", traceback.format_exc()
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
    seconds, needed = time.process_time() - start, _peak() - before
    if needed > MOST_BYTES and kind in ("accepted", "refused"):
        kind, text = "memory", f"{needed / 1e9:.1f} GB; {kind} {text}"
    return _outcome(kind, seconds, text, file, content)


def _reset_peak() -> int:
    """The memory in use, which is made the peak."""
    Path("/proc/self/clear_refs").write_text("5")
    return _peak()


def _peak() -> int:
    status = Path("/proc/self/status").read_text()
    return 1024 * int(status.partition("VmHWM:")[2].split()[0])
