"""A drone survey of a tidal flat: the flight, the photographs, and sparse points as from structure from motion."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from tidefield.data.scene import SparsePoints
from tidefield.geometry.cameras import Cameras, pixel_grid
from tidefield.parallel import in_parallel
from tidefield.synthetic.flat import Date, TidalFlat, make_flat
from tidefield.synthetic.grids import Extent
from tidefield.synthetic.settings import Settings, settings_for

_CELL_PER_ALTITUDE = 0.0035
"""Spacing of the terrain's nodes: some two thirds of a pixel of a photograph 240 wide, whatever the altitude."""
LARGEST_CELL_M = 0.6
"""Upper limit of that spacing: creeks need it, whatever the altitude."""
_NOISE_PX = 0.3
"""Standard deviation of an observation, per axis."""
_MATCHED = 0.7
"""Chance that a point is matched in a photograph in which it is visible."""
_VISIBLE_PX = 0.75
"""A point is visible where its depth agrees with that of its pixel, to so many footprints of a pixel."""
_MAX_SIGMA_PX = 3.0
"""Points with a standard deviation above so many footprints of a pixel are dropped: their rays are near parallel."""
_MAX_WATER_M = 0.1
"""No points are matched on water deeper than this: its appearance moves with the eye."""


@dataclass(frozen=True)
class Flight:
    """Flight plan and exposure of a survey."""

    altitude_m: float = 45.0
    """Height above mean mud level."""
    forward_overlap: float = 0.8
    side_overlap: float = 0.7
    focal_ratio: float = 0.8
    """Focal length as a share of the image's width."""
    aspect: float = 0.75
    """Height of a photograph as a share of its width."""
    jitter_deg: float = 1.5
    """Standard deviation of roll, pitch and heading."""
    oblique_share: float = 0.0
    """Share of the photographs that look forward and down by 25-45 degrees from nadir."""
    exposure_spread: float = 0.0
    """Standard deviation of the photographs' gains, in natural log; colour balance varies by a third of it."""
    water_motion: float = 0.0
    """Seconds between photographs, for the wavelets; 0 freezes them."""
    sun_elevation_deg: float | None = None
    """None draws it between 42 and 60 from the seed."""
    wetness: float | None = None
    """0 to 1; None for that of the category."""

    def date(self, settings: Settings, random: np.random.Generator) -> Date:
        """What a flat is like when it is photographed: the settings with this flight's wetness, and the sun."""
        if self.wetness is not None:
            settings = replace(settings, wetness=self.wetness)
        elevation = float(random.uniform(42, 60)) if self.sun_elevation_deg is None else self.sun_elevation_deg
        return Date(settings, elevation, float(random.uniform(0, 360)))

    def seconds(self, views: int) -> list[float]:
        """Times of the photographs, for the wavelets."""
        # In single precision, on which the photographs of a seed depend.
        return torch.tensor([i * self.water_motion for i in range(views)]).tolist()


@dataclass(frozen=True)
class Survey:
    """Photographs of a procedural flat and the truth about them.

    Attributes:
        category: one of CATEGORIES.
        seed: of everything random.
        flat: the scene, which can be rendered from any other camera.
        cameras: one per photograph, with true poses; near and far enclose all depths of each.
        photographs: sRGB, 8 bits.
        depth: exact z-depth at pixel centres, metres; inf where there is sky.
        points: triangulated from noisy observations, as by structure from motion.
    """

    category: str
    seed: int
    flat: TidalFlat
    cameras: Cameras
    photographs: UInt8[Tensor, "V H W 3"]
    depth: Float[Tensor, "V H W"]
    points: SparsePoints


def make_survey(
    category: str,
    seed: int,
    views: int = 40,
    width: int = 240,
    flight: Flight | None = None,
    supersample: int = 2,
) -> Survey:
    """Fly a survey over a new flat. The same arguments give the same pixels.

    Args:
        category: tidal_trees, river_mouths, ground_textures, vegetation or deep_water.
        seed: of everything random.
        views: photographs.
        width: of a photograph, pixels; neither the flat nor the flight depends on it.
        flight: None for the defaults, which suit a demonstration.
        supersample: rays per pixel along each side.

    Raises:
        SceneError: the category is unknown.
    """
    flight = flight or Flight()
    random = np.random.default_rng([seed, 20260])
    settings = settings_for(category, random)
    cameras = fly(flight, views, width, random)
    extent = ground_extent(cameras, flight)
    date = flight.date(settings, random)
    # As a task of its own: then the flat does not depend on the number of cores.
    [flat] = in_parallel([partial(make_flat, date, extent, random)], "cpu")
    return photograph_flat(category, seed, flat, cameras, flight, supersample, random)


def photograph_flat(
    category: str,
    seed: int,
    flat: TidalFlat,
    cameras: Cameras,
    flight: Flight,
    supersample: int,
    random: np.random.Generator,
) -> Survey:
    """Take the photographs of a flight, and make their sparse points."""
    seconds = flight.seconds(len(cameras))

    def photograph(i: int) -> tuple[Tensor, Tensor]:
        colour, depth = flat.photograph(cameras[i], supersample, seconds[i])
        return (colour * 255).round().to(torch.uint8), depth

    made = in_parallel([partial(photograph, i) for i in range(len(cameras))], "cpu")
    photographs, depth = (torch.stack(parts) for parts in zip(*made, strict=True))
    cameras = replace(cameras, near_far=_near_far(depth))
    points = _sparse_points(flat, cameras, photographs, depth, random)
    return Survey(category, seed, flat, cameras, photographs, depth, points)


def fly(flight: Flight, views: int, width: int, random: np.random.Generator, strips: int | None = None) -> Cameras:
    """Plan a lawn-mower flight over the origin: strips north and south in turn, image tops in flight direction.

    Args:
        strips: their number; if not given, as many as make the surveyed ground about a square.
    """
    height = round(width * flight.aspect)
    across = flight.altitude_m / flight.focal_ratio
    along = across * flight.aspect
    spacing_m = np.array([across * (1 - flight.side_overlap), along * (1 - flight.forward_overlap)])
    strips = strips or max(1, min(views, round(math.sqrt(views * spacing_m[1] / spacing_m[0]))))
    poses = []
    for strip, members in enumerate(np.array_split(np.arange(views), strips)):
        heading = 0.0 if strip % 2 == 0 else math.pi
        for k in range(len(members)):
            ahead = (k - (len(members) - 1) / 2) * spacing_m[1] * math.cos(heading)
            position = np.array([(strip - (strips - 1) / 2) * spacing_m[0], ahead, flight.altitude_m])
            position = position + random.normal(0, 0.012, 3) * flight.altitude_m
            tilt = random.uniform(25, 45) if random.random() < flight.oblique_share else 0.0
            turn = random.normal(0, flight.jitter_deg, 3) + np.array([tilt, 0.0, 0.0])
            poses.append(np.column_stack([_attitude(heading, np.radians(turn)), position]))
    # Exposure, and a third of its spread for the colour balance.
    log_gain = random.normal(0, 1, (views, 1)) + random.normal(0, 1 / 3, (views, 3))
    return Cameras(
        T_world_camera=torch.from_numpy(np.stack(poses)).float(),
        focal_px=torch.full((views, 2), flight.focal_ratio * width),
        principal_px=torch.tensor([width / 2, height / 2]).repeat(views, 1),
        size_px=torch.tensor([width, height]).repeat(views, 1),
        near_far=(torch.tensor([0.5, 2.0]) * flight.altitude_m).repeat(views, 1),
        gain=torch.from_numpy(np.exp(flight.exposure_spread * log_gain)).float(),
    )


def _attitude(heading: float, turn: np.ndarray) -> np.ndarray:
    """Rotate camera to world: a view straight down, its top towards a heading clockwise from north, then turned.

    The turns are about the camera's x, y and z axes in this order; about x tilts the view towards the image's top.
    """
    sin, cos = math.sin(heading), math.cos(heading)
    (cx, cy, cz), (sx, sy, sz) = np.cos(turn), np.sin(turn)
    about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    about_z = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    return np.array([[cos, -sin, 0], [-sin, -cos, 0], [0, 0, -1]]) @ (about_z @ about_y @ about_x)


def ground_extent(cameras: Cameras, flight: Flight) -> Extent:
    """Bound the ground in the photographs, out to four flight heights, with a margin for shadows and crowns."""
    corners = torch.tensor([[0, 0], [1, 0], [0, 1], [1, 1]]) * cameras.size_px[:, None].float()
    direction = cameras.directions_world(corners)
    below = cameras.position_world[:, None, 2:] + 3.0
    run = direction[..., :2] / (-direction[..., 2:]).clamp(min=1e-3)
    length = run.norm(dim=-1, keepdim=True)
    run = run * (length.clamp(max=4.0) / length)
    ground = (cameras.position_world[:, None, :2] + run * below).reshape(-1, 2)
    cell_m = min(flight.altitude_m * _CELL_PER_ALTITUDE, LARGEST_CELL_M)
    return Extent.around((ground.amin(0) - 4).tolist(), (ground.amax(0) + 4).tolist(), cell_m)


def _near_far(depth: Float[Tensor, "V H W"]) -> Float[Tensor, "V 2"]:
    """Bound the finite depths of each view, with a margin of a tenth."""
    flat = depth.flatten(1)
    near = flat.amin(1)
    far = torch.where(torch.isfinite(flat), flat, near[:, None]).amax(1)
    return torch.stack([0.9 * near, 1.1 * far], dim=1)


def _sparse_points(
    flat: TidalFlat,
    cameras: Cameras,
    photographs: UInt8[Tensor, "V H W 3"],
    depth: Float[Tensor, "V H W"],
    random: np.random.Generator,
) -> SparsePoints:
    """Pick corners, match them in the other photographs by their true depth, add noise and triangulate.

    There are no outliers.
    """
    true = torch.cat([_corners(cameras[i], photographs[i], depth[i], random) for i in range(len(cameras))])
    # The water's depth counts where a point is on the water, not on a plant above it.
    above = true[:, 2] - flat.surface.sample(true[:, :2].T)[0]
    true = true[(above >= 0.02) | (flat.ground.sample(true[:, :2].T).water_depth_m < _MAX_WATER_M)]
    visible = _visible(cameras, depth, true)
    visible &= torch.from_numpy(random.random(visible.shape) < _MATCHED)
    camera, point = torch.nonzero(visible, as_tuple=True)
    noise = torch.from_numpy(random.normal(0, _NOISE_PX, (*visible.shape, 2)))
    uv = cameras.project(true)[0].double()[camera, point] + noise[camera, point]
    xyz, certain = _triangulate(cameras, true.double(), point, camera, uv)
    inside = ((uv > 0) & (uv < cameras.size_px[camera])).all(1)
    often = torch.bincount(point[inside], minlength=len(true)) >= 2
    kept = certain & often
    point, camera, uv = (x[inside & kept[point]] for x in (point, camera, uv))
    residual = _normal_equations(cameras, xyz, point, camera, uv)[3]
    total = torch.zeros(len(true), dtype=torch.float64).index_add_(0, point, residual.norm(dim=1))
    error = total / torch.bincount(point, minlength=len(true))
    number = kept.cumsum(0) - 1
    return SparsePoints(xyz[kept].float(), error[kept].float(), number[point], camera, uv.float())


def _corners(
    camera: Cameras, photograph: UInt8[Tensor, "H W 3"], depth: Float[Tensor, "H W"], random: np.random.Generator
) -> Float[Tensor, "P 3"]:
    """Draw pixels by their corner strength and return their world points."""
    grey = cv2.cvtColor(photograph.numpy(), cv2.COLOR_RGB2GRAY)
    strength = np.sqrt(cv2.cornerMinEigenVal(grey, 3).clip(min=1e-8)).reshape(-1)
    strength = np.where(np.isfinite(depth.numpy().reshape(-1)), strength, 0)
    wanted = int(np.clip(grey.size / 400, 60, 200))
    # The largest of u^(1/w) are a weighted sample without replacement (Efraimidis and Spirakis 2006).
    key = np.log(random.random(grey.size)) / np.maximum(strength, 1e-12)
    pixel = torch.from_numpy(np.sort(np.argpartition(-key, wanted)[:wanted]))
    z = depth.reshape(-1)[pixel]
    uv = pixel_grid(camera.width, camera.height)[pixel]
    at = camera.position_world + camera.directions_world(uv[None])[0] * z[:, None]
    return at[torch.isfinite(z)]


def _visible(cameras: Cameras, depth: Float[Tensor, "V H W"], points: Float[Tensor, "P 3"]) -> Bool[Tensor, "V P"]:
    """Test the points' visibility in each photograph."""
    uv, z = cameras.project(points)
    height, width = depth.shape[1:]
    column, row = uv.floor().long().unbind(-1)
    inside = (z > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    pixel = row.clamp(0, height - 1) * width + column.clamp(0, width - 1)
    surface = depth.flatten(1).gather(1, pixel)
    return inside & ((z - surface).abs() < _VISIBLE_PX * z / cameras.focal_px[:, :1])


def _triangulate(
    cameras: Cameras,
    start: Float[Tensor, "P 3"],
    point: Int[Tensor, " O"],
    camera: Int[Tensor, " O"],
    uv: Float[Tensor, "O 2"],
) -> tuple[Float[Tensor, "P 3"], Bool[Tensor, " P"]]:
    """Triangulate points by Gauss-Newton, and test which of them are well determined."""
    xyz = start
    # Points with fewer than two rays are dropped later; this keeps their matrices regular.
    tiny = 1e-9 * torch.eye(3, dtype=xyz.dtype)
    for _ in range(3):
        normal, right, _, _ = _normal_equations(cameras, xyz, point, camera, uv)
        xyz = xyz + torch.linalg.solve(normal + tiny, right).clamp(-10, 10)
    normal, _, z, _ = _normal_equations(cameras, xyz, point, camera, uv)
    sigma = _NOISE_PX / torch.sqrt(torch.linalg.eigvalsh(normal)[:, 0].clamp(min=1e-12))
    footprint = torch.zeros_like(sigma).scatter_reduce_(0, point, z / cameras.focal_px[camera, 0], "amax")
    return xyz, sigma < _MAX_SIGMA_PX * footprint


def _normal_equations(
    cameras: Cameras, xyz: Tensor, point: Tensor, camera: Tensor, uv: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Compute left [P 3 3] and right [P 3] sides per point; z-depths [O] and residuals [O 2] of the observations."""
    pose = cameras.T_world_camera.double()[camera]
    focal, principal = cameras.focal_px.double()[camera], cameras.principal_px.double()[camera]
    local = ((xyz[point] - pose[:, :, 3])[:, None] @ pose[:, :, :3])[:, 0]
    z = local[:, 2]
    ratio = local[:, :2] / z[:, None]
    residual = uv - (ratio * focal + principal)
    axes = pose[:, :, :3].transpose(1, 2)
    jacobian = (focal / z[:, None])[..., None] * (axes[:, :2] - ratio[..., None] * axes[:, 2:])
    transposed = jacobian.transpose(1, 2)
    normal = torch.zeros(len(xyz), 3, 3, dtype=xyz.dtype).index_add_(0, point, transposed @ jacobian)
    right = torch.zeros_like(xyz).index_add_(0, point, (transposed @ residual[..., None])[..., 0])
    return normal, right, z, residual
