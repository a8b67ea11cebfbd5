"""Tables of an ablation: the effect of leaving out or changing one part, next to the effect of other seeds.

A variant is compared with the whole network, or, if it changes several parts, with the variant that changes all but
the last of them: `no-sparse-points+no-agreement` with `no-sparse-points`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean

from scipy.special import stdtrit

from tidefield.compare.results import Result, Results
from tidefield.compare.run import WHOLE, Settings, of_seed, variant_and_seed
from tidefield.compare.tables import NOTHING, Table, shown, write_figures, write_tables
from tidefield.config import PRESETS, variants_of

LEAST_DB = 0.05
"""A smaller difference counts as noise, even if seeds happen to agree better."""
CONFIDENCE = 0.95
"""That a larger difference is none of the seeds."""
WITHIN = "within the noise"
PSNR = "psnr_seen_cc"
_METRICS = ((PSNR, "PSNR, dB", ".2f"), ("ssim_seen_cc", "SSIM", ".4f"), ("flip_seen_cc", "FLIP", ".4f"))


@dataclass(frozen=True)
class Difference:
    """PSNR of a variant minus that of what it is a variant of, dB.

    Attributes:
        mean: of all seeds.
        error: its standard error, from how far results of one variant with several seeds are apart, on all scenes
            together; None where each has one seed.
        freedom: degrees of freedom of that error.
    """

    mean: float
    error: float | None
    freedom: int

    @property
    def effect(self) -> str:
        """Better, worse or within the noise."""
        noise = 0.0 if self.error is None else self.error * float(stdtrit(self.freedom, 0.5 + CONFIDENCE / 2))
        if abs(self.mean) <= max(LEAST_DB, noise):
            return WITHIN
        return "better" if self.mean > 0 else "worse"

    def __str__(self) -> str:
        return f"{self.mean:+.2f}" + ("" if self.error is None else f" ± {self.error:.2f}")


def variants(chosen: Sequence[str], preset: str, seeds: int) -> tuple[str, ...]:
    """The whole network and its variants, all that the preset has where none is chosen, once with each seed.

    Variants of several parts come with those that they are compared with.
    """
    names = {WHOLE: None}
    for name in chosen or variants_of(PRESETS[preset]):
        parts = name.split("+")
        names |= dict.fromkeys("+".join(parts[:count]) for count in range(1, len(parts) + 1))
    return tuple(of_seed(name, seed) for seed in range(seeds) for name in names)


def ablation_tables(results: Results) -> list[Table]:
    """One table of all scenes for each network that has variants."""
    runs = _by_variant(results)
    groups: dict[str, list[str]] = {}
    for name in _names(runs):
        if name != WHOLE:
            groups.setdefault(_base(name), []).append(name)
    return [_table(runs, base, names) for base, names in groups.items()]


def summarise(results: Results) -> list[str]:
    """What the tables show together, as sentences: which parts matter, and which bring nothing."""
    runs = _by_variant(results)
    noise, groups = _noise(runs), dict[str, list[str]]()
    for name in _names(runs):
        differences = (_difference(of, name, noise) for of in runs.values())
        found = {one.effect for one in differences if one is not None}
        beyond = found - {WITHIN}
        if found and len(beyond) < 2:
            groups.setdefault(next(iter(beyond), WITHIN), []).append(name)
    within = f"{LEAST_DB:g} dB" + ("" if noise is None else f" or the noise ({CONFIDENCE:.0%})")
    sentences = {
        "worse": "Worse, and nowhere better",
        "better": "Better, and nowhere worse",
        WITHIN: f"Within {within} on all scenes, so that no effect was measured",
    }
    found = [f"{sentence}: {', '.join(groups[effect])}." for effect, sentence in sentences.items() if effect in groups]
    if noise is None:
        once = "All were trained with one seed: how far trainings are apart was not measured; a difference may be that."
        return [*found, once] if found else []
    return [
        *found,
        f"The noise, {noise.psnr:.3f} dB of a training, is how far those with other seeds are apart "
        f"({noise.freedom} degrees of freedom): {', '.join(noise.scenes)}.",
    ]


def write_ablation(results: Results, settings: Settings, out: Path) -> list[Path]:
    """Write the tables and figures of an ablation, complete or not, over older ones.

    Returns:
        The files.
    """
    tables = ablation_tables(results)
    return [
        *write_tables("ablation", "Ablation", tables, summarise(results), results, settings, out),
        write_figures("ablation", results, settings, out),
    ]


_Runs = dict[str, list[Result]]
"""The runs of each variant on one scene, one for each seed; of all variants, in the order of the results."""


def _by_variant(results: Results) -> dict[str, _Runs]:
    """What was measured, by scene, in the order of the results."""
    there = {method for _, method in results.by}
    names = dict.fromkeys(variant_and_seed(method)[0] for method in results.methods if method in there)
    measured = {scene for scene, _ in results.by}
    runs: dict[str, _Runs] = {s: {name: [] for name in names} for s in results.scenes if s in measured}
    for scene, of in runs.items():
        for method in results.methods:
            if (scene, method) in results.by:
                of[variant_and_seed(method)[0]].append(results.by[scene, method])
    return runs


def _names(runs: Mapping[str, _Runs]) -> list[str]:
    return list(dict.fromkeys(name for of in runs.values() for name in of))


def _base(name: str) -> str:
    return name.rpartition("+")[0] or WHOLE


@dataclass(frozen=True)
class _Noise:
    """How far results of one variant on one scene with different seeds are apart, all of them together.

    Seeds are few: those of one scene would show its own noise less well than those of all scenes show the usual one.

    Attributes:
        psnr: standard deviation of one training, dB.
        freedom: its degrees of freedom.
        scenes: that have several seeds of a variant.
    """

    psnr: float
    freedom: int
    scenes: tuple[str, ...]


def _noise(runs: Mapping[str, _Runs]) -> _Noise | None:
    """The noise of trainings; None where each has one seed."""
    squares, freedom, scenes = 0.0, 0, list[str]()
    for scene, of in runs.items():
        for name in of:
            values = _values(of, name)
            if len(values) > 1:
                squares += sum((value - fmean(values)) ** 2 for value in values)
                freedom += len(values) - 1
                scenes.append(scene)
    return _Noise(math.sqrt(squares / freedom), freedom, tuple(dict.fromkeys(scenes))) if freedom else None


def _difference(runs: _Runs, name: str, noise: _Noise | None) -> Difference | None:
    """PSNR against what it is a variant of; None where either was not measured, and for the whole network."""
    if name == WHOLE:
        return None
    own, other = (_values(runs, each) for each in (name, _base(name)))
    if not own or not other:
        return None
    mean = fmean(own) - fmean(other)
    if noise is None:
        return Difference(mean, None, 0)
    return Difference(mean, noise.psnr * math.sqrt(1 / len(own) + 1 / len(other)), noise.freedom)


def _values(runs: _Runs, name: str) -> list[float]:
    values = (run.metric(PSNR) for run in runs.get(name, ()))
    return [value for value in values if value is not None]


def _table(runs: Mapping[str, _Runs], base: str, names: Sequence[str]) -> Table:
    """What variants change: PSNR on each scene, and means over the scenes of a variant of what else is measured, speeds
    relative to those of the network that it is a variant of."""
    noise = _noise(runs)

    def row(name: str) -> list[str]:
        counts = [len(of[name]) for of in runs.values() if of.get(name)] or [0]
        cells = [name, "-".join(map(str, dict.fromkeys((min(counts), max(counts)))))]
        for of in runs.values():
            found = _difference(of, name, noise) if name != base else None
            value = _mean(_values(of, name))
            effect = NOTHING if found is None else f"{found}{', noise' if found.effect == WITHIN else ''}"
            cells.append(shown(value, "{:.2f}") if name == base else effect)
        both = [of for of in runs.values() if of.get(name) and of.get(base)]

        def means(measure: Callable[[Result], float | None]) -> Iterator[float | None]:
            """Over these scenes, of the variant and of what it is a variant of."""
            for each in (name, base):
                yield _mean([_mean([measure(run) for run in of[each]]) for of in both])

        for metric, _, style in _METRICS:
            value, usual = means(lambda run, metric=metric: run.metric(metric))
            if name == base or value is None or usual is None:
                cells.append(shown(value, f"{{:{style}}}"))
            else:
                cells.append(f"{value - usual:+{style}}")
        for speed in (_steps_per_minute, lambda run: run.evaluation["rays_per_second"]):
            value, usual = means(speed)
            cells.append(NOTHING if value is None or not usual else f"{value / usual:.2f}")
        return cells

    budgets = {_budget(run) for of in runs.values() for name in (base, *names) for run in of.get(name, ())}
    title = f"Of {base}: {' or '.join(sorted(budgets))}, doubly seen pixels, after the colour fit"
    columns = ["variant", "seeds", *runs, *(f"mean: {metric}" for _, metric, _ in _METRICS)]
    return Table(title, [*columns, "training, times as fast", "rendering, times as fast"], [*map(row, (base, *names))])


def _mean(values: Sequence[float | None]) -> float | None:
    """Of those that were measured; None where none was."""
    known = [value for value in values if value is not None]
    return fmean(known) if known else None


def _steps_per_minute(run: Result) -> float | None:
    steps, seconds = run.trained("steps"), run.trained("seconds")
    return 60 * steps / seconds if steps is not None and seconds else None


def _budget(run: Result) -> str:
    settings = run.process.get("settings", {})
    minutes, start = settings.get("minutes"), " from random weights" if settings.get("from_scratch") else ""
    return (f"{minutes:g} min" if minutes is not None else f"{settings.get('steps')} steps") + start
