"""The original NeRF's Blender scenes: `transforms_{train,val,test}.json`, and pictures of an object with alpha."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tidefield.data.readers.posed import PosedPhotographs, keep_present
from tidefield.data.readers.transforms import frames_of, lens_of, names_of, poses_of, read_json

# The cameras lie on a sphere around the object at the origin and look at it. The original NeRF takes 2 to 6 at a
# radius of 4.
_NEAREST, _FARTHEST = 0.5, 1.5
_WHITE = (1.0, 1.0, 1.0)


def read_blender(root: Path, allow_missing: bool) -> PosedPhotographs:
    """A Blender scene: its train photographs to learn from, its test photographs (or else val) held out.

    Raises:
        SceneError: for damaged files or missing photographs.
    """
    parts = [root / "transforms_train.json"]
    held_out = [root / f"transforms_{part}.json" for part in ("test", "val")]
    parts += [part for part in held_out if part.is_file()][:1]
    names, paths, lenses, poses = [], [], [], []
    for file in parts:
        top = read_json(file)
        frames, part_paths = frames_of(top, root, file)
        present = keep_present(part_paths, file, allow_missing)
        frames, part_paths = [frames[i] for i in present], [part_paths[i] for i in present]
        names.append(names_of(root, part_paths))
        paths += part_paths
        lenses += [lens_of({**top, **frame}, path, file) for frame, path in zip(frames, part_paths, strict=True)]
        poses.append(poses_of(frames, file))
    T_world_camera = np.concatenate(poses)
    distance = np.linalg.norm(T_world_camera[:, :, 3], axis=1)
    return PosedPhotographs(
        names=sum(names, ()),
        paths=tuple(paths),
        lenses=tuple(lenses),
        T_world_camera=T_world_camera,
        near_far=np.stack([_NEAREST * distance, _FARTHEST * distance], axis=1),
        split=(frozenset(names[0]), frozenset(names[1]) - frozenset(names[0])) if len(names) == 2 else None,
        background_rgb=_WHITE,
    )
