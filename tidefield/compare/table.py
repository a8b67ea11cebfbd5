"""A table, in the forms that people use: Markdown, LaTeX, CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass

NOTHING = "-"
_ESCAPES = str.maketrans({"&": r"\&", "%": r"\%", "_": r"\_", "#": r"\#", "$": r"\$", "{": r"\{", "}": r"\}"})


@dataclass(frozen=True)
class Table:
    """Cells as text; the first column is words, the others are figures.

    Attributes:
        title: above it; may be empty.
        columns: their heads.
        rows: the cells.
        bold: (row, column) of cells to stand out.
    """

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    bold: frozenset[tuple[int, int]] = frozenset()

    def markdown(self) -> str:
        """A heading, where there is a title, and the table."""
        rows = [[f"**{c}**" if (i, j) in self.bold else c for j, c in enumerate(r)] for i, r in enumerate(self.rows)]
        lines = [self.columns, ["---", *["---:"] * (len(self.columns) - 1)], *rows]
        heading = [f"### {self.title}", ""] if self.title else []
        return "\n".join([*heading, *(f"| {' | '.join(line)} |" for line in lines)])

    def latex(self) -> str:
        """A table environment; needs the package booktabs."""
        rows = [
            [rf"\textbf{{{_tex(c)}}}" if (i, j) in self.bold else _tex(c) for j, c in enumerate(row)]
            for i, row in enumerate(self.rows)
        ]
        body = [" & ".join(line) + r" \\" for line in rows]
        head = " & ".join(map(_tex, self.columns)) + r" \\"
        return "\n".join(
            [
                r"\begin{table}",
                rf"\caption{{{_tex(self.title)}}}",
                rf"\begin{{tabular}}{{l{'r' * (len(self.columns) - 1)}}}",
                r"\toprule",
                head,
                r"\midrule",
                *body,
                r"\bottomrule",
                r"\end{tabular}",
                r"\end{table}",
            ]
        )

    def csv(self) -> str:
        """With a line of heads; cells without a value are empty."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(self.columns)
        writer.writerows([["" if cell == NOTHING else cell for cell in row] for row in self.rows])
        return text.getvalue()


def _tex(text: str) -> str:
    return text.translate(_ESCAPES)


def shown(value: float | int | None, style: str) -> str:
    return NOTHING if value is None else style.format(value)
