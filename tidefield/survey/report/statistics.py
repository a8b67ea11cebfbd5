"""Measure a reconstruction: resolution, heights, coverage, overlap and errors, per photograph."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int
from shapely import Polygon

from tidefield.survey.report.block import Block, read_block
from tidefield.survey.report.coverage import Coverage, Overlap, cover, overlap
from tidefield.survey.report.findings import Findings
from tidefield.survey.report.ground import fit_ground, footprints
from tidefield.survey.survey import Photograph


@dataclass(frozen=True)
class Statistics:
    """Measures of a model; lengths in metres where it has a georeference, else in its own unit; NaN where unknown.

    Attributes:
        block: the model as arrays.
        photographs: what was read of each registered photograph; None if it is not in the survey.
        order: registered photographs in the order of the flight: by time, or by name where times are missing.
        gsd: ground sampling distance of every photograph: median over its points of z-depth / focal length.
        height: of every camera above the ground beneath.
        footprints: what each covers of the ground, counter-clockwise x and y; empty if it sees none.
        coverage: how many photographs see each piece of ground.
        overlap: what each shares with its neighbours.
        error_px: reprojection error of every observation.
        mean_px, rms_px: per photograph.
        observed: points that every photograph observes.
        track_length: photographs that observe each point.
    """

    block: Block
    photographs: tuple[Photograph | None, ...]
    order: Int[np.ndarray, " N"]
    gsd: Float64[np.ndarray, " N"]
    height: Float64[np.ndarray, " N"]
    footprints: tuple[Polygon, ...]
    coverage: Coverage
    overlap: Overlap
    error_px: Float64[np.ndarray, " O"]
    mean_px: Float64[np.ndarray, " N"]
    rms_px: Float64[np.ndarray, " N"]
    observed: Int[np.ndarray, " N"]
    track_length: Int[np.ndarray, " P"]


def measure(findings: Findings) -> Statistics:
    """Compute all statistics of the reconstruction.

    Raises:
        SurveyError: nothing is registered, or there are no points.
    """
    block = read_block(findings.reconstruction, level=findings.frame is None)
    known = {photograph.name: photograph for photograph in findings.survey.photographs}
    photographs = tuple(known.get(name) for name in block.names)
    order = _flight_order(photographs)
    track_length = np.bincount(block.point, minlength=len(block.points))
    trusted = block.points[track_length > 2]
    ground = fit_ground(trusted if len(trusted) >= len(block.points) / 4 else block.points)
    height = ground.above(block.position)
    outlines = footprints(block, ground)
    gsd, error_px, mean_px, rms_px = _resolution_and_errors(block)
    return Statistics(
        block=block,
        photographs=photographs,
        order=order,
        gsd=gsd,
        height=height,
        footprints=outlines,
        coverage=cover(outlines),
        overlap=overlap(outlines, block.position, order, float(np.median(height))),
        error_px=error_px,
        mean_px=mean_px,
        rms_px=rms_px,
        observed=np.bincount(block.photograph, minlength=len(block)),
        track_length=track_length,
    )


def _flight_order(photographs: tuple[Photograph | None, ...]) -> Int[np.ndarray, " N"]:
    times = np.array([np.nan if photograph is None else photograph.time_s for photograph in photographs])
    return np.arange(len(times)) if np.isnan(times).any() else np.argsort(times, kind="stable")


def _resolution_and_errors(block: Block) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Per photograph: ground sampling distance; per observation: error; per photograph: its mean and RMS."""
    gsd, mean, rms = np.full((3, len(block)), np.nan)
    error = np.zeros(len(block.point))
    for i, mine in block.observations():
        camera = block.camera(i)
        offset = block.points[block.point[mine]] - block.position[i]
        in_camera = offset @ block.R_world_camera[i]
        gsd[i] = np.median(in_camera[:, 2]) / camera.mean_focal_length()
        error[mine] = np.linalg.norm(camera.img_from_cam(in_camera) - block.uv_px[mine], axis=1)
        here = error[mine][np.isfinite(error[mine])]  # a point behind the camera has no image
        if len(here):
            mean[i], rms[i] = np.mean(here), np.sqrt(np.mean(here**2))
    return gsd, error, mean, rms
