"""Run commands of nerfstudio and NerfBaselines with Tidefield, in nerfstudio's own environment.

`foreign_commands.py WORKER PACKAGES COMMAND ARGUMENTS ... [: COMMAND ARGUMENTS ...]` with ns-train and so on, or
nerfbaselines; the command `rays` writes what nerfstudio's data parser makes of a scene. Packages that only Tidefield
needs come from the folder PACKAGES, after nerfstudio's own.
"""

from __future__ import annotations

import json
import runpy
import sys
from importlib import import_module
from itertools import groupby
from pathlib import Path


def write_rays(scene: str, out: str) -> None:
    """Positions of the training cameras and directions through a pixel of each, with and without scaling."""
    import torch

    from tidefield.nerfstudio.data import SceneParserConfig

    found = {}
    for name, scaled in (("scaled", True), ("metres", False)):
        outputs = SceneParserConfig(data=Path(scene), auto_scale_poses=scaled).setup().get_dataparser_outputs("train")
        indices = torch.arange(len(outputs.cameras))[:, None]
        rays = outputs.cameras.generate_rays(indices, coords=torch.tensor([[10.0, 50.0]]).repeat(len(indices), 1))
        found[name] = {
            "files": [str(file) for file in outputs.image_filenames],
            "origins": rays.origins.tolist(),
            "directions": rays.directions.tolist(),
            "points": outputs.metadata["points3D_xyz"].tolist(),
            "colours": outputs.metadata["points3D_rgb"].tolist(),
            "masks": [str(mask) for mask in outputs.mask_filenames or ()],
            "scale": outputs.dataparser_scale,
            "transform": outputs.dataparser_transform.tolist(),
        }
    Path(out).write_text(json.dumps(found))


def run_nerfbaselines(arguments: list[str]) -> None:
    """Its LPIPS has random weights: tests fetch nothing from the net."""
    import torchvision.models

    for name in ("alexnet", "vgg16"):
        network = getattr(torchvision.models, name)
        setattr(torchvision.models, name, lambda network=network, **_: network(weights=None))
    sys.argv = ["nerfbaselines", *arguments]
    import_module("nerfbaselines.cli").main()


def main(worker: str, packages: str, words: list[str]) -> None:
    sys.path.append(packages)
    runpy.run_path(worker)["without_compiled_torchvision"]()
    for is_end, group in groupby(words, ":".__eq__):
        if is_end:
            continue
        command, *arguments = group
        if command == "rays":
            write_rays(*arguments)
            continue
        if command == "nerfbaselines":
            run_nerfbaselines(arguments)
            continue
        sys.argv = [command, *arguments]
        import_module(f"nerfstudio.scripts.{command.removeprefix('ns-')}").entrypoint()


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], sys.argv[3:])
