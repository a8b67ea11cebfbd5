"""The instructions and stages of the Containerfile."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "Containerfile").read_text(encoding="utf-8")
INSTRUCTIONS = [
    (line.split(maxsplit=1)[0], line.split(maxsplit=1)[1])
    for line in re.sub(r"\\\n\s*", "", TEXT).splitlines()
    if line and not line.startswith("#")
]
STAGES = [text.split()[-1] for name, text in INSTRUCTIONS if name == "FROM"]
IMAGE = re.compile(r"tidefield:\w+")
