"""At which sizes pictures are matched."""

from typing import Any

import pytest

from tidefield.data.matching import Matcher
from tidefield.geometry.cameras import Cameras


def matched_sizes(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, int]]:
    """Widths and heights of the pictures that are matched from now on."""
    sizes, match = [], Matcher._match

    def noted(self: Matcher, camera: Cameras, *others: Any) -> Any:
        sizes.append((camera.width, camera.height))
        return match(self, camera, *others)

    monkeypatch.setattr(Matcher, "_match", noted)
    return sizes
