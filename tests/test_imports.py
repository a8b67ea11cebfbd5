"""Imports point downward, from the commands to geometry: RANK below has the order of the folders."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "tidefield"
RANK = {
    "geometry": 0,
    "data": 1,
    "synthetic": 2,
    "addresses": 2,
    "survey": 2,
    "model": 2,
    "evaluation": 3,
    "render": 3,
    "train": 4,
    "change": 6,
    "baselines": 5,
    "maps": 5,
    "methods": 6,
    "api": 7,
    "compare": 7,
    "nerfbaselines": 7,
    "nerfstudio": 7,
    "viewer": 7,
    "commands": 8,
    "cli": 9,
}
FOR_ALL = {
    *("cluster", "config", "machine", "device", "errors", "files", "progress", "parallel", "recording"),
    *("processes", "pages"),
}
"""These import nothing of ours but each other."""
MODULES = sorted(PACKAGE.rglob("*.py"))


def name_of(path: Path) -> str:
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


BY_NAME = {name_of(path): path for path in MODULES}


def guards_types(node: ast.AST) -> bool:
    """`if TYPE_CHECKING:`, which runs in no program."""
    return isinstance(node, ast.If) and ast.unparse(node.test) in ("TYPE_CHECKING", "typing.TYPE_CHECKING")


def statements(node: ast.AST, at_import: bool) -> Iterator[ast.AST]:
    """All nodes, or only those that run when the module is imported."""
    functions = (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda)
    for child in ast.iter_child_nodes(node):
        if at_import and (isinstance(child, functions) or guards_types(child)):
            continue
        yield child
        yield from statements(child, at_import)


def imports(path: Path, at_import: bool = False) -> set[str]:
    """Full names of the modules that a file imports."""
    found: set[str] = set()
    for node in statements(ast.parse(path.read_text(encoding="utf-8")), at_import):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{name_of(path)} imports relatively, line {node.lineno}"
            module = node.module or ""
            # `from package import module` names a module only if there is one of that name.
            inner = {f"{module}.{alias.name}" for alias in node.names} & set(BY_NAME)
            found |= inner | {module}
    return found


def test_every_folder_has_its_place_in_the_order():
    places = {name.split(".")[1] for name in BY_NAME if "." in name}
    assert places - FOR_ALL <= set(RANK), "give the new folder its place in RANK"


@pytest.mark.parametrize("name", BY_NAME)
def test_imports_point_downward(name: str):
    own = [*name.split("."), ""][1]
    # The package's own interface is imported when it is first used; nothing below may use it.
    if name == "tidefield":
        return
    for imported in imports(BY_NAME[name]):
        if imported.split(".")[0] != "tidefield" or imported == "tidefield":
            continue
        assert imported in BY_NAME, f"{name} imports {imported}, which does not exist"
        theirs = imported.split(".")[1]
        if theirs in FOR_ALL or theirs == own:
            continue
        assert own not in FOR_ALL, f"{name} is for all to import, but imports {imported}"
        assert own in RANK, f"{name} imports {imported}, but is imported by everything"
        assert RANK[theirs] < RANK[own], f"{name} imports {imported}, which lies above it or on its level"


def imported_with(name: str) -> set[str]:
    """What importing a module imports before anything is called, through all of ours."""
    reached, waiting = set(), [name]
    while waiting:
        module = waiting.pop()
        if module in reached:
            continue
        reached.add(module)
        parents = [".".join(module.split(".")[:k]) for k in range(1, module.count(".") + 1)]
        waiting += [m for m in parents if m in BY_NAME]
        if module in BY_NAME:
            waiting += imports(BY_NAME[module], at_import=True)
    return reached


@pytest.mark.parametrize("name", ["tidefield", "tidefield.config", "tidefield.errors", "tidefield.cli"])
def test_torch_is_not_imported_with_what_answers_help(name: str):
    assert not [m for m in imported_with(name) if m.split(".")[0] == "torch"]


@pytest.mark.parametrize("name", ["features", "blocks"])
def test_the_processes_of_prepare_do_without_torch(name: str):
    assert not [m for m in imported_with(f"tidefield.survey.sfm.{name}") if m.split(".")[0] == "torch"]


@pytest.mark.parametrize("command", ["render", "train"])
def test_what_renders_and_trains_does_without_structure_from_motion(command: str):
    assert not [m for m in imported_with(f"tidefield.commands.{command}") if m.split(".")[0] == "pycolmap"]


def test_modules_of_the_same_folder_do_not_import_each_other_in_circles():
    open_, done = [], set()

    def visit(name: str) -> None:
        assert name not in open_, " -> ".join([*open_[open_.index(name) :], name])
        if name in done:
            return
        open_.append(name)
        for imported in sorted(imports(BY_NAME[name], at_import=True) & set(BY_NAME) - {name.rpartition(".")[0]}):
            visit(imported)
        done.add(open_.pop())

    for name in BY_NAME:
        visit(name)
    assert done == set(BY_NAME)
