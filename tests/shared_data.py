"""Where the real scenes and surveys are that some tests use, and skip without."""

from pathlib import Path

SHARED = Path(__file__).parents[2] / "shared" / "data"
