"""The rooms of the house: no room imports from a room to its right (docs/architecture.md)."""

import ast
from pathlib import Path

import pytest

import nsm

PACKAGE = Path(nsm.__file__).parent
# from left to right; a module imports from its own room and from those before it
ROOMS = [
    "surfaces",
    "maps",
    "energies",
    "domains",
    "correspondence",
    "data",
    "tasks",
    "results",
    "pipeline",
]
# what every room may import
COMMON = {
    *("compiled", "errors", "instantiation", "optional_dependencies", "settings"),
    *("side_by_side", "stages", "tensors", "wording"),
}
# rooms that stand for themselves: meshes in numpy, and maps in torch
INDEPENDENT = {"maps": {"surfaces"}, "energies": {"surfaces", "maps"}}
# a run knows its configuration, its folder, the sweep that it belongs to and the user's modules;
# results of older versions are lifted by the table of old names
BESIDE = {
    "pipeline": {
        "config",
        "config_validation",
        "migration",
        "plugins",
        "run_directories",
        "sweeps",
    },
    "results": {"migration"},
}


def imports_of(file: Path) -> set[str]:
    """The modules of nsm that a file imports at run time, as dotted names without ``nsm``."""
    tree = ast.parse(file.read_text(encoding="utf-8"))
    typing_only = {
        child
        for node in ast.walk(tree)
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
        for child in ast.walk(node)
    }
    found: set[str] = set()
    for node in ast.walk(tree):
        if node in typing_only:
            continue
        if isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        else:
            continue
        found.update(name.removeprefix("nsm.") for name in names if name.startswith("nsm."))
    return found


@pytest.mark.parametrize("room", ROOMS)
def test_no_room_imports_from_a_room_to_its_right(room):
    allowed = {*ROOMS[: ROOMS.index(room) + 1], *COMMON, *BESIDE.get(room, ())}
    allowed -= INDEPENDENT.get(room, set())
    files = sorted((PACKAGE / room).rglob("*.py"))
    assert files, f"nsm/{room} is empty"
    wrong = {
        f"{file.relative_to(PACKAGE)}: {name}"
        for file in files
        for name in imports_of(file)
        if name.split(".")[0] not in allowed
    }
    assert not wrong
