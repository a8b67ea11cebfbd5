"""Presets, what they are made of, and their variants: plain values, no heavy imports.

A run stores its `Config` as JSON next to its weights; `config_from_json` reads it back.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
import reprlib
import types
import typing
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Annotated, Any, Literal

from tidefield.errors import RunError

PROTOCOL = "strict"
"""Nothing of a held-out photograph but its camera reaches a method: neither its pixels nor its observations of sparse
points, which are placed by the training photographs alone (docs/method.md, section 11). Records without it are older:
there the points and the range of depths were also of held-out photographs."""


@dataclass(frozen=True)
class Range:
    """The least and the greatest number that a field may have, which bounds what a damaged file can ask for."""

    least: int | float
    greatest: int | float


Channels = Annotated[int, Range(1, 1024)]
Layers = Annotated[int, Range(1, 64)]
Count = Annotated[int, Range(1, 4096)]
Pixels = Annotated[int, Range(1, 4096)]
Share = Annotated[float, Range(0, 1)]
Weight = Annotated[float, Range(0, 1e6)]
Seed = Annotated[int, Range(-(1 << 63), (1 << 64) - 1)]
"""What PyTorch's generators take."""


@dataclass(frozen=True)
class EncoderConfig:
    """The feature network (Table 1)."""

    widths: tuple[Channels, Channels, Channels, Channels] = (64, 64, 128, 256)
    """Channels of the 7x7 convolution and of the three residual stages."""
    blocks: tuple[Layers, Layers, Layers] = (3, 4, 6)
    """Basic blocks of the residual stages; ResNet-34 has 3, 4, 6."""
    instance_norm: bool = True
    """Instance norms in place of ResNet's batch norms; without them features do not depend on how much is encoded."""


@dataclass(frozen=True)
class PassConfig:
    """One pass along the rays; each searches closer to where the one before found the surface."""

    stride: Pixels
    """Pixels between rays: 4 means one ray for 4 x 4 pixels."""
    samples: Count
    """M, samples along a ray."""
    feature_stride: Literal[4, 2, 1]
    """Pixels between the texels of the feature maps that this pass reads."""
    feature_channels: Channels
    """C, channels of these maps."""
    hidden: Channels
    """H, channels of the aggregated features and of the ray transformer."""


Part = Literal[
    "direction weights",
    "ray transformer",
    "target colour",
    "sparse points",
    "matched surface",
    "doubled photographs",
    "sharpening",
    "agreement",
    "density head",
]
"""Parts of a network that it can do without: the paper's, those of both, and ours."""
PARTS: dict[str, tuple[Part, ...]] = {"paper": typing.get_args(Part)[:4], "swift": typing.get_args(Part)}
"""Those that a kind of network can have."""


@dataclass(frozen=True)
class NetworkConfig:
    """A network over neighbouring views (the paper's Figure 2)."""

    kind: Literal["paper", "swift"]
    """`model.paper.PaperNetwork`, the network as printed, or `model.swift.SwiftNetwork`, ours."""
    encoder: EncoderConfig
    passes: tuple[PassConfig, ...]
    """Coarse to fine; the paper has one."""
    views: Annotated[int, Range(1, 256)]
    """N, neighbouring views of each sample."""
    heads: Channels = 4
    """Attention heads of the ray transformer."""
    harmonics_degree: Annotated[int, Range(0, 4)] = 3
    """J of eq. 8."""
    uniform_fraction: Share = 0.05
    """Share of a finer pass's samples that are spread evenly instead of where the coarser pass found the surface."""
    without: tuple[Part, ...] = ()
    """Parts that are left out. Of the paper: views count alike instead of by direction (eq. 6), densities come from
    each sample alone, colours from the neighbours alone. Of both: nothing comes from the scene's sparse points, neither
    where rays are sampled nor what depths learn from. Of ours: the surface is not matched before it is searched for,
    photographs are read at their own size only, nothing is sharpened, views that agree make no surface likelier, and
    neither do learned features."""

    def has(self, part: Part) -> bool:
        """Whether the network has a part."""
        return part in PARTS[self.kind] and part not in self.without


@dataclass(frozen=True)
class TrainConfig:
    """How the network is trained."""

    tile_px: Pixels
    """Side of the square tiles that rays are drawn in."""
    tiles: Count
    """Tiles per step."""
    crop_px: Pixels | None
    """Side of the crops of the neighbours that are encoded for a tile; None encodes whole photographs."""
    learning_rate: Share
    warm_up: Annotated[int, Range(1, 10**9)] = 50
    """Steps over which the learning rate rises."""
    unseen_weight: Weight = 1.0
    """In the loss, of pixels that fewer than two other training photographs see: little can be learned from what
    cannot be known, and its large errors drown the rest."""
    structure_weight: Weight = 0.0
    """In the loss, of 1 - SSIM of the tiles: squared errors alone leave unpredictable detail blurred."""
    depth_weight: Weight = 0.0
    """In the loss, of the sparse points' depths; added where a surface misses a point by 1%."""
    neighbours: Literal["seen", "direction"] = "seen"
    """How neighbours are ranked: by what the target sees, or by viewing direction alone, as the paper does."""


@dataclass(frozen=True)
class NerfConfig:
    """Classical NeRF, the baseline."""

    method: Literal["nerf"] = "nerf"
    coarse: Count = 64
    """Samples of the coarse pass; the fine one reads them again."""
    fine: Count = 128
    """Further samples of the fine pass."""
    depth: Layers = 8
    width: Annotated[int, Range(2, 4096)] = 256
    position_octaves: Annotated[int, Range(0, 32)] = 10
    direction_octaves: Annotated[int, Range(0, 32)] = 4
    rays: Annotated[int, Range(1, 1 << 20)] = 1024
    """Rays of a step."""
    learning_rate: Share = 5e-4
    """At the beginning; a tenth at the end."""
    density_noise: Weight = 1.0
    """Standard deviation of what is added to densities of scenes without background, while training."""


@dataclass(frozen=True)
class NerfstudioConfig:
    """One of nerfstudio's methods, the baselines, with nerfstudio's defaults."""

    method: Literal["nerfacto", "splatfacto"]
    version: str
    """Of nerfstudio."""


@dataclass(frozen=True)
class OpensplatConfig:
    """OpenSplat, a baseline, with its defaults."""

    version: str
    """Of the program."""
    method: Literal["opensplat"] = "opensplat"


@dataclass(frozen=True)
class Config:
    """All that a run needs to be repeated, besides its scene and its seed."""

    preset: str
    network: NetworkConfig
    train: TrainConfig
    method: Literal["tidefield"] = "tidefield"


ExternalConfig = NerfstudioConfig | OpensplatConfig
"""Of what a program of its own trains."""
AnyConfig = Config | NerfConfig | ExternalConfig


@dataclass(frozen=True)
class Sampling:
    """How a pixel's footprint is sampled when a view is rendered; no part of what is learned."""

    cones: bool = True
    """Read photographs where their pixels are about as large as the footprint (`data.pyramid`), not at the size that
    the scene was opened at."""
    rays_per_side: int | None = None
    """Rays of a pixel, in each direction. None is two where its footprint is much larger than the pixels of the
    photographs at the scene's size, and one elsewhere."""


USUAL_SAMPLING = Sampling()

PAPER = Config(
    preset="paper",
    network=NetworkConfig(
        kind="paper",
        encoder=EncoderConfig(),
        passes=(PassConfig(stride=1, samples=64, feature_stride=4, feature_channels=64, hidden=64),),
        views=8,
    ),
    train=TrainConfig(tile_px=8, tiles=8, crop_px=None, learning_rate=5e-4, neighbours="direction"),
)
SWIFT = Config(
    preset="swift",
    network=NetworkConfig(
        kind="swift",
        encoder=EncoderConfig(widths=(16, 16, 32, 64), blocks=(1, 1, 1), instance_norm=False),
        passes=(
            PassConfig(stride=4, samples=8, feature_stride=4, feature_channels=32, hidden=32),
            PassConfig(stride=1, samples=4, feature_stride=1, feature_channels=16, hidden=16),
        ),
        views=5,
        # Neither brings anything that can be measured there (docs/results.md, "What the paper's parts bring").
        without=("ray transformer", "target colour"),
    ),
    train=TrainConfig(
        tile_px=32,
        tiles=4,
        crop_px=96,
        learning_rate=1e-2,
        unseen_weight=0.02,
        structure_weight=3e-2,
        depth_weight=1e-4,
    ),
)
PRESETS = {"paper": PAPER, "swift": SWIFT}


@dataclass(frozen=True)
class Budget:
    """How long to train: minutes or steps."""

    minutes: float | None = None
    """Minutes of training; 10 if neither this nor --steps is given."""
    steps: int | None = None
    """Steps of training, instead of minutes."""

    def checked(self) -> Budget:
        """This budget, or ten minutes where nothing is given.

        Raises:
            RunError: both minutes and steps are given, or one that is not a number above 0.
        """
        if self.minutes is not None and self.steps is not None:
            raise RunError("both --minutes and --steps are given: expected one of them; leave one out")
        if self.steps is not None and not 1 <= self.steps < 1 << 63:
            raise RunError(f"--steps {reprlib.repr(self.steps)} was asked for: expected 1 or more; choose another")
        if self.minutes is not None and not 0 < self.minutes < math.inf:
            raise RunError(f"--minutes {self.minutes} was asked for: expected a time above 0; choose another")
        return Budget(minutes=10.0) if self.minutes is None and self.steps is None else self

    def share(self, step: int, seconds: float) -> float:
        """Share of the budget that is used, 0 to 1."""
        if self.steps is not None:
            return min(1.0, step / max(self.steps, 1))
        assert self.minutes is not None, "a budget is steps or minutes"
        return min(1.0, seconds / max(60 * self.minutes, 1e-9))


def checked_seed(seed: int) -> int:
    """The seed that --seed gives.

    Raises:
        RunError: random generators do not take it.
    """
    if not 0 <= seed < 1 << 63:
        raise RunError(f"--seed {reprlib.repr(seed)} was asked for: expected 0 to {(1 << 63) - 1}; choose another")
    return seed


def vary(config: Config, name: str) -> AnyConfig:
    """The variant of that name, for the ablation: one part changed, left out or added, or several, joined by `+`.

    Raises:
        RunError: there is none, or none of this configuration.
    """
    first, plus, rest = name.partition("+")
    if plus:
        varied = vary(config, first)
        if not isinstance(varied, Config):
            raise RunError(f"{name} was asked for: expected nothing after {first}, which has no parts; leave it out")
        return vary(varied, rest)
    if name not in VARIANTS:
        raise RunError(f"there is no variant {name}: expected one of {', '.join(VARIANTS)}")
    try:
        return VARIANTS[name](config)
    except _NotApplicable as reason:
        names = ", ".join(variants_of(config))
        raise RunError(f"{config.preset} has no variant {name}: {reason}; expected one of {names}") from None


def variants_of(config: Config) -> tuple[str, ...]:
    """The names of the variants that a configuration has, and is not itself."""
    names = []
    for name, change in VARIANTS.items():
        with contextlib.suppress(_NotApplicable):
            if change(config) != config:
                names.append(name)
    return tuple(names)


class _NotApplicable(Exception):
    """A variant of a part that a configuration does not have, or that it has already."""


def _network(config: Config, **changes: Any) -> Config:
    return dataclasses.replace(config, network=dataclasses.replace(config.network, **changes))


def _without(config: Config, part: Part) -> Config:
    if not config.network.has(part):
        raise _NotApplicable(f"it has no {part}")
    return _network(config, without=(*config.network.without, part))


def _with(config: Config, part: Part) -> Config:
    if config.network.has(part):
        raise _NotApplicable(f"it has its {part} already")
    return _network(config, without=tuple(other for other in config.network.without if other != part))


def _degree(config: Config, degree: int) -> Config:
    if not config.network.has("target colour"):
        raise _NotApplicable("it has no target colour")
    return _network(config, harmonics_degree=degree)


def _neighbours(config: Config, strategy: Literal["seen", "direction"]) -> Config:
    """Another choice of the neighbouring views, of the same network."""
    return dataclasses.replace(config, train=dataclasses.replace(config.train, neighbours=strategy))


def _weight(config: Config, field: str, weight: float) -> Config:
    """Another weight of the loss."""
    if getattr(config.train, field) == weight:
        raise _NotApplicable(f"its {field} is {weight:g} already")
    return dataclasses.replace(config, train=dataclasses.replace(config.train, **{field: weight}))


def _samples(config: Config, share: float) -> Config:
    """Another number of samples along the ray, as a share of the preset's, in all passes."""
    passes = (dataclasses.replace(one, samples=max(2, round(share * one.samples))) for one in config.network.passes)
    return _network(config, passes=tuple(passes))


VARIANTS: dict[str, Callable[[Config], AnyConfig]] = {
    "no-neighbours": lambda _: NerfConfig(),
    **{f"no-{part.replace(' ', '-')}": partial(_without, part=part) for part in typing.get_args(Part)},
    "with-ray-transformer": partial(_with, part="ray transformer"),
    "with-target-colour": partial(_with, part="target colour"),
    "with-every-part": lambda config: _with(_with(config, "ray transformer"), "target colour"),
    **{f"degree-{degree}": partial(_degree, degree=degree) for degree in (0, 1, 2, 4)},
    **{f"views-{views}": partial(_network, views=views) for views in (2, 3, 4, 5, 6, 8, 10, 12)},
    "neighbours-seen": partial(_neighbours, strategy="seen"),
    "neighbours-direction": partial(_neighbours, strategy="direction"),
    "no-depth-loss": partial(_weight, field="depth_weight", weight=0.0),
    "no-structure-loss": partial(_weight, field="structure_weight", weight=0.0),
    "unseen-alike": partial(_weight, field="unseen_weight", weight=1.0),
    "samples-half": partial(_samples, share=0.5),
    "samples-double": partial(_samples, share=2.0),
}
"""Without neighbouring views what is left is classical NeRF. The direction weights are the paper's eq. 6."""


def config_to_json(config: AnyConfig) -> dict[str, Any]:
    return dataclasses.asdict(config)


def config_from_json(data: Any, where: str = "config") -> AnyConfig:
    """The configuration of a JSON object; `where` names it in messages.

    Raises:
        RunError: a field is missing, unknown, of another type or out of its range, or two do not fit each other.
    """
    data = _convert_0_1(data)
    method = data.get("method") if isinstance(data, dict) else None
    kinds = typing.get_args(AnyConfig)
    kind = next((k for k in kinds if method in typing.get_args(typing.get_type_hints(k)["method"])), Config)
    config = from_json(kind, data, where)
    if isinstance(config, Config):
        _require_fit(config, where)
    return config


def _require_fit(config: Config, where: str) -> None:
    """Raises: RunError when sizes that depend on each other do not fit."""
    network, passes = config.network, config.network.passes
    strides, swift = [one.stride for one in passes], network.kind == "swift"
    for fits, expected in (
        (swift or len(passes) == 1, "one pass of the paper's network"),
        (strides[-1:] == [1] and not any(a % b for a, b in pairwise(strides)), "strides that divide each other, to 1"),
        (not any(config.train.tile_px % stride for stride in strides), "tiles that the strides divide"),
        (not any(one.hidden % network.heads for one in passes), "as many hidden channels for every head"),
        (not swift or all(one.hidden == one.feature_channels for one in passes), "as many hidden as feature channels"),
    ):
        if not fits:
            raise RunError(f"{where} has sizes that do not fit each other: expected {expected}; train it again")


def _convert_0_1(data: Any) -> Any:
    """A configuration that 0.1 wrote, in today's names; anything else as it is.

    Raises:
        RunError: it is of a network with a per-scene field or without neighbouring views, which 0.2 took out.
    """
    network = data.get("network") if isinstance(data, dict) else None
    if not isinstance(network, dict) or "as_printed" not in network:
        return data
    if network.get("field") is not None or not network.get("views"):
        raise RunError(
            "this run has a per-scene field (--field, no-neighbours), which Tidefield 0.2 took out: expected a run "
            "without one; train it again, or use Tidefield 0.1"
        )
    kept = {name: value for name, value in network.items() if name in ("encoder", "views", "heads", "harmonics_degree")}
    kept |= {
        "kind": "paper" if network["as_printed"] else "swift",
        "passes": network.get("stages"),
        "uniform_fraction": network.get("doubt"),
        "without": network.get("without"),
    }
    train = data.get("train")
    if isinstance(train, dict):
        train = {name: value for name, value in train.items() if name != "field_learning_rate"}
    return {**data, "network": kept, "train": train}


def from_json(kind: Any, data: Any, where: str) -> Any:
    """A value of a type from JSON: a dataclass, tuple, literal, number (also one with a `Range`), text or bool.

    Raises:
        RunError: it is something else; `where` says which value.
    """
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if dataclasses.is_dataclass(kind):
        hints = typing.get_type_hints(kind, include_extras=True)
        if not isinstance(data, dict) or set(data) != set(hints):
            wrong = set(data) ^ set(hints) if isinstance(data, dict) else type(data).__name__
            raise RunError(
                f"{where} does not fit this version ({reprlib.repr(wrong)}): expected {sorted(hints)}; train it again"
            )
        return kind(**{name: from_json(hint, data[name], f"{where}.{name}") for name, hint in hints.items()})  # type: ignore[operator]
    if origin is tuple:
        kinds = arguments[:1] * len(data) if isinstance(data, list) and arguments[-1] is ... else arguments
        if not isinstance(data, list) or len(data) != len(kinds):
            raise RunError(f"{where} is {reprlib.repr(data)}: expected a list of {len(kinds)}; train it again")
        return tuple(from_json(k, x, f"{where}[{i}]") for i, (k, x) in enumerate(zip(kinds, data, strict=True)))
    if origin in (typing.Union, types.UnionType):
        inner = next(k for k in arguments if k is not type(None))
        return None if data is None else from_json(inner, data, where)
    if origin is Annotated:
        inner, allowed = arguments
        if type(data) in (int, float) and not allowed.least <= data <= allowed.greatest:
            expected = f"{allowed.least:g} to {allowed.greatest:g}"
            raise RunError(f"{where} is {reprlib.repr(data)}: expected {expected}; train it again")
        return from_json(inner, data, where)
    if origin is Literal:
        if not any(type(data) is type(one) and data == one for one in arguments):
            raise RunError(f"{where} is {reprlib.repr(data)}: expected one of {arguments}; train it again")
        return data
    if kind is float and type(data) is int and abs(data) < 1 << 1023:  # more is no float
        return float(data)
    if type(data) is not kind:
        raise RunError(f"{where} is {reprlib.repr(data)}: expected {kind.__name__}; train it again")
    return data
