"""Make a Scene on disk from a survey: one stage after the other, with files between them.

SCENE/prepare contains the intermediate files, and the state of the stages in `stages.json`: the result of each, and a
key, which is a digest of its options and of the key of the stage before it, so that a changed option repeats that stage
and all that follow. The names of the stages, their options and the keys of their results are a file format: a change
makes earlier scenes start again.
"""

from __future__ import annotations

import hashlib
import json
import logging
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, is_dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pycolmap
from rich.console import Console

from tidefield.data.georeference import Georeference, read_georeference
from tidefield.data.load import load_scene
from tidefield.errors import RunError
from tidefield.files import write_json, writing_to
from tidefield.progress import ProgressBar
from tidefield.survey.colour import ExposureCorrection, estimate_correction
from tidefield.survey.export import write_images, write_transforms
from tidefield.survey.georeference.georeference import georeference
from tidefield.survey.quality.assessment import QualityDecision, assess_quality, select_photographs
from tidefield.survey.quality.measures import Measures
from tidefield.survey.sfm.features import FeatureOptions, decode_name, extract
from tidefield.survey.sfm.mapping import Heights, LensChoice, LensTrial, choose_lens, reconstruct, registered_names
from tidefield.survey.sfm.matching import PREVIEW, candidate_pairs, match, preview_descriptors, select_pairs
from tidefield.survey.survey import Photograph, Survey

log = logging.getLogger(__name__)

Facts = dict[str, Any]
"""Result of a stage, as JSON."""
COLOUR_WIDTH = 400
"""Width of the photographs on which exposure differences are measured."""
STAGES = ("quality", "features", "pairs", "matches", "poses", "georeference", "images")
"""In their order."""


class Stages:
    """The stages of one working folder and their state.

    Args:
        folder: contains `stages.json` and the stages' files; created if it does not exist.
        source: what the first stage depends on (any JSON).
        redo: name of a stage to repeat, with all that follow, even if nothing has changed.

    Attributes:
        seconds: run time of each stage, including interrupted attempts.

    Raises:
        RunError: the folder cannot be written to, or `stages.json` is damaged.
    """

    def __init__(self, folder: Path, source: object, redo: str | None = None) -> None:
        with writing_to(folder.parent):
            folder.mkdir(parents=True, exist_ok=True)
        self._folder, self._file = folder, folder / "stages.json"
        self._records: dict[str, Facts] = {}
        if self._file.exists():
            try:
                self._records = json.loads(self._file.read_text(encoding="utf-8"))
                if not isinstance(self._records, dict) or not all(isinstance(r, dict) for r in self._records.values()):
                    raise ValueError("no table of stages")
            except ValueError as error:
                raise RunError(
                    f"{self._file} is damaged ({error}): expected what an earlier run wrote; remove {folder} to start "
                    "again"
                ) from error
        self._key, self._redo, self._is_redoing = _digest(source), redo, False
        self.seconds: dict[str, float] = {}

    def run(self, name: str, options: object, outputs: Sequence[Path], job: Callable[[bool], Facts]) -> Facts:
        """Run a stage unless it is complete.

        Args:
            options: everything its result depends on, besides the previous stages (any JSON).
            outputs: files or folders that must exist for the stage to count as complete.
            job: runs the stage; called with whether an interrupted attempt with the same key can be continued.

        Returns:
            The job's result, of this run or of an earlier one.
        """
        self._key = _digest([self._key, name, options])
        self._is_redoing = self._is_redoing or name == self._redo
        record = self._records.get(name, {})
        is_same = record.get("key") == self._key and not self._is_redoing
        if is_same and record.get("done") and all(path.exists() for path in outputs):
            self.seconds[name] = record["seconds"]
            log.info(f"{name}: complete already")
            return record["facts"]
        earlier = record.get("seconds", 0.0) if is_same else 0.0
        record = self._records[name] = {"key": self._key, "done": False, "seconds": earlier}
        write_json(self._file, self._records)
        start = time.monotonic()
        try:
            with writing_to(self._folder.parent):
                facts = job(is_same)
            record |= {"done": True, "facts": facts}
        finally:
            self.seconds[name] = record["seconds"] = earlier + time.monotonic() - start
            write_json(self._file, self._records)
        return facts


def _digest(value: object) -> str:
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:16]


@dataclass(frozen=True)
class Prepared:
    """Results of the stages, for the report.

    Attributes:
        survey: the input.
        verdicts: quality of every photograph.
        used: names of the photographs that were not left out for their quality.
        models: names of the photographs of every model, the largest first.
        lens: lens choice of the largest model.
        georeference: of the largest model.
        correction: of the photographs of the largest model, by name; None if it was switched off.
        seconds: of each stage.
    """

    survey: Survey
    verdicts: tuple[QualityDecision, ...]
    used: frozenset[str]
    models: list[list[str]]
    lens: LensChoice
    georeference: Georeference
    correction: ExposureCorrection | None
    seconds: dict[str, float]


def prepare(
    survey: Survey,
    scene: Path,
    features: FeatureOptions,
    device: pycolmap.Device,
    console: Console,
    *,
    keep_all: bool = False,
    colour: Literal["auto", "on", "off"] = "auto",
    redo: str | None = None,
) -> Prepared:
    """Make a scene of a survey, or continue an interrupted run.

    Args:
        keep_all: use photographs of low quality too.
        colour: correct exposures and lens falloff: where it helps, always, or never.
        redo: a stage to repeat, with all that follow.

    Raises:
        RunError: the scene's folder contains something else, or cannot be written to.
        SurveyError: too few photographs are good, or fit together.
    """
    _refuse_foreign(scene, survey)
    work, sparse, images = scene / "prepare", scene / "sparse" / "0", scene / "images"
    database, model = work / "database.db", work / "model"
    if redo not in (None, *STAGES):
        raise RunError(f"there is no stage {redo!r}: expected one of {', '.join(STAGES)}; name one of these")
    stages = Stages(work, _fingerprint(survey), redo)

    def judge_quality(_: bool) -> Facts:
        with ProgressBar(console, "Judging photographs") as bar:
            return {"verdicts": [_to_json(verdict) for verdict in assess_quality(survey, bar)]}

    quality = stages.run("quality", {}, [], judge_quality)
    verdicts = tuple(_verdict_from_json(verdict) for verdict in quality["verdicts"])
    good = select_photographs(survey, verdicts, keep_all)
    names = [photograph.name for photograph in good.photographs]

    def extract_features(resume: bool) -> Facts:
        if not resume:
            database.unlink(missing_ok=True)
        with ProgressBar(console, "Extracting features") as bar:
            return {"features": extract(good.photographs, database, features, device, bar)}

    stages.run("features", [names, asdict(features)], [database], extract_features)
    chosen = stages.run("pairs", {}, [], lambda _: choose_pairs(good.photographs, database, console))
    pairs = [(first, second) for first, second in chosen["pairs"]]

    def match_pairs(resume: bool) -> Facts:
        if not resume:
            with pycolmap.Database.open(database) as db:
                db.clear_matches()
                db.clear_two_view_geometries()
        with ProgressBar(console, "Matching") as bar:
            agree, inliers = match(database, pairs, device, bar)
        return {"agree": agree, "inliers": inliers}

    stages.run("matches", {}, [database], match_pairs)
    poses = stages.run("poses", {}, [model], lambda _: estimate_poses(survey, database, model, console))
    stages.run(
        "georeference",
        {"control": repr(good.control)},
        [sparse, scene / "georeference.json"],
        lambda _: georeference_model(good, model, sparse, console),
    )
    registered = set(poses["models"][0])
    placed = [photograph for photograph in good.photographs if photograph.name in registered]
    written = stages.run(
        "images",
        {"colour": colour},
        [images, scene / "transforms.json"],
        lambda _: write_scene(placed, scene, colour, console),
    )

    located = read_georeference(scene)
    assert located is not None, "the stage `georeference` has written it"
    return Prepared(
        survey,
        verdicts,
        frozenset(names),
        poses["models"],
        _lens_from_json(poses["lens"]),
        located,
        _correction_from_json(written["evening"]),
        stages.seconds,
    )


def choose_pairs(photographs: Sequence[Photograph], database: Path, console: Console) -> Facts:
    """Choose the pairs of photographs to match, by name."""
    with pycolmap.Database.open(database) as db:
        ids = {decode_name(image.name): image.image_id for image in db.read_all_images()}
        largest = [np.array(db.read_descriptors(ids[p.name]).data[:PREVIEW]) for p in photographs]
    with ProgressBar(console, "Choosing pairs") as bar:
        pairs = select_pairs(candidate_pairs(photographs), preview_descriptors(largest), bar)
    return {"pairs": [[photographs[i].name, photographs[j].name] for i, j in pairs]}


def estimate_poses(survey: Survey, database: Path, folder: Path, console: Console) -> Facts:
    """Reconstruct poses and sparse points, choose the lens model, and write the largest model to a folder."""
    with ProgressBar(console, "Estimating poses") as bar:
        models = reconstruct(database, folder.with_name("models"), bar)
    has_prior = all(photograph.lens is not None for photograph in survey.photographs)
    with ProgressBar(console, "Choosing a lens") as bar:
        choice = choose_lens(models[0], survey.photographs, has_prior, bar)
    folder.mkdir(exist_ok=True)
    models[0].write_binary(folder)
    return {"models": [registered_names(model) for model in models], "lens": _to_json(choice)}


def georeference_model(good: Survey, model: Path, sparse: Path, console: Console) -> Facts:
    """Georeference the largest model; write it, and `georeference.json`, to the scene."""
    reconstruction = pycolmap.Reconstruction(model)
    with ProgressBar(console, "Georeferencing") as bar:
        located = georeference(reconstruction, good, bar)
    sparse.mkdir(parents=True, exist_ok=True)
    reconstruction.write_binary(sparse)
    located.write(sparse.parents[1])
    return {}


def write_scene(
    photographs: Sequence[Photograph], scene: Path, colour: Literal["auto", "on", "off"], console: Console
) -> Facts:
    """Write the model's photographs, at a common exposure if that helps, colour its points, write transforms.json."""
    images, sparse = scene / "images", scene / "sparse" / "0"
    model = pycolmap.Reconstruction(sparse)
    camera_of = {image.name: model.camera(image.camera_id) for image in map(model.image, model.reg_image_ids())}
    cameras = [camera_of[photograph.name] for photograph in photographs]
    with ProgressBar(console, "Writing photographs") as bar:
        write_images(photographs, images, None, cameras, bar)
    correction = None
    if colour != "off":
        with ProgressBar(console, "Measuring exposures") as bar:
            loaded = load_scene(scene, width=COLOUR_WIDTH, progress=bar)
        correction = estimate_correction(loaded, [camera.camera_id for camera in cameras], always=colour == "on")
        if correction.helps:
            with ProgressBar(console, "Correcting exposures") as bar:
                write_images(photographs, images, correction, cameras, bar)
    model.extract_colors_for_all_images(images)
    model.write_binary(sparse)
    write_transforms(scene, model, z_is_up=True, overwrite=True)
    return {"evening": _to_json(correction)}


def _refuse_foreign(scene: Path, survey: Survey) -> None:
    """Raise a RunError if the scene's folder contains something else, or the photographs themselves."""
    photographs = survey.folder.resolve()
    if scene.resolve() == photographs or scene.resolve() in photographs.parents:
        raise RunError(f"{scene} holds the photographs: expected another folder for the scene; name a new one")
    if scene.exists() and not scene.is_dir():
        raise RunError(f"{scene} is a file: expected a folder or a new name; choose another")
    if scene.is_dir() and any(scene.iterdir()) and not (scene / "prepare" / "stages.json").exists():
        raise RunError(
            f"{scene} holds something else: expected a new name, or a scene that `tidefield prepare` started; choose "
            "another"
        )


def _fingerprint(survey: Survey) -> list:
    """Identify the photographs and their metadata; if one of them changes, all stages are repeated."""
    fingerprint = []
    for photograph in survey.photographs:
        state = photograph.path.stat()
        position, lens = repr(photograph.position), repr(photograph.lens)
        fingerprint.append([photograph.name, state.st_size, state.st_mtime_ns, position, lens])
    return fingerprint


def _to_json(value: Any) -> Any:
    """Convert dataclasses and arrays to JSON, which has no NaN and no infinity: these become null."""
    if is_dataclass(value):
        return {name: _to_json(part) for name, part in vars(value).items()}
    if isinstance(value, tuple | list):
        return [_to_json(part) for part in value]
    if isinstance(value, np.ndarray):
        return value.tolist()
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _nan(value: float | None) -> float:
    return math.nan if value is None else value


def _verdict_from_json(facts: Facts) -> QualityDecision:
    measures = facts["measures"] and Measures(**{name: _nan(value) for name, value in facts["measures"].items()})
    return QualityDecision(facts["name"], measures, facts["left_out"])


def _lens_from_json(facts: Facts) -> LensChoice:
    trials = tuple(LensTrial(**trial) for trial in facts["trials"])
    return LensChoice(**{**facts, "trials": trials, "heights": facts["heights"] and Heights(**facts["heights"])})


def _correction_from_json(facts: Facts | None) -> ExposureCorrection | None:
    if facts is None:
        return None
    arrays = {name: np.array(facts[name], dtype=np.float64) for name in ("gain", "falloff")}
    return ExposureCorrection(**{**facts, **arrays, **{k: _nan(facts[k]) for k in ("before", "gains_alone", "after")}})
