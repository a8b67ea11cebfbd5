"""The notebook of the documentation: it runs, and what it shows is what it was run with."""

import os
from pathlib import Path

import pytest

nbformat = pytest.importorskip("nbformat", reason="needs nbclient, which is not installed")
ROOT = Path(__file__).parents[1]
NOTEBOOK = ROOT / "docs/from-photographs-to-change.ipynb"
PICTURES = 5


def pictures(notebook: object) -> int:
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]  # type: ignore[attr-defined]
    return sum("image/png" in output.get("data", {}) for output in outputs)


def test_the_notebook_is_stored_as_it_was_run_from_top_to_bottom():
    notebook = nbformat.read(NOTEBOOK, 4)
    nbformat.validate(notebook)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1))
    assert pictures(notebook) == PICTURES
    assert not [output for cell in code for output in cell.outputs if output.get("name") == "stderr"]
    assert NOTEBOOK.stat().st_size < 2_000_000


@pytest.mark.slow
def test_the_notebook_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    from nbclient import NotebookClient

    monkeypatch.setenv("TIDEFIELD_NOTEBOOK", str(tmp_path))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")])))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    notebook = nbformat.read(NOTEBOOK, 4)
    NotebookClient(notebook, timeout=1800, kernel_name="python3").execute()
    assert pictures(notebook) == PICTURES
    assert (tmp_path / "change/change.html").is_file()
