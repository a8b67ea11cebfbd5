"""What results are made from, scenes and trained weights, and that results which are reused are made from the same."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tidefield.compare.run import (
    RUN_FILE,
    RUNS,
    Settings,
    preset_of,
    read_evaluation,
    read_process,
    starts_from_weights,
)
from tidefield.errors import RunError, SceneError
from tidefield.files import read_json

if TYPE_CHECKING:
    from tidefield.data.readers.posed import PosedPhotographs

_END_BYTES = 1 << 16


def check_scene(scene: Path, width: int | None) -> tuple[str, str]:
    """Identify the poses and the split of a scene (`poses_key`), and its contents (`contents_key`).

    Raises:
        SceneError: it cannot be compared on.
    """
    import torch

    from tidefield.data.load import read_posed, require_width
    from tidefield.data.scene import poses_key

    require_width(width)
    posed = read_posed(scene, allow_missing=False)
    held_out = {posed.names[i] for i in posed.train_and_test[1]}
    if not held_out:
        raise SceneError(f"{scene} holds no photograph out: expected at least one to compare with; add photographs")
    T_world_camera, _ = posed.centred
    poses = poses_key(posed.names, torch.from_numpy(T_world_camera).float(), held_out)
    return poses, contents_key(posed)


def contents_key(posed: PosedPhotographs) -> str:
    """Identify photographs, masks, lenses and sparse points, but not where the files are and when they were written.

    Of a file, its size and both of its ends count: a photograph or mask that is made anew differs there, and a survey
    of gigabytes takes a second. Numbers are rounded, as another machine may do when it reads them.
    """
    from tidefield.data.cache import array_hash

    digest = hashlib.sha256()
    for path, mask in zip(posed.paths, posed.masks or (None,) * len(posed.paths), strict=True):
        for file in (path, mask):
            digest.update(b"none" if file is None else _ends(file))
    lenses = json.dumps([asdict(lens) for lens in posed.lenses])
    digest.update(json.dumps(json.loads(lenses, parse_float=lambda text: f"{float(text):.9g}")).encode())
    if (points := posed.points) is not None:
        for array in (points.xyz_world.round(5), points.point_index, points.photograph_index, points.uv_px.round(3)):
            digest.update(array_hash(array + 0).encode())  # no -0.0
    return digest.hexdigest()


def _ends(path: Path) -> bytes:
    """The SHA-256 of a file's size, its beginning and its end."""
    size = path.stat().st_size
    with path.open("rb") as file:
        first = file.read(_END_BYTES)
        file.seek(max(0, size - _END_BYTES))
        return hashlib.sha256(b"%d " % size + first + file.read(_END_BYTES)).digest()


def installed_weights(methods: Sequence[str], settings: Settings) -> dict[str, str | None]:
    """The SHA-256 of the installed weights that methods start from; None for those that start from none."""
    from tidefield.train.checkpoint import shipped_weights, weights_sha256

    found: dict[str, str | None] = dict.fromkeys(methods)
    for method in methods:
        file = None
        if starts_from_weights(method, settings):
            file = shipped_weights(str(preset_of(method, settings)))
        found[method] = None if file is None else weights_sha256(file)
    return found


def require_one_state(scenes: Mapping[str, str], methods: Sequence[str], out: Path) -> None:
    """Raises: RunError when results are of other poses or splits than the scene has: it was made anew in between.

    Args:
        scenes: the poses that `check_scene` returned, by the scenes' names.
    """
    for name, state in scenes.items():
        measured: dict[str, list[str]] = {}
        for method in methods:
            run, evaluation = _made(out / RUNS / name / method)
            for poses in {of["poses"] for of in (run, evaluation) if of.get("poses") is not None}:
                measured.setdefault(poses, []).append(method)
        if len(measured) > 1:
            groups = ", and ".join(", ".join(group) for group in measured.values())
            raise RunError(
                f"{out / RUNS / name} has results of {groups}, on different poses or splits of the scene: expected the "
                "same for all; delete the older ones, or name another folder with --out"
            )
        if measured and state not in measured:
            (older,) = measured.values()
            raise RunError(
                f"{out / RUNS / name} has results of {', '.join(older)}, on other poses or another split than the "
                "scene has now: expected the same; delete them, or name another folder with --out"
            )


def require_same_sources(contents: Mapping[str, str], weights: Mapping[str, str | None], out: Path) -> None:
    """Raises: RunError when results are of other contents of a scene, or of other weights, than there are now.

    Args:
        contents: those that `check_scene` returned, by the scenes' names.
        weights: `installed_weights`, of all methods.
    """
    for name, state in contents.items():
        for method, installed in weights.items():
            folder = out / RUNS / name / method
            if read_process(folder).get("scene", {}).get("contents", state) != state:
                raise RunError(
                    f"{folder} was made with other photographs, masks, lenses or sparse points than the scene has now: "
                    "expected the same; delete it, or name another folder with --out"
                )
            run, evaluation = _made(folder)
            for one in (run, evaluation.get("configuration", {})):
                if one.get("weights", installed) != installed:
                    was, now = (
                        f"those with SHA-256 {of[:12]}..." if of else "none" for of in (one["weights"], installed)
                    )
                    raise RunError(
                        f"{folder} was made with other trained weights than are installed now: expected the same "
                        f"({now}), found {was}; delete it, or name another folder with --out"
                    )


def _made(folder: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """The run and the evaluation of a result, empty where there is none; an interrupted run is made anew."""
    # Not `read_run`: the memory of PyTorch would be charged to every process that this one starts.
    run = read_json(folder / RUN_FILE) if "train" in read_process(folder) else None
    return run or {}, read_evaluation(folder) or {}
