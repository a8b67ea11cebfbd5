"""Variants of a preset, each with one part changed or left out, for the ablation.

Plain values and no heavy imports, like the configurations.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

from tidefield.config import AnyConfig, Config, NerfConfig, Part
from tidefield.errors import RunError

VIEWS = (2, 3, 4, 5, 6, 8, 10, 12)
DEGREES = (0, 1, 2, 3, 4)
SAMPLES = {"half": 0.5, "double": 2.0}
"""Shares of the preset's samples along the ray, in all passes."""


def vary(config: Config, name: str) -> AnyConfig:
    """The variant of that name.

    Raises:
        RunError: there is none.
    """
    if name not in VARIANTS:
        raise RunError(f"there is no variant {name}: expected one of {', '.join(VARIANTS)}")
    return VARIANTS[name](config)


def _network(config: Config, **changes: Any) -> Config:
    return replace(config, network=replace(config.network, **changes))


def _without(config: Config, part: Part) -> Config:
    return _network(config, without=(*config.network.without, part))


def _samples(config: Config, share: float) -> Config:
    passes = (replace(one, samples=max(2, round(share * one.samples))) for one in config.network.passes)
    return _network(config, passes=tuple(passes))


VARIANTS: dict[str, Callable[[Config], AnyConfig]] = {
    "no-neighbours": lambda _: NerfConfig(),
    "no-direction-weights": partial(_without, part="direction weights"),
    "no-ray-transformer": partial(_without, part="ray transformer"),
    "no-target-colour": partial(_without, part="target colour"),
    **{f"degree-{degree}": partial(_network, harmonics_degree=degree) for degree in DEGREES},
    **{f"views-{views}": partial(_network, views=views) for views in VIEWS},
    **{f"samples-{name}": partial(_samples, share=share) for name, share in SAMPLES.items()},
}
"""Without neighbouring views what is left is classical NeRF. The direction weights are the paper's eq. 6."""
