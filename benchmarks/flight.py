"""Photographs of a large flight over a built-in flat, as a drone writes them, for `large`, `cost` and `scales`."""

from __future__ import annotations

from pathlib import Path

from tyro.conf import Positional

from tidefield.progress import ProgressBar, make_console
from tidefield.synthetic import Flight
from tidefield.synthetic.large import LargeFlight, make_large_flight, write_large_scene


def flight(
    out: Positional[Path],
    category: str = "ground_textures",
    strips: int = 50,
    each: int = 100,
    width: int = 400,
    altitude: float = 60.0,
    forward_overlap: float = 0.8,
    side_overlap: float = 0.7,
    gps: float = 1.5,
    seed: int = 0,
    scene: Path | None = None,
) -> None:
    """Make the photographs.

    Args:
        out: Folder for `photographs/` and `truth.json`: a new one, or one of the same flight.
        category: Kind of flat: tidal_trees, river_mouths, ground_textures, vegetation or deep_water.
        strips: Number of strips.
        each: Photographs of each strip.
        width: Of a photograph, in pixels.
        altitude: Height above the mud, in metres.
        forward_overlap: Share of a photograph that the next one shows again.
        side_overlap: Share of a strip that the next one shows again.
        gps: Standard deviation of the stated positions in each horizontal direction, in metres; twice that vertically.
        seed: Of everything random.
        scene: Also write this folder: the scene that a perfect `tidefield prepare` would make, with the true poses.
    """
    own = Flight(altitude_m=altitude, forward_overlap=forward_overlap, side_overlap=side_overlap)
    plan = LargeFlight(category, seed, strips, each, width, gps_m=gps, flight=own)
    with ProgressBar(make_console(quiet=False), "Photographing") as bar:
        make_large_flight(plan, out, bar)
    if scene is not None:
        write_large_scene(plan, out, scene)
