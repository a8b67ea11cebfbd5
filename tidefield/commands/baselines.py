"""`tidefield baselines`: install methods of other projects."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from tyro.conf import OmitArgPrefixes, Positional

from tidefield.commands.common import Verbosity

if TYPE_CHECKING:
    from rich.console import Console


@dataclass(frozen=True)
class Baselines:
    """Install methods of other projects, in environments of their own.

    They get the PyTorch that Tidefield runs on, which must be 2.6 or newer.
    """

    action: Positional[Literal["install"]]
    """What to do."""
    name: Positional[Literal["nerfacto"]]
    """nerfacto is nerfstudio, with splatfacto."""
    overwrite: bool = False
    """Replace an existing installation."""
    verbosity: OmitArgPrefixes[Verbosity] = Verbosity()


def baselines(options: Baselines, console: Console) -> None:
    """Run `tidefield baselines`."""
    from tidefield.baselines.nerfstudio import environment

    environment.install(options.overwrite, console)
    console.print(f"nerfstudio {environment.VERSION} is in {environment.home()}", highlight=False, soft_wrap=True)
