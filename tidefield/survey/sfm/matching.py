"""Matches between photographs, and the two-view geometry that they agree on: pycolmap's, on CUDA where it has that."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import pycolmap

from tidefield.survey.sfm.features import opened, stored_name
from tidefield.survey.stages import interruptible

AT_ONCE = 64
"""Pairs that are matched before progress is told: what an interruption loses at most."""


def match(
    database: Path, pairs: Sequence[tuple[str, str]], device: pycolmap.Device, progress: Callable[[int, int], object]
) -> tuple[int, int]:
    """Match pairs of photographs by name and write what agrees to the database; what it holds already is kept.

    Returns:
        How many pairs agree on a geometry, and how many matches support these in all.
    """
    pairs = [(stored_name(first), stored_name(second)) for first, second in pairs]
    with opened(database) as db:
        images = {image.name: image.image_id for image in db.read_all_images()}
        todo = [pair for pair in pairs if not db.exists_two_view_geometry(*(images[name] for name in pair))]
    some = pycolmap.ImportedPairingOptions(match_list_path=database.with_name("pairs.txt"))
    verification = pycolmap.TwoViewGeometryOptions()
    # The same photographs give the same poses.
    verification.ransac.random_seed = 0
    for start in range(0, len(todo), AT_ONCE):
        part = todo[start : start + AT_ONCE]
        some.match_list_path.write_text("".join(f"{first} {second}\n" for first, second in part), encoding="utf-8")
        interruptible(
            lambda token: pycolmap.match_image_pairs(
                database,
                pairing_options=some,
                verification_options=verification,
                device=device,
                cancellation_token=token,
            )
        )
        progress(len(pairs) - len(todo) + start + len(part), len(pairs))
    some.match_list_path.unlink(missing_ok=True)
    with opened(database) as db:
        _, inliers = db.read_two_view_geometry_num_inliers()
    return sum(n > 0 for n in inliers), sum(inliers)
