"""Read and write `georeference.json`: where on the Earth a scene is, and how accurately that is known."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from jaxtyping import Bool, Float64

from tidefield.data.readers.files import number, numbers, parsing, read_json
from tidefield.data.readers.posed import Reference
from tidefield.files import completed_file
from tidefield.geometry.geodesy import WGS84, LocalFrame
from tidefield.geometry.similarity import Similarity

FILE_NAME = "georeference.json"
_VERSION = 1

Source = Literal["ground control", "GPS", "project", "none"]


@dataclass(frozen=True)
class Residuals:
    """Differences between the scene's positions and those that were given, in metres of the world.

    Attributes:
        names: photographs or control points.
        error_m: the scene's minus the given, east, north and up; NaN where one of them is unknown.
    """

    names: tuple[str, ...] = ()
    error_m: Float64[np.ndarray, "N 3"] = field(default_factory=lambda: np.empty((0, 3)))

    @property
    def known(self) -> Bool[np.ndarray, " N"]:
        """Whether all of an error's components are finite."""
        return np.asarray(np.isfinite(self.error_m).all(axis=1))

    @property
    def known_in_plan(self) -> Bool[np.ndarray, " N"]:
        """Whether an error's horizontal components are finite; positions without heights have no vertical one."""
        return np.asarray(np.isfinite(self.error_m[:, :2]).all(axis=1))

    @property
    def horizontal_rms_m(self) -> float:
        """NaN if there are none."""
        return _rms(np.linalg.norm(self.error_m[:, :2], axis=1))

    @property
    def vertical_rms_m(self) -> float:
        """NaN if there are none."""
        return _rms(self.error_m[:, 2])

    @property
    def rms_m(self) -> float:
        """Of all directions together; NaN if there are none."""
        return _rms(np.linalg.norm(self.error_m, axis=1))

    @property
    def median_m(self) -> Float64[np.ndarray, " 3"]:
        """The common part, such as a shift between datums; NaN if there are none."""
        known = self.error_m[self.known]
        return np.median(known, axis=0) if len(known) else np.full(3, math.nan)

    def to_json(self) -> dict[str, Any]:
        """Return the values that `from_json` reads, and statistics."""
        return {
            "horizontal_rms_m": _number(self.horizontal_rms_m),
            "vertical_rms_m": _number(self.vertical_rms_m),
            "median_east_north_up_m": [_number(value) for value in self.median_m],
            "each": [
                {"name": name, "east_north_up_m": [_number(value) for value in error]}
                for name, error in zip(self.names, self.error_m, strict=True)
            ],
        }

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> Residuals:
        rows = [[math.nan if v is None else float(v) for v in each["east_north_up_m"]] for each in values["each"]]
        names = tuple(str(each["name"]) for each in values["each"])
        return cls(names, np.array(rows, dtype=np.float64).reshape(-1, 3))


@dataclass(frozen=True)
class LeftOut:
    """An observation that was rejected.

    Attributes:
        kind: "GPS", "control point" or "mark".
        name: the photograph, the control point, or "point in photograph".
        reason: a sentence for the surveyor.
    """

    kind: Literal["GPS", "control point", "mark"]
    name: str
    reason: str


@dataclass(frozen=True)
class Georeference:
    """Position of a scene's world on the Earth.

    Attributes:
        frame: None if the position is unknown; the world then has its vertical from the photographs, and an arbitrary
            origin and scale.
        source: of the frame; "project" is the file of another program's project.
        world_from_model: the similarity between the model as it was reconstructed and the world. With ground control
            the model was adjusted further, in the world.
        gps: of the cameras, with those that were rejected, which the report lists; `gps_used` is without them.
        control: of the control points, after the adjustment that they took part in.
        check: of the control points, each after an adjustment without it. This is the accuracy to rely on.
        left_out: rejected observations.
        notes: further sentences for the surveyor.
        control_world: surveyed coordinates of all control points that the scene was fitted to.
        gps_has_part: whether the cameras' positions have placed or shaped the scene, next to ground control.
    """

    frame: LocalFrame | None
    source: Source
    world_from_model: Similarity
    gps: Residuals
    control: Residuals
    check: Residuals
    left_out: tuple[LeftOut, ...]
    notes: tuple[str, ...]
    control_world: Float64[np.ndarray, "N 3"] = field(default_factory=lambda: np.empty((0, 3)))
    gps_has_part: bool = True

    @property
    def gps_used(self) -> Residuals:
        """Residuals of the cameras whose positions were used."""
        wrong = {item.name for item in self.left_out if item.kind == "GPS"}
        keep = [i for i, name in enumerate(self.gps.names) if name not in wrong]
        return Residuals(tuple(self.gps.names[i] for i in keep), self.gps.error_m[keep])

    def write(self, folder: Path) -> None:
        """Write `georeference.json` into a scene's folder, over an older one.

        Raises:
            RunError: the folder cannot be written to.
        """
        # With statistics for readers who have only the file.
        kinds = {"gps": self.gps, "gps_used": self.gps_used, "control": self.control, "check": self.check}
        similarity = self.world_from_model
        values = {
            "version": _VERSION,
            "source": self.source,
            "frame": None if self.frame is None else self.frame.to_json(),
            "world_from_model": {
                "scale": similarity.scale,
                "rotation": similarity.rotation.tolist(),
                "translation": similarity.translation.tolist(),
            },
            "residuals": {kind: residuals.to_json() for kind, residuals in kinds.items()},
            "left_out": [asdict(item) for item in self.left_out],
            "notes": list(self.notes),
            "control_world": self.control_world.tolist(),
            "gps_has_part": self.gps_has_part,
        }
        with completed_file(folder / FILE_NAME, overwrite=True) as partial:
            partial.write_text(json.dumps(values, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def read_georeference(folder: Path) -> Georeference | None:
    """Read `georeference.json` of a scene; None if it has none.

    Raises:
        SceneError: the file is damaged, or of a later version.
    """
    path = folder / FILE_NAME
    expected = (
        "a file of `tidefield prepare`; prepare the scene again, or remove the file to use the scene without a "
        "georeference"
    )
    with parsing(path, expected):
        if not path.exists():
            return None
        values = read_json(path)
        if values["version"] != _VERSION:
            raise ValueError(f"it is of version {values['version']}, expected {_VERSION}")
        return _from_json(values, path)


def find_georeference(folder: Path, reference: Reference | None) -> Georeference | None:
    """Where a scene is: by its `georeference.json`, else by another program's project; None where neither says.

    Args:
        folder: of the scene.
        reference: the origin that the project states, in metres east, north and up of which its poses are.

    Raises:
        SceneError: `georeference.json` is damaged, or of a later version.
    """
    located = read_georeference(folder)
    if located is not None or reference is None:
        return located
    return Georeference(
        frame=LocalFrame.at(WGS84, (reference.longitude_deg, reference.latitude_deg, reference.height_m)),
        source="project",
        world_from_model=Similarity(1.0, np.eye(3), np.zeros(3)),
        gps=Residuals(),
        control=Residuals(),
        check=Residuals(),
        left_out=(),
        notes=("The origin is that of another program's project; its accuracy is unknown.",),
    )


def _from_json(values: dict[str, Any], path: Path) -> Georeference:
    if values["source"] not in get_args(Source):
        raise ValueError(f"its source is {values['source']!r}")
    similarity = values["world_from_model"]
    world_from_model = Similarity(
        number(similarity, "scale", path),
        numbers(similarity, "rotation", path, (3, 3)),
        numbers(similarity, "translation", path, (3,)),
    )
    if world_from_model.scale <= 0:
        raise ValueError("the scale of its similarity is not positive")
    residuals = {kind: Residuals.from_json(values["residuals"][kind]) for kind in ("gps", "control", "check")}
    return Georeference(
        frame=None if values["frame"] is None else LocalFrame.from_json(values["frame"]),
        source=values["source"],
        world_from_model=world_from_model,
        left_out=tuple(LeftOut(item["kind"], str(item["name"]), str(item["reason"])) for item in values["left_out"]),
        notes=tuple(str(note) for note in values["notes"]),
        control_world=np.array(
            [numbers({"point": point}, "point", path, (3,)) for point in values.get("control_world", [])]
        ).reshape(-1, 3),
        gps_has_part=bool(values.get("gps_has_part", values["source"] != "ground control")),
        **residuals,
    )


def _number(value: float) -> float | None:
    """JSON has no NaN."""
    return float(value) if math.isfinite(value) else None


def _rms(values: Float64[np.ndarray, " N"]) -> float:
    known = values[np.isfinite(values)]
    return float(np.sqrt((known**2).mean())) if len(known) else math.nan
