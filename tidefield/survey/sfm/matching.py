"""Match pairs of photographs by pycolmap, in processes.

Its own `match_spatial` needs a position of every photograph, and reports no progress.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Sequence
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

import pycolmap

from tidefield.errors import RunError
from tidefield.processes import in_order, worker_processes
from tidefield.survey.sfm.features import copy_photographs, encode_name, is_gpu, set_up_pycolmap, workers_on
from tidefield.survey.survey import Progress

Pair = tuple[int, int]
"""The numbers of two photographs in a database."""
BATCH = 256
"""Most pairs that a process matches at a time. An interruption loses them; fewer need clusters more often."""


def match(
    database: Path, pairs: Sequence[tuple[str, str]], device: pycolmap.Device, progress: Progress
) -> tuple[int, int]:
    """Match and verify pairs of photographs by name; what the database contains of them is kept, other pairs are not.

    Returns:
        The number of pairs with a verified two-view geometry, and the total number of their inlier matches.

    Raises:
        RunError: a process was killed.
    """
    folder = database.with_name("matching")
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    try:
        with pycolmap.Database.open(database) as db:
            ids = {image.name: image.image_id for image in db.read_all_images()}
            numbers = [(ids[encode_name(first)], ids[encode_name(second)]) for first, second in pairs]
            _delete_others(db, numbers)
            todo = [pair for pair in numbers if not db.exists_two_view_geometry(*pair)]
            done = len(pairs) - len(todo)
            for count in _match_in_processes(db, todo, folder, device):
                done += count
                progress(done, len(pairs))
            _, inliers = db.read_two_view_geometry_num_inliers()
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    return sum(n > 0 for n in inliers), sum(inliers)


def _delete_others(db: pycolmap.Database, pairs: Sequence[Pair]) -> None:
    """Delete what a database contains of other pairs than these."""
    wanted = {frozenset(pair) for pair in pairs}
    with pycolmap.DatabaseTransaction(db):
        for pair_id in {*db.read_num_matches()[0], *db.read_two_view_geometry_num_inliers()[0]}:
            pair = pycolmap.pair_id_to_image_pair(pair_id)
            if frozenset(pair) not in wanted:
                db.delete_matches(*pair)
                db.delete_two_view_geometry(*pair)


def _match_in_processes(
    db: pycolmap.Database, pairs: Sequence[Pair], folder: Path, device: pycolmap.Device
) -> Iterator[int]:
    """Match and verify pairs of a database; yields how many were written to it."""
    # Processes, because on several threads pycolmap rarely finds other matches: it searches descriptors in clusters,
    # and these then differ. A GPU compares all descriptors.
    workers, threads = workers_on(device, len(pairs)), -1 if is_gpu(device) else 1
    size = max(1, min(BATCH, -(-len(pairs) // workers)))
    batches = [pairs[start : start + size] for start in range(0, len(pairs), size)]
    try:
        with worker_processes(workers, set_up_pycolmap) as pool:

            def submit(batch: Sequence[Pair]) -> Future[Path]:
                part = folder / f"{batch[0][0]}_{batch[0][1]}.db"
                _copy_features(db, part, batch)
                return pool.submit(_match, part, batch, device, threads)

            for batch, part in in_order(submit, batches, 2 * workers):
                _copy_geometries(part, batch, db)
                part.unlink()
                yield len(batch)
    except BrokenProcessPool as error:
        raise RunError(
            "a process that matches photographs was killed, which happens when memory runs out: expected memory "
            f"for {workers} of them; give fewer --features, and continue with the same command"
        ) from error


def _copy_features(db: pycolmap.Database, part: Path, pairs: Sequence[Pair]) -> None:
    """Write what matching reads of some photographs to a database of their own."""
    numbers = sorted({number for pair in pairs for number in pair})
    with pycolmap.Database.open(part) as own, pycolmap.DatabaseTransaction(own):
        copy_photographs(db, own, numbers)
        for number in numbers:
            own.write_descriptors(number, db.read_descriptors(number))


def _match(part: Path, pairs: Sequence[Pair], device: pycolmap.Device, threads: int) -> Path:
    """Match and verify pairs of the photographs of a database, and return its path."""
    with pycolmap.Database.open(part) as db:
        name = {image.image_id: image.name for image in db.read_all_images()}
    listed = part.with_suffix(".txt")
    listed.write_text("".join(f"{name[first]} {name[second]}\n" for first, second in pairs), encoding="utf-8")
    verification = pycolmap.TwoViewGeometryOptions()
    # A fixed seed, so that the same photographs give the same poses.
    verification.ransac.random_seed = 0
    pycolmap.match_image_pairs(
        part,
        pycolmap.FeatureMatchingOptions(num_threads=threads),
        pycolmap.ImportedPairingOptions(match_list_path=listed),
        verification,
        device,
    )
    return part


def _copy_geometries(part: Path, pairs: Sequence[Pair], db: pycolmap.Database) -> None:
    """Write what was verified of pairs to the common database, all or nothing; also that there was nothing.

    Matches that were not verified stay behind: mapping does not read them.
    """
    with pycolmap.Database.open(part) as own, pycolmap.DatabaseTransaction(db):
        for pair in pairs:
            db.write_two_view_geometry(*pair, own.read_two_view_geometry(*pair))
