"""From a folder of photographs to a Scene on disk: one stage after the other, with files between them.

SCENE/prepare/ holds what the stages leave for each other, and which of them are done.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
import pycolmap
from rich.console import Console

from tidefield.data.georeference import Georeference, read_georeference
from tidefield.data.load import load_scene
from tidefield.errors import RunError
from tidefield.progress import ProgressBar
from tidefield.survey.colour import Evening, estimate_evening
from tidefield.survey.copy_images import place_photographs
from tidefield.survey.export import write_transforms
from tidefield.survey.georeference.georeference import georeference
from tidefield.survey.quality.assessment import QualityDecision, assess_quality, select_photographs
from tidefield.survey.quality.measures import Measures
from tidefield.survey.sfm.features import FeatureOptions, extract, opened, real_name
from tidefield.survey.sfm.lens_choice import Choice, Heights, Trial, choose_lens
from tidefield.survey.sfm.mapping import reconstruct, registered_names
from tidefield.survey.sfm.matching import match
from tidefield.survey.sfm.pairs import GLANCE, candidates, glances, promising
from tidefield.survey.stages import Facts, Stages
from tidefield.survey.survey import Photograph, Survey

log = logging.getLogger(__name__)

COLOUR_WIDTH = 400
"""Of the photographs that colour differences are measured on."""


@dataclass(frozen=True)
class PrepareOptions:
    """What a preparation is asked for.

    Attributes:
        keep_all: use photographs of low quality too.
        colour: even out exposures and the lens' falloff: where it helps, always, or never.
        features: how features are found.
        redo: a stage to do again, with all that follow.
    """

    keep_all: bool = False
    colour: Literal["auto", "on", "off"] = "auto"
    features: FeatureOptions = field(default_factory=FeatureOptions)
    redo: str | None = None


@dataclass(frozen=True)
class Prepared:
    """What a preparation found, for the report.

    Attributes:
        survey: what was read.
        verdicts: on every photograph's quality.
        used: names of the photographs that were not left out for it.
        models: names of the photographs of every model, the largest first.
        lens: how that of the largest model was chosen.
        georeference: where the largest lies.
        evening: of its photographs in the order of their names; None if it was not to be tried.
        seconds: of each stage.
    """

    survey: Survey
    verdicts: tuple[QualityDecision, ...]
    used: frozenset[str]
    models: list[list[str]]
    lens: Choice
    georeference: Georeference
    evening: Evening | None
    seconds: dict[str, float]


def prepare(
    survey: Survey, scene: Path, options: PrepareOptions, device: pycolmap.Device, console: Console
) -> Prepared:
    """Make a scene of a survey, or go on with one.

    Raises:
        RunError: the scene's folder is something else's, or cannot be written to.
        SurveyError: too few photographs are good, or fit together.
    """
    _refuse_foreign(scene, survey)
    making = _Making(survey, scene, options, device, console)
    verdicts = making.quality()
    good = select_photographs(survey, verdicts, options.keep_all)
    making.features(good.photographs)
    making.matches(making.pairs(good.photographs))
    models, lens = making.poses()
    located = making.georeference(good)
    placed = set(models[0])
    registered = [photograph for photograph in good.photographs if photograph.name in placed]
    evening = making.images(registered, located)
    used = frozenset(photograph.name for photograph in good.photographs)
    return Prepared(survey, verdicts, used, models, lens, located, evening, making.stages.seconds)


class _Making:
    """A scene in the making: its stages, in their order."""

    def __init__(
        self, survey: Survey, scene: Path, options: PrepareOptions, device: pycolmap.Device, console: Console
    ) -> None:
        self.survey, self.scene, self.options, self.device, self.console = survey, scene, options, device, console
        self.work = scene / "prepare"
        self.stages = Stages(self.work, _fingerprint(survey), options.redo)
        self.database, self.model, self.located = self.work / "database.db", self.work / "model", scene / "sparse" / "0"

    def quality(self) -> tuple[QualityDecision, ...]:
        """Assess the quality of the photographs."""

        def job(resume: bool) -> Facts:
            with ProgressBar(self.console, "Judging photographs") as meter:
                return {"verdicts": [_verdict_to_json(verdict) for verdict in assess_quality(self.survey, meter)]}

        return tuple(map(_verdict_from_json, self.stages.run("quality", {}, [], job)["verdicts"]))

    def features(self, photographs: Sequence[Photograph]) -> None:
        """Find features in the good photographs."""

        def job(resume: bool) -> Facts:
            if not resume:
                self.database.unlink(missing_ok=True)
            with ProgressBar(self.console, "Finding features") as meter:
                return {"features": extract(photographs, self.database, self.options.features, self.device, meter)}

        options = [[photograph.name for photograph in photographs], asdict(self.options.features)]
        self.stages.run("features", options, [self.database], job)

    def pairs(self, photographs: Sequence[Photograph]) -> list[tuple[str, str]]:
        """Choose the pairs of photographs to match."""

        def job(resume: bool) -> Facts:
            with opened(self.database) as db:
                images = {real_name(image.name): image.image_id for image in db.read_all_images()}
                largest = [np.array(db.read_descriptors(images[p.name]).data[:GLANCE]) for p in photographs]
            with ProgressBar(self.console, "Choosing pairs") as meter:
                chosen = promising(candidates(photographs), glances(largest), meter)
            return {"pairs": [[photographs[i].name, photographs[j].name] for i, j in chosen]}

        return [(a, b) for a, b in self.stages.run("pairs", {}, [], job)["pairs"]]

    def matches(self, pairs: Sequence[tuple[str, str]]) -> None:
        """Match the pairs."""

        def job(resume: bool) -> Facts:
            if not resume:
                with opened(self.database) as db:
                    db.clear_matches()
                    db.clear_two_view_geometries()
            with ProgressBar(self.console, "Matching") as meter:
                agree, inliers = match(self.database, pairs, self.device, meter)
            return {"agree": agree, "inliers": inliers}

        self.stages.run("matches", {}, [self.database], job)

    def poses(self) -> tuple[list[list[str]], Choice]:
        """Structure from motion; returns the photographs of every model, the largest first, and how its lens fits."""

        def job(resume: bool) -> Facts:
            with ProgressBar(self.console, "Placing photographs") as meter:
                models = reconstruct(self.database, self.work / "models", meter)
            known = all(photograph.lens is not None for photograph in self.survey.photographs)
            with ProgressBar(self.console, "Choosing a lens") as meter:
                choice = choose_lens(models.best, self.survey.photographs, known, meter)
            self.model.mkdir(exist_ok=True)
            models.best.write_binary(self.model)
            names = [registered_names(models.best), *map(list, models.others)]
            return {"models": names, "lens": asdict(choice)}

        facts = self.stages.run("poses", {}, [self.model], job)
        lens = facts["lens"]
        trials = tuple(Trial(**trial) for trial in lens["trials"])
        heights = lens["heights"] and Heights(**lens["heights"])
        return facts["models"], Choice(**{**lens, "trials": trials, "heights": heights})

    def georeference(self, good: Survey) -> Georeference:
        """Lay the largest model onto the Earth."""

        def job(resume: bool) -> Facts:
            model = pycolmap.Reconstruction(self.model)
            with ProgressBar(self.console, "Laying it onto the Earth") as meter:
                located = georeference(model, good, meter)
            self.located.mkdir(parents=True, exist_ok=True)
            model.write_binary(self.located)
            located.write(self.scene)
            return {}

        outputs = [self.located, self.scene / "georeference.json"]
        self.stages.run("georeference", {"control": repr(good.control)}, outputs, job)
        located = read_georeference(self.scene)
        assert located is not None, "the stage has written it"
        return located

    def images(self, photographs: Sequence[Photograph], located: Georeference) -> Evening | None:
        """Write the photographs of the model, evened out where that helps, and what else reads them."""
        folder = self.scene / "images"

        def job(resume: bool) -> Facts:
            model = pycolmap.Reconstruction(self.located)
            images = [model.image(number) for number in model.reg_image_ids()]
            lenses = {image.name: model.camera(image.camera_id) for image in images}
            cameras = [lenses[photograph.name] for photograph in photographs]
            with ProgressBar(self.console, "Placing photographs") as meter:
                place_photographs(photographs, folder, None, cameras, meter)
            evening = self._evening([camera.camera_id for camera in cameras])
            if evening is not None and evening.helps:
                with ProgressBar(self.console, "Evening out colours") as meter:
                    place_photographs(photographs, folder, evening, cameras, meter)
            model.extract_colors_for_all_images(folder)
            model.write_binary(self.located)
            write_transforms(self.scene, model, z_is_up=True, overwrite=True)
            return {"evening": None if evening is None else _evening_to_json(evening)}

        outputs = [folder, self.scene / "transforms.json"]
        facts = self.stages.run("images", {"colour": self.options.colour}, outputs, job)
        return None if facts["evening"] is None else _evening_from_json(facts["evening"])

    def _evening(self, lens_numbers: Sequence[int]) -> Evening | None:
        """How to even out the photographs that lie in the scene."""
        if self.options.colour == "off":
            return None
        with ProgressBar(self.console, "Measuring colours") as meter:
            scene = load_scene(self.scene, width=COLOUR_WIDTH, progress=meter)
        return estimate_evening(scene, lens_numbers, always=self.options.colour == "on")


def _refuse_foreign(scene: Path, survey: Survey) -> None:
    """Raises: RunError where the scene's folder holds something else, or the photographs themselves."""
    photographs = survey.folder.resolve()
    if scene.resolve() == photographs or scene.resolve() in photographs.parents:
        raise RunError(f"{scene} holds the photographs: expected another folder for the scene; name a new one")
    if scene.exists() and not scene.is_dir():
        raise RunError(f"{scene} is a file: expected a folder or a new name; choose another")
    if scene.is_dir() and any(scene.iterdir()) and not (scene / "prepare" / "stages.json").exists():
        raise RunError(
            f"{scene} holds something else: expected a new name, or a scene that `tidefield prepare` began; choose "
            "another"
        )


def _fingerprint(survey: Survey) -> list:
    """What the photographs are: when one of them is another, everything is done again."""
    own = []
    for photograph in survey.photographs:
        state = photograph.path.stat()
        place, lens = repr(photograph.position), repr(photograph.lens)
        own.append([photograph.name, state.st_size, state.st_mtime_ns, place, lens])
    return own


def _verdict_to_json(verdict: QualityDecision) -> Facts:
    measures = None if verdict.measures is None else asdict(verdict.measures)
    finite = measures and {name: value if math.isfinite(value) else None for name, value in measures.items()}
    return {"name": verdict.name, "measures": finite, "left_out": verdict.left_out}


def _verdict_from_json(values: Facts) -> QualityDecision:
    finite = values["measures"]
    measures = finite and Measures(**{name: math.nan if value is None else value for name, value in finite.items()})
    return QualityDecision(values["name"], measures, values["left_out"])


def _evening_to_json(evening: Evening) -> Facts:
    values = {
        name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in asdict(evening).items()
    }
    return {name: None if isinstance(value, float) and math.isnan(value) else value for name, value in values.items()}


def _evening_from_json(values: Facts) -> Evening:
    gain, falloff = (np.array(values[name], dtype=np.float64) for name in ("gain", "falloff"))
    errors = (math.nan if values[name] is None else values[name] for name in ("before", "gains_alone", "after"))
    return Evening(gain, falloff, *errors, helps=values["helps"], sees_falloff=values["sees_falloff"])
