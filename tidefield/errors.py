"""Errors that a user can fix; commands print them without a traceback.

Every message says what was found, what was expected and what to do.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from types import ModuleType


class TidefieldError(Exception):
    """Base of every error that a user can fix; commands print it and exit with status 2."""


class SceneError(TidefieldError):
    """A scene on disk is missing, incomplete or inconsistent."""


class SurveyError(TidefieldError):
    """Photographs, their positions or ground control cannot be made a scene of."""


class RunError(TidefieldError):
    """A run folder or a checkpoint cannot be used as asked."""


class DeviceError(TidefieldError):
    """The requested device is not on this machine."""


def need(module: str, extra: str = "maps") -> ModuleType:
    """Import a library of one of this package's extras.

    Raises:
        RunError: it is not installed, or cannot be imported.
    """
    try:
        return import_module(module)
    except ImportError as error:
        raise RunError(
            f"this needs {module.partition('.')[0]}, which cannot be imported ({error}): expected the extra `{extra}`; "
            f"install it with `pip install 'tidefield[{extra}]'`"
        ) from error


def list_names(names: Sequence[str], shown: int = 5) -> str:
    """The first few of a list of names, and how many more there are, for a message."""
    rest = len(names) - shown
    return ", ".join(names[:shown]) + (f" and {rest} more" if rest > 0 else "")
