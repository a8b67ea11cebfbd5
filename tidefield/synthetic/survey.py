"""A drone's survey of a tidal flat: the flight, the photographs, and what structure-from-motion would know."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from tidefield.data.scene import SparsePoints
from tidefield.geometry.cameras import Cameras
from tidefield.parallel import in_parallel
from tidefield.synthetic.flat import TidalFlat, make_flat, moved
from tidefield.synthetic.raster import Extent
from tidefield.synthetic.settings import settings_for
from tidefield.synthetic.tracks import sparse_points

_CELL_PER_ALTITUDE = 0.0035
"""Spacing of the terrain's nodes: some two thirds of a pixel of a photograph 240 wide, whatever the altitude."""
_LARGEST_CELL_M = 0.6
"""Creeks need it, from however high they are seen."""


@dataclass(frozen=True)
class Flight:
    """How a survey is flown and photographed."""

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
    """Drawn from the seed between 42 and 60 where None."""
    wetness: float | None = None
    """0 to 1; the category's own where None."""


@dataclass(frozen=True)
class Survey:
    """Photographs of a procedural flat and the truth about them.

    Attributes:
        category: which of the five.
        seed: what it was drawn from.
        flat: the flat, which can be rendered from any other camera.
        cameras: one per photograph, true; near and far enclose everything each one sees.
        photographs: 8 bits, display-referred.
        depth: exact z-depth at pixel centres, metres; inf where there is sky.
        points: as structure-from-motion would have them: triangulated from noisy observations.
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
    device: torch.device | str = "cpu",
) -> Survey:
    """Fly a survey over a new flat. The same arguments give the same pixels on the same device.

    Args:
        category: tidal_trees, river_mouths, ground_textures, vegetation or deep_water.
        seed: of everything random.
        views: photographs.
        width: of a photograph, pixels; neither the flat nor the flight depends on it.
        flight: how it is flown; the defaults suit a demonstration.
        supersample: rays per pixel along each side.
        device: where it is rendered, and where the result lies.

    Raises:
        SceneError: there is no such category.
    """
    flight = flight or Flight()
    random = np.random.default_rng([seed, 20260])
    settings = settings_for(category, random)
    if flight.wetness is not None:
        settings = replace(settings, wetness=flight.wetness)
    cameras = fly(flight, views, width, random)
    elevation = flight.sun_elevation_deg if flight.sun_elevation_deg is not None else random.uniform(42, 60)
    extent = _ground_extent(cameras, flight)
    azimuth = float(random.uniform(0, 360))
    [flat] = in_parallel([partial(make_flat, settings, extent, float(elevation), azimuth, random)], "cpu")
    flat = moved(flat, device)
    cameras = cameras.to(device)
    tasks = [partial(_photograph, flat, cameras[i], supersample, i * flight.water_motion) for i in range(views)]
    photographs, depth = (torch.stack(parts) for parts in zip(*in_parallel(tasks, device), strict=True))
    cameras = replace(cameras, near_far=_near_far(depth))
    points = sparse_points(flat, cameras, photographs, depth, random)
    return Survey(category, seed, flat, cameras, photographs, depth, points)


def _photograph(flat: TidalFlat, camera: Cameras, supersample: int, seconds: float) -> tuple[Tensor, Tensor]:
    """One photograph [H W 3] in 8 bits and its depth [H W]."""
    colour, depth = flat.render(camera, supersample, torch.tensor([seconds]))
    return (colour[0] * 255).round().to(torch.uint8), depth[0]


def fly(flight: Flight, views: int, width: int, random: np.random.Generator) -> Cameras:
    """A lawn-mower flight over the origin: strips north and south in turn, the image's top towards the nose."""
    height = round(width * flight.aspect)
    across = flight.altitude_m / flight.focal_ratio
    along = across * flight.aspect
    spacing_m = np.array([across * (1 - flight.side_overlap), along * (1 - flight.forward_overlap)])
    strips = max(1, min(views, round(math.sqrt(views * spacing_m[1] / spacing_m[0]))))
    poses = []
    for strip, members in enumerate(np.array_split(np.arange(views), strips)):
        heading = 0.0 if strip % 2 == 0 else math.pi
        for k in range(len(members)):
            ahead = (k - (len(members) - 1) / 2) * spacing_m[1] * math.cos(heading)
            place = np.array([(strip - (strips - 1) / 2) * spacing_m[0], ahead, flight.altitude_m])
            place = place + random.normal(0, 0.012, 3) * flight.altitude_m
            tilt = random.uniform(25, 45) if random.random() < flight.oblique_share else 0.0
            turn = random.normal(0, flight.jitter_deg, 3) + np.array([tilt, 0.0, 0.0])
            poses.append(np.column_stack([_attitude(heading) @ _turned(np.radians(turn)), place]))
    pose = torch.from_numpy(np.stack(poses)).float()
    focal = torch.full((views, 2), flight.focal_ratio * width)
    principal, size = torch.tensor([[width / 2, height / 2]]), torch.tensor([[width, height]])
    near_far = torch.tensor([[0.5, 2.0]]) * flight.altitude_m
    return Cameras(
        T_world_camera=pose,
        focal_px=focal,
        principal_px=principal.repeat(views, 1),
        size_px=size.repeat(views, 1),
        near_far=near_far.repeat(views, 1),
        gain=_gains(flight, views, random),
    )


def _gains(flight: Flight, views: int, random: np.random.Generator) -> Float[Tensor, "V 3"]:
    exposure = random.normal(0, 1, (views, 1)) + random.normal(0, 1 / 3, (views, 3))
    return torch.from_numpy(np.exp(flight.exposure_spread * exposure)).float()


def _attitude(heading: float) -> np.ndarray:
    """Camera-to-world rotation of a camera that looks straight down, its top towards a heading clockwise from north."""
    sin, cos = math.sin(heading), math.cos(heading)
    return np.array([[cos, -sin, 0.0], [-sin, -cos, 0.0], [0.0, 0.0, -1.0]])


def _turned(angles: np.ndarray) -> np.ndarray:
    """Rotation about the camera's own x, y and z axes, in turn; about x raises the view towards the image's top."""
    (cx, cy, cz), (sx, sy, sz) = np.cos(angles), np.sin(angles)
    about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    about_z = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    return about_z @ about_y @ about_x


def _ground_extent(cameras: Cameras, flight: Flight) -> Extent:
    """The ground that the photographs show, out to four flight heights, with a margin for shadows and crowns."""
    width, height = cameras.width, cameras.height
    corners = torch.tensor([[0.0, 0.0], [width, 0.0], [0.0, height], [width, height]])
    direction = cameras.directions_world(corners.expand(len(cameras), -1, -1))
    below = cameras.position_world[:, None, 2:] + 3.0
    run = direction[..., :2] / (-direction[..., 2:]).clamp(min=1e-3)
    length = run.norm(dim=-1, keepdim=True)
    run = run * (length.clamp(max=4.0) / length)
    ground = (cameras.position_world[:, None, :2] + run * below).reshape(-1, 2)
    (west, south), (east, north) = (ground.amin(0) - 4).tolist(), (ground.amax(0) + 4).tolist()
    return Extent.around(west, south, east, north, min(flight.altitude_m * _CELL_PER_ALTITUDE, _LARGEST_CELL_M))


def _near_far(depth: Float[Tensor, "V H W"]) -> Float[Tensor, "V 2"]:
    """Bounds around the finite depths of each view, with a margin of a tenth."""
    flat = depth.flatten(1)
    near = flat.amin(1)
    far = torch.where(torch.isfinite(flat), flat, near[:, None]).amax(1)
    return torch.stack([0.9 * near, 1.1 * far], dim=1)
