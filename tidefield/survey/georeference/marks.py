"""Surveyed points in the photographs of a model: their marks, where these see the points, and how far they are off."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import pycolmap
from jaxtyping import Bool, Float64, Int
from scipy.optimize import least_squares

from tidefield.data.georeference import LeftOut
from tidefield.errors import SurveyError, list_names
from tidefield.geometry.geodesy import LocalFrame
from tidefield.survey.survey import Control, Photograph


@dataclass(frozen=True)
class Marks:
    """M marks in registered photographs.

    Attributes:
        point: name of the control point.
        photograph: where it shows.
        image: number of the photograph in the model.
        uv_px: pixel, on the grid of the model's images.
        zoom: pixels of the photograph per pixel of the model's image.
        width_px: of the model's images.
        surveyed_world: the control point's coordinates.
    """

    point: tuple[str, ...]
    photograph: tuple[str, ...]
    image: Int[np.ndarray, " M"]
    uv_px: Float64[np.ndarray, "M 2"]
    zoom: Float64[np.ndarray, " M"]
    width_px: Float64[np.ndarray, " M"]
    surveyed_world: Float64[np.ndarray, "M 3"]

    def __len__(self) -> int:
        return len(self.point)

    def where(self, mask: Bool[np.ndarray, " M"]) -> Marks:
        """Those of a mask."""
        return Marks(
            tuple(name for name, keep in zip(self.point, mask, strict=True) if keep),
            tuple(name for name, keep in zip(self.photograph, mask, strict=True) if keep),
            self.image[mask],
            self.uv_px[mask],
            self.zoom[mask],
            self.width_px[mask],
            self.surveyed_world[mask],
        )

    def of(self, *points: str) -> Bool[np.ndarray, " M"]:
        """Which marks are of these points."""
        return np.array([name in points for name in self.point], dtype=bool)

    @property
    def points(self) -> dict[str, Float64[np.ndarray, " 3"]]:
        """Coordinates of the points that are marked, by name."""
        return {name: self.surveyed_world[self.point.index(name)] for name in sorted(set(self.point))}


def place_marks(
    model: pycolmap.Reconstruction, control: Control, photographs: Sequence[Photograph], frame: LocalFrame
) -> tuple[Marks, tuple[LeftOut, ...]]:
    """The marks that the model can use, and those in photographs that it does not have.

    Raises:
        SurveyError: none of the marks is in a photograph of the model.
    """
    images = {model.image(number).name: model.image(number) for number in model.reg_image_ids()}
    sizes = {photograph.name: photograph.width for photograph in photographs}
    names = sorted(control.points)
    places = frame.from_system(control.crs, np.array([control.points[name] for name in names], dtype=np.float64))
    world = dict(zip(names, places, strict=True))
    found = [mark for mark in control.marks if mark.photograph in images and mark.photograph in sizes]
    left_out = tuple(
        LeftOut("mark", f"{mark.point} in {mark.photograph}", "the photograph could not be placed, or is not there")
        for mark in control.marks
        if mark not in found
    )
    if not found:
        raise SurveyError(
            f"the {len(control.marks)} marks of ground control are in "
            f"{list_names([m.photograph for m in control.marks])}, which could not be placed: expected marks in "
            f"some of {list_names(sorted(images))}; mark these, or see why the others were not placed"
        )
    width = np.array([model.camera(images[mark.photograph].camera_id).width for mark in found], dtype=np.float64)
    zoom = np.array([sizes[mark.photograph] for mark in found]) / width
    marks = Marks(
        tuple(mark.point for mark in found),
        tuple(mark.photograph for mark in found),
        np.array([images[mark.photograph].image_id for mark in found], dtype=np.int64),
        np.array([mark.uv_px for mark in found], dtype=np.float64).reshape(-1, 2) / zoom[:, None],
        zoom,
        width,
        np.array([world[mark.point] for mark in found]),
    )
    return marks, left_out


def reprojection_px(
    model: pycolmap.Reconstruction, marks: Marks, points: Float64[np.ndarray, "M 3"]
) -> Float64[np.ndarray, " M"]:
    """Distance of each mark from where its own point shows, in the model's pixels; infinite behind the camera."""
    shown = np.full((len(marks), 2), np.inf)
    for i, (image, point) in enumerate(zip(marks.image, points, strict=True)):
        uv = model.image(int(image)).project_point(point)
        if uv is not None:
            shown[i] = uv
    return np.linalg.norm(shown - marks.uv_px, axis=1)


def triangulate(model: pycolmap.Reconstruction, marks: Marks) -> Float64[np.ndarray, " 3"] | None:
    """Where two or more marks of one point see it, by least reprojection error; None if in front of no camera."""
    images = [model.image(int(number)) for number in marks.image]
    lenses = [model.camera(image.camera_id) for image in images]
    flat = [lens.cam_from_img(uv) for lens, uv in zip(lenses, marks.uv_px, strict=True)]
    rays = np.array([np.append(xy, 1.0) for xy in flat if xy is not None])
    if len(rays) < len(images):  # a mark where the lens sees nothing
        return None
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    start = pycolmap.triangulate_multi_view_point([image.cam_from_world().matrix() for image in images], rays)
    if start is None:
        return None

    def error(point: Float64[np.ndarray, " 3"]) -> Float64[np.ndarray, " K"]:
        shown = [image.project_point(point) for image in images]
        # A point behind a camera is no solution; an error that no mark has keeps the search away from there.
        return np.concatenate([np.full(2, 1e6) if uv is None else uv for uv in shown]) - marks.uv_px.ravel()

    return least_squares(error, start, x_scale=np.maximum(np.abs(start), 1e-3)).x


def triangulate_points(
    model: pycolmap.Reconstruction, marks: Marks, tolerance: float
) -> dict[str, Float64[np.ndarray, " 3"]]:
    """The points with two marks or more that agree, from those that do.

    Args:
        tolerance: of reprojection, in widths of the image.
    """
    found = {}
    for name in marks.points:
        own = marks.where(marks.of(name))
        best, most = None, (0, 0.0)
        for pair in combinations(range(len(own)), 2):
            point = triangulate(model, own.where(np.isin(np.arange(len(own)), pair)))
            if point is None:
                continue
            share = reprojection_px(model, own, np.tile(point, (len(own), 1))) / own.width_px / tolerance
            rank = (int((share < 1).sum()), -float(np.minimum(share, 1).sum()))
            if rank[0] >= 2 and (best is None or rank > most):
                best, most = share < 1, rank
        point = None if best is None else triangulate(model, own.where(best))
        if point is not None:
            found[name] = point
    return found
