"""Write surveys of two dates as a pilot brings them home: photographs, a receiver's positions, and surveyed control.

Nothing else of the truth is written; what is known of it has the errors that it has in the field.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float64

from tidefield.errors import SceneError
from tidefield.files import write_text, writing_to
from tidefield.geometry.geodesy import LocalFrame
from tidefield.synthetic.grids import Raster
from tidefield.synthetic.two_dates import Pair
from tidefield.synthetic.write import write_picture

CONTROL_POINTS = 8
CONTROL_M, MARK_PX, GPS_M = 0.01, 0.3, 1.5
"""Deviations of surveyed control, of its marks in photographs, and of the receiver's positions."""
BARE_M = 0.03
"""Ground is bare where what is seen straight down is less than this above it."""


def write_flights(pair: Pair, folder: Path, frame: LocalFrame, dates: Sequence[str], seed: int) -> None:
    """Write FOLDER/DATE/photographs of both dates: JPEGs, gps.csv and gcp_list.txt, which `tidefield prepare` reads.

    Args:
        pair: of surveys.
        folder: to write to.
        frame: in which the flat's coordinates are.
        dates: names of both surveys.
        seed: of all errors and of where control is.

    Raises:
        SceneError: no ground is fit for control.
        RunError: the folder cannot be written to.
    """
    points = _control(pair, seed)
    for k, (survey, date) in enumerate(zip((pair.earlier, pair.later), dates, strict=True)):
        random = np.random.default_rng([seed, 20290, k])
        photographs = folder / date / "photographs"
        names = [f"IMG_{k}{i:03d}.jpg" for i in range(len(survey.cameras))]
        with writing_to(photographs):
            photographs.mkdir(parents=True)
            for name, picture in zip(names, survey.photographs.numpy(), strict=True):
                write_picture(photographs / name, picture, jpeg_quality=96)
        position = survey.cameras.position_world.double().numpy()
        noisy = frame.to_geographic(position + random.normal(0, GPS_M, position.shape))
        rows = [f"{n},{p[1]:.8f},{p[0]:.8f},{p[2]:.2f}" for n, p in zip(names, noisy, strict=True)]
        write_text(photographs / "gps.csv", "\n".join(["image_name,lat,lon,gps_height", *rows]) + "\n")
        points[:, 2] = survey.flat.bed.sample(torch.from_numpy(points[:, :2].T).float())[0].numpy()
        uv, depth = survey.cameras.project(torch.from_numpy(points).float())
        surveyed = frame.to_crs(points + random.normal(0, CONTROL_M, points.shape))
        lines = [frame.crs]
        width, height = survey.cameras.width, survey.cameras.height
        for i, name in enumerate(names):
            for p, place in enumerate(surveyed):
                u, v = uv[i, p].tolist()
                if depth[i, p] > 0 and 5 < u < width - 5 and 5 < v < height - 5:
                    u, v = u + random.normal(0, MARK_PX), v + random.normal(0, MARK_PX)
                    lines.append(f"{place[0]:.4f} {place[1]:.4f} {place[2]:.4f} {u:.2f} {v:.2f} {name} P{p}")
        write_text(photographs / "gcp_list.txt", "\n".join(lines) + "\n")


def _control(pair: Pair, seed: int) -> Float64[np.ndarray, "P 3"]:
    """Places of control: bare, dry, unchanged, seen by three photographs of both dates, and far from each other."""
    candidates = np.random.default_rng([seed, 20291]).uniform(-45, 45, (4000, 2))
    xy = torch.from_numpy(candidates.T).float()
    good = np.abs(pair.ground_change.sample(xy)[0].numpy()) < 1e-6
    for survey in (pair.earlier, pair.later):
        flat = survey.flat
        # A mark that is next to a plant is hidden by it in some photographs.
        above = F.max_pool2d(flat.seen(flat.bed.extent).values - flat.bed.values, 3, stride=1, padding=1)
        clear = Raster(flat.bed.extent, above).sample(xy)[0].numpy() < BARE_M
        bed, surface = (raster.sample(xy)[0].numpy() for raster in (flat.bed, flat.surface))
        good &= (surface - bed < 1e-3) & clear
        points = torch.from_numpy(np.column_stack([candidates, bed])).float()
        uv, depth = survey.cameras.project(points)
        size = survey.cameras.size_px[:, None].float()
        seen = ((uv > 8) & (uv < size - 8)).all(-1) & (depth > 0)
        good &= (seen.sum(0) >= 3).numpy()
    left = candidates[good]
    if len(left) < CONTROL_POINTS:
        raise SceneError(
            f"the flat has {len(left)} places for control: expected {CONTROL_POINTS}; fly more photographs, or another "
            "seed"
        )
    chosen = [left[np.argmin(left.sum(axis=1))]]
    while len(chosen) < CONTROL_POINTS:
        away = np.min([np.hypot(*(left - one).T) for one in chosen], axis=0)
        chosen.append(left[np.argmax(away)])
    return np.column_stack([np.array(chosen), np.zeros(CONTROL_POINTS)])
