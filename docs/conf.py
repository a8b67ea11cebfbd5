"""Settings of the documentation's site: Sphinx, the theme furo, and MyST for pages in Markdown and the notebook."""

from __future__ import annotations

import os
import subprocess
import sys
import textwrap
from pathlib import Path

from docutils import nodes
from docutils.parsers.rst import Directive
from sphinx.application import Sphinx

import tidefield
from tidefield.cli import COMMANDS

ROOT = Path(__file__).resolve().parents[1]
COLUMNS = 84
"""Characters in a line of `--help`: as many as fit on a page of the site."""

project = "Tidefield"
author = "The Tidefield developers"
copyright = author
release = tidefield.__version__
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.mathjax"]
exclude_patterns = ["_build", "measured"]
myst_enable_extensions = ["dollarmath", "amsmath"]
myst_heading_anchors = 3
# The notebook is shown as it was run: `tests/test_notebook.py` runs it.
nb_execution_mode = "off"
# Generated pages go from headings of level 1 to level 3.
suppress_warnings = ["myst.header"]
html_theme = "furo"
html_title = "Tidefield"
# Single backticks in docstrings are code.
default_role = "code"
# jaxtyping's shapes are no Python types: they stay as they are written, and are not looked up.
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
autodoc_member_order = "bysource"
napoleon_use_ivar = True


class CommandHelp(Directive):
    """What `tidefield COMMAND --help` prints, asked when the site is built."""

    has_content = False
    optional_arguments = 1

    def run(self) -> list[nodes.Node]:
        environment = {
            **os.environ,
            "COLUMNS": str(COLUMNS),
            "NO_COLOR": "1",
            "TERM": "dumb",
            "PYTHONPATH": _python_path(),
        }
        command = [sys.executable, "-m", "tidefield.cli", *self.arguments, "--help"]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
        text = "\n".join(_wrapped(line) for line in done.stdout.splitlines())
        return [nodes.literal_block(text, text, language="text")]


def _wrapped(line: str) -> str:
    """Break a long line of text; boxes are as wide as COLUMNS already."""
    indent = " " * (len(line) - len(line.lstrip()) + 2) if line.startswith(" ") else ""
    return "\n".join(textwrap.wrap(line, COLUMNS, subsequent_indent=indent)) or line


def _python_path() -> str:
    return os.pathsep.join([str(ROOT), *sys.path])


def _every_command_is_shown(app: Sphinx) -> None:
    page = (ROOT / "docs" / "commands.md").read_text(encoding="utf-8")
    missing = [name for name in COMMANDS if f"{{command-help}} {name}\n" not in page]
    assert not missing, f"docs/commands.md does not show {missing}"


def _adapt_links(app: Sphinx, page: str, source: list[str]) -> None:
    """Links that lead somewhere in the repository, but not on the site, become plain text there."""
    source[0] = source[0].replace("[docs/measured](measured)", "`docs/measured`")


def setup(app: Sphinx) -> None:
    app.add_directive("command-help", CommandHelp)
    app.connect("builder-inited", _every_command_is_shown)
    app.connect("source-read", _adapt_links)
