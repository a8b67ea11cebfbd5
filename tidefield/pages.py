"""The reports: pages for a browser that need no other file."""

from __future__ import annotations

import os
import shlex
import sys
from pathlib import Path

from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined


def template_environment(*packages: str) -> Environment:
    """Templates of packages, the first that has one of a name before the others, and the style that reports share;
    names of photographs are escaped, and what a template names must be there."""
    return Environment(
        loader=ChoiceLoader([PackageLoader(package, "templates") for package in (*packages, "tidefield")]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def command_line() -> str:
    """The command as it was given, with the names of files and folders alone: a report is sent on."""

    def named(word: str) -> str:
        option, sign, value = word.partition("=") if word.startswith("--") else ("", "", word)
        return option + sign + (Path(value).name if "/" in value or os.sep in value else value)

    return shlex.join(["tidefield", *map(named, sys.argv[1:])])
