"""Code blocks of documents, and their command lines as Tidefield understands them."""

import re
import sys
from collections.abc import Sequence
from contextlib import nullcontext

import pytest

from tidefield import addresses, cli


def blocks(text: str, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", text, flags=re.MULTILINE | re.DOTALL)


def read_by_command(words: Sequence[str], monkeypatch: pytest.MonkeyPatch) -> int:
    """How many commands were called with the options of a command line."""
    called = []
    module, _, function = cli.COMMANDS[words[1]]
    monkeypatch.setattr(module, function, lambda options, console: called.append(options))
    monkeypatch.setattr(cli, "_set_up", lambda verbosity: None)
    monkeypatch.setattr(addresses, "up_to_date", lambda paths, console: nullcontext())
    monkeypatch.setattr(sys, "argv", list(words))
    cli.main()
    return len(called)
