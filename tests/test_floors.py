"""What each folder may import: the floors of the house, from the ground up, and no circle."""

import ast
import functools
import subprocess
import sys
from pathlib import Path

import pytest

import sb3_abisim

PACKAGE = Path(sb3_abisim.__file__).parent
# From the ground up; a folder imports from its own floor and from those below.
FLOORS = (
    {"common", "registry", "_version"},
    {"envs", "networks"},
    {"data", "objectives", "rl"},
    {"pretraining", "zoo"},
    {"analysis", "benchmark"},
    {"demo", "doctor", "push", "__main__"},
)
FLOOR_OF = {room: number for number, rooms in enumerate(FLOORS) for room in rooms}
# Imports every module of some folders, and prints which rooms that has brought along.
IMPORT_ALL = """
import importlib, pkgutil, sys
import sb3_abisim
before = set(sys.modules)
for room in sys.argv[1:]:
    module = importlib.import_module("sb3_abisim." + room)
    for found in pkgutil.walk_packages(getattr(module, "__path__", []), module.__name__ + "."):
        importlib.import_module(found.name)
names = {name.split(".")[1] for name in set(sys.modules) - before if name.startswith("sb3_abisim.")}
print(" ".join(names))
"""


def rooms() -> set[str]:
    return {path.stem for path in PACKAGE.iterdir() if path.suffix == ".py" or (path / "__init__.py").is_file()}


def imported(path: Path) -> set[str]:
    """Rooms that a file's import statements name, those within functions included, those for types alone left out."""
    found = set()
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            node.body.clear()
    for node in ast.walk(tree):
        names = []
        if isinstance(node, ast.ImportFrom) and node.module:
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        found |= {name.split(".")[1] for name in names if name.startswith("sb3_abisim.")}
    return found & FLOOR_OF.keys()


@functools.cache
def arrows() -> dict[str, set[str]]:
    graph: dict[str, set[str]] = {room: set() for room in FLOOR_OF}
    for path in PACKAGE.rglob("*.py"):
        room = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
        if room in FLOOR_OF:
            graph[room] |= imported(path) - {room}
    return graph


def test_every_room_has_its_floor() -> None:
    data = {"media", "hyperparams", "encoders"}
    assert rooms() - data - {"__init__"} == FLOOR_OF.keys()


@pytest.mark.parametrize("room", sorted(FLOOR_OF))
def test_no_statement_imports_from_a_higher_floor(room: str) -> None:
    higher = {other for other in arrows()[room] if FLOOR_OF[other] > FLOOR_OF[room]}
    assert not higher, f"sb3_abisim.{room} imports from {', '.join(sorted(higher))}"


def test_no_folder_is_part_of_a_circle() -> None:
    graph = arrows()
    reached = {room: set(others) for room, others in graph.items()}
    for _ in graph:
        for room in reached:
            reached[room] |= set().union(*(reached[other] for other in reached[room]))
    assert {room for room, others in reached.items() if room in others} == set()


@pytest.mark.parametrize("floor", range(len(FLOORS) - 1))
def test_a_fresh_process_loads_no_higher_floor(floor: int) -> None:
    command = [sys.executable, "-c", IMPORT_ALL, *sorted(FLOORS[floor])]
    output = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    higher = {room for room in output.split() if FLOOR_OF.get(room, 0) > floor}
    assert not higher, f"importing {', '.join(sorted(FLOORS[floor]))} loads {', '.join(sorted(higher))}"


def test_no_module_is_part_of_a_circle() -> None:
    """Within folders, too."""
    names = {
        path: ".".join(("sb3_abisim", *path.relative_to(PACKAGE).with_suffix("").parts))
        for path in PACKAGE.rglob("*.py")
    }
    modules = {name.removesuffix(".__init__"): path for path, name in names.items()}
    graph: dict[str, set[str]] = {}
    for name, path in modules.items():
        graph[name] = set()
        tree = ast.parse(path.read_text(encoding="utf-8"))
        for node in tree.body:
            if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("sb3_abisim"):
                for alias in node.names:
                    whole = f"{node.module}.{alias.name}"
                    graph[name].add(whole if whole in modules else node.module)
    # A folder's __init__ may import its modules, which may import from one another.
    reached = {name: {other for other in others if other != "sb3_abisim"} for name, others in graph.items()}
    for _ in range(len(graph)):
        before = {name: len(others) for name, others in reached.items()}
        for name in reached:
            reached[name] |= set().union(*(reached.get(other, set()) for other in reached[name]))
        if before == {name: len(others) for name, others in reached.items()}:
            break
    assert sorted(name for name, others in reached.items() if name in others) == []
