"""nerfstudio's own environment: its pins are old, so it lives apart."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import venv
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

from rich.console import Console

from tidefield.errors import RunError
from tidefield.files import writing_to

VERSION = "1.1.5"
WORKER = Path(__file__).with_name("worker.py")
_NEWEST_PYTHON = (3, 12)
"""The newest that NumPy 1, which nerfstudio needs, has wheels for."""
OLDEST_TORCH = (2, 6)
"""Before it, loading a checkpoint can run code that is in it, even with weights_only (CVE-2025-32434)."""
_NEEDED = (
    "appdirs",
    "av",
    "fpsample",
    "gdown",
    "gsplat==1.4.0",
    "imageio",
    "ipython",
    "jaxtyping",
    "matplotlib",
    "mediapy",
    "msgspec",
    "nerfacc==0.5.2",
    "numpy<2",
    "opencv-python-headless==4.10.0.84",
    "pathos",
    "pillow",
    "plotly",
    "protobuf",
    "psutil",
    "pyquaternion",
    "pyyaml",
    "pytorch-msssim",
    "rawpy",
    "requests",
    "scipy",
    "splines",
    "tensorboard",
    "tensorly",
    "torch-fidelity",
    "torchmetrics",
    "trimesh",
    "tyro<0.10",
    "typeguard",
    "viser==0.2.7",
    "xatlas",
)
"""What training and rendering with nerfstudio import. All that it asks for is gigabytes more (notebooks, cloud
clients, mesh tools), some of it without wheels for new Pythons."""


def home() -> Path:
    """$XDG_DATA_HOME/tidefield/nerfstudio-1.1.5.

    Raises:
        RunError: that is not set, and the system knows no home folder of this user, as in containers.
    """
    data = Path(os.environ.get("XDG_DATA_HOME") or os.path.expanduser("~/.local/share"))
    if data.parts[0] == "~":
        raise RunError("this user has no home folder for nerfstudio: expected one; set XDG_DATA_HOME to a folder")
    return data / "tidefield" / f"nerfstudio-{VERSION}"


def python() -> Path:
    """The environment's interpreter.

    Raises:
        RunError: it is not installed.
    """
    if not _complete().exists():
        raise RunError(
            f"nerfstudio {VERSION} is not installed (expected in {home()}): run `tidefield baselines install nerfacto`"
        )
    return _interpreter()


def without_our_python(given: Mapping[str, str]) -> dict[str, str]:
    """Variables of a process for one of that environment: those that name modules of our Python mean nothing there."""
    return {name: value for name, value in given.items() if name not in ("PYTHONPATH", "PYTHONHOME")}


def install(overwrite: bool, console: Console) -> None:
    """Make the environment: nerfstudio with the PyTorch that we run on, so that speeds compare.

    Raises:
        RunError: it is there already, this Python is too new for it, this PyTorch too old or too new, or pip fails.
    """
    folder = home()
    if _complete().exists() and not overwrite:
        raise RunError(f"{folder} is there already: expected nothing; pass --overwrite to make it anew")
    if sys.version_info[:2] > _NEWEST_PYTHON:
        raise RunError(
            f"nerfstudio {VERSION} does not install on Python {'.'.join(map(str, sys.version_info[:2]))}: "
            f"expected {'.'.join(map(str, _NEWEST_PYTHON))} or older; install Tidefield there"
        )
    torch = version("torch").partition("+")[0]
    vision = _vision(torch)

    def stage(number: int, what: str) -> None:
        console.print(f"{number} of 4: {what}", soft_wrap=True)

    console.print(
        f"Making {folder}: some gigabytes to download, minutes to hours. Nothing is compiled where pip finds wheels. "
        "splatfacto compiles its CUDA kernels when it first runs, with CUDA's nvcc and a C++ compiler; nerfacto needs "
        "neither.",
        soft_wrap=True,
    )
    with writing_to(folder):
        _complete().unlink(missing_ok=True)  # first: what is left of an interrupted deletion is not complete
    shutil.rmtree(folder, ignore_errors=True)
    stage(1, "an empty environment")
    with writing_to(folder):
        folder.parent.mkdir(parents=True, exist_ok=True)
        venv.create(folder, with_pip=True)
    stage(2, f"PyTorch {torch} and {len(_NEEDED)} packages that nerfstudio imports")
    _pip([f"torch=={torch}", *_NEEDED], console)
    stage(3, f"torchvision and nerfstudio {VERSION}")
    _pip(["--no-deps", vision, f"nerfstudio=={VERSION}"], console)
    stage(4, "a test that nerfstudio starts")
    checked = _run([str(_interpreter()), str(WORKER), "check"], capture_output=True, text=True)
    if checked.returncode:
        why = checked.stderr.strip().splitlines()[-1:] or ["no message"]
        raise RunError(
            f"nerfstudio was installed into {folder} but does not start ({why[0]}): expected it to; report it"
        )
    _complete().touch()


def _pip(words: list[str], console: Console) -> None:
    """Install packages; what pip prints meanwhile is the progress."""
    command = [str(_interpreter()), "-m", "pip", "install", "--disable-pip-version-check", *["--quiet"] * console.quiet]
    if _run([*command, *words]).returncode:
        raise RunError(
            f"pip could not install what nerfstudio needs into {home()}: expected it to; read what it says above, and "
            "run the same command again"
        )


def _run(command: list[str], **options: Any) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, check=False, env=without_our_python(os.environ), **options)


def _vision(torch: str) -> str:
    """The newest torchvision that there is for a release of PyTorch, as pip writes it: 0.15 came with 2.0, and so on.

    The third numbers of the two differ, and torchvision may come later, so an older one is taken where there is no
    other: what is needed of it is its Python half.

    Raises:
        RunError: the PyTorch is too old or too new.
    """
    release = tuple(map(int, re.findall(r"\d+", torch)[:2]))
    if release < OLDEST_TORCH:
        raise RunError(
            f"torch {torch} is here, with which loading nerfstudio's checkpoints is not safe: expected "
            f"{'.'.join(map(str, OLDEST_TORCH))} or newer, as nerfstudio gets the same; update it with pip install "
            "--upgrade torch"
        )
    if release[0] != 2:
        raise RunError(f"torch {torch} is new to this version of Tidefield: expected 2.x; update Tidefield")
    return f"torchvision<0.{release[1] + 16}"


def _complete() -> Path:
    return home() / "complete"


def _interpreter() -> Path:
    return home() / ("Scripts/python.exe" if sys.platform == "win32" else "bin/python")
