"""Make a Scene on disk from a survey: one stage after the other, with files between them in SCENE/prepare."""

from __future__ import annotations

import logging
import math
import shutil
from collections.abc import Collection, Sequence
from dataclasses import asdict, dataclass, is_dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pycolmap
from rich.console import Console

from tidefield.data.georeference import Georeference, read_georeference
from tidefield.data.holdout import FILE_NAME as HOLDOUT_FILE
from tidefield.data.holdout import Holdout
from tidefield.data.load import load_scene
from tidefield.data.readers.posed import every_eighth
from tidefield.errors import RunError, SurveyError, list_names
from tidefield.files import is_empty, only_writer, writing_to
from tidefield.progress import ProgressBar
from tidefield.survey.colour import ExposureCorrection, estimate_correction
from tidefield.survey.export import reduced_folders, write_images, write_masks, write_reduced_images, write_transforms
from tidefield.survey.georeference.georeference import georeference
from tidefield.survey.io.gcp_file import write_check_points
from tidefield.survey.io.photographs import FEWEST, control_remark
from tidefield.survey.quality.assessment import QualityDecision, assess_quality, select_photographs, without
from tidefield.survey.quality.measures import Measures
from tidefield.survey.sfm.blocks import cut, matched_pairs, merge, reconstruct_blocks, settle
from tidefield.survey.sfm.features import FeatureOptions, LensKind, decode_name, extract, is_database, reduced_size
from tidefield.survey.sfm.mapping import (
    Heights,
    LensChoice,
    LensTrial,
    Mapper,
    choose_lens,
    large_enough,
    reconstruct,
    registered_names,
)
from tidefield.survey.sfm.matching import match
from tidefield.survey.sfm.model_files import model_files, read_model, write_model
from tidefield.survey.sfm.pairs import PREVIEW, candidate_pairs, places_of, preview_descriptors, select_pairs
from tidefield.survey.sfm.placing import MIN_INLIERS, place
from tidefield.survey.stages import Facts, Stages
from tidefield.survey.survey import Photograph, Survey

log = logging.getLogger(__name__)

COLOUR_WIDTH = 400
"""Width of the photographs on which exposure differences are measured."""
STAGES = ("quality", "features", "pairs", "matches", "poses", "georeference", "images")
"""In their order; on request, "downscale" follows."""


@dataclass(frozen=True)
class Prepared:
    """Results of the stages, for the report.

    Attributes:
        survey: the input.
        verdicts: quality of every photograph.
        used: names of the photographs that were not left out for their quality.
        models: names of the photographs of every model, the largest first.
        held_out: names of photographs of the largest model that were placed afterwards.
        lens: lens choice of the largest model.
        georeference: of the largest model.
        correction: of the photographs of the largest model, by name; None if it was switched off.
        seconds: of each stage.
    """

    survey: Survey
    verdicts: tuple[QualityDecision, ...]
    used: frozenset[str]
    models: list[list[str]]
    held_out: frozenset[str]
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
    lens: LensKind = "pinhole",
    keep_all: bool = False,
    holdout: bool = False,
    colour: Literal["auto", "on", "off"] = "auto",
    downscale: Sequence[int] = (),
    mapper: Mapper = "incremental",
    redo: str | None = None,
) -> Prepared:
    """Make a scene of a survey, or continue an interrupted run.

    Args:
        lens: of the camera.
        keep_all: use photographs of low quality too.
        holdout: keep every eighth photograph out of everything, and place it afterwards. Which ones are chosen, their
            quality and their colours do not depend on their pixels.
        colour: correct exposures and lens falloff: where it helps, always, or never.
        downscale: factors of reduced photographs to write beside the others.
        mapper: one photograph after the other, or all at once.
        redo: a stage to repeat, with all that follow.

    Raises:
        RunError: the scene's folder contains something else, cannot be written to, or another process writes to it.
        SurveyError: too few photographs are good, or fit together.
    """
    reduced = reduced_folders(downscale)
    if redo not in (None, *STAGES):
        raise RunError(f"there is no stage {redo!r}: expected one of {', '.join(STAGES)}; name one of these")
    with writing_to(scene):
        _refuse_foreign(scene, survey)
    with only_writer(scene):
        work, sparse, images = scene / "prepare", scene / "sparse" / "0", scene / "images"
        database, model = work / "database.db", work / "model"
        stages = Stages(work, _fingerprint(survey), redo)
        everyone = [photograph.name for photograph in survey.photographs]
        held_out = frozenset(everyone[i] for i in every_eighth(len(everyone))[1] if holdout)

        def judge_quality(_: bool) -> Facts:
            with ProgressBar(console, "Judging photographs") as bar:
                verdicts = list(assess_quality(without(survey, held_out), bar))
            if held_out:  # of these, only whether they can be decoded
                verdicts += [v for v in assess_quality(without(survey, {*everyone} - held_out)) if v.measures is None]
            return {"verdicts": [_to_json(verdict) for verdict in verdicts]}

        # No option is part of the key of scenes that do not have it, so that earlier ones are kept.
        judged: dict[str, Any] = {"holdout": True} if holdout else {}
        if used := _masks_fingerprint(survey):
            judged["masks"] = used
        verdicts = stages.run("quality", judged, [], judge_quality, _verdicts_from_json)
        good = select_photographs(survey, verdicts, keep_all)
        names = [photograph.name for photograph in good.photographs]
        mapped = without(good, held_out)
        if len(mapped.photographs) < FEWEST:
            raise SurveyError(
                f"{len(mapped.photographs)} photographs are left beside those that --holdout keeps out: expected at "
                f"least {FEWEST}; leave --holdout out, or add photographs"
            )
        lost = _require_control(survey, mapped)

        def extract_features(resume: bool) -> Facts:
            if not resume or not is_database(database):
                database.unlink(missing_ok=True)
            with ProgressBar(console, "Extracting features") as bar:
                return {"features": extract(good.photographs, database, features, device, bar, lens)}

        def refuse_damaged(facts: Facts) -> Facts:
            if not is_database(database):
                raise ValueError(f"{database.name} is no database of features")
            return facts

        # None of these is part of the key of scenes that do not have it.
        masks, kind = _masks_fingerprint(good), [lens] if lens != "pinhole" else []
        scales = ["a scale of each side"] if _is_rounded(good, features.side_px) else []
        options = [names, asdict(features), *masks, *kind, *scales]
        pixels = [_pixels_fingerprint(good), *options]  # other positions choose other pairs of the same features
        stages.run("features", options, [database], extract_features, refuse_damaged, inputs=pixels)
        pairs = stages.run(
            "pairs",
            {},
            [],
            lambda _: choose_pairs(good.photographs, held_out, database, console),
            lambda facts: _pairs_from_json(facts, names),
        )

        def match_pairs(resume: bool) -> Facts:
            if not resume:
                with pycolmap.Database.open(database) as db:
                    db.clear_matches()
                    db.clear_two_view_geometries()
            with ProgressBar(console, "Matching") as bar:
                agree, inliers = match(database, pairs, device, bar)
            return {"agree": agree, "inliers": inliers}

        stages.run("matches", {}, [database], match_pairs, inputs=pixels)

        def read_poses(facts: Facts) -> tuple[list[list[str]], LensChoice]:
            models = [[str(name) for name in model] for model in facts["models"]]
            if registered_names(read_model(model)) != models[0] or not set(models[0]) <= set(names):
                raise ValueError("the model has other photographs")
            return models, _lens_from_json(facts["lens"])

        models, choice = stages.run(
            "poses",
            {"mapper": mapper} if mapper != "incremental" else {},
            model_files(model),
            lambda resume: estimate_poses(mapped, database, model, console, mapper, resume),
            read_poses,
        )

        def read_located(facts: Facts) -> tuple[Georeference, list[str]]:
            located, placed = read_georeference(scene), sorted([*models[0], *facts.get("placed", ())])
            if located is None or registered_names(read_model(sparse)) != placed:
                raise ValueError("the model has other photographs")
            return located, placed

        located, models[0] = stages.run(
            "georeference",
            {"control": repr(good.control)} | ({"optional": True} if good.control and good.control_was_found else {}),
            [*model_files(sparse), scene / "georeference.json"],
            lambda _: georeference_model(mapped, model, sparse, console, database, held_out & {*names}, lost),
            read_located,
        )
        registered = set(models[0])
        placed = [photograph for photograph in good.photographs if photograph.name in registered]
        mask_names = [f"{photograph.name}.png" for photograph in placed] if _have_masks(placed) else []
        correction = stages.run(
            "images",
            {"colour": colour},
            [
                *(images / photograph.name for photograph in placed),
                *(scene / "masks" / name for name in mask_names),
                *(scene / name for name in ("transforms.json", "sparse_pc.ply")),
                *([scene / HOLDOUT_FILE] if holdout else []),
            ],
            lambda _: write_scene(placed, scene, colour, console, held_out & registered),
            lambda facts: _correction_from_json(facts["evening"], len(placed)),
        )

        def reduce(_: bool) -> Facts:
            if downscale:
                with ProgressBar(console, "Reducing photographs") as bar:
                    write_reduced_images(scene, models[0], downscale, bar)
            return {}

        if downscale or stages.has_run("downscale"):  # without, what an earlier run has written is removed
            files = [scene / folder / name for folder in reduced for name in models[0]]
            files += [scene / f"masks_{factor}" / name for factor in downscale for name in mask_names]
            stages.run("downscale", {"factors": list(downscale)}, files, reduce)
        return Prepared(
            survey=survey,
            verdicts=verdicts,
            used=frozenset(names),
            models=models,
            held_out=held_out & registered,
            lens=choice,
            georeference=located,
            correction=correction,
            seconds=stages.seconds,
        )


def _require_control(survey: Survey, used: Survey) -> str | None:
    """A remark on ground control that is marked only in photographs that are left out; None if there is none.

    Raises:
        SurveyError: no point is left of ground control that the user named.
    """
    if survey.control is None:
        return None
    left = used.control.points if used.control is not None else {}
    lost = [name for name in survey.control.points if name not in left]
    if not lost:
        return None
    said = (
        f"{len(lost)} of {len(survey.control.points)} points of ground control are marked only in photographs that are "
        f"left out: {list_names(lost)}."
    )
    fitted = used.control is not None and used.control.fitted() is not None
    if survey.control.fitted() is not None and not fitted and not survey.control_was_found:
        raise SurveyError(
            f"{said.removesuffix('.')}: expected some in photographs that are used; mark others, keep photographs of "
            "low quality with --keep-all, or leave --holdout out"
        )
    return said


def choose_pairs(
    photographs: Sequence[Photograph], held_out: Collection[str], database: Path, console: Console
) -> Facts:
    """Choose the pairs of photographs to match, by name.

    Pairs with a held-out photograph are selected apart from the others, and there are none of two.
    """
    places = places_of(photographs)
    candidates = candidate_pairs(photographs, places)
    of_held_out = [sum(photographs[k].name in held_out for k in pair) for pair in candidates]
    parts = [[pair for pair, n in zip(candidates, of_held_out, strict=True) if n == part] for part in (0, 1)]
    with pycolmap.Database.open(database) as db:
        ids = {decode_name(image.name): image.image_id for image in db.read_all_images()}
        largest = [np.array(db.read_descriptors(ids[p.name]).data[:PREVIEW]) for p in photographs]
    with ProgressBar(console, "Choosing pairs") as bar:
        previews = preview_descriptors(largest)
        pairs = [pair for part in parts for pair in select_pairs(part, previews, places, bar)]
    return {"pairs": [[photographs[i].name, photographs[j].name] for i, j in pairs]}


def estimate_poses(
    survey: Survey, database: Path, folder: Path, console: Console, mapper: Mapper = "incremental", resume: bool = False
) -> Facts:
    """Reconstruct poses and sparse points, choose the lens model, and write the largest model to a folder.

    Large surveys are reconstructed in blocks, unless some focal lengths are unknown: each block would find its own.

    Args:
        resume: keep the blocks of an interrupted run.
    """
    known = all(photograph.lens is not None for photograph in survey.photographs)
    names = [photograph.name for photograph in survey.photographs]
    blocks = cut(survey.photographs, matched_pairs(database, names)) if known else []
    with ProgressBar(console, "Estimating poses") as bar:
        largest = None
        if len(blocks) <= 1:
            models = reconstruct(database, folder.with_name("models"), names, bar, known, mapper)
        else:
            log.info(f"poses: {len(blocks)} blocks of up to {max(len(block.names) for block in blocks)} photographs")
            parts = reconstruct_blocks(database, folder.with_name("blocks"), blocks, known, mapper, resume, bar)
            parts = large_enough(sorted(parts, key=lambda model: -model.num_reg_images()), database, names)
            largest = pycolmap.Reconstruction(parts[0])
            models = merge(parts, database)
            if not set(largest.reg_image_ids()) <= set(models[0].reg_image_ids()):
                largest = None  # it is of another site, perhaps of another drone
            settle(models[0])
    with ProgressBar(console, "Choosing a lens") as bar:
        choice = choose_lens(models[0], survey.photographs, known, bar, largest)
    write_model(models[0], folder)
    for work in ("blocks", "models"):
        shutil.rmtree(folder.with_name(work), ignore_errors=True)
    return {"models": [registered_names(model) for model in models], "lens": _to_json(choice)}


def georeference_model(
    good: Survey,
    model: Path,
    sparse: Path,
    console: Console,
    database: Path,
    held_out: Collection[str],
    remark_on_control: str | None = None,
) -> Facts:
    """Georeference the largest model and place held-out photographs; write it, and `georeference.json`."""
    reconstruction = read_model(model)
    with ProgressBar(console, "Georeferencing") as bar:
        try:
            located = georeference(reconstruction, good, bar)
        except SurveyError as error:
            if good.control is None or not good.control_was_found:
                raise
            remark = control_remark(error)
            log.warning(remark)
            reconstruction, good = read_model(model), replace(good, control=None)
            located = georeference(reconstruction, good, bar)
            located = replace(located, notes=(*located.notes, remark))
    if remark_on_control is not None:
        log.warning(remark_on_control)
        located = replace(located, notes=(*located.notes, remark_on_control))
    placed: list[str] = []
    if held_out:
        with ProgressBar(console, "Placing held-out photographs") as bar:
            failed = place(reconstruction, database, held_out, bar)
        for name, inliers in failed.items():
            log.warning(
                f"{name} is held out and cannot be placed: {inliers} of its matches with the other photographs' points "
                f"fit a pose, {MIN_INLIERS} are needed; it is left out"
            )
        placed = sorted(set(held_out) - set(failed))
        if not placed:
            raise SurveyError(
                f"none of the {len(held_out)} held-out photographs can be placed: expected some that overlap with the "
                "others; leave --holdout out, or add photographs"
            )
        remark = f"{len(placed)} photographs are held out: they were placed afterwards, by the points of the others."
        located = replace(located, notes=(*located.notes, remark))
    write_model(reconstruction, sparse)
    located.write(sparse.parents[1])
    write_check_points(good.control, sparse.parents[1])
    return {"placed": placed}


def write_scene(
    photographs: Sequence[Photograph],
    scene: Path,
    colour: Literal["auto", "on", "off"],
    console: Console,
    held_out: frozenset[str],
) -> Facts:
    """Write the model's photographs, at a common exposure if that helps, colour its points, write transforms.json.

    Held-out photographs keep their own exposures; `holdout.json` says what the others were divided by.
    """
    (scene / "transforms.json").unlink(missing_ok=True)  # its split may be of another run's photographs
    if held_out:
        Holdout(held_out, {}).write(scene)
    images, sparse = scene / "images", scene / "sparse" / "0"
    model = read_model(sparse)
    camera_of = {image.name: model.camera(image.camera_id) for image in map(model.image, model.reg_image_ids())}
    cameras = [camera_of[photograph.name] for photograph in photographs]
    with ProgressBar(console, "Writing photographs") as bar:
        write_images(photographs, images, None, cameras, bar)
    masks = _have_masks(photographs)
    if masks:
        with ProgressBar(console, "Writing masks") as bar:
            write_masks(photographs, scene / "masks", bar)
    correction = None
    if colour != "off":
        # A cache of its own: photographs that are to be corrected would only fill the user's.
        cache = scene / "prepare" / "exposures"
        shutil.rmtree(cache, ignore_errors=True)  # of a run that was killed
        with ProgressBar(console, "Measuring exposures") as bar:
            loaded = load_scene(
                scene,
                width=COLOUR_WIDTH,
                hold_out=bool(held_out),
                calibrate=False,
                progress=bar,
                cache=cache,
                unfinished=True,
            )
        correction = estimate_correction(loaded, [camera.camera_id for camera in cameras], always=colour == "on")
        del loaded
        shutil.rmtree(cache, ignore_errors=True)
        if correction.helps:
            with ProgressBar(console, "Correcting exposures") as bar:
                write_images(photographs, images, correction, cameras, bar)
            if held_out:
                gains = {p.name: gain for p, gain in zip(photographs, correction.gain, strict=True)}
                Holdout(held_out, gains).write(scene)
    model.extract_colors_for_all_images(images)
    write_model(model, sparse)
    write_transforms(scene, model, held_out=held_out, masks=masks, z_is_up=True, overwrite=True)
    return {"evening": _to_json(correction)}


def _refuse_foreign(scene: Path, survey: Survey) -> None:
    """Raise a RunError if the scene's folder contains something else, or the photographs themselves."""
    photographs = survey.folder.resolve()
    if scene.resolve() == photographs or scene.resolve() in photographs.parents:
        raise RunError(f"{scene} holds the photographs: expected another folder for the scene; name a new one")
    if scene.is_dir() and not (scene / "prepare" / "stages.json").exists() and not is_empty(scene):
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
        # The photograph's own angles change with its file.
        angles = [repr(photograph.gimbal_deg)] if photograph.gimbal_is_given else []
        fingerprint.append([photograph.name, state.st_size, state.st_mtime_ns, position, lens, *angles])
    return fingerprint


def _pixels_fingerprint(survey: Survey) -> list:
    """Identify what features and matches are made of: files and lenses, without positions and angles."""
    return [[name, size, time, lens] for name, size, time, _, lens, *_ in _fingerprint(survey)]


def _have_masks(photographs: Sequence[Photograph]) -> bool:
    """Whether a photograph is masked or transparent, so that all get a mask in the scene."""
    return any(photograph.mask is not None or photograph.has_alpha for photograph in photographs)


def _masks_fingerprint(survey: Survey) -> list:
    """Identify the masks of photographs; empty if no photograph has one, or is transparent."""
    masks = [(p.name, p.mask.stat()) for p in survey.photographs if p.mask is not None]
    transparent = [[p.name, "transparent"] for p in survey.photographs if p.has_alpha]
    return [[name, state.st_size, state.st_mtime_ns] for name, state in masks] + transparent


def _is_rounded(survey: Survey, side_px: int) -> bool:
    """Whether a photograph is reduced to another aspect; earlier versions scaled its features by its width alone."""
    sizes = {(photograph.width, photograph.height) for photograph in survey.photographs}
    reduced = [(*size, *reduced_size(*size, side_px)) for size in sizes]
    return any(width * rows != height * columns for width, height, columns, rows in reduced)


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
    return math.nan if value is None else float(value)


def _verdicts_from_json(facts: Facts) -> tuple[QualityDecision, ...]:
    return tuple(
        QualityDecision(
            str(verdict["name"]),
            verdict["measures"] and Measures(**{name: _nan(value) for name, value in verdict["measures"].items()}),
            None if verdict["left_out"] is None else str(verdict["left_out"]),
        )
        for verdict in facts["verdicts"]
    )


def _pairs_from_json(facts: Facts, names: Collection[str]) -> list[tuple[str, str]]:
    pairs = [(first, second) for first, second in facts["pairs"]]
    unknown = {name for pair in pairs for name in pair} - set(names)
    if unknown:
        raise ValueError(f"there is no photograph {min(unknown)}")
    return pairs


def _lens_from_json(facts: Facts) -> LensChoice:
    trials = tuple(LensTrial(**trial) for trial in facts["trials"])
    return LensChoice(**{**facts, "trials": trials, "heights": facts["heights"] and Heights(**facts["heights"])})


def _correction_from_json(facts: Facts | None, count: int) -> ExposureCorrection | None:
    if facts is None:
        return None
    arrays = {name: np.array(facts[name], dtype=np.float64).reshape(count, 3) for name in ("gain", "falloff")}
    return ExposureCorrection(**{**facts, **arrays, **{k: _nan(facts[k]) for k in ("before", "gains_alone", "after")}})
