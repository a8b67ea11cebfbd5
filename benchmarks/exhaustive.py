"""Structure from motion as it is run without knowing the survey: COLMAP's defaults, every photograph with every other.

`python -m benchmarks.exhaustive PHOTOS OUT` writes OUT/model and OUT/exhaustive.json.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import pycolmap


def main() -> None:
    photographs, out = Path(sys.argv[1]), Path(sys.argv[2])
    out.mkdir(parents=True, exist_ok=True)
    pycolmap.logging.minloglevel = int(pycolmap.logging.ERROR)
    database, seconds = out / "database.db", {}
    database.unlink(missing_ok=True)

    def step(name: str, function, *arguments, **options):
        start = time.perf_counter()
        result = function(*arguments, **options)
        seconds[name] = time.perf_counter() - start
        return result

    names = sorted(p.name for p in photographs.iterdir() if p.suffix.lower() in (".jpg", ".jpeg", ".png"))
    mode = pycolmap.CameraMode.SINGLE
    step("features", pycolmap.extract_features, database, photographs, image_names=names, camera_mode=mode)
    step("matches", pycolmap.match_exhaustive, database)
    models = step("poses", pycolmap.incremental_mapping, database, photographs, out)
    best = max(models.values(), key=lambda model: model.num_reg_images(), default=None)
    if best is not None:
        (out / "model").mkdir(exist_ok=True)
        best.write_binary(out / "model")
    record = {
        "photographs": len(names),
        "registered": best.num_reg_images() if best else 0,
        "reprojection_error_px": best.compute_mean_reprojection_error() if best else None,
        "focal_px": [camera.mean_focal_length() for camera in best.cameras.values()] if best else [],
        "seconds": seconds,
    }
    (out / "exhaustive.json").write_text(json.dumps(record, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
