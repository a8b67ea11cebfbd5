"""An endless stream of scenes to learn from: procedural tidal flats, and real ones.

Scene k of a seed is always the same. A pool of a few scenes is drawn from; every so many steps the
oldest is replaced by the next one, which another process has made meanwhile. Procedural or real, each scene is
augmented: few sparse points, photographs that are a little misaligned, exposures that are not quite corrected.
"""

from __future__ import annotations

import math
import os
import shutil
from collections.abc import Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import cache
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from torch import Tensor

from tidefield.config import Config
from tidefield.data.depth_prior import DepthPriors
from tidefield.data.load import at_twice_the_size, at_width, load_scene
from tidefield.data.matching import MATCHED_PX, Matcher
from tidefield.data.pyramid import Pyramid
from tidefield.data.scene import Scene
from tidefield.geometry.cameras import Cameras
from tidefield.machine import cores
from tidefield.processes import start_worker
from tidefield.synthetic import CATEGORIES, Flight, Survey, make_survey, write_survey

POOL_SIZE = 8
"""Scenes that are drawn from at a time."""
PRIOR_BYTES = 500_000_000
"""Of the depth priors of one of them: a real one may have thousands of photographs."""
STEPS_EACH = 200
"""Steps after which the oldest scene is replaced."""
CORES_PER_MAKER = 4
"""Cores for each process that makes scenes, a few ahead: making one takes longer than a GPU's steps until the next."""
REAL_SHARE = 0.5
"""Share of real scenes, where there are some."""
WIDTHS = (200, 280, 400, 560, 800, 1600)
"""Of the photographs of real scenes, pixels: each scene takes part at those that its files have."""
WHOLE_WIDTHS = (200, 280, 400)
"""The same for networks that encode photographs whole, of which larger ones would not fit into memory."""
MISPOSED_DEG = 0.6
"""Error of attitudes that structure from motion got wrong."""
SPARSE_SHARE = 0.25
"""Share of the scenes with few points, so that depth is learned from the views, too."""
SPARSE_POINTS = 0.01, 0.3
"""Range of the shares of points that these keep."""
POINTLESS_SHARE = 0.12
"""Share of the scenes without points: depth comes from the views alone."""
SHIFTED_SHARE = 0.25
"""Share of the scenes with misaligned photographs, so that views are averaged where they do not quite fit."""
SHIFT_PX = 0.2, 1.0
"""Range of the standard deviations of the misalignment, pixels."""
EXPOSURE_ERROR_SHARE = 0.25
"""Share of the scenes with wrong exposures, so that no view is preferred for its colours."""
EXPOSURE_ERROR = 0.01, 0.08
"""Range of the standard deviations of the logarithms of their gains."""
RECOLOURED_SHARE = 0.5
"""Share of the scenes with their colour channels in a random order, so that brown is not learned as a rule."""


@dataclass(frozen=True)
class Recipe:
    """Parameters of a procedural survey, and which of its photographs have a wrong attitude, as structure from motion
    sometimes gives; equal recipes make equal scenes."""

    category: str
    seed: int
    views: int
    width: int
    flight: Flight
    misposed: tuple[int, ...]


@dataclass(frozen=True)
class Draw:
    """Which scene a number stands for, and its augmentation.

    Attributes:
        recipe: of a procedural scene; None for a real one.
        choice: which of the real scenes, 0 to 1.
        points_share: share of the sparse points that are kept.
        shift_px: standard deviation of the misalignment of its photographs.
        exposure_error: standard deviation of the logarithms of the errors of its gains.
        channels: the order of its colours' channels.
        seed: of the augmentation.
    """

    recipe: Recipe | None
    choice: float
    points_share: float
    shift_px: float
    exposure_error: float
    channels: tuple[int, ...]
    seed: int


@dataclass(frozen=True)
class Drawn:
    """A scene with its depth priors, and the cameras that the network is given.

    `doubled` is the scene at twice the size, where its files have as much and the network reads it.
    """

    scene: Scene
    priors: DepthPriors
    cameras: Cameras
    doubled: Scene | None = None


@cache  # called several times at every step
def describe_draw(seed: int, number: int, real_share: float) -> Draw:
    """Scene `number` of a seed, and its augmentation."""
    random = np.random.default_rng([seed, number, 78])
    made = recipe(seed, number) if random.random() >= real_share else None
    shares = (SHIFTED_SHARE, EXPOSURE_ERROR_SHARE, RECOLOURED_SHARE)
    shifted, wrong_exposure, recoloured = (random.random() < share for share in shares)
    kind, few = random.random(), math.exp(random.uniform(*np.log(SPARSE_POINTS)))
    points_share = 0.0 if kind < POINTLESS_SHARE else few if kind < POINTLESS_SHARE + SPARSE_SHARE else 1.0
    return Draw(
        recipe=made,
        choice=float(random.random()),
        points_share=points_share,
        shift_px=float(random.uniform(*SHIFT_PX)) if shifted else 0.0,
        exposure_error=float(random.uniform(*EXPOSURE_ERROR)) if wrong_exposure else 0.0,
        channels=tuple(random.permutation(3).tolist()) if recoloured else (0, 1, 2),
        seed=int(random.integers(1 << 31)),
    )


def recipe(seed: int, number: int) -> Recipe:
    """Procedural scene `number` of a seed: everything users may bring, drawn at random."""
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


def _take_one_core() -> None:
    torch.set_num_threads(1)


def make(given: Recipe, folder: Path) -> None:
    """Write a recipe's scene; the folder appears when it is complete."""
    half = folder.with_name(f".{folder.name}.partial")
    shutil.rmtree(half, ignore_errors=True)
    survey = make_survey(given.category, given.seed, given.views, given.width, given.flight)
    write_survey(misposed(survey, given), half, suffix=".jpg", truth=False)
    half.rename(folder)


def misposed(survey: Survey, given: Recipe) -> Survey:
    """The survey as structure from motion gives it, with some attitudes wrong."""
    pose = survey.cameras.T_world_camera.clone()
    random = np.random.default_rng([given.seed, 5])
    for index in given.misposed:
        axis = random.normal(size=3)
        turn = Rotation.from_rotvec(math.radians(MISPOSED_DEG) * axis / np.linalg.norm(axis))
        pose[index, :, :3] = pose[index, :, :3] @ torch.from_numpy(turn.as_matrix()).to(pose)
    return replace(survey, cameras=replace(survey.cameras, T_world_camera=pose))


def rotate(drawn: Drawn, quaternion: Float[Tensor, "4"]) -> Drawn:
    """Rotate the world axes of a scene for the network; the quaternion need not be of unit length."""
    turn = torch.from_numpy(Rotation.from_quat(quaternion.numpy()).as_matrix())
    pose = drawn.cameras.T_world_camera
    return replace(drawn, cameras=replace(drawn.cameras, T_world_camera=turn.to(pose) @ pose))


def at_several_widths(root: Path, widths: Sequence[int]) -> list[Scene]:
    """Load a real scene at each of the widths that its files have; at its own if it has none of them."""
    largest = load_scene(root, width=max(widths))
    own = int(largest.cameras.size_px[:, 0].max())
    return [at_width(largest, width) for width in widths if width < own] + [largest]


class Stream:
    """Draws scenes from a pool that is renewed as training goes on.

    Args:
        folder: for the procedural scenes in the pool.
        real: folders of real scenes; only their training photographs are learned from.
        seed: of the procedural scenes.
        config: of the network that learns.
    """

    def __init__(self, folder: Path, real: Sequence[Path], seed: int, config: Config) -> None:
        self.folder, self.seed = folder, seed
        widths = WHOLE_WIDTHS if config.train.crop_px is None else WIDTHS
        self.real = [scene for path in real for scene in at_several_widths(path, widths)]
        self.network = config.network
        self.pool: dict[int, Drawn] = {}
        self.pending: dict[int, Future[None]] = {}
        together = int(os.environ.get("LOCAL_WORLD_SIZE", "1"))  # processes of torchrun on this machine
        self.makers = min(POOL_SIZE, max(1, cores() // (CORES_PER_MAKER * together)))
        # Processes, because making a scene keeps a core busy; spawned, because forking one with threads may hang.
        self.maker = ProcessPoolExecutor(self.makers, get_context("spawn"), start_worker, (_take_one_core,))
        folder.mkdir(parents=True, exist_ok=True)
        # Of a training that was ended: some may never be drawn.
        self.left = {int(path.name.split("-")[1]) for path in folder.glob(f"{seed}-*") if path.name[-6:].isdigit()}

    def __enter__(self) -> Stream:
        return self

    def __exit__(self, *error: object) -> None:
        # Scenes that are being made are completed: ending a process that holds a lock of the pool's may hang.
        self.maker.shutdown(cancel_futures=True)

    def draw(self, step: int, generator: torch.Generator, device: torch.device | str = "cpu") -> Drawn:
        """A scene for a step, the same for the same step, seed and state of the generator.

        Its axes are rotated at random: directions are the world's, and north must mean nothing. Its photographs are
        matched on the device.
        """
        first = step // STEPS_EACH
        number = first + int(torch.randint(POOL_SIZE, (), generator=generator))
        for gone in [k for k in {*self.pool, *self.pending, *self.left} if k < first]:
            self.left.discard(gone)
            self.pool.pop(gone, None)
            if gone in self.pending:  # made, but never drawn
                self.pending.pop(gone).result()
            shutil.rmtree(self._path(gone), ignore_errors=True)
        for soon in range(first, first + POOL_SIZE + self.makers):
            self._order(soon)
        if number not in self.pool:
            own = self._describe(number)
            scene = self.real[int(own.choice * len(self.real))] if own.recipe is None else self._made(number)
            self.pool[number] = self._augmented(scene, own, device)
        return rotate(self.pool[number], torch.randn(4, generator=generator))

    def _describe(self, number: int) -> Draw:
        return describe_draw(self.seed, number, REAL_SHARE if self.real else 0.0)

    def _made(self, number: int) -> Scene:
        if number in self.pending:
            self.pending.pop(number).result()
        return load_scene(self._path(number), cache=self._path(number) / "decoded")  # deleted with the scene

    def _order(self, number: int) -> None:
        """Start making a procedural scene, unless it exists or is pending."""
        recipe_ = self._describe(number).recipe
        if recipe_ is not None and number not in self.pending and not self._path(number).exists():
            self.pending[number] = self.maker.submit(make, recipe_, self._path(number))

    def _path(self, number: int) -> Path:
        return self.folder / f"{self.seed}-{number:06d}"

    def _augmented(self, scene: Scene, own: Draw, device: torch.device | str = "cpu") -> Drawn:
        """Augment a scene; the depth loss keeps all points that were observed."""
        random = np.random.default_rng(own.seed)
        shift = torch.from_numpy(random.normal(scale=own.shift_px, size=(len(scene.names), 2))).float()
        light = torch.from_numpy(np.exp(random.normal(scale=own.exposure_error, size=(len(scene.names), 1)))).float()
        cameras = scene.cameras
        cameras = replace(cameras, principal_px=cameras.principal_px + shift, gain=cameras.gain * light)
        observed = scene.points if self.network.has("sparse points") else None
        points = observed if own.points_share else None
        if points is not None and own.points_share < 1:
            points = points.subset(torch.from_numpy(random.random(len(points.xyz_world)) < own.points_share))
        misaligned = replace(scene, cameras=cameras, points=points)
        augmented = recoloured(misaligned, own.channels)
        twice = at_twice_the_size(scene) if self.network.has("doubled photographs") else None
        match = None
        if self.network.has("matched surface"):  # as for one scene; on greys, which are those of any order of channels
            match = Matcher(misaligned, Pyramid(misaligned, twice), most_px=MATCHED_PX, finer=True, device=device)
        doubled = None if twice is None else recoloured(twice, own.channels)
        return Drawn(augmented, DepthPriors(augmented, observed, match, PRIOR_BYTES), augmented.cameras, doubled)


def recoloured(scene: Scene, channels: tuple[int, ...]) -> Scene:
    """A scene with its colour channels in another order; its photographs no longer come from files."""
    if channels == (0, 1, 2):
        return scene
    own, shading = scene.cameras, scene.cameras.shading
    shading = None if shading is None else shading[:, :, channels]
    order = torch.tensor(channels)  # to index with it takes eight times as long
    colours = tuple(c.index_select(-1, order) for c in scene.photographs.colours)
    return replace(
        scene,
        cameras=replace(own, gain=own.gain[:, channels], shading=shading),
        photographs=replace(scene.photographs, colours=colours, files=()),
    )
