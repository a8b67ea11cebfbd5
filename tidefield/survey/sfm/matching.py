"""Match pairs of photographs by pycolmap.

Its own `match_spatial` needs a position of every photograph, and reports no progress.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from concurrent.futures import TimeoutError as NotReady
from functools import partial
from pathlib import Path
from typing import TypeVar

import pycolmap

from tidefield.survey.sfm.features import encode_name
from tidefield.survey.survey import Progress

Result = TypeVar("Result")
BATCH = 64
"""Pairs that are matched between two reports of progress: an interruption loses at most these."""


def interruptible(job: Callable[[pycolmap.CancellationToken], Result]) -> Result:
    """Run a long job of pycolmap in a thread and cancel it on Ctrl-C, which it would not notice itself."""
    token = pycolmap.CancellationToken()
    with ThreadPoolExecutor(1) as pool:
        future = pool.submit(job, token)
        try:
            while True:
                try:
                    return future.result(timeout=0.2)
                except NotReady:
                    if future.done():  # the job itself raised it
                        raise
        except BaseException:
            token.cancel()
            raise


def match(
    database: Path, pairs: Sequence[tuple[str, str]], device: pycolmap.Device, progress: Progress
) -> tuple[int, int]:
    """Match and verify pairs of photographs by name; pairs that the database contains already are kept.

    Returns:
        The number of pairs with a verified two-view geometry, and the total number of their inlier matches.
    """
    encoded = [(encode_name(first), encode_name(second)) for first, second in pairs]
    with pycolmap.Database.open(database) as db:
        ids = {image.name: image.image_id for image in db.read_all_images()}
        todo = [pair for pair in encoded if not db.exists_two_view_geometry(ids[pair[0]], ids[pair[1]])]
    pairing = pycolmap.ImportedPairingOptions(match_list_path=database.with_name("pairs.txt"))
    verification = pycolmap.TwoViewGeometryOptions()
    # A fixed seed, so that the same photographs give the same poses.
    verification.ransac.random_seed = 0
    match_listed = partial(
        pycolmap.match_image_pairs,
        database,
        pairing_options=pairing,
        verification_options=verification,
        device=device,
    )
    for start in range(0, len(todo), BATCH):
        batch = todo[start : start + BATCH]
        pairing.match_list_path.write_text("".join(f"{a} {b}\n" for a, b in batch), encoding="utf-8")
        interruptible(lambda token: match_listed(cancellation_token=token))
        progress(len(pairs) - len(todo) + start + len(batch), len(pairs))
    pairing.match_list_path.unlink(missing_ok=True)
    with pycolmap.Database.open(database) as db:
        _, inliers = db.read_two_view_geometry_num_inliers()
    return sum(n > 0 for n in inliers), sum(inliers)
