"""Whether what was measured is what was aimed at."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

from benchmarks.begun import FROM_SCRATCH, MINUTE, SECONDS, ByLength
from tidefield.compare.published import TABLE_3
from tidefield.compare.results import Result, Results
from tidefield.compare.run import ZERO_SHOT

SURVEYS = ("caliterra", "swindale", "turin_lot", "brighton_beach")
"""Where we are compared with blending, which is good there."""
SCENES = (*TABLE_3, *SURVEYS, "fern", "lego")
"""Where we are compared with Nerfacto."""
UNTRAINED = ("plane-sweep", "sparse-depth")
UNSEEN = ("caliterra", "swindale")
"""Which the shipped weights have never learned from."""
BEGUN = (*UNSEEN, "turin_lot", "fern")
"""On which lengths of training are compared."""
MINUTES, WIDTH, DEVICE = 10.0, 400, "cpu"
GAIN_DB, AHEAD_DB = 1.5, 3.0
TIMES_AS_FAST = {"nerfacto": 10.0, "paper": 20.0}
TRAINING_BYTES, FRAME_BYTES, FRAME_PX = 4e9, 6e9, [4000, 3000]
FIRST_SECONDS, FURTHER_SECONDS, VIEW_PX, GROWTH = 30.0, 10.0, [800, 600], 1.1


@dataclass(frozen=True)
class Bar:
    """What was aimed at, what came out, and whether that is enough; None if it was not measured."""

    aim: str
    result: str
    met: bool | None


@dataclass(frozen=True)
class Kept:
    """What the benchmarks left, as they wrote it; None for what was not measured."""

    speed: Mapping[str, Any] | None = None
    memory: Mapping[str, Any] | None = None
    frames: Mapping[str, Any] | None = None


Gains = Mapping[str, float | None]


@dataclass(frozen=True)
class Quality:
    """A metric, whether more of it is better, and the difference that shows in a table."""

    metric: str
    title: str
    more: bool
    style: str
    visible: float


QUALITIES = (
    Quality("psnr", "PSNR", True, "{:+.2f} dB", 0.005),
    Quality("ssim", "SSIM", True, "{:+.4f}", 0.0005),
    Quality("lpips_vgg", "LPIPS (VGG)", False, "{:+.4f}", 0.0005),
)


def judge(results: Results, kept: Kept, lengths: ByLength) -> list[Bar]:
    """Every bar. Results of other settings than those aimed at count as not measured."""

    def gain(
        name: str, others: tuple[str, ...], scenes: tuple[str, ...], more: bool = True, own: str = "tidefield"
    ) -> Gains:
        return {scene: _gain(results, scene, name, own, others, more) for scene in scenes}

    def ahead(own: str, others: tuple[str, ...], scenes: tuple[str, ...], aim: str) -> list[Bar]:
        return [
            _on_each(
                aim.format(f"{of.title} {'above' if of.more else 'below'}"),
                gain(of.metric, others, scenes, of.more, own),
                of.style,
                lambda x: x > 0,
            )
            for of in QUALITIES
        ]

    blending = gain("psnr_seen_cc", UNTRAINED, SURVEYS)
    structure = gain("ssim_seen_cc", UNTRAINED, SURVEYS)
    paper = gain("psnr_seen_cc", ("paper",), SURVEYS)
    peer = ("nerfacto",)
    return [
        _on_each("PSNR above the better floor on each survey", blending, "{:+.2f} dB", lambda x: x > 0),
        _on_each("SSIM above the better floor on each survey", structure, "{:+.4f}", lambda x: x > 0),
        _in_the_mean("PSNR above the better floor", blending, GAIN_DB),
        _on_each("PSNR not below the preset paper's on any survey", paper, "{:+.2f} dB", lambda x: x >= 0),
        *ahead("tidefield", peer, SCENES, "{} Nerfacto's on each scene"),
        _in_the_mean("PSNR above Nerfacto's, doubly seen pixels", gain("psnr_seen", peer, SCENES), AHEAD_DB),
        *ahead("zero-shot", peer, UNSEEN, "Zero-shot, {} Nerfacto's where nothing was learned"),
        *ahead("zero-shot", UNTRAINED, SCENES, "Zero-shot, {} the better floor on each scene"),
        *_of_lengths(lengths),
        *(_as_fast(results, kept.speed, other) for other in TIMES_AS_FAST),
        *_frame_times(kept.frames),
        _training_memory(results),
        _frame_memory(kept.memory),
    ]


def _gain(results: Results, scene: str, name: str, own: str, others: tuple[str, ...], more: bool) -> float | None:
    """How much better we are than the best of others; None unless all were measured as aimed."""
    values = [_aimed(results, scene, method, name) for method in (own, *others)]
    known = [value if more else -value for value in values if value is not None]
    return known[0] - max(known[1:]) if len(known) == len(values) else None


def _of_lengths(lengths: ByLength) -> list[Bar]:
    """Ten seconds are not worse than none, as far as the tables show, and a minute better than ten without weights."""

    def gains(of: Quality, length: str, other: str) -> Gains:
        sign = 1 if of.more else -1
        pairs = {scene: [lengths.get(name, {}).get(scene) for name in (length, other)] for scene in BEGUN}
        values = {
            scene: [
                result.metric(of.metric) if result is not None and _measured_as_aimed(result) else None
                for result in pair
            ]
            for scene, pair in pairs.items()
        }
        return {s: None if a is None or b is None else sign * (a - b) for s, (a, b) in values.items()}

    aims = (
        (
            "Ten seconds of training, {} not worse than zero-shot's",
            SECONDS,
            ZERO_SHOT,
            lambda of, gain: gain > -of.visible,
        ),
        (
            "One minute of training, {} better than after ten from scratch",
            MINUTE,
            FROM_SCRATCH,
            lambda of, gain: gain > 0,
        ),
    )
    return [
        _on_each(aim.format(of.title), gains(of, length, other), of.style, partial(enough, of))
        for aim, length, other, enough in aims
        for of in QUALITIES
    ]


def _aimed(results: Results, scene: str, method: str, name: str) -> float | None:
    result = results.by.get((scene, method))
    if result is None:
        return None
    trained = "train" not in result.process or result.process.get("settings", {}).get("minutes") == MINUTES
    return result.metric(name) if trained and _measured_as_aimed(result) else None


def _measured_as_aimed(result: Result) -> bool:
    """At the width and on the device that are aimed at, however long it was trained."""
    settings = result.process.get("settings", {})
    return (settings.get("width"), settings.get("device")) == (WIDTH, DEVICE)


def _unmeasured(aim: str, values: Gains) -> Bar | None:
    missing = [scene for scene, value in values.items() if value is None]
    return Bar(aim, f"not measured on {', '.join(missing)}", None) if missing else None


def _on_each(aim: str, values: Gains, style: str, enough: Callable[[float], bool]) -> Bar:
    if unmeasured := _unmeasured(aim, values):
        return unmeasured
    worst, scene = min((value, scene) for scene, value in values.items() if value is not None)
    return Bar(aim, f"least: {style.format(worst)} ({scene})", enough(worst))


def _in_the_mean(aim: str, gains: Gains, least: float) -> Bar:
    aim = f"{aim}, by {least} dB in the mean"
    if unmeasured := _unmeasured(aim, gains):
        return unmeasured
    known = [gain for gain in gains.values() if gain is not None]
    mean = sum(known) / len(known)
    return Bar(aim, f"{mean:+.2f} dB", mean >= least)


def _as_fast(results: Results, speed: Mapping[str, Any] | None, other: str) -> Bar:
    """Of paper by the benchmark of speed, which measures both in one run, of others by evaluations on each scene."""
    times = TIMES_AS_FAST[other]
    aim = f"swift renders {times:.0f} times as many rays per second as {other}"
    if other == "paper":
        if speed is None or speed["device"] != DEVICE:
            return Bar(aim, "not measured on a CPU", None)
        ratio = speed["ratios"]["rendering"]
        return Bar(aim, f"{ratio:.1f} times", ratio >= times)

    def rate(scene: str, method: str) -> float | None:
        there = _aimed(results, scene, method, "psnr") is not None
        return results.by[scene, method].evaluation["rays_per_second"] if there else None

    rates = {scene: (rate(scene, "tidefield"), rate(scene, other)) for scene in SCENES}
    ratios = {scene: own / theirs if own and theirs else None for scene, (own, theirs) in rates.items()}
    return _on_each(aim, ratios, "{:.1f} times", lambda ratio: ratio >= times)


def _frame_times(frames: Mapping[str, Any] | None) -> list[Bar]:
    width, height = VIEW_PX
    first = f"From a scene on disk to the first {width} x {height} view, zero-shot, in {FIRST_SECONDS:.0f} s"
    further = f"Every further view in {FURTHER_SECONDS:.0f} s"
    growth = f"A view takes at most {GROWTH:.0%} of the time however many photographs there are"
    if frames is None or (frames["device"], frames["size_px"]) != (DEVICE, VIEW_PX):
        return [Bar(aim, "not measured on a CPU", None) for aim in (first, further, growth)]
    begun, more = frames["first"]["seconds"], frames["further_seconds"]
    seconds = [frames["by_photographs"][count] for count in sorted(frames["by_photographs"], key=int)]
    ratio = max(seconds) / seconds[0]
    return [
        Bar(first, f"{begun:.1f} s", begun < FIRST_SECONDS),
        Bar(further, f"{more:.1f} s", more < FURTHER_SECONDS),
        Bar(growth, f"{ratio:.0%}", ratio <= GROWTH),
    ]


def _training_memory(results: Results) -> Bar:
    aim = f"Training at {WIDTH} px stays under {TRAINING_BYTES / 1e9:.0f} GB"
    ours = [(scene, method) for scene in SURVEYS for method in ("tidefield", "paper")]
    peaks = [
        (results.by[pair].peak_bytes("train"), pair) for pair in ours if _aimed(results, *pair, "psnr") is not None
    ]
    known = [(peak, pair) for peak, pair in peaks if peak is not None]
    if len(known) < len(ours):
        return Bar(aim, "not measured with both presets on all surveys", None)
    peak, (scene, method) = max(known)
    return Bar(aim, f"most: {peak / 1e9:.2f} GB ({method} on {scene})", peak < TRAINING_BYTES)


def _frame_memory(memory: Mapping[str, Any] | None) -> Bar:
    aim = f"Rendering a frame of {FRAME_PX[0]} x {FRAME_PX[1]} px stays under {FRAME_BYTES / 1e9:.0f} GB"
    if memory is None or memory["size_px"] != FRAME_PX or memory["device"] != DEVICE:
        return Bar(aim, "not measured at this size on a CPU", None)
    peak = memory["peak_memory_bytes"]
    return Bar(aim, f"{peak / 1e9:.2f} GB ({memory['preset']})", peak < FRAME_BYTES)
