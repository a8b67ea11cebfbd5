"""What a training shows of itself."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rich.console import Console

from tidefield.progress import ProgressBar
from tidefield.train.losses import psnr

if TYPE_CHECKING:
    from tidefield.train.loop import Budget, Trainer


class Display:
    """Step, loss, PSNR, rays per second and time left."""

    def __init__(self, console: Console) -> None:
        self._meter = ProgressBar(console, "Training")

    def __enter__(self) -> Display:
        self._meter.__enter__()
        return self

    def __exit__(self, *error: object) -> None:
        self._meter.__exit__(*error)

    def update(self, trainer: Trainer, budget: Budget, mean_square: float) -> None:
        """Show the state after a step."""
        progress = trainer.progress
        rays = trainer.rays_per_step * progress.step / max(progress.seconds, 1e-9)
        loss = f"loss {mean_square:.5f}  PSNR {psnr(mean_square):.2f} dB  {rays:,.0f} rays/s"
        self.show(budget.share(progress), f"step {progress.step}  {loss}")

    def show(self, share: float, line: str) -> None:
        """Show how much of the budget is used, and a line beside it."""
        self._meter(share, 1, line)
