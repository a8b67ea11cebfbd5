"""The Containerfile is checked against the repository, and built where there is a container engine."""

import re
import shutil
import subprocess
import tomllib
from fnmatch import fnmatch

import pytest
from containers import INSTRUCTIONS, ROOT, STAGES, TEXT
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
PINNED = {
    canonicalize_name(Requirement(line).name)
    for line in (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    if line and not line.startswith("#")
}
(EXTRAS,) = [match[1].split(",") for match in re.finditer(r"^ENV EXTRAS=(\S+)$", TEXT, flags=re.MULTILINE)]
IGNORED = [
    line
    for line in (ROOT / ".dockerignore").read_text(encoding="utf-8").splitlines()
    if line and not line.startswith("#")
]
SHOWN = [line[1:] for line in IGNORED if line.startswith("!")]


def is_ignored(path: str) -> bool:
    """As engines decide: the last pattern that fits the path, or a folder that it is in, counts."""
    parts, ignored = path.split("/"), False
    for line in IGNORED:
        pattern = line.removeprefix("!")
        anywhere = pattern.startswith("**/")
        pattern = pattern.removeprefix("**/")
        assert "/" not in pattern, "only names in the root, or anywhere, are understood here"
        if any(fnmatch(part, pattern) for part in (parts if anywhere else parts[:1])):
            ignored = not line.startswith("!")
    return ignored


def test_the_images_are_made_of_what_they_need_and_of_nothing_else() -> None:
    files = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True)
    if files.returncode != 0:
        pytest.skip("not a git repository")
    taken = [path for path in files.stdout.splitlines() if not is_ignored(path)]
    assert {path.split("/")[0] for path in taken} == set(SHOWN)
    readme = re.findall(r'path = "([^"]+)"', (ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    needed = {*readme, *PROJECT["license-files"], "pyproject.toml", "constraints.txt", "weights/paper/pyproject.toml"}
    assert needed <= set(taken)
    package = [path for path in files.stdout.splitlines() if path.startswith(("tidefield/", "weights/"))]
    assert set(package) <= set(taken)
    assert is_ignored("tidefield/__pycache__/cli.pyc")
    assert is_ignored("weights/paper/build/lib/tidefield_paper_weights/paper.safetensors")


def test_every_path_that_is_copied_exists_and_is_not_ignored() -> None:
    copied = [text.split() for name, text in INSTRUCTIONS if name == "COPY"]
    own = [source for words in copied if not words[0].startswith("--") for source in words[:-1]]
    assert own
    for source in own:
        assert (ROOT / source).exists(), source
        assert source == "." or not is_ignored(source), source
    for words in copied:
        if words[0].startswith("--from="):
            assert words[0].removeprefix("--from=") in STAGES
    for path in re.findall(r"(?<= )\./[\w/]+$", "\n".join(text for _, text in INSTRUCTIONS), flags=re.MULTILINE):
        assert (ROOT / path / "pyproject.toml").is_file(), path


def test_the_extras_exist_and_all_that_is_installed_is_pinned() -> None:
    assert "cluster" in EXTRAS
    lines = [*PROJECT["dependencies"], *(line for extra in EXTRAS for line in PROJECT["optional-dependencies"][extra])]
    assert {canonicalize_name(Requirement(line).name) for line in lines} - PINNED == set()
    installs = [text for name, text in INSTRUCTIONS if name == "RUN" and "pip install" in text]
    assert installs
    assert all("-c constraints.txt" in text for text in installs)


def test_python_is_one_that_the_project_promises() -> None:
    (version,) = re.findall(r"^ARG PYTHON=([\d.]+)$", TEXT, flags=re.MULTILINE)
    assert SpecifierSet(PROJECT["requires-python"]).contains(version)
    assert f"Programming Language :: Python :: {version}" in PROJECT["classifiers"]


def test_both_images_run_the_same_command_as_an_ordinary_user() -> None:
    assert {"cpu", "cuda"} <= set(STAGES)
    parents = {text.split()[-1]: text.split()[0] for name, text in INSTRUCTIONS if name == "FROM"}
    assert parents["cpu"] == parents["cuda"] == "base"
    base = dict(
        INSTRUCTIONS[[name == "FROM" and text.endswith("AS base") for name, text in INSTRUCTIONS].index(True) :]
    )
    assert base["USER"] not in ("root", "0")
    assert base["ENTRYPOINT"] == '["tidefield"]'
    assert f"XDG_CACHE_HOME={base['VOLUME']}" in base["ENV"]
    assert "tidefield" in PROJECT["scripts"]


def engine() -> str | None:
    """A container engine that answers."""
    for name in ("docker", "podman"):
        if shutil.which(name) and subprocess.run([name, "info"], capture_output=True, timeout=60).returncode == 0:
            return name
    return None


@pytest.mark.slow
def test_the_image_for_cpus_is_built_and_runs() -> None:
    name = engine()
    if name is None:
        pytest.skip("no container engine answers here: neither docker nor podman")
    build = [name, "build", "--file", "Containerfile", "--target", "cpu", "--tag", "tidefield:test", "."]
    subprocess.run(build, cwd=ROOT, check=True)
    run = [name, "run", "--rm", "--user", "12345:12345", "tidefield:test", "--version"]
    assert subprocess.run(run, capture_output=True, text=True, check=True).stdout.startswith("tidefield ")
    imports = "import av, cv2, laspy, lensfunpy, pillow_heif, pycolmap, pyogrio, rasterio, ray, torchvision, viser"
    code = [name, "run", "--rm", "--entrypoint", "python", "tidefield:test", "-c", imports]
    subprocess.run(code, check=True)
