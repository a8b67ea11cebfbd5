"""Ground control: its marks in a model, triangulation, the similarity that fits most of them, and the adjustment.

A model that is only aligned with its control points keeps the bend of its own matches. Adjusted together with the
matches, fixed control points remove the bend, and determine lens parameters that flat ground does not: a longer lens is
equivalent to a higher flight, unless points lie at two heights or a bend shows the difference. Every point is left out
in turn to check the rest; marks and points that disagree with the others are rejected.

A model that positions of differential receivers have shaped keeps that shape where control says no better: a few
points in one corner would turn and bend all the rest.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
import pycolmap
from jaxtyping import Bool, Float64, Int, Shaped
from scipy.optimize import least_squares

from tidefield.data.georeference import LeftOut, Residuals
from tidefield.errors import SurveyError, list_names
from tidefield.geometry.geodesy import LocalFrame
from tidefield.geometry.similarity import COLLINEAR, Similarity, hypotheses, refine_similarity
from tidefield.survey.georeference.bundle_adjustment import (
    all_images,
    carry_over,
    generalise_lenses,
    reliable,
    solve,
    thinned,
)
from tidefield.survey.georeference.gps_alignment import Down, PositionFit, camera_centres, metres, rms_m
from tidefield.survey.survey import Control, Photograph, Progress

GROSS_ERROR = 0.02
"""Of the image width: a mark with this reprojection error in an unadjusted model, which bends by less, is wrong."""
_CONTROL_M = 0.02
"""Standard deviation of a surveyed point, as its weight relative to the cameras' positions."""
_MOST_PAIRS = 200
"""Of marks of one point that it is triangulated from, at random of more: of 200 one fits while a tenth of marks do."""
_REPEATS = 4
"""Weight of a mark. A matched point is as precise as a mark, but its errors are correlated with its neighbours' (lens,
shutter), which the sum of squares ignores; the weight compensates for that."""
_MARK_TOLERANCE = 0.005
"""Of the image width. Marks with a larger reprojection error in an adjusted model are wrong, or, if others are as bad,
those beyond five robust standard deviations."""
_POINT_FACTOR = 5.0
"""A point is wrong whose error, left out, is this many times the median of the others."""
_WRONG_POINTS = 3
"""No more points than this are rejected by cross-validation."""
_WORTH_FREEING = 0.9
"""The lens is adjusted if the errors of the points left out fall below this share."""
_WORTH_RESHAPING = 0.5
"""A model that positions have shaped is adjusted to control if the errors of the points left out fall below this
share, ..."""
_FARTHER = 2.0
"""... or below that of a lens, while the cameras' distances from their positions grow by no more than this factor."""
_ROUNDS = 4
_FOLDS = 12
_FOLDS_OF_LARGE = 4
_LARGE = 300  # photographs


_UNMOVED = Similarity(1.0, np.eye(3), np.zeros(3))


@dataclass(frozen=True)
class Adjusted:
    """What an adjustment to ground control has found.

    Attributes:
        residuals: of the control points.
        check: those of each without it.
        rejected: marks and points.
        notes: as whole sentences.
        used_world: surveyed coordinates of the points that were used.
        moved: what was done to the model as a whole.
    """

    residuals: Residuals
    check: Residuals
    rejected: tuple[LeftOut, ...]
    notes: tuple[str, ...]
    used_world: Float64[np.ndarray, "N 3"]
    moved: Similarity = _UNMOVED


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

    @property
    def points_world(self) -> Float64[np.ndarray, "N 3"]:
        """The same, without names."""
        return np.array(list(self.points.values()), dtype=np.float64).reshape(-1, 3)


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
    placed = images.keys() & sizes
    found = [mark for mark in control.marks if mark.photograph in placed]
    left_out = tuple(
        LeftOut("mark", f"{mark.point} in {mark.photograph}", "the photograph could not be placed, or is not there")
        for mark in control.marks
        if mark.photograph not in placed
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
    start = _triangulate_linearly(*_rays(model, marks))
    if not np.isfinite(start).all():
        return None
    images = [model.image(int(number)) for number in marks.image]

    def error(point: Float64[np.ndarray, " 3"]) -> Float64[np.ndarray, " K"]:
        projected = [image.project_point(point) for image in images]
        # A point behind a camera is no solution; an error larger than any mark's keeps the search away from there.
        return np.concatenate([np.full(2, 1e6) if uv is None else uv for uv in projected]) - marks.uv_px.ravel()

    return least_squares(error, start, x_scale=np.maximum(np.abs(start), 1e-3)).x


def _rays(
    model: pycolmap.Reconstruction, marks: Marks
) -> tuple[Float64[np.ndarray, "K 3 4"], Float64[np.ndarray, "K 3"]]:
    """Poses of the photographs of marks (T_camera_world) and unit rays to these; NaN where the lens images nothing."""
    images = [model.image(int(number)) for number in marks.image]
    normalised = [model.camera(image.camera_id).cam_from_img(uv) for image, uv in zip(images, marks.uv_px, strict=True)]
    rays = np.array([np.full(3, np.nan) if xy is None else np.append(xy, 1.0) for xy in normalised])
    poses = np.array([image.cam_from_world().matrix() for image in images])
    return poses, rays / np.linalg.norm(rays, axis=1, keepdims=True)


def _triangulate_linearly(
    T_camera_world: Float64[np.ndarray, "K 3 4"], rays_camera: Float64[np.ndarray, "K 3"]
) -> Float64[np.ndarray, " 3"]:
    """Triangulate unit rays by the smallest algebraic distance; pycolmap 4.0 has no such function.

    Returns:
        The point; not finite where rays are parallel or unknown.
    """
    if not np.isfinite(rays_camera).all():
        return np.full(3, np.nan)
    across = T_camera_world - rays_camera[:, :, None] * np.einsum("ki,kij->kj", rays_camera, T_camera_world)[:, None]
    _, vectors = np.linalg.eigh(np.einsum("kij,kil->jl", across, across))
    with np.errstate(divide="ignore", invalid="ignore"):  # parallel rays meet at infinity
        return vectors[:3, 0] / vectors[3, 0]


def triangulate_points(
    model: pycolmap.Reconstruction, marks: Marks, tolerance: float
) -> dict[str, Float64[np.ndarray, " 3"]]:
    """Triangulate each point from the largest set of at least two marks that agree with a pair of them.

    Args:
        tolerance: largest reprojection error, in image widths.
    """
    found = {}
    for name in marks.points:
        own = marks.where(marks.of(name))
        poses, rays = _rays(model, own)
        pairs = np.array(list(combinations(range(len(own)), 2)), dtype=int).reshape(-1, 2)
        if len(pairs) > _MOST_PAIRS:
            pairs = np.random.default_rng(0).permutation(pairs)[:_MOST_PAIRS]
        best, most = None, (0, 0.0)
        for pair in pairs:
            point = _triangulate_linearly(poses[pair], rays[pair])
            if not np.isfinite(point).all():
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
    model: pycolmap.Reconstruction, marks: Marks, down: Down, positions: PositionFit | None, shaped: bool = False
) -> tuple[Similarity, Bool[np.ndarray, " M"]]:
    """Estimate the similarity from a model to its control points.

    Candidates are similarities through minimal subsets of the points, and that of the cameras' positions shifted onto
    one point. All marks vote, so that a point with one mark counts too and a wrong point is outvoted.

    Args:
        positions: the model aligned with its cameras' positions. They determine what control points do not that are
            too few or on one line.
        shaped: whether the model was adjusted to the positions, which then count beside any control.

    Returns:
        The similarity, and which marks agree with it.

    Raises:
        SurveyError: there are too few points, they have too few marks, or most of the marks fit no similarity.
    """
    source, target = _pairs(model, marks)
    if positions is not None:
        _require_a_place(source, marks, shaped)
    candidates = hypotheses(source, target, None if positions else down.direction_model, np.random.default_rng(0))
    candidates = [one for one in candidates if down.is_upright(one)]
    if positions is not None:
        prior = positions.world_from_model
        shifts = target - prior(source)
        candidates += [prior, *(replace(prior, translation=prior.translation + shift) for shift in shifts)]
    if not candidates:
        raise SurveyError(
            f"{len(source)} control points show in two photographs or more, and the photographs have no positions: "
            "expected two such points; mark more, or give the photographs' positions"
        )
    similarity = min(candidates, key=lambda one: float((np.minimum(_share(model, marks, one), 1) ** 2).sum()))
    agree = _share(model, marks, similarity) < 1
    if 2 * np.count_nonzero(agree) < len(marks):
        more = "" if len(source) else "; of no point do two marks fit together: mark each in two photographs or more"
        raise SurveyError(
            f"only {np.count_nonzero(agree)} of the {len(marks)} marks of ground control fit together with the "
            "photographs: expected most of them; check the coordinate reference system, the order of the coordinates, "
            f"the names of the points and what size of photograph the marks were made on{more}"
        )
    source, target = _pairs(model, marks.where(agree))
    sigma = np.full_like(target, _CONTROL_M)
    if not (shaped and positions is not None) and not are_collinear(target):
        similarity = refine_similarity(similarity, source, target, sigma).similarity
    elif positions is not None:
        _require_a_place(source, marks.where(agree), shaped)
        similarity = _with_positions(similarity, source, target, positions)
    elif len(source) >= 2:
        prior_down = down.direction_model, down.sigma_rad
        similarity = refine_similarity(similarity, source, target, sigma, *prior_down).similarity
    return similarity, _share(model, marks, similarity) < 1


def _require_a_place(source: Float64[np.ndarray, "N 3"], marks: Marks, shaped: bool) -> None:
    """Raise an error where marks move nothing: no point is in the model, and too few are to be adjusted to."""
    names = list(marks.points)
    if len(source) == 0 and (shaped or are_collinear(marks.points.values())):
        raise SurveyError(
            f"no point of ground control ({list_names(names)}) has two marks that fit together, and one mark does not "
            "place a point in the model: expected marks of a point in two photographs; mark each point in two or more, "
            "or leave ground control out"
        )


def are_collinear(points: Collection[Float64[np.ndarray, " 3"]]) -> bool:
    """Test whether points leave a rotation undetermined: fewer than three, or on one line."""
    if len(points) < 3:
        return True
    xyz = np.array(list(points))
    spread = np.linalg.svd(xyz - xyz.mean(0), compute_uv=False)
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
    shift = np.median(target - prior(source), axis=0)  # one point in three may be wrong
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


def adjust_to_control(
    model: pycolmap.Reconstruction,
    marks: Marks,
    agree: Bool[np.ndarray, " M"],
    progress: Progress,
    shaped_by: PositionFit | None = None,
) -> Adjusted:
    """Adjust a model that is aligned with its control points, in place.

    The lens is adjusted too if this reduces the errors of the points that are left out in turn. Marks are added when
    the adjusted model agrees with them, and removed when it does not.

    Args:
        agree: the marks to start with.
        shaped_by: the positions that the model was adjusted to, as they are in the world; None if it was to none.
    """
    if are_collinear(marks.where(agree).points.values()):
        note = (
            "Fewer than three control points can be used, or they lie on one line: the photographs were aligned with "
            "them without adjustment, and cannot be checked."
        )
        found = _control_residuals(model, marks.where(agree))
        return Adjusted(found, Residuals(), _rejected(model, marks, agree), (note,), marks.where(agree).points_world)
    refused: set[str] = set()
    floor_m = _MARK_TOLERANCE * float(np.median(marks.width_px)) * _pixel_m(model)
    while shaped_by is not None and len(refused) < _WRONG_POINTS:  # which an adjustment would bend the model to
        shown = _control_residuals(model, marks.where(agree))
        apart = shown.error_m - np.median(shown.error_m, axis=0)
        if (wrong := _worst(Residuals(shown.names, apart), floor_m)) is None:
            break
        refused.add(wrong)
        agree = agree & ~marks.of(wrong)
    sound = reliable(model)
    while True:
        agree = _consistent(sound, marks, agree, False, refused)
        fixed = _cross_validate(sound, marks.where(agree), False, lambda done, whole: progress(done, 2 * whole))
        free = _cross_validate(sound, marks.where(agree), True, lambda done, whole: progress(done + whole, 2 * whole))
        free_lens = free.rms_m < _WORTH_FREEING * fixed.rms_m
        check = free if free_lens else fixed
        wrong = _worst(check, floor_m)
        if wrong is None or len(refused) == _WRONG_POINTS:
            break
        refused.add(wrong)
        agree = agree & ~marks.of(wrong)
    final = _consistent(sound, marks, agree, free_lens, refused)
    if (final != agree).any():
        agree, check = final, _cross_validate(sound, marks.where(final), free_lens, progress)
    adjusted = _adjusted(sound, marks.where(agree), free_lens)
    surveyed = marks.where(agree).points_world
    if shaped_by is not None:
        error = _control_residuals(model, marks.where(agree)).error_m
        shift = -error.mean(0) if len(error) else np.zeros(3)  # what is rejected now has moved the model, too
        shifted = pycolmap.Reconstruction(model)
        shifted.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(), shift))
        found = _control_residuals(shifted, marks.where(agree))
        by_shift = _without_own_shift(found)
        now, then = (_from_positions_m(one, shaped_by) for one in (shifted, adjusted))
        better = _share_of(check, by_shift)
        if not (better < _WORTH_RESHAPING or (better < _WORTH_FREEING and then <= _FARTHER * now)):
            model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(), shift))
            note = (
                "Ground control has moved the model, which keeps the shape that the positions gave it: adjusted to "
                f"the control alone, its cameras would be {metres(then)} from their positions, beside a common shift, "
                f"instead of {metres(now)}."
            )
            notes = (note, *_unchecked(marks.where(agree), by_shift, "one photograph shows it"))
            moved = replace(_UNMOVED, translation=shift)
            return Adjusted(found, by_shift, _rejected(model, marks, agree), notes, surveyed, moved)
    notes = []
    if free_lens:
        changes = [
            f"{camera.mean_focal_length():.1f} to {adjusted.camera(number).mean_focal_length():.1f} px"
            for number, camera in sorted(model.cameras.items())
        ]
        notes.append(
            f"Ground control corrected the lens (focal length {list_names(changes)}, principal point and distortion): "
            "this reduces the errors of points that are left out in turn."
        )
    notes += _unchecked(marks.where(agree), check, "one photograph shows it, or too few points would be left")
    carry_over(adjusted, model)
    found = _control_residuals(adjusted, marks.where(agree))
    return Adjusted(found, check, _rejected(adjusted, marks, agree), tuple(notes), surveyed)


def _unchecked(used: Marks, check: Residuals, why: str) -> list[str]:
    """A note on points that were used and not checked, if there are any."""
    names = sorted(used.points.keys() - set(check.names))
    return [f"Used, but not checked: {list_names(names)}; {why}."] if names else []


def _share_of(check: Residuals, other: Residuals) -> float:
    """Errors of points as a share of their errors in another check; NaN without a point in both."""
    both = [name for name in check.names if name in other.names]
    if not both:
        return np.nan
    one, two = (rms_m(found.error_m[[found.names.index(name) for name in both]]) for found in (check, other))
    return one / max(two, 1e-9)


def _without_own_shift(residuals: Residuals) -> Residuals:
    """Errors of points of a model that the others have shifted."""
    error, count = residuals.error_m, len(residuals.names)
    if count < 2:
        return Residuals()
    return Residuals(residuals.names, error + (error - error.mean(0)) / (count - 1))


def _from_positions_m(model: pycolmap.Reconstruction, positions: PositionFit) -> float:
    """Root mean square distance of cameras from their positions, but for a common shift, as that of another datum."""
    centres = camera_centres(model)
    away = np.array([centres[name] for name in positions.names]) - positions.given_world
    away = away[positions.used]
    return rms_m(away - np.median(away, axis=0))


def _adjusted(model: pycolmap.Reconstruction, marks: Marks, free_lens: bool) -> pycolmap.Reconstruction:
    """Copy a model in the world and adjust it to its matches and to marks of fixed points.

    Args:
        free_lens: adjust focal length, principal point and distortion too, of COLMAP's OPENCV.
    """
    copy = pycolmap.Reconstruction(model)
    config = all_images(copy)
    generalise_lenses(copy, config, free_lens)
    for name, surveyed in marks.points.items():
        track, own = pycolmap.Track(), marks.of(name)
        for number, uv in zip(marks.image[own], marks.uv_px[own], strict=True):
            points = copy.image(int(number)).points2D
            for _ in range(_REPEATS):
                points.append(pycolmap.Point2D(uv))
                track.add_element(int(number), len(points) - 1)
        config.add_constant_point(copy.add_point3D(surveyed, track))
    solve(copy, config, refine_focal_length=True)
    return copy


def _cross_validate(model: pycolmap.Reconstruction, marks: Marks, free_lens: bool, progress: Progress) -> Residuals:
    """Leave out each control point in turn, adjust, and triangulate it from its marks.

    With more than a dozen points a twelfth of them is left out at a time, with more than 300 photographs a quarter.
    Large models are thinned, which hardly changes the errors.

    Args:
        model: in the world, not yet adjusted to any of the points.
    """
    surveyed = marks.points
    seen = [name for name in surveyed if np.count_nonzero(marks.of(name)) >= 2]
    count = _FOLDS if model.num_reg_images() <= _LARGE else _FOLDS_OF_LARGE
    folds = [fold for fold in (seen[start::count] for start in range(count)) if fold]
    names, errors = [], []
    light = thinned(model)
    for done, fold in enumerate(folds):
        progress(done, len(folds))
        rest = marks.where(~marks.of(*fold))
        if are_collinear(rest.points.values()):
            continue
        adjusted = _adjusted(light, rest, free_lens)
        for name in fold:
            point = triangulate(adjusted, marks.where(marks.of(name)))
            if point is not None:
                names.append(name)
                errors.append(point - surveyed[name])
    progress(len(folds), len(folds))
    return Residuals(tuple(names), np.array(errors, dtype=np.float64).reshape(-1, 3))


def _control_residuals(adjusted: pycolmap.Reconstruction, marks: Marks) -> Residuals:
    """Compute triangulated minus surveyed coordinates of the control points."""
    seen, surveyed = triangulate_points(adjusted, marks, 1.0), marks.points
    errors = [point - surveyed[name] for name, point in seen.items()]
    return Residuals(tuple(seen), np.array(errors, dtype=np.float64).reshape(-1, 3))


def _consistent(
    model: pycolmap.Reconstruction, marks: Marks, agree: Bool[np.ndarray, " M"], free_lens: bool, refused: set[str]
) -> Bool[np.ndarray, " M"]:
    """Find marks with which a model agrees that is adjusted to them."""
    allowed = ~marks.of(*refused)
    for _ in range(_ROUNDS):
        adjusted = _adjusted(model, marks.where(agree), free_lens)
        share = reprojection_px(adjusted, marks, marks.surveyed_world) / marks.width_px
        found = allowed & (share < max(_MARK_TOLERANCE, 5 * 1.4826 * float(np.median(share[agree]))))
        # Where most of a point's marks disagree, those that agree do so by chance.
        found &= ~marks.of(*(n for n in marks.points if 2 * (found & marks.of(n)).sum() < marks.of(n).sum()))
        if (found == agree).all() or are_collinear(marks.where(found).points.values()):
            break
        agree = found
    return agree


def _worst(check: Residuals, floor_m: float) -> str | None:
    """Find the point of the largest error, if this is far larger than the others' median."""
    if len(check.names) < 4:
        return None
    distance = np.linalg.norm(check.error_m, axis=1)
    last = int(np.argmax(distance))
    typical = float(np.median(np.delete(distance, last)))
    return check.names[last] if distance[last] > max(_POINT_FACTOR * typical, floor_m) else None


def _pixel_m(model: pycolmap.Reconstruction) -> float:
    """Compute the ground sampling distance of the model's images: the median over the cameras."""
    ground = np.median([point.xyz[2] for point in model.points3D.values()])
    images = [model.image(number) for number in model.reg_image_ids()]
    return float(
        np.median([(i.projection_center()[2] - ground) / model.camera(i.camera_id).mean_focal_length() for i in images])
    )


def _rejected(model: pycolmap.Reconstruction, marks: Marks, agree: Bool[np.ndarray, " M"]) -> tuple[LeftOut, ...]:
    """Describe rejected marks: a point as a whole where its marks agree with one another, else mark by mark."""
    found = []
    pixels = reprojection_px(model, marks, marks.surveyed_world) * marks.zoom
    for name, surveyed in marks.points.items():
        own = marks.of(name)
        wrong = np.flatnonzero(own & ~agree)
        if len(wrong) == np.count_nonzero(own) >= 2:
            seen = triangulate_points(model, marks.where(own), 2 * _MARK_TOLERANCE)
            share = reprojection_px(model, marks.where(own), np.tile(seen.get(name, surveyed), (len(wrong), 1)))
            if name in seen and (share < 2 * _MARK_TOLERANCE * marks.width_px[own]).all():
                east, north, up = error_m = seen[name] - surveyed
                reason = (
                    f"its {len(wrong)} marks agree with one another, but show it "
                    f"{metres(float(np.linalg.norm(error_m)))} from where it was surveyed ({east:+.2f} m east, "
                    f"{north:+.2f} m north, {up:+.2f} m up): check its coordinates and its name"
                )
                found.append(LeftOut("control point", name, reason))
                continue
        found += [
            LeftOut(
                "mark",
                f"{name} in {marks.photograph[i]}",
                f"it is {pixels[i]:,.0f} pixels from where the surveyed point shows"
                if np.isfinite(pixels[i])
                else "the surveyed point is behind the camera",
            )
            for i in wrong
        ]
    return tuple(found)
