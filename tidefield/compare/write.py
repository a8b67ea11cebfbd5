"""What a comparison leaves: tables in every form, figures, curves, and all numbers with their settings as JSON."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from tidefield.compare.ablation import ablation_tables, verdicts
from tidefield.compare.figures import side_by_side, write_curves
from tidefield.compare.results import Results, figures_of
from tidefield.compare.run import Settings
from tidefield.compare.table import Table
from tidefield.compare.tables import all_tables, lpips_weights, missing_metrics
from tidefield.data.load import load_scene
from tidefield.files import completed_file, write_json
from tidefield.machine import describe


def write_comparison(results: Results, scenes: Mapping[str, Path], settings: Settings, out: Path) -> list[Path]:
    """Write what there is so far into the comparison's folder, over older ones.

    Returns:
        The files.
    """
    tables, made = all_tables(results), describe()
    files = [
        _write(out / "tables.md", _page("Comparison", tables, _remarks(results), settings, made)),
        _write(out / "tables.tex", _latex(tables)),
        _write(out / "tables.csv", _csv(tables)),
    ]
    write_json(out / "comparison.json", {"settings": asdict(settings), **made, "results": figures_of(results)})
    files.append(out / "comparison.json")
    for name, path in scenes.items():
        figure = side_by_side(results, name, load_scene(path, width=settings.width))
        if figure is not None:
            file = out / "figures" / f"{name}.png"
            with completed_file(file, overwrite=True) as partial:
                figure.save(partial)
            files.append(file)
    curves = out / "curves.png"
    if any(result.curve for result in results.by.values()):
        with completed_file(curves, overwrite=True) as partial:
            write_curves(results, partial)
        files.append(curves)
    else:
        curves.unlink(missing_ok=True)
    return files


def write_ablation(results: Results, settings: Settings, out: Path) -> list[Path]:
    """Write the tables of an ablation as far as it is there, over older ones.

    Returns:
        The files.
    """
    tables, made = ablation_tables(results), describe()
    write_json(out / "ablation.json", {"settings": asdict(settings), **made, "results": figures_of(results)})
    return [
        _write(
            out / "ablation.md", _page("Ablation", tables, [*verdicts(results), *_remarks(results)], settings, made)
        ),
        _write(out / "ablation.tex", _latex(tables)),
        _write(out / "ablation.csv", _csv(tables)),
        out / "ablation.json",
    ]


def _latex(tables: list[Table]) -> str:
    return "\n\n".join(table.latex() for table in tables) + "\n"


def _csv(tables: list[Table]) -> str:
    return "\n".join(f"{table.title}\n{table.csv()}" for table in tables)


def _remarks(results: Results) -> list[str]:
    return [*lpips_weights(results), *missing_metrics(results)]


def _page(title: str, tables: list[Table], remarks: list[str], settings: Settings, made: Mapping[str, Any]) -> str:
    machine = made["machine"]
    budget = f"{settings.minutes:g} minutes" if settings.minutes is not None else f"{settings.steps} steps"
    lines = [
        f"# {title}",
        "Means over the held-out photographs. Each had the same photographs, split, resolution and machine, "
        f"and {budget} of training, one after another.",
        f"{machine['processor']}, {machine['cores']} cores, {machine['memory_bytes'] / 2**30:.0f} GiB, on "
        f"{settings.device}; photographs {settings.width or 'as they are'} px wide; Tidefield {made['version']}, torch "
        f"{machine['torch']}; {made['date']}.",
        *remarks,
        *(table.markdown() for table in tables),
    ]
    return "\n\n".join(lines) + "\n"


def _write(path: Path, text: str) -> Path:
    with completed_file(path, overwrite=True) as partial:
        partial.write_text(text, encoding="utf-8")
    return path
