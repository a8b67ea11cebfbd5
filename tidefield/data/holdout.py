"""The file `holdout.json` of a scene that `tidefield prepare --holdout` made for honest measurement.

It lists the held-out photographs, and the gains that the others were divided by. Held-out photographs stay as taken:
their gains follow from those of the others as these were taken (docs/method.md, section 11).
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from tidefield.data.readers.files import numbers, parsing, read_json
from tidefield.errors import SceneError, list_names
from tidefield.files import completed_file

FILE_NAME = "holdout.json"


@dataclass(frozen=True)
class Holdout:
    """What took no part in a scene's poses, points and colours.

    Attributes:
        names: of the held-out photographs.
        divided_by: gains that photographs were divided by, by name; those that are not named were not divided.
    """

    names: frozenset[str]
    divided_by: Mapping[str, Float64[np.ndarray, "3"]]

    def split(self, names: Sequence[str]) -> tuple[frozenset[str], frozenset[str]]:
        """Split photographs into training and held-out ones."""
        return frozenset(names) - self.names, self.names & frozenset(names)

    def gains(self, names: Sequence[str]) -> Float64[np.ndarray, "V 3"]:
        """List what each of the photographs was divided by."""
        return np.array([self.divided_by.get(name, np.ones(3)) for name in names], dtype=np.float64).reshape(-1, 3)

    def write(self, folder: Path) -> None:
        """Write `holdout.json` into a scene's folder, over an older one."""
        gains = {name: gain.tolist() for name, gain in sorted(self.divided_by.items())}
        with completed_file(folder / FILE_NAME, overwrite=True) as partial:
            text = json.dumps({"held_out": sorted(self.names), "divided_by": gains}, indent=1, allow_nan=False)
            partial.write_text(text + "\n", encoding="utf-8")


def read_holdout(folder: Path, names: Sequence[str], allow_missing: bool) -> Holdout | None:
    """Read `holdout.json` of a scene; None if it has none.

    Args:
        names: of the scene's photographs.
        allow_missing: held-out photographs may be missing.

    Raises:
        SceneError: the file is damaged, or is of other photographs.
    """
    path = folder / FILE_NAME
    with parsing(path, "a file of `tidefield prepare --holdout`; prepare the scene again"):
        if not path.exists():
            return None
        top = read_json(path)
        held_out, gains = frozenset(map(str, top["held_out"])), top["divided_by"]
        divided_by = {name: numbers(gains, name, path, (3,)) for name in gains}
        if not all((gain > 0).all() for gain in divided_by.values()):
            raise ValueError("a gain is not positive")
    unknown = held_out - set(names)
    if (unknown and not allow_missing) or not 0 < len(held_out - unknown) < len(names):
        found = list_names(sorted(unknown or held_out)) or "nothing"
        raise SceneError(
            f"{path} holds out {found}: expected some of the scene's {len(names)} photographs; prepare the scene again"
        )
    return Holdout(held_out, divided_by)
