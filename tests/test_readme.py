"""What the documents say is checked against what there is."""

import re
import shlex
import shutil
import subprocess
from dataclasses import replace
from importlib.metadata import metadata
from pathlib import Path
from types import ModuleType

import pytest
from command_lines import blocks, read_by_command
from rich.console import Console
from scenes_on_disk import PINHOLE, survey, write_colmap

import tidefield
from tidefield import cli

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
PAGES = sorted((ROOT / "docs").glob("*.md"))
DOCUMENTS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md", *PAGES]
GENERATED = {"results.md", "surveys.md", "change-results.md"}


def command_lines(program: str, *documents: Path) -> list[str]:
    """Of the code blocks, indented lines and inline code."""
    found = set()
    for document in documents:
        text = document.read_text(encoding="utf-8")
        indented, inline = re.findall(r"^    (.*)$", text, flags=re.MULTILINE), re.findall(r"`([^`\n]+)`", text)
        lines = [*"\n".join(blocks(text, "sh")).splitlines(), *indented, *inline]
        found |= {line.split("  #")[0].strip() for line in lines}
    # Capitals stand for names, as in `tidefield COMMAND --help`; options such as --version belong to no command.
    return sorted(
        line for line in found if re.match(rf"{program} [a-z]", line) and not re.search(r" [A-Z]+\b|\.\.\.", line)
    )


WRITTEN = [page for page in PAGES if page.name not in GENERATED]
TIDEFIELD_LINES = [
    line for line in command_lines("tidefield", ROOT / "README.md", *WRITTEN) if line.split()[1:] != [line.split()[1]]
]


@pytest.mark.parametrize("line", TIDEFIELD_LINES)
def test_every_command_line_is_understood(line: str, monkeypatch: pytest.MonkeyPatch) -> None:
    assert read_by_command(shlex.split(line), monkeypatch) == 1


def test_every_command_is_shown() -> None:
    assert {line.split()[1] for line in command_lines("tidefield", ROOT / "README.md")} == set(cli.COMMANDS)


@pytest.mark.skipif(shutil.which("make") is None, reason="there is no make on this machine")
@pytest.mark.parametrize("line", command_lines("make", ROOT / "README.md", ROOT / "CONTRIBUTING.md", *WRITTEN))
def test_every_make_target_is_there(line: str) -> None:
    words = [word for word in shlex.split(re.split(r"  +", line)[0]) if not word.startswith("PYTHON=")]
    done = subprocess.run([words[0], "-n", *words[1:]], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_readme_fits_two_screens() -> None:
    assert len(README.splitlines()) <= 130


@pytest.mark.thorough
def test_the_python_runs_as_it_stands(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    from tidefield.commands.train import Train, train
    from tidefield.config import Budget

    (code,) = blocks(README, "python")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    truth = survey(PINHOLE)
    names = tuple(f"DJI_{41 + i:04d}.JPG" for i in range(len(truth.names)))
    write_colmap(tmp_path / "my-scene", replace(truth, names=names))
    monkeypatch.chdir(tmp_path)
    train(Train(Path("my-scene"), Path("my-run"), budget=Budget(steps=1), device="cpu"), Console(quiet=True))
    exec(compile(code, "README.md", "exec"), ModuleType("readme").__dict__)
    assert "torch.Size([48, 64, 3])" in capsys.readouterr().out


def anchors(document: Path) -> set[str]:
    """Of a page's headings, as GitHub and MyST make them."""
    headings = re.findall(r"^#+ (.+)$", document.read_text(encoding="utf-8"), flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_every_link_leads_somewhere(document: Path) -> None:
    links = [link for link in re.findall(r"\]\(([^)]+)\)", document.read_text(encoding="utf-8")) if "://" not in link]
    dead = []
    for link in links:
        path, _, anchor = link.partition("#")
        target = document.parent / path if path else document
        if not target.exists() or (anchor and anchor not in anchors(target)):
            dead.append(link)
    assert not dead


def test_figures_of_readme_are_those_of_the_results() -> None:
    rows = re.findall(r"^\| (\w+)[^|]* \| ([\d.]+) \| ([\d.]+) \| ([\d.]+) \|$", README, flags=re.MULTILINE)
    assert rows
    results = (ROOT / "docs" / "results.md").read_text(encoding="utf-8")
    table = results[results.index("### 400 px: PSNR, dB") :]
    head = next(line for line in table.splitlines() if line.startswith("| scene"))
    columns = [cell.strip() for cell in head.strip("|").split("|")]
    for scene, *figures in rows:
        line = next(line for line in table.splitlines() if re.match(rf"\| {scene}\b", line))
        cells = dict(zip(columns, (cell.strip(" *") for cell in line.strip("|").split("|")), strict=True))
        assert figures == [cells[name] for name in ("tidefield", "zero-shot", "sparse-depth")]


def test_the_method_has_the_sections_that_the_code_cites() -> None:
    text = (ROOT / "docs" / "method.md").read_text(encoding="utf-8")
    sections = [int(number) for number in re.findall(r"^## (\d+)\. ", text, flags=re.MULTILINE)]
    assert sections == list(range(1, 16))
    cited = set()
    for module in (ROOT / "tidefield").rglob("*.py"):
        for numbers in re.findall(r"docs/method\.md,\s+sections? ([\d, and]+)", module.read_text(encoding="utf-8")):
            cited |= {int(number) for number in re.findall(r"\d+", numbers)}
    assert cited, "the code cites the method"
    assert cited <= set(sections)


def test_every_source_of_the_method_is_cited_and_listed() -> None:
    text, _, listed = (ROOT / "docs" / "method.md").read_text(encoding="utf-8").partition("\n## Sources\n")
    numbers = {int(number) for number in re.findall(r"^(\d+)\. ", listed, flags=re.MULTILINE)}
    # Brackets around a single number are a citation; [3, 6] are layers of Table 1.
    assert {int(number) for number in re.findall(r"(?<!\w)\[(\d+)\](?!\()", text)} == numbers


def test_the_reference_lists_the_whole_interface_from_python() -> None:
    page = (ROOT / "docs" / "api.md").read_text(encoding="utf-8")
    names = [name for name in tidefield.__all__ if name != "__version__"]
    assert names
    assert [name for name in names if f":: tidefield.{name}\n" not in page] == []


def test_readme_of_the_package_has_no_links_that_lead_nowhere() -> None:
    shown = metadata("tidefield")["Description"] or metadata("tidefield").get_payload()
    assert isinstance(shown, str)
    assert "## Use" in shown
    assert re.findall(r"\]\((?!https://)", shown) == []
