"""Ground control: marks in the photographs of a model, triangulation, and the similarity that fits most of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
import pycolmap
from jaxtyping import Bool, Float64, Int, Shaped
from scipy.optimize import least_squares

from tidefield.data.georeference import LeftOut
from tidefield.errors import SurveyError, list_names
from tidefield.geometry.geodesy import LocalFrame
from tidefield.geometry.similarity import COLLINEAR, Similarity, hypotheses, refine_similarity
from tidefield.survey.georeference.gps_alignment import Down, PositionFit
from tidefield.survey.survey import Control, Photograph

GROSS_ERROR = 0.02
"""Of the image width: a mark with this reprojection error in an unadjusted model, which bends by less, is wrong."""
_CONTROL_M = 0.02
"""Standard deviation of a surveyed point, as its weight relative to the cameras' positions."""


@dataclass(frozen=True)
class Marks:
    """M marks in registered photographs.

    Attributes:
        point: name of the control point.
        photograph: name of the photograph.
        image: number of the photograph in the model.
        uv_px: pixel, on the grid of the model's images.
        zoom: pixels of the photograph per pixel of the model's image.
        width_px: of the model's images.
        surveyed_world: the control point's coordinates.
    """

    point: Shaped[np.ndarray, " M"]
    photograph: Shaped[np.ndarray, " M"]
    image: Int[np.ndarray, " M"]
    uv_px: Float64[np.ndarray, "M 2"]
    zoom: Float64[np.ndarray, " M"]
    width_px: Float64[np.ndarray, " M"]
    surveyed_world: Float64[np.ndarray, "M 3"]

    def __len__(self) -> int:
        return len(self.point)

    def where(self, mask: Bool[np.ndarray, " M"]) -> Marks:
        """Select marks by a mask."""
        return Marks(**{name: values[mask] for name, values in vars(self).items()})

    def of(self, *points: str) -> Bool[np.ndarray, " M"]:
        """Mask the marks of these points."""
        return np.array([name in points for name in self.point], dtype=bool)

    @property
    def points(self) -> dict[str, Float64[np.ndarray, " 3"]]:
        """Surveyed coordinates of the marked points, by name."""
        return {name: self.surveyed_world[self.point == name][0] for name in sorted(set(self.point.tolist()))}


def locate_marks(
    model: pycolmap.Reconstruction, control: Control, photographs: Sequence[Photograph], frame: LocalFrame
) -> tuple[Marks, tuple[LeftOut, ...]]:
    """Convert marks to the pixels of the model's images; also list those in photographs that it does not have.

    Raises:
        SurveyError: none of the marks is in a photograph of the model.
    """
    images = {model.image(number).name: model.image(number) for number in model.reg_image_ids()}
    sizes = {photograph.name: photograph.width for photograph in photographs}
    names = sorted(control.points)
    coordinates = frame.from_system(control.crs, np.array([control.points[name] for name in names], dtype=np.float64))
    world = dict(zip(names, coordinates, strict=True))
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
        np.array([mark.point for mark in found]),
        np.array([mark.photograph for mark in found]),
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
    """Compute reprojection errors of one point per mark, in the model's pixels; infinite behind the camera."""
    projected = np.full((len(marks), 2), np.inf)
    for i, (image, point) in enumerate(zip(marks.image, points, strict=True)):
        uv = model.image(int(image)).project_point(point)
        if uv is not None:
            projected[i] = uv
    return np.linalg.norm(projected - marks.uv_px, axis=1)


def triangulate(model: pycolmap.Reconstruction, marks: Marks) -> Float64[np.ndarray, " 3"] | None:
    """Triangulate two or more marks of one point by least reprojection error; None if in front of no camera."""
    images = [model.image(int(number)) for number in marks.image]
    lenses = [model.camera(image.camera_id) for image in images]
    normalised = [lens.cam_from_img(uv) for lens, uv in zip(lenses, marks.uv_px, strict=True)]
    rays = np.array([np.append(xy, 1.0) for xy in normalised if xy is not None])
    if len(rays) < len(images):  # a mark where the lens images nothing
        return None
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    start = _triangulate_linearly(np.array([image.cam_from_world().matrix() for image in images]), rays)
    if not np.isfinite(start).all():
        return None

    def error(point: Float64[np.ndarray, " 3"]) -> Float64[np.ndarray, " K"]:
        projected = [image.project_point(point) for image in images]
        # A point behind a camera is no solution; an error larger than any mark's keeps the search away from there.
        return np.concatenate([np.full(2, 1e6) if uv is None else uv for uv in projected]) - marks.uv_px.ravel()

    return least_squares(error, start, x_scale=np.maximum(np.abs(start), 1e-3)).x


def _triangulate_linearly(
    T_camera_world: Float64[np.ndarray, "K 3 4"], rays_camera: Float64[np.ndarray, "K 3"]
) -> Float64[np.ndarray, " 3"]:
    """Triangulate unit rays by the smallest algebraic distance; pycolmap 4.0 has no such function."""
    across = T_camera_world - rays_camera[:, :, None] * np.einsum("ki,kij->kj", rays_camera, T_camera_world)[:, None]
    _, vectors = np.linalg.eigh(np.einsum("kij,kil->jl", across, across))
    with np.errstate(divide="ignore", invalid="ignore"):  # parallel rays meet at infinity
        return vectors[:3, 0] / vectors[3, 0]


def triangulate_points(
    model: pycolmap.Reconstruction, marks: Marks, tolerance: float
) -> dict[str, Float64[np.ndarray, " 3"]]:
    """Triangulate each point from the largest set of at least two marks that agree.

    Args:
        tolerance: largest reprojection error, in image widths.
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


def fit_control(
    model: pycolmap.Reconstruction, marks: Marks, down: Down, positions: PositionFit | None
) -> tuple[Similarity, Bool[np.ndarray, " M"]]:
    """Estimate the similarity from a model to its control points.

    Candidates are similarities through minimal subsets of the points, and that of the cameras' positions shifted onto
    one point. All marks vote, so that a point with one mark counts too and a wrong point is outvoted.

    Args:
        positions: the model aligned with its cameras' positions. They determine what control points do not that are
            too few or on one line.

    Returns:
        The similarity, and which marks agree with it.

    Raises:
        SurveyError: there are too few points, or most of the marks fit no similarity.
    """
    source, target = _pairs(model, marks)
    candidates = hypotheses(source, target, None if positions else down.direction_model, np.random.default_rng(0))
    candidates = [one for one in candidates if (one.rotation @ down.direction_model)[2] < 0]
    if positions is not None:
        prior = positions.world_from_model
        shifts = target - prior(source)
        candidates += [prior, *(replace(prior, translation=prior.translation + shift) for shift in shifts)]
    if not candidates:
        raise SurveyError(
            f"{len(source)} control points show in two photographs or more, and the photographs have no positions: "
            "expected three such points; mark more, or give the photographs' positions"
        )
    similarity = min(candidates, key=lambda one: float((np.minimum(_share(model, marks, one), 1) ** 2).sum()))
    agree = _share(model, marks, similarity) < 1
    if 2 * np.count_nonzero(agree) < len(marks):
        raise SurveyError(
            f"only {np.count_nonzero(agree)} of the {len(marks)} marks of ground control fit together with the "
            "photographs: expected most of them; check the coordinate reference system, the order of the coordinates, "
            "the names of the points and what size of photograph the marks were made on"
        )
    source, target = _pairs(model, marks.where(agree))
    sigma = np.full_like(target, _CONTROL_M)
    if not are_collinear(target):
        similarity = refine_similarity(similarity, source, target, sigma).similarity
    elif positions is not None:
        similarity = _with_positions(similarity, source, target, positions)
    elif len(source) >= 2:
        prior_down = down.direction_model, down.sigma_rad
        similarity = refine_similarity(similarity, source, target, sigma, *prior_down).similarity
    return similarity, _share(model, marks, similarity) < 1


def are_collinear(points: Float64[np.ndarray, "N 3"]) -> bool:
    """Test whether points leave a rotation undetermined: fewer than three, or on one line."""
    if len(points) < 3:
        return True
    spread = np.linalg.svd(points - points.mean(0), compute_uv=False)
    return bool(spread[1] <= COLLINEAR * spread[0])


def _pairs(
    model: pycolmap.Reconstruction, marks: Marks
) -> tuple[Float64[np.ndarray, "N 3"], Float64[np.ndarray, "N 3"]]:
    """Triangulate points of which two marks or more agree; return model and surveyed coordinates."""
    found, surveyed = triangulate_points(model, marks, GROSS_ERROR), marks.points
    return np.array(list(found.values())).reshape(-1, 3), np.array([surveyed[name] for name in found]).reshape(-1, 3)


def _with_positions(
    start: Similarity, source: Float64[np.ndarray, "N 3"], target: Float64[np.ndarray, "N 3"], positions: PositionFit
) -> Similarity:
    """Refine the position by few control points, and rotation and scale by the cameras' positions, shifted as one."""
    if len(source) == 0:
        return start
    prior, used = positions.world_from_model, positions.used
    shift = (target - prior(source)).mean(0)
    return refine_similarity(
        replace(prior, translation=prior.translation + shift),
        np.concatenate([source, positions.centres_model[used]]),
        np.concatenate([target, positions.given_world[used] + shift]),
        np.concatenate([np.full_like(target, _CONTROL_M), positions.sigma_m[used]]),
    ).similarity


def _share(model: pycolmap.Reconstruction, marks: Marks, similarity: Similarity) -> Float64[np.ndarray, " M"]:
    """Compute reprojection errors of the surveyed points as shares of a gross error."""
    points = similarity.inverse()(marks.surveyed_world)
    return reprojection_px(model, marks, points) / marks.width_px / GROSS_ERROR
