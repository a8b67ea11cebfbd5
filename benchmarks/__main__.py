"""`python -m benchmarks NAME`, as `python -m benchmarks --help` lists them; without a name, speed.

A command is the function of its name in the module of its name, which is imported when it is asked for.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from importlib import import_module

import tyro

from tidefield.errors import TidefieldError
from tidefield.machine import tune_process

DESCRIPTION = """Measure speed, views, memory, surveys and robustness, and write the pages of results. Without a name,
it is speed. `tidefield compare` and `tidefield ablate` measure quality.

Measure on a machine that does nothing else. The page is made of the files of `tidefield compare`, `tidefield ablate`,
speed, frames and memory."""
COMMANDS = {
    "speed": "Rays per second of paper and swift, by stage, and their share of the machine's peak arithmetic (2-3 "
    "minutes).",
    "frames": "Time of zero-shot views: the first, further ones, and among many photographs (minutes).",
    "memory": "Peak memory of rendering one frame of 4000 x 3000 pixels from photographs of that size (minutes, 1 GB "
    "of disk).",
    "scales": "Quality and time at several widths: read at points, by cones, and with several rays (hours); write the "
    "page.",
    "surveys": "Prepare surveys and compare with exhaustive structure from motion; write the page (hours).",
    "mappers": "Prepare surveys with the incremental and with the global mapper (a quarter of an hour).",
    "flight": "Make the photographs of a large flight over a built-in flat, as a drone writes them (minutes; "
    "continues).\n\n`tidefield prepare OUT/photographs SCENE` reads them, and OUT/truth.json has the true positions. "
    "The same command completes what was interrupted.",
    "large": "Time, memory and errors of `tidefield prepare` on flights of `python -m benchmarks flight`, by stage "
    "(minutes).",
    "cost": "Hours, memory and disk of a survey, by a model fitted to flights that are measured; writes the page on "
    "costs.",
    "areas": "Training by areas: memory against the number of photographs, quality, and seams (an hour).",
    "maps": "Maps of built-in flats against the exact truth, and two baselines: sparse points, semi-global matching "
    "(an hour).",
    "map_control": "Heights of a map's surface at ground control that is left out in turn (minutes).",
    "map_views": "A photograph of a built-in flat that took no part in its map, against the orthophoto warped into it "
    "(minutes).",
    "map_surveys": "Maps of real surveys and the time they take, next to what users of ODM published (minutes each).",
    "map_memory": "Peak memory of a map of a square kilometre, simulated by repeating a scene (an hour, 20 GB of "
    "disk).",
    "cluster": "A map on a cluster of this machine: speed of one and two workers, and what killed workers cost (an "
    "hour).",
    "points": "Zero-shot views of scenes with COLMAP's points, and of the same without any (minutes for each scene).",
    "parts": "Zero-shot views with weights that were trained with and without parts of the network (minutes for each "
    "scene).",
    "depth": "Depths of held-out views of built-in flats against the exact truth and the triangulated points "
    "(minutes).",
    "change": "Measure `tidefield change` against published figures and on pairs of known change (10 minutes); write "
    "the page.",
    "change_size": "Time and peak memory of `tidefield change` on surfaces of many cells (10 minutes, 2 GB of disk).",
    "change_cover": "Plants and waterlines of built-in pairs of dates against the truth (3 minutes).",
    "change_chain": "Photographs of a built-in flat at two dates -> prepare -> map -> change, each against the truth "
    "(20-30 minutes).",
    "change_null": "Two flights over swindale, 27 minutes apart, as two surveys: nothing dry changed (30 minutes).",
    "view": "How soon `tidefield view` shows pictures after moves of the camera, and what memory they take (minutes).",
    "gaussians": "What `tidefield export` loses against held-out photographs, with points chosen in several ways "
    "(minutes).",
    "kills": "Kill commands at random moments, complete their work, and compare it with that of uninterrupted ones "
    "(minutes).",
    "fuzz": "Give damaged files to everything that reads files, and keep those that are not properly refused "
    "(minutes).",
    "table": "Write the page of results from stored measurements; it marks what is missing.",
    "robustness": "Write the page on damaged files and killed commands from stored counts.",
    "card": "Write the card of weights, from the file itself and from stored measurements.",
}
"""Help by name."""


def main(words: Sequence[str] | None = None) -> None:
    """Entry point: exit status 2 for a user's mistake, 130 after an interruption."""
    words = list(sys.argv[1:] if words is None else words)
    if not words or (words[0].startswith("-") and words[0] not in ("-h", "--help")):
        words = ["speed", *words]
    name, program = words[0], "python -m benchmarks"
    try:
        if name in COMMANDS:
            if name != "surveys":  # it measures COLMAP as it is, in a process with this one's environment
                tune_process()
            function = getattr(import_module(f"benchmarks.{name}"), name)
            tyro.cli(function, prog=f"{program} {name}", description=COMMANDS[name], args=words[1:])
        else:
            named = {name: _described(text) for name, text in COMMANDS.items()}
            tyro.extras.subcommand_cli_from_dict(named, prog=program, description=DESCRIPTION, args=words)
    except TidefieldError as error:
        print(f"benchmarks: {error}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print("benchmarks: interrupted; repeat the command to continue", file=sys.stderr)
        sys.exit(130)


def _described(text: str) -> Callable[[], None]:
    """A function with this help, in place of a command whose module is not imported."""

    def command() -> None: ...

    command.__doc__ = text
    return command


if __name__ == "__main__":
    main()
