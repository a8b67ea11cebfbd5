"""An endless stream of scenes to learn from: procedural tidal flats, and real ones.

Scene k of a seed is always the same. A few are at hand at a time; after so many steps the oldest makes room for the
next, which another process has made meanwhile. Procedural or real, a scene comes with hardships of its own: few sparse
points, photographs that are a little off, and exposures that are not quite evened out.
"""

from __future__ import annotations

import math
import shutil
import signal
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from multiprocessing import get_context
from multiprocessing.pool import AsyncResult
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from torch import Tensor

from tidefield.data.depth_prior import DepthPriors
from tidefield.data.load import load_scene
from tidefield.data.scene import Scene
from tidefield.geometry.cameras import Cameras
from tidefield.synthetic import CATEGORIES, Flight, Survey, make_survey, write_survey

AT_HAND = 8
"""Scenes at a time."""
STEPS_EACH = 200
"""Steps after which the oldest makes room."""
REAL_SHARE = 0.5
"""Of the scenes, where there are real ones."""
WIDTHS = (256, 400)
"""Of real scenes' photographs: each is there at both."""
MISPOSED_DEG = 0.6
SPARSE_SHARE = 0.25
"""Of the scenes with few points, so that depth is learned from what the views see, too."""
SPARSE_POINTS = 0.01, 0.3
"""Shares of the points that these have."""
POINTLESS_SHARE = 0.12
"""Of the scenes without any points, as some arrive: what the views see must do."""
SHIFTED_SHARE = 0.25
"""Of the scenes whose photographs are off, so that views are averaged where they do not quite fit."""
SHIFT_PX = 0.2, 1.0
"""Standard deviations of that, pixels: one for each of these scenes."""
UNEVEN_SHARE = 0.25
"""Of the scenes whose exposures are told wrong, so that no view is preferred for its colours."""
UNEVEN = 0.01, 0.08
"""Standard deviations of the logarithms of these: one for each of these scenes."""
RECOLOURED_SHARE = 0.5
"""Of the scenes with their colours' channels in a random order, so that little is learned of mud being brown."""


@dataclass(frozen=True)
class Recipe:
    """What a procedural scene is made of; equal recipes make equal scenes.

    Attributes:
        category, seed, views, width, flight: of the survey.
        misposed: photographs whose attitude is told wrong, as structure from motion now and then does.
    """

    category: str
    seed: int
    views: int
    width: int
    flight: Flight
    misposed: tuple[int, ...]


@dataclass(frozen=True)
class Slot:
    """What is at hand under a number.

    Attributes:
        recipe: of a procedural scene; None for a real one.
        choice: which of the real ones, 0 to 1.
        points_share: of the sparse points that are known.
        shift_px: standard deviation of how far its photographs are off.
        uneven: standard deviation of the logarithms of its exposures' errors.
        channels: the order of its colours' channels.
        seed: of what is random in this.
    """

    recipe: Recipe | None
    choice: float
    points_share: float
    shift_px: float
    uneven: float
    channels: tuple[int, ...]
    seed: int


@dataclass(frozen=True)
class Drawn:
    """A scene with what training asks of it; cameras are where the network is."""

    scene: Scene
    surfaces: DepthPriors
    cameras: Cameras


@cache  # asked for several at every step
def slot(seed: int, number: int, real_share: float) -> Slot:
    """Scene `number` of a seed, and its hardships."""
    random = np.random.default_rng([seed, number, 78])
    made = recipe(seed, number) if random.random() >= real_share else None
    shares = (SHIFTED_SHARE, UNEVEN_SHARE, RECOLOURED_SHARE)
    shifted, uneven, recoloured = (random.random() < share for share in shares)
    kind, few = random.random(), math.exp(random.uniform(*np.log(SPARSE_POINTS)))
    points_share = 0.0 if kind < POINTLESS_SHARE else few if kind < POINTLESS_SHARE + SPARSE_SHARE else 1.0
    return Slot(
        recipe=made,
        choice=float(random.random()),
        points_share=points_share,
        shift_px=float(random.uniform(*SHIFT_PX)) if shifted else 0.0,
        uneven=float(random.uniform(*UNEVEN)) if uneven else 0.0,
        channels=tuple(random.permutation(3).tolist()) if recoloured else (0, 1, 2),
        seed=int(random.integers(1 << 31)),
    )


def recipe(seed: int, number: int) -> Recipe:
    """Procedural scene `number` of a seed: all that deployment may meet, drawn at random."""
    random = np.random.default_rng([seed, number, 77])
    views = int(random.integers(18, 32))
    flight = Flight(
        altitude_m=float(math.exp(random.uniform(math.log(18), math.log(110)))),
        forward_overlap=float(random.uniform(0.6, 0.88)),
        side_overlap=float(random.uniform(0.5, 0.8)),
        focal_ratio=float(random.uniform(0.6, 1.2)),
        aspect=float(random.choice([0.5625, 0.667, 0.75])),
        jitter_deg=float(random.uniform(0.5, 4.0)),
        oblique_share=float(random.choice([0.0, 0.0, 0.3, 0.8])),
        exposure_spread=float(random.choice([0.0, 0.05, 0.15, 0.3])),
        water_motion=float(random.choice([0.0, 2.0])),
        sun_elevation_deg=float(random.uniform(20, 70)),
        wetness=float(random.uniform(0, 1)),
    )
    misposed = tuple(int(k) for k in random.choice(views, int(random.random() < 0.3), replace=False))
    category = str(random.choice(list(CATEGORIES)))
    return Recipe(category, int(random.integers(1 << 31)), views, int(random.choice([224, 288, 352])), flight, misposed)


def make(given: Recipe, folder: Path) -> None:
    """Write a recipe's scene; the folder appears when it is complete."""
    torch.set_num_threads(1)
    half = folder.with_name(f".{folder.name}.partial")
    shutil.rmtree(half, ignore_errors=True)
    survey = make_survey(given.category, given.seed, given.views, given.width, given.flight)
    write_survey(misposed(survey, given), half, suffix=".jpg")
    half.rename(folder)


def misposed(survey: Survey, given: Recipe) -> Survey:
    """The survey as structure from motion tells it that got some attitudes wrong."""
    pose = survey.cameras.T_world_camera.clone()
    random = np.random.default_rng([given.seed, 5])
    for index in given.misposed:
        axis = random.normal(size=3)
        turn = Rotation.from_rotvec(math.radians(MISPOSED_DEG) * axis / np.linalg.norm(axis))
        pose[index, :, :3] = pose[index, :, :3] @ torch.from_numpy(turn.as_matrix()).to(pose)
    return replace(survey, cameras=replace(survey.cameras, T_world_camera=pose))


def _end_quietly() -> None:
    """A process that is told to end ends; imported libraries would print where it stood."""
    signal.signal(signal.SIGTERM, signal.SIG_DFL)


@runtime_checkable
class Source(Protocol):
    """Where scenes to learn from come from."""

    def draw(self, step: int, generator: torch.Generator) -> Drawn:
        """A scene for a step; the same for the same step and state of the generator."""
        ...


def turned(drawn: Drawn, quaternion: Float[Tensor, "4"]) -> Drawn:
    """The same scene with other axes for the network; the quaternion need not be of unit length."""
    turn = torch.from_numpy(Rotation.from_quat(quaternion.numpy()).as_matrix())
    pose = drawn.cameras.T_world_camera
    return replace(drawn, cameras=replace(drawn.cameras, T_world_camera=turn.to(pose) @ pose))


class Stream:
    """Draws scenes.

    Args:
        folder: where the procedural ones lie while they are at hand.
        real: folders of scenes of which only the training photographs are learned from.
        seed: of the procedural ones.
        device: where the network is.
    """

    def __init__(self, folder: Path, real: Sequence[Path], seed: int, device: torch.device) -> None:
        self.folder, self.seed, self.device = folder, seed, device
        self.real = [load_scene(path, width=width) for path in real for width in WIDTHS]
        self.pool: dict[int, Drawn] = {}
        self.coming: dict[int, AsyncResult[None]] = {}
        # A process, because making a scene keeps a core busy; a new one, because a fork of one with threads may hang.
        self.maker = get_context("spawn").Pool(1, _end_quietly)
        folder.mkdir(parents=True, exist_ok=True)

    def __enter__(self) -> Stream:
        return self

    def __exit__(self, *error: object) -> None:
        self.maker.terminate()
        self.maker.join()

    def draw(self, step: int, generator: torch.Generator) -> Drawn:
        """A scene for a step, the same for the same step, seed and state of the generator.

        It is turned at random: directions are the world's, and nothing may be learned of where north is.
        """
        first = step // STEPS_EACH
        number = first + int(torch.randint(AT_HAND, (), generator=generator))
        for gone in [k for k in {*self.pool, *self.coming} if k < first]:
            self.pool.pop(gone, None)
            if gone in self.coming:  # nobody drew it
                self.coming.pop(gone).get()
            shutil.rmtree(self._path(gone), ignore_errors=True)
        for soon in range(first, first + AT_HAND + 1):
            self._order(soon)
        if number not in self.pool:
            own = self._slot(number)
            scene = self.real[int(own.choice * len(self.real))] if own.recipe is None else self._made(number)
            self.pool[number] = self._with_hardships(scene, own)
        return turned(self.pool[number], torch.randn(4, generator=generator))

    def _slot(self, number: int) -> Slot:
        return slot(self.seed, number, REAL_SHARE if self.real else 0.0)

    def _made(self, number: int) -> Scene:
        if number in self.coming:
            self.coming.pop(number).get()
        return load_scene(self._path(number), cache=self._path(number) / "decoded")  # forgotten with the scene

    def _order(self, number: int) -> None:
        """Have a procedural scene made, unless it is there or coming."""
        wanted = self._slot(number).recipe
        if wanted is not None and number not in self.coming and not self._path(number).exists():
            self.coming[number] = self.maker.apply_async(make, (wanted, self._path(number)))

    def _path(self, number: int) -> Path:
        return self.folder / f"{self.seed}-{number:06d}"

    def _with_hardships(self, scene: Scene, own: Slot) -> Drawn:
        """A scene with what makes it harder; the loss is told of all points that were observed."""
        random = np.random.default_rng(own.seed)
        off = torch.from_numpy(random.normal(scale=own.shift_px, size=(len(scene.names), 2))).float()
        light = torch.from_numpy(np.exp(random.normal(scale=own.uneven, size=(len(scene.names), 1)))).float()
        principal, gain = scene.cameras.principal_px + off, scene.cameras.gain[:, own.channels] * light
        cameras = replace(scene.cameras, principal_px=principal, gain=gain)
        known = scene.points if own.points_share else None
        if known is not None and own.points_share < 1:
            known = known.subset(torch.from_numpy(random.random(len(known.xyz_world)) < own.points_share))
        photographs = scene.photographs
        if own.channels != (0, 1, 2):
            photographs = replace(photographs, colours=tuple(c[..., own.channels] for c in photographs.colours))
        hard = replace(scene, cameras=cameras, photographs=photographs, points=known)
        return Drawn(hard, DepthPriors(hard, scene.points), cameras.to(self.device))
