"""nerfstudio's own environment, where tests run commands of nerfstudio and NerfBaselines with Tidefield."""

import os
import subprocess
import sysconfig
import tomllib
from pathlib import Path

import pytest

import tidefield
from tidefield.baselines.nerfstudio import environment
from tidefield.errors import RunError

ROOT = Path(__file__).parents[1]
SCRIPT = ROOT / "tests/foreign_commands.py"


def entry_points() -> dict[str, str]:
    """Those of pyproject.toml, as nerfstudio and NerfBaselines take them from environment variables."""
    groups = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["entry-points"]
    found = {
        f"NERFSTUDIO_{kind.upper()}_CONFIGS": ",".join(
            f"{name}={place}" for name, place in groups[f"nerfstudio.{kind}_configs"].items()
        )
        for kind in ("method", "dataparser")
    }
    package = Path(tidefield.__file__).parents[1]
    (spec,) = groups["nerfbaselines.specs"].values()
    return {**found, "NERFBASELINES_REGISTER": str(package / f"{spec.replace('.', '/')}.py")}


def python(*needed: str) -> Path:
    """The environment's interpreter; the test is skipped, and says so, where it or a module is missing."""
    try:
        found = environment.python()
    except RunError as error:
        pytest.skip(str(error))
    for name in needed:
        if subprocess.run([found, "-c", f"import {name}"], capture_output=True, check=False).returncode:
            pytest.skip(f"needs {name} in nerfstudio's environment: {found} -m pip install --no-deps {name} click")
    return found


def run(*words: str | Path, needed: tuple[str, ...] = ()) -> str:
    """Run commands of `foreign_commands.py`; returns what they printed."""
    command = [python(*needed), SCRIPT, environment.WORKER, sysconfig.get_path("purelib"), *words]
    settings = {**os.environ, **entry_points(), "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    done = subprocess.run([str(word) for word in command], env=settings, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-4000:]
    return done.stdout + done.stderr
