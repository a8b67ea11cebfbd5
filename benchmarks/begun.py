"""What trained weights bring: views at once, after seconds and minutes of training, and after ten minutes without."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from tidefield.compare.results import Result, Results
from tidefield.compare.run import WHOLE, ZERO_SHOT
from tidefield.compare.table import Table, shown
from tidefield.compare.tables import METRICS

ByLength = Mapping[str, Mapping[str, Result]]
"""By the length of training, as it is called, and by scene."""
SECONDS, MINUTE, FROM_SCRATCH = "10 s", "1 min", "10 min from scratch"
"""Lengths that something is aimed at of, besides `ZERO_SHOT`."""


def by_length(compared: Results, begun: Sequence[Results]) -> ByLength:
    """Our network in comparisons of several lengths; shorter ones first, those from scratch last."""
    found: dict[tuple[bool, float, str], dict[str, Result]] = {}
    for results in (compared, *begun):
        for (scene, method), result in results.by.items():
            settings = result.process.get("settings", {})
            minutes, scratch = settings.get("minutes"), bool(settings.get("from_scratch"))
            if method == ZERO_SHOT:
                found.setdefault((False, 0.0, ZERO_SHOT), {})[scene] = result
            elif method == WHOLE and minutes is not None:
                found.setdefault((scratch, minutes, length_of(result)), {})[scene] = result
    return {name: scenes for (_, _, name), scenes in sorted(found.items(), key=lambda item: item[0])}


def length_of(result: Result) -> str:
    """What the length of a training is called."""
    settings = result.process.get("settings", {})
    minutes = settings.get("minutes")
    if minutes is None:
        name = f"{settings.get('steps')} steps"
    else:
        name = f"{60 * minutes:.0f} s" if minutes < 1 else f"{minutes:g} min"
    return f"{name} from scratch" if settings.get("from_scratch") else name


def length_tables(lengths: ByLength) -> list[Table]:
    """PSNR, SSIM and LPIPS of the scenes that were trained on for several lengths."""
    counted = [scene for scenes in lengths.values() for scene in scenes]
    shared = [scene for scene in dict.fromkeys(counted) if counted.count(scene) > 2]
    names = [name for name, scenes in lengths.items() if set(scenes) & set(shared)]
    if not shared:
        return []
    return [
        Table(
            f"{title}, all pixels ({'more' if more else 'less'} is better)",
            ["scene", *names],
            [(scene, *(_cell(lengths[name].get(scene), metric, style) for name in names)) for scene in shared],
        )
        for metric, title, style, more in METRICS[:4]
    ]


def _cell(result: Result | None, metric: str, style: str) -> str:
    return shown(None if result is None else result.metric(metric), style)
