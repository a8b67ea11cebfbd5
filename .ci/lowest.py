"""Print the lowest versions that pyproject.toml promises, as pip's constraints."""

import tomllib
from pathlib import Path

from packaging.requirements import Requirement

project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]
for line in project["dependencies"]:
    requirement = Requirement(line)
    (lowest,) = [one.version for one in requirement.specifier if one.operator == ">="]
    print(f"{requirement.name}=={lowest}")
