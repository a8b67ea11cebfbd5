"""Pinhole cameras with Brown's lens distortion and fisheye cameras, and their removal from photographs.

Pixel coordinates have pixel centres at +0.5, as COLMAP's have, so a photograph of width W spans u in [0, W]. OpenCV's
have them at 0: half a pixel is taken off the principal point wherever OpenCV is called, and nowhere else.

With x, y on the plane z = 1 of the camera and r^2 = x^2 + y^2 (Brown 1971, as in OpenCV and COLMAP):

    radial = 1 + k1 r^2 + k2 r^4 + k3 r^6
    x_d = x radial + 2 p1 x y + p2 (r^2 + 2 x^2)
    y_d = y radial + 2 p2 x y + p1 (r^2 + 2 y^2)
    u = fx x_d + cx,   v = fy y_d + cy

and of a fisheye lens (Kannala and Brandt 2006, as OpenCV's fisheye module has it), with theta = atan r

    theta_d = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)
    x_d = x theta_d / r,   y_d = y theta_d / r
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from typing import TypeVar

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from tidefield.errors import SceneError

_WIDEST = 1_000_000
_FOCAL_RANGE = 1e-3, 1e4
"""Of the longer side: fields of view from 0.006 to 179.9 degrees."""
_FARTHEST_PRINCIPAL = 10.0
"""From the middle of the photograph, in its longer sides: those that are cut out of larger ones have theirs outside."""
_LARGEST_TERM = 1e12
"""Of the distortion, whose squares appear in its Jacobian; terms of real lenses are at most some hundreds."""
WIDEST_DEG = 120.0
"""Of a fisheye's pinhole: farther out, its pixels are stretched more than fourfold along the radius."""
_LEAST_SHARE = 0.01
"""Of the field of view that a lens would have without distortion: a pinhole's is larger."""

COLMAP_PARAMETERS = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "SIMPLE_RADIAL_FISHEYE": ("f", "cx", "cy", "k1"),
    "RADIAL_FISHEYE": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV_FISHEYE": ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
    "FULL_OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
}
"""COLMAP's camera models that are a `Lens` or a `FisheyeLens`, and their parameters in order."""
FISHEYES = ("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE")
COLMAP_MODELS = (
    *("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV", "FOV"),
    *("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE"),
    *("SIMPLE_DIVISION", "DIVISION", "SIMPLE_FISHEYE", "FISHEYE", "EUCM", "EQUIRECTANGULAR"),
)
"""All of COLMAP's camera models, each at the index that stands for it in cameras.bin (src/colmap/sensor/models.h)."""

Points = Float[np.ndarray, "P 2"]
L = TypeVar("L", bound="LensModel")
_Jacobian = tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True)
class LensModel(ABC):
    """Interior orientation of a camera for photographs of width x height pixels: any of the module's equations."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    def __post_init__(self) -> None:
        longer = max(self.width, self.height)
        # Comparisons with NaN are false.
        usable = 1 <= min(self.width, self.height) <= longer <= _WIDEST
        usable &= all(_FOCAL_RANGE[0] * longer <= f <= _FOCAL_RANGE[1] * longer for f in (self.fx, self.fy))
        usable &= abs(self.cx - self.width / 2) <= _FARTHEST_PRINCIPAL * longer
        usable &= abs(self.cy - self.height / 2) <= _FARTHEST_PRINCIPAL * longer
        if not (usable and all(abs(term) <= _LARGEST_TERM for term in self.distortion)):
            raise SceneError(
                f"a camera has the unusable calibration {self}: expected a size of 1 to {_WIDEST} pixels, focal "
                f"lengths of {_FOCAL_RANGE[0]:g} to {_FOCAL_RANGE[1]:g} times the longer side and a principal point "
                "near the photograph; calibrate the photographs again"
            )

    @property
    @abstractmethod
    def distortion(self) -> tuple[float, ...]:
        """The terms of the distortion, in OpenCV's order."""

    @property
    @abstractmethod
    def colmap_model(self) -> str:
        """The simplest of COLMAP's models that has all of the lens's terms."""

    @property
    @abstractmethod
    def is_distorted(self) -> bool: ...

    @abstractmethod
    def distort(self, xy: Points) -> Points:
        """Apply the distortion to points of the plane z = 1."""

    @abstractmethod
    def _jacobian(self, xy: Points) -> _Jacobian:
        """The (symmetric) derivative of `distort`."""

    @abstractmethod
    def _reach(self) -> tuple[float, float]:
        """The largest x and y on the plane z = 1 that a pinhole may have."""

    @abstractmethod
    def _tables(self) -> tuple[np.ndarray, np.ndarray]:
        """Where each pixel of `pinhole()` lies in the photograph, as OpenCV's remap takes it."""

    def undistort(self, xy_distorted: Points) -> Points:
        """Invert `distort` by Newton's method; NaN where the lens images no point.

        cv2.undistortPoints is ten times as fast, but on the lens of a real survey wrong by 0.004 px.
        """
        if not self.is_distorted:
            return xy_distorted.copy()
        xy = self._newton(xy_distorted, xy_distorted)
        # Where distortion lengthens, the start may lie beyond the fold of points within it.
        if (lost := np.isnan(xy).any(axis=1)).any():
            xy[lost] = self._newton(0.5 * xy_distorted[lost], xy_distorted[lost])
        return xy

    def _newton(self, start: Points, xy_distorted: Points) -> Points:
        """`undistort` from a start."""
        xy = start.astype(np.float64)
        with np.errstate(all="ignore"):  # points without a solution diverge; they become NaN below
            for _ in range(50):
                residual = self.distort(xy) - xy_distorted
                (a, b), (c, d) = self._jacobian(xy)
                step = np.stack([d * residual[:, 0] - b * residual[:, 1], a * residual[:, 1] - c * residual[:, 0]], -1)
                step /= (a * d - b * c)[:, None]
                xy -= step
                if not (np.abs(step) > 1e-13).any():
                    break
            found = (np.abs(self.distort(xy) - xy_distorted).max(-1) < 1e-9) & self._is_unfolded(xy)
        return np.where(found[:, None], xy, np.nan)

    def project(self, points_camera: Float[np.ndarray, "P 3"]) -> Points:
        """Project points in front of the camera to pixels."""
        xy = self.distort(points_camera[:, :2] / points_camera[:, 2:])
        return xy * (self.fx, self.fy) + (self.cx, self.cy)

    def unproject(self, uv_px: Points) -> Points:
        """Back-project pixels to the plane z = 1; NaN where the lens images no point."""
        return self.undistort((uv_px - (self.cx, self.cy)) / (self.fx, self.fy))

    def resized(self: L, width: int, height: int) -> L:
        """Scale the lens to photographs of another size."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self, width=width, height=height, fx=self.fx * sx, fy=self.fy * sy, cx=self.cx * sx, cy=self.cy * sy
        )

    @lru_cache(maxsize=256)  # noqa: B019 - a frozen value: the cache holds no more than a few hundred small objects
    def pinhole(self) -> Lens:
        """Compute the distortion-free camera of the same size with the largest field of view inside the photograph.

        Of a fisheye it is at most `WIDEST_DEG` along the longer side; what lies beyond is left out.
        Its image has no blank pixels: its image plane is the inner rectangle of the undistorted photograph, so fx and
        fy may differ slightly where those of the lens do not. A lens without distortion is returned unchanged.
        (cv2.getOptimalNewCameraMatrix with alpha=0 samples the border more coarsely and ignores folds.)
        """
        if isinstance(self, Lens) and not self.is_distorted:
            return self
        x0, x1, y0, y1 = self._inner_rectangle()
        fx, fy = self.width / (x1 - x0), self.height / (y1 - y0)
        return Lens(self.width, self.height, fx, fy, -x0 * fx, -y0 * fy)

    def to_pinhole(self, uv_px: Points, pinhole: Lens) -> Points:
        """Move pixels of a photograph to the undistorted one; NaN outside of it."""
        uv = self.unproject(uv_px) * (pinhole.fx, pinhole.fy) + (pinhole.cx, pinhole.cy)
        inside = (uv >= 0) & (uv < (pinhole.width, pinhole.height))
        return np.where(inside.all(axis=1, keepdims=True), uv, np.nan)

    def _is_unfolded(self, xy: Points) -> np.ndarray:
        """Test that no fold lies between the axis and each point; beyond a fold, two points share a pixel."""
        along = np.linspace(0.0, 1.0, 17)[1:, None, None]
        (a, b), (c, d) = self._jacobian((along * xy).reshape(-1, 2))
        # Both eigenvalues of the (symmetric) Jacobian are positive until the first fold.
        unfolded = (a * d - b * c > 0) & (a + d > 0)
        return np.logical_and.reduce(unfolded.reshape(len(along), -1), axis=0)

    def _inner_rectangle(self) -> tuple[float, float, float, float]:
        """Find left, right, top and bottom on the plane z = 1 of a rectangle that lies inside the photograph."""
        left, right, top, bottom = map(self.unproject, _sides(0.0, float(self.width), 0.0, float(self.height)))
        # A side that the model never reaches (it folds over before) starts far out and is shrunk below.
        widest, highest = self._reach()
        x0, x1 = np.nanmax(left[:, 0], initial=-widest), np.nanmin(right[:, 0], initial=widest)
        y0, y1 = np.nanmax(top[:, 1], initial=-highest), np.nanmin(bottom[:, 1], initial=highest)
        if not (x0 < 0 < x1 and y0 < 0 < y1):
            raise SceneError(f"the principal point of {self} lies outside its photographs; calibrate them again")
        rectangle = np.array([x0, x1, y0, y1])
        # Usually 1. Less where corners fold over, or stick out of a photograph with a wavy border.
        share = 1.0
        least = _LEAST_SHARE * min(self.width / self.fx, self.height / self.fy) / min(x1 - x0, y1 - y0)
        while share >= least and not self._contains(share * rectangle):
            share *= 0.995
        if share < least:
            raise SceneError(
                f"the distortion of {self} leaves nothing of its photographs: expected that of a lens; calibrate them "
                "again"
            )
        x0, x1, y0, y1 = (share * rectangle).tolist()
        return x0, x1, y0, y1

    def _contains(self, rectangle: Float[np.ndarray, " 4"]) -> bool:
        """Test whether a rectangle of the plane z = 1 lies inside the photograph."""
        border = np.concatenate(_sides(*rectangle.tolist()))
        uv = self.distort(border) * (self.fx, self.fy) + (self.cx, self.cy)
        # The border is sampled; 0.05 px is far less than what repeating the edge pixels hides.
        inside = (uv > -0.05).all() and (uv < np.array([self.width, self.height]) + 0.05).all()
        return bool(inside and self._is_unfolded(border).all())


@dataclass(frozen=True)
class Lens(LensModel):
    """A lens with Brown's distortion, or without distortion."""

    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0

    @property
    def distortion(self) -> tuple[float, float, float, float, float]:
        """(k1, k2, p1, p2, k3): OpenCV's order."""
        return (self.k1, self.k2, self.p1, self.p2, self.k3)

    @property
    def colmap_model(self) -> str:
        """The simplest of COLMAP's models that has all of the lens's terms."""
        return "FULL_OPENCV" if self.k3 else "OPENCV" if self.is_distorted else "PINHOLE"

    @property
    def is_distorted(self) -> bool:
        return any(self.distortion)

    def distort(self, xy: Points) -> Points:
        """Apply the distortion to points of the plane z = 1."""
        x, y = xy[:, 0], xy[:, 1]
        r2 = x * x + y * y
        radial = 1 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
        x_d = x * radial + 2 * self.p1 * x * y + self.p2 * (r2 + 2 * x * x)
        y_d = y * radial + 2 * self.p2 * x * y + self.p1 * (r2 + 2 * y * y)
        return np.stack([x_d, y_d], axis=-1)

    def _jacobian(self, xy: Points) -> _Jacobian:
        x, y = xy[:, 0], xy[:, 1]
        r2 = x * x + y * y
        radial = 1 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
        slope = 2 * (self.k1 + r2 * (2 * self.k2 + r2 * 3 * self.k3))
        mixed = x * y * slope + 2 * self.p1 * x + 2 * self.p2 * y
        dx = radial + x * x * slope + 2 * self.p1 * y + 6 * self.p2 * x
        dy = radial + y * y * slope + 2 * self.p2 * x + 6 * self.p1 * y
        return (dx, mixed), (mixed, dy)

    def _reach(self) -> tuple[float, float]:
        return 4.0 * self.width / self.fx, 4.0 * self.height / self.fy

    def _tables(self) -> tuple[np.ndarray, np.ndarray]:
        return cv2.initUndistortRectifyMap(
            _opencv_matrix(self),
            np.array(self.distortion),
            None,  # pyright: ignore[reportCallIssue, reportArgumentType] - None is OpenCV's "no rotation"
            _opencv_matrix(self.pinhole()),
            (self.width, self.height),
            cv2.CV_32FC1,
        )


@dataclass(frozen=True)
class FisheyeLens(LensModel):
    """A fisheye lens, whose images of equal angles are about equally long: COLMAP's and OpenCV's OPENCV_FISHEYE."""

    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0

    @property
    def distortion(self) -> tuple[float, float, float, float]:
        return (self.k1, self.k2, self.k3, self.k4)

    @property
    def colmap_model(self) -> str:
        return "OPENCV_FISHEYE"

    @property
    def is_distorted(self) -> bool:
        return True

    def distort(self, xy: Points) -> Points:
        return xy * self._scale(xy)[0][:, None]

    def _scale(self, xy: Points) -> tuple[np.ndarray, np.ndarray]:
        """theta_d / r, and its derivative with respect to r, over r."""
        r = np.hypot(*xy.T)
        # Near the axis theta_d = r to the last digit, and the derivative is multiplied by r^2.
        near = r < 1e-6
        r = np.where(near, 1.0, r)
        theta = np.arctan(r)
        square = theta * theta
        angle = theta * (1 + square * (self.k1 + square * (self.k2 + square * (self.k3 + square * self.k4))))
        slope = 1 + square * (3 * self.k1 + square * (5 * self.k2 + square * (7 * self.k3 + square * 9 * self.k4)))
        scale = angle / r
        change = (slope / (1 + r * r) - scale) / (r * r)
        return np.where(near, 1.0, scale), np.where(near, 0.0, change)

    def _jacobian(self, xy: Points) -> _Jacobian:
        (x, y), (scale, change) = xy.T, self._scale(xy)
        mixed = x * y * change
        return (scale + x * x * change, mixed), (mixed, scale + y * y * change)

    def _reach(self) -> tuple[float, float]:
        longer = np.tan(np.radians(WIDEST_DEG / 2)) / max(self.width, self.height)
        return longer * self.width, longer * self.height

    def _tables(self) -> tuple[np.ndarray, np.ndarray]:
        return cv2.fisheye.initUndistortRectifyMap(
            _opencv_matrix(self),
            np.array(self.distortion),
            np.eye(3),
            _opencv_matrix(self.pinhole()),
            (self.width, self.height),
            cv2.CV_32FC1,
        )


def _sides(x0: float, x1: float, y0: float, y1: float) -> list[Points]:
    """Sample the left, right, top and bottom side of a rectangle."""
    x, y = np.linspace(x0, x1, 201), np.linspace(y0, y1, 201)
    return [np.stack(np.broadcast_arrays(u, v), -1) for u, v in ((x0, y), (x1, y), (x, y0), (x, y1))]


def lens_from_colmap(
    model: str, width: int, height: int, parameters: Sequence[float] | Float[np.ndarray, " K"]
) -> Lens | FisheyeLens:
    """Convert the parameters of a COLMAP camera.

    Raises:
        SceneError: for other models, for FULL_OPENCV's k4, k5, k6, and for a wrong number of parameters.
    """
    if model not in COLMAP_PARAMETERS:
        raise SceneError(
            f"a camera has COLMAP's model {model}: supported are {', '.join(COLMAP_PARAMETERS)}; run COLMAP's "
            "image_undistorter and open its output, or reconstruct again with --ImageReader.camera_model OPENCV"
        )
    names = COLMAP_PARAMETERS[model]
    if len(names) != len(parameters):
        raise SceneError(f"a {model} camera has {len(parameters)} parameters, expected {len(names)}: {names}")
    values = dict(zip(names, map(float, parameters), strict=True))
    if "f" in values:
        values["fx"] = values["fy"] = values.pop("f")
    if model in FISHEYES:
        return FisheyeLens(width, height, **values)
    if any([values.pop(name, 0.0) for name in ("k4", "k5", "k6")]):
        raise SceneError(
            "a FULL_OPENCV camera has k4, k5 or k6 other than 0: supported are k1, k2, k3, p1, p2; run COLMAP's "
            "image_undistorter and open its output, or reconstruct again with --ImageReader.camera_model OPENCV"
        )
    return Lens(width, height, **values)


def colmap_parameters(lens: LensModel, model: str) -> list[float]:
    """List a lens's parameters in the order of a COLMAP model; terms that this model lacks are dropped."""
    values = {**asdict(lens), "f": (lens.fx + lens.fy) / 2}
    return [values.get(name, 0.0) for name in COLMAP_PARAMETERS[model]]


def rectify(
    photograph: UInt8[np.ndarray, "H W C"], lens: LensModel, width: int, height: int
) -> UInt8[np.ndarray, "height width C"]:
    """Resample a photograph to its `lens.pinhole()`, reduced to width x height pixels.

    Distortion is removed at full resolution with a sharp interpolator, then every pixel of the result is the mean of
    the pixels that it covers. Without distortion and without reduction the photograph is returned unchanged.
    """
    assert photograph.shape[:2] == (lens.height, lens.width), "the lens belongs to a photograph of another size"
    channels = photograph.shape[2]
    if lens.is_distorted:
        # Lanczos is the sharper; averaging over blocks of pixels hides the difference and cubic takes a quarter of it.
        kernel = cv2.INTER_LANCZOS4 if width > lens.width / 2 else cv2.INTER_CUBIC
        photograph = cv2.remap(photograph, *_remap_tables(lens), kernel, borderMode=cv2.BORDER_REPLICATE)
    if (width, height) != (lens.width, lens.height):
        photograph = cv2.resize(photograph, (width, height), interpolation=cv2.INTER_AREA)
    return photograph.reshape(height, width, channels)


@lru_cache(maxsize=2)  # one survey has one or two cameras; the tables of a 50-megapixel one take 400 MB
def _remap_tables(lens: LensModel) -> tuple[np.ndarray, np.ndarray]:
    return lens._tables()


def _opencv_matrix(lens: LensModel) -> np.ndarray:
    return np.array([[lens.fx, 0, lens.cx - 0.5], [0, lens.fy, lens.cy - 0.5], [0, 0, 1]])
