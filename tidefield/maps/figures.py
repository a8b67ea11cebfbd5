"""Maps and charts for pages, in one style; maps have coordinates."""

from __future__ import annotations

import base64
import io
from typing import Any

from markupsafe import Markup
from matplotlib import style
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Text

from tidefield.maps.styles import INK

SOFT, RULE = "#55626b", "#d5dbdf"
INCHES = 7.6
"""Width of a map."""
_DPI = 130
_STYLE: list[Any] = [
    "default",
    {
        "font.size": 9.5,
        "text.parse_math": False,
        "text.color": INK,
        "axes.edgecolor": SOFT,
        "axes.labelcolor": SOFT,
        "xtick.color": SOFT,
        "ytick.color": SOFT,
        "axes.linewidth": 0.8,
    },
]
Extent = tuple[float, float, float, float]
"""West, east, south and north."""


def figure_of(width: float, height: float) -> Figure:
    """An empty figure in the style of the pages, inches."""
    with style.context(_STYLE):
        return Figure(figsize=(width, height), dpi=_DPI)


def map_of(rows: int, columns: int, width: float = INCHES) -> tuple[Figure, Axes]:
    """An empty map of so many cells, with coordinates along its sides; inches."""
    aspect = min(1.5, max(0.25, rows / columns))
    with style.context(_STYLE):
        figure = Figure(figsize=(width, width * 0.86 * aspect + 0.5), dpi=_DPI, layout="constrained")
        axes = figure.add_subplot()
    axes.ticklabel_format(useOffset=False, style="plain")
    axes.locator_params(nbins=5)
    axes.tick_params(labelsize=8)
    axes.set_aspect("equal")
    return figure, axes


def png(figure: Figure, what: str) -> Markup:
    """An image element with the picture in it."""
    buffer = io.BytesIO()
    # The style holds for texts that are made within it.
    for text in figure.findobj(Text):
        text.set_parse_math(False)  # type: ignore[attr-defined]
    with style.context(_STYLE):
        figure.savefig(buffer, format="png", metadata={"Software": None})
    data = base64.b64encode(buffer.getvalue()).decode("ascii")
    return Markup('<img alt="{}" src="data:image/png;base64,{}">').format(what, data)
