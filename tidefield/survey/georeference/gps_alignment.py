"""GPS alignment: the robust similarity from a model to the given positions of its cameras."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pycolmap
from jaxtyping import Bool, Float64

from tidefield.data.georeference import LeftOut
from tidefield.errors import SurveyError
from tidefield.geometry.geodesy import WGS84, LocalFrame, metres_per_degree, near_longitude
from tidefield.geometry.similarity import Similarity, hypotheses, least_median, outliers, refine_similarity
from tidefield.survey.io.positions import degrees_of, radius_m
from tidefield.survey.survey import Photograph, Position

DIFFERENTIAL_M = 0.3
"""Positions with a stated standard deviation below this are from a differential receiver."""
FEWEST_DIFFERENTIAL = 8
"""Positions of differential receivers that are enough to go by."""
_LEAST_BREADTH = 0.25
"""Differential positions are as long and as broad as this share of all, or they are not enough."""
_NOMINAL_M = 3.0
"""Standard deviation assumed for a receiver that states none: a good fix, so that only gross errors are rejected."""
_NARROW_M = 3 * _NOMINAL_M
"""Positions on one line may be as broad as this by their receivers' errors alone."""
_LEAST_M = 0.01
"""Smallest standard deviation, which keeps the weights finite."""
_MAX_TILT_RAD = math.radians(1.0)
"""If positions determine the vertical less accurately than this, a prior from the photographs is used."""
_GIMBALS = "the gimbals' pitch"
_VIEWING = "the mean viewing direction, as if the photographs looked straight down"
_MAX_GIMBAL_TILT_DEG = 2.0
"""Good positions and gimbals differ by less: by 1.3 degrees in brighton_beach, by 1.2 in turin_lot."""
_MAX_SIGMAS = 4.0
"""Photographs that differ by more from the vertical of the positions do not look straight down, but at a wall."""
_MIRRORED = 0.3
"""Positions were mirrored if their mirror image has a median error of less than this share of theirs."""
_DATUMS = {
    "mean sea level": "mean sea level, as the receivers know it",
    "ellipsoid": "the WGS 84 ellipsoid",
    "unknown": "unknown; heights are as the receivers gave them",
}


@dataclass(frozen=True)
class GivenPositions:
    """Positions of photographs.

    Attributes:
        names: of the photographs.
        longitude_latitude_height: WGS 84, degrees and metres.
        stated_m: standard deviations (horizontal, vertical) stated by the receivers, NaN where they state none, or the
            height is not theirs.
        vertical_datum: of the heights, as text.
        has_heights: otherwise all are taken to be at one height.
        notes: which positions or heights are not used, as whole sentences.
    """

    names: tuple[str, ...]
    longitude_latitude_height: Float64[np.ndarray, "N 3"]
    stated_m: Float64[np.ndarray, "N 2"]
    vertical_datum: str
    has_heights: bool = True
    notes: tuple[str, ...] = ()

    @property
    def middle(self) -> tuple[float, float]:
        """Median longitude and latitude."""
        longitude, latitude, _ = np.median(self.longitude_latitude_height, axis=0)
        return float(longitude), float(latitude)

    @property
    def radius_m(self) -> float:
        """How far they reach from there."""
        return radius_m(self.longitude_latitude_height[:, :2], self.middle)

    def frame(self) -> LocalFrame:
        """Create a local frame at their middle, with products in its UTM zone and heights as given."""
        return LocalFrame.at(WGS84, (*self.middle, 0.0), self.vertical_datum)


def given_positions(photographs: Sequence[Photograph]) -> GivenPositions:
    """Collect positions with heights: absolute ones, else above take-off, else all at one height.

    Heights are used if at least half of the positions have them; positions without are then left out. So are those
    whose heights may be over another vertical datum, which would tilt the model.
    """
    located = [(photograph, photograph.position) for photograph in photographs if photograph.position is not None]
    with_height = [pair for pair in located if math.isfinite(pair[1].height_m)]
    absolute = _of_one_datum(with_height)
    relative = [pair for pair in located if math.isfinite(pair[0].relative_altitude_m)]
    enough, count, without, notes = max(3, len(located) / 2), len(located), 0, []
    has_heights = True
    if len(with_height) >= enough and len(absolute) >= 3:
        located, heights, without = absolute, [position.height_m for _, position in absolute], count - len(with_height)
        datum = _DATUMS[absolute[0][1].datum]
        own = _datum(absolute[0][1])
        if others := [_datum(position) for _, position in with_height if _datum(position) != own]:
            notes.append(
                f"{len(others)} of {count} positions are not used: their heights are over "
                f"{' and '.join(sorted(set(others)))}, those of the others over {own}. To have them used, give all "
                "positions in one file, with heights over one vertical datum."
            )
    elif len(relative) >= enough:
        located, heights = relative, [photograph.relative_altitude_m for photograph, _ in relative]
        datum, without = "the place of take-off", count - len(relative)
    else:
        heights, has_heights = [0.0] * count, False
        datum = "the mean height of flight, since too few photographs have heights"
        if absolute or relative:
            notes.append(
                f"Only {max(len(absolute), len(relative))} of {count} positions have a height over one vertical datum: "
                "all are taken to be at one height. To have these heights used, add those of the others, or remove the "
                "others' positions."
            )
    if without:
        notes.append(f"{without} of {count} positions are not used: they have no height, unlike the others.")
    vertical_m = [position.vertical_m if located is absolute else math.nan for _, position in located]
    stated = [(position.horizontal_m, vertical) for (_, position), vertical in zip(located, vertical_m, strict=True)]
    degrees = degrees_of([photograph for photograph, _ in located])
    return GivenPositions(
        names=tuple(photograph.name for photograph, _ in located),
        longitude_latitude_height=np.column_stack([degrees, np.array(heights, dtype=np.float64)]),
        stated_m=np.array(stated, dtype=np.float64).reshape(-1, 2),
        vertical_datum=datum,
        has_heights=has_heights,
        notes=tuple(notes),
    )


def _of_one_datum(located: Sequence[tuple[Photograph, Position]]) -> list[tuple[Photograph, Position]]:
    """Select positions with one vertical datum: that of most, or of a differential receiver that saw the survey.

    A few differential positions at one place or on one line say less of the model's tilt than many others, unless these
    are on one line, too.
    """
    by_datum = defaultdict(list)
    for pair in located:
        by_datum[_datum(pair[1])].append(pair)
    across_m, along_m = _breadths_m([position for _, position in located])
    least_m = _LEAST_BREADTH * np.array([across_m if across_m > _NARROW_M else 0.0, along_m])

    def worth(own: Sequence[tuple[Photograph, Position]]) -> tuple[bool, int]:
        accurate = [p for _, p in own if p.horizontal_m < DIFFERENTIAL_M and p.vertical_m < DIFFERENTIAL_M]
        return len(accurate) >= FEWEST_DIFFERENTIAL and bool((_breadths_m(accurate) >= least_m).all()), len(own)

    return max(by_datum.values(), key=worth, default=[])


def _breadths_m(positions: Sequence[Position]) -> Float64[np.ndarray, " 2"]:
    """Standard deviations of positions across the line that they lie along, and along it."""
    if len(positions) < 2:
        return np.zeros(2)
    degrees = np.array([(p.longitude_deg, p.latitude_deg) for p in positions])
    degrees[:, 0] = near_longitude(degrees[:, 0], degrees[0, 0])
    return np.sqrt(np.maximum(0.0, np.linalg.eigvalsh(np.cov((degrees * metres_per_degree(degrees[0, 1])).T))))


def _datum(position: Position) -> str:
    """Name a height's vertical datum: the ellipsoid is one, but two sources' sea levels may be tens of metres apart."""
    if position.datum == "ellipsoid":
        return "the ellipsoid"
    source = position.source.partition(", ")[0].replace("XMP", "EXIF")
    return f"{'an unknown datum' if position.datum == 'unknown' else position.datum} ({source})"


@dataclass(frozen=True)
class Down:
    """Direction of gravity in a model.

    Attributes:
        direction_model: unit vector.
        sigma_rad: standard deviation.
        source: of the direction, as text.
        below_model: a direction below the horizon, also where the other one is far off.
    """

    direction_model: Float64[np.ndarray, " 3"]
    sigma_rad: float
    source: str
    below_model: Float64[np.ndarray, " 3"]

    def is_upright(self, world_from_model: Similarity) -> bool:
        """Whether a similarity puts the ground below the cameras."""
        return bool((world_from_model.rotation @ self.below_model)[2] < 0)

    def off_rad(self, world_from_model: Similarity) -> float:
        """Angle between this direction and the vertical of a similarity."""
        return math.acos(np.clip(-(world_from_model.rotation @ self.direction_model)[2], -1, 1))


@dataclass(frozen=True)
class PositionFit:
    """A model aligned with its cameras' positions.

    Attributes:
        names: of the photographs.
        world_from_model: the similarity.
        centres_model: projection centres of the cameras.
        given_world: their given positions.
        used: which were not gross errors.
        sigma_m: observed standard deviations (east, north, up), per position.
        left_out: the gross errors, named.
        notes: what the positions do not determine.
    """

    names: tuple[str, ...]
    world_from_model: Similarity
    centres_model: Float64[np.ndarray, "N 3"]
    given_world: Float64[np.ndarray, "N 3"]
    used: Bool[np.ndarray, " N"]
    sigma_m: Float64[np.ndarray, "N 3"]
    left_out: tuple[LeftOut, ...]
    notes: tuple[str, ...]


def camera_centres(model: pycolmap.Reconstruction) -> dict[str, Float64[np.ndarray, " 3"]]:
    """Map names of registered photographs to their projection centres in the model."""
    images = [model.image(number) for number in model.reg_image_ids()]
    return {image.name: image.projection_center() for image in images}


def find_down(model: pycolmap.Reconstruction, photographs: Sequence[Photograph]) -> Down:
    """Estimate the direction of gravity from gimbal angles, else from how photographs are usually held.

    Photographs are taken level: their x axes are horizontal, whichever way the camera points. Where these axes are all
    parallel, they leave the pitch open: down is the direction nearest to the mean viewing direction that is
    perpendicular to them. This is right for photographs straight down, and off by 90 degrees for those of a wall.
    """
    gimbal = {p.name: p.gimbal_deg for p in photographs if p.gimbal_deg is not None}
    images = [model.image(number) for number in model.reg_image_ids()]
    R_camera_model = np.array([image.cam_from_world().rotation.matrix() for image in images])
    stated = [i for i, image in enumerate(images) if image.name in gimbal]
    if 2 * len(stated) > len(images):
        pitch, roll = np.deg2rad([gimbal[images[i].name][1:] for i in stated]).T
        down_camera = np.stack([np.cos(pitch) * np.sin(roll), np.cos(pitch) * np.cos(roll), -np.sin(pitch)], axis=1)
        down_model = np.einsum("nji,nj->ni", R_camera_model[stated], down_camera)
        direction = _unit(np.median(down_model, axis=0))
        return Down(direction, math.radians(1), _GIMBALS, direction)
    x, forward = R_camera_model[:, 0], R_camera_model[:, 2].mean(0)
    # Between the viewing direction and the image's down, which is below the horizon for pitches from -135 to +45
    # degrees; the viewing direction itself is above it for cameras that look slightly upwards.
    below = forward + R_camera_model[:, 1].mean(0)
    strength, axes = np.linalg.eigh(x.T @ x / len(x))
    if strength[1] > 0.05:
        direction = axes[:, 0] * (1.0 if axes[:, 0] @ below >= 0 else -1.0)
        return Down(direction, math.radians(5), "level photographs", direction)
    along = axes[:, 2]
    return Down(_unit(forward - (forward @ along) * along), math.radians(5), _VIEWING, below)


def fit_positions(
    model: pycolmap.Reconstruction, photographs: Sequence[Photograph], positions: GivenPositions, frame: LocalFrame
) -> PositionFit | None:
    """Estimate the similarity from a model to its cameras' positions, without moving it.

    Args:
        photographs: of the model. Their direction of gravity is a prior for positions that do not determine the
            vertical (all on one line).
        positions: of these photographs.
        frame: the world.

    Returns:
        None if there are fewer than three positions, or if they do not follow the model's cameras.

    Raises:
        SurveyError: the positions mirror the survey, as they do when latitude and longitude are swapped.
    """
    if len(positions.names) < 3:
        return None
    down, centre_of = find_down(model, photographs), camera_centres(model)
    centres = np.array([centre_of[name] for name in positions.names])
    given = frame.from_geographic(positions.longitude_latitude_height)
    stated = positions.stated_m[:, [0, 0, 1]]
    nominal = np.where(np.isfinite(stated), stated, _NOMINAL_M)
    # The least median has no weights: it would follow the receiver of most photographs, not the accurate one.
    differential = np.all(stated < DIFFERENTIAL_M, axis=1)
    enough = np.count_nonzero(differential) >= FEWEST_DIFFERENTIAL
    first = differential if enough else np.ones(len(given), dtype=bool)
    similarity, median = _robust_start(centres[first], given[first], down)
    if median > _NOMINAL_M:
        _refuse_mirrored(centres, positions, down, median)
    sigma, notes, used = nominal, (), np.ones(len(given), dtype=bool)
    for _ in range(3):
        error = similarity(centres) - given
        used = ~outliers(np.linalg.norm(error, axis=1), 5 * np.linalg.norm(nominal, axis=1))
        sigma = _observed_sigma(error, used, nominal)
        refined, notes = refine_similarity(similarity, centres[used], given[used], sigma[used]), ()
        is_open = refined.tilt_rad >= _MAX_TILT_RAD
        limit_rad = _MAX_SIGMAS * math.hypot(refined.tilt_rad, down.sigma_rad)
        if is_open and down.source == _VIEWING and down.off_rad(refined.similarity) > limit_rad:
            notes = (
                "The vertical is that of the cameras' positions alone, to within about "
                f"{math.degrees(refined.tilt_rad):.1f} degrees: the photographs do not look straight down.",
            )
        elif is_open:
            prior = down.direction_model, down.sigma_rad
            refined = refine_similarity(similarity, centres[used], given[used], sigma[used], *prior)
            notes = (
                "The cameras' positions alone do not determine the vertical (they lie on one line, or are too "
                f"inaccurate): it is taken from {down.source}, to within about "
                f"{math.degrees(refined.tilt_rad):.1f} degrees.",
            )
        similarity = refined.similarity
    tilt_deg = math.degrees(down.off_rad(similarity))
    if not notes and down.source == _GIMBALS and tilt_deg > _MAX_GIMBAL_TILT_DEG:
        notes = (
            f"The vertical by the cameras' positions is {tilt_deg:.1f} degrees off that of the gimbals: some heights "
            "may be wrong, or be over another vertical datum.",
        )
    error = similarity(centres) - given
    spread_m = rms_m((given[used] - given[used].mean(0))[:, :2])
    if np.count_nonzero(used) < 3 or rms_m(error[used, :2]) >= 0.5 * spread_m or spread_m < _LEAST_M:
        return None
    distance = np.linalg.norm(error, axis=1)
    typical = metres(float(np.median(distance[used])))
    gross_errors = tuple(
        LeftOut(
            "GPS",
            positions.names[i],
            f"its position lies {metres(float(distance[i]))} from where the photographs place the camera; "
            f"half of the others are within {typical}",
        )
        for i in np.flatnonzero(~used)
    )
    return PositionFit(positions.names, similarity, centres, given, used, sigma, gross_errors, notes)


def rms_m(error_m: Float64[np.ndarray, "N K"]) -> float:
    """Compute the root mean square length of errors."""
    return float(np.sqrt((error_m**2).sum(1).mean()))


def metres(length_m: float) -> str:
    """Format a length with the digits that matter."""
    if length_m >= 10_000:
        return f"{length_m / 1000:,.0f} km"
    if length_m >= 2:
        return f"{length_m:,.0f} m" if length_m >= 20 else f"{length_m:.1f} m"
    return f"{100 * length_m:.0f} cm"


def _observed_sigma(
    error: Float64[np.ndarray, "N 3"], used: Bool[np.ndarray, " N"], nominal: Float64[np.ndarray, "N 3"]
) -> Float64[np.ndarray, "N 3"]:
    """Estimate robust standard deviations, horizontal and vertical, from residuals; nominal ones are relative weights.

    A model bends by more than a differential receiver errs, so a stated accuracy separates good fixes from poor ones,
    but does not predict the residuals.
    """
    relative = np.maximum(nominal, _LEAST_M) / np.maximum(np.median(nominal, axis=0), _LEAST_M)
    scaled = np.abs(error[used]) / relative[used]
    horizontal = max(_LEAST_M, 1.4826 * float(np.median(scaled[:, :2])))
    vertical = max(_LEAST_M, 1.4826 * float(np.median(scaled[:, 2])))
    return relative * [horizontal, horizontal, vertical]


def _robust_start(
    source: Float64[np.ndarray, "N 3"], target: Float64[np.ndarray, "N 3"], down: Down
) -> tuple[Similarity, float]:
    """Find the similarity of least median distance among those with the ground below the cameras; also the median."""
    candidates = hypotheses(source, target, down.direction_model, np.random.default_rng(0))
    return least_median([one for one in candidates if down.is_upright(one)], source, target)


def _refuse_mirrored(
    centres_model: Float64[np.ndarray, "N 3"], positions: GivenPositions, down: Down, median: float
) -> None:
    """Raise an error if swapped coordinates or a changed sign make the positions fit."""
    given = positions.longitude_latitude_height
    corrections = {
        "latitude and longitude are swapped": given[:, [1, 0, 2]],
        "the sign of one of the two is wrong": given * [-1, 1, 1],
    }
    for mistake, corrected in corrections.items():
        possible = np.abs(corrected[:, 1]) < 90
        if np.count_nonzero(possible) < 3:
            continue
        longitude, latitude = np.median(corrected[possible], axis=0)[:2]
        frame = LocalFrame.at(WGS84, (float(longitude), float(latitude), 0.0))
        _, least = _robust_start(centres_model[possible], frame.from_geographic(corrected[possible]), down)
        if least < _MIRRORED * median:
            raise SurveyError(
                f"the positions of the photographs (latitude {positions.middle[1]:.5f}, longitude "
                f"{positions.middle[0]:.5f}) mirror what the photographs show: {mistake}; "
                "expected latitude, counted positive to the north, and longitude, to the east; correct them where they "
                "were given"
            )


def _unit(vector: Float64[np.ndarray, " 3"]) -> Float64[np.ndarray, " 3"]:
    return vector / np.linalg.norm(vector)
