"""What a training shows of itself: a live line on terminals, a log line now and then elsewhere."""

from __future__ import annotations

import logging
import time
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from tidefield.train.losses import psnr

if TYPE_CHECKING:
    from tidefield.train.loop import Budget, Trainer

log = logging.getLogger(__name__)

LOG_SECONDS = 15.0


class Display:
    """Step, loss, PSNR, rays per second and time left."""

    def __init__(self, console: Console) -> None:
        columns = [
            TextColumn("{task.description}"),
            BarColumn(),
            TimeElapsedColumn(),
            TextColumn("{task.fields[rest]}"),
        ]
        self._live = Progress(*columns, console=console, disable=not console.is_terminal, transient=True)
        self._task = self._live.add_task("Training", total=1.0, rest="")
        self._quiet = not console.is_terminal
        self._began: tuple[float, float] | None = None
        self._logged = time.monotonic()

    def __enter__(self) -> Display:
        self._live.__enter__()
        return self

    def __exit__(self, *error: object) -> None:
        self._live.stop()

    def update(self, trainer: Trainer, budget: Budget, mean_square: float) -> None:
        """Show the state after a step."""
        progress, share = trainer.progress, budget.share(trainer.progress)
        now = time.monotonic()
        if self._began is None:
            self._began = (now, share)
        begin, share_then = self._began
        left = (now - begin) * (1 - share) / (share - share_then) if share > share_then else float("nan")
        rays = trainer.rays_per_step * progress.step / max(progress.seconds, 1e-9)
        line = (
            f"step {progress.step}  loss {mean_square:.5f}  PSNR {psnr(mean_square):.2f} dB  {rays:,.0f} rays/s  "
            f"{_clock(left)} left"
        )
        self._live.update(self._task, completed=share, rest=line)
        if self._quiet and (now - self._logged > LOG_SECONDS or share >= 1):
            log.info(line)
            self._logged = now


def _clock(seconds: float) -> str:
    if seconds != seconds:  # not known after a single step
        return "--:--"
    return f"{int(seconds) // 60}:{int(seconds) % 60:02d}"
