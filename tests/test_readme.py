"""What the documents say is held against what there is."""

import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest
from scenes_on_disk import PINHOLE, survey, write_colmap

from tidefield import cli

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
DOCUMENTS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md", *(ROOT / "docs").glob("*.md")]


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", README, flags=re.MULTILINE | re.DOTALL)


def command_lines(program: str) -> list[str]:
    """Of the code blocks, indented lines and inline code."""
    indented, inline = re.findall(r"^    (.*)$", README, flags=re.MULTILINE), re.findall(r"`([^`\n]+)`", README)
    lines = [line.split("  #")[0].strip() for line in [*"\n".join(blocks("sh")).splitlines(), *indented, *inline]]
    return sorted({line for line in lines if line.startswith(program + " ")})


@pytest.mark.parametrize("line", command_lines("tidefield"))
def test_every_command_line_is_understood(line: str, monkeypatch: pytest.MonkeyPatch) -> None:
    words, called = shlex.split(line), []
    module, _, function = cli.COMMANDS[words[1]]
    monkeypatch.setattr(module, function, lambda options, console: called.append(options))
    monkeypatch.setattr(cli, "_set_up", lambda verbosity: None)
    monkeypatch.setattr(sys, "argv", words)
    cli.main()
    assert len(called) == 1


def test_every_command_is_shown() -> None:
    assert {line.split()[1] for line in command_lines("tidefield")} == set(cli.COMMANDS)


@pytest.mark.skipif(shutil.which("make") is None, reason="there is no make on this machine")
@pytest.mark.parametrize("line", command_lines("make"))
def test_every_make_target_is_there(line: str) -> None:
    words = [word for word in shlex.split(line) if not word.startswith("PYTHON=")]
    done = subprocess.run([words[0], "-n", *words[1:]], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_the_python_runs_as_it_stands(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    (code,) = blocks("python")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    write_colmap(tmp_path / "my-scene", survey(PINHOLE))
    monkeypatch.chdir(tmp_path)
    exec(compile(code, "README.md", "exec"), ModuleType("readme").__dict__)
    assert "torch.Size([48, 64, 3])" in capsys.readouterr().out


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_every_link_leads_somewhere(document: Path) -> None:
    links = re.findall(r"\]\(([^)#]+)[^)]*\)", document.read_text(encoding="utf-8"))
    dead = [link for link in links if "://" not in link and not (document.parent / link).exists()]
    assert not dead
