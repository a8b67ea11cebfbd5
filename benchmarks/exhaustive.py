"""Structure from motion as it is run without knowing the survey: COLMAP's defaults, every photograph with every other.

`python -m benchmarks.exhaustive PHOTOS OUT [PAIRS]` writes OUT/model and OUT/exhaustive.json. Given a number of PAIRS,
it matches only so many, drawn at random, reckons the time of all from theirs, and places no photograph.
"""

from __future__ import annotations

import json
import random
import sys
import time
from itertools import combinations
from pathlib import Path
from typing import Any

import pycolmap


def main() -> None:
    photographs, out, count = Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]) if len(sys.argv) > 3 else None
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
    pairs = list(combinations(names, 2))
    drawn = pairs if count is None else random.Random(0).sample(pairs, min(count, len(pairs)))
    record = {"photographs": len(names), "pairs": len(pairs), "pairs_matched": len(drawn), "seconds": seconds}
    if len(drawn) == len(pairs):
        step("matches", pycolmap.match_exhaustive, database)
        record |= _placed(step("poses", pycolmap.incremental_mapping, database, photographs, out), out / "model")
    else:
        (out / "pairs.txt").write_text("".join(f"{a} {b}\n" for a, b in drawn), encoding="utf-8")
        some = pycolmap.ImportedPairingOptions(match_list_path=out / "pairs.txt")
        step("matches", pycolmap.match_image_pairs, database, pairing_options=some)
        seconds["matches"] *= len(pairs) / len(drawn)
    (out / "exhaustive.json").write_text(json.dumps(record, indent=1), encoding="utf-8")


def _placed(models: dict[int, pycolmap.Reconstruction], folder: Path) -> dict[str, Any]:
    """Write the model of the most photographs, and tell what it is."""
    best = max(models.values(), key=lambda model: model.num_reg_images(), default=None)
    if best is None:
        return {"registered": 0, "reprojection_error_px": None, "focal_px": []}
    folder.mkdir(exist_ok=True)
    best.write_binary(folder)
    return {
        "registered": best.num_reg_images(),
        "reprojection_error_px": best.compute_mean_reprojection_error(),
        "focal_px": [camera.mean_focal_length() for camera in best.cameras.values()],
    }


if __name__ == "__main__":
    main()
