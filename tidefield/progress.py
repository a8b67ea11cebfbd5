"""Progress of long jobs: a bar on a terminal, a line every ten seconds elsewhere."""

from __future__ import annotations

import logging
from time import monotonic

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

log = logging.getLogger(__name__)

LINE_SECONDS = 10.0


class _Console(Console):
    def on_broken_pipe(self) -> None:
        """Leave it to the command what to do when nobody reads; Rich would exit with status 1."""
        raise


def make_console(quiet: bool = False) -> Console:
    """A console that prints texts as they are: a path with `[x]` or `:sea:` in it is no markup."""
    return _Console(quiet=quiet, markup=False, emoji=False, highlight=False)


class ProgressBar:
    """Shows the share of a job that is done, and the time left.

    On a terminal a bar that goes away with the job. In a file or a pipe a line every ten seconds, as a message of this
    module's logger, which --quiet silences; a job that ends sooner leaves no line.

        with ProgressBar(console, "Rendering") as meter:
            for done, frame in enumerate(frames, start=1):
                ...
                meter(done, len(frames))
    """

    def __init__(self, console: Console, job: str) -> None:
        columns = [
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            TimeElapsedColumn(),
            TextColumn("{task.fields[rest]}", markup=False),
        ]
        self._job, self._bar_shows, self._quiet = job, console.is_interactive, console.quiet
        self._bar = Progress(*columns, console=console, disable=not self._bar_shows, transient=True)
        self._task = self._bar.add_task(job, total=None, rest="")
        self._first: tuple[float, float] | None = None
        self._spoken, self._has_spoken = monotonic(), False

    def __enter__(self) -> ProgressBar:
        self._bar.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._bar.stop()

    def __call__(self, done: int | float, whole: int | float, note: str | None = None) -> None:
        """Show progress.

        Args:
            note: the text; `done of whole` if None.
        """
        now, share = monotonic(), done / whole
        line = f"{done} of {whole}" if note is None else note
        if self._first is None:
            self._first = now, share
        # From this process's own progress: a job that is continued may have started elsewhere.
        since, share_then = self._first
        if share_then < share < 1:
            line += f"  {_clock((now - since) * (1 - share) / (share - share_then))} left"
        self._bar.update(self._task, completed=done, total=whole, rest=line)
        due = now - self._spoken >= LINE_SECONDS or (share >= 1 and self._has_spoken)
        if due and not self._bar_shows and not self._quiet:
            log.info(f"{self._job}: {line}")
            self._spoken, self._has_spoken = now, True


def _clock(seconds: float) -> str:
    return f"{round(seconds) // 60}:{round(seconds) % 60:02d}"
