"""Imports go one way: a module uses only modules that precede it in the table of CONTRIBUTING.md.

Further rules: tests import public names, and only one folder of tests reads compiled programs.
"""

import ast
import importlib
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

import polhode as ph

SOURCE = Path(ph.__file__).parent
CONTRIBUTING = Path(__file__).resolve().parents[1] / "CONTRIBUTING.md"
FACE = "__init__"


def house() -> list[str]:
    """Modules (folders, and files at the root of the package) in the order of the table."""
    text = CONTRIBUTING.read_text(encoding="utf-8")
    section = text.partition("## Modules")[2].partition("\n## ")[0]
    rows = re.findall(r"^\| *\d+ *\|([^|]*)\|", section, re.M)
    return [room for row in rows for room in re.findall(r"`(\w+)`", row)]


def room_of(path: Path) -> str:
    return path.relative_to(SOURCE).parts[0].removesuffix(".py")


def rooms() -> set[str]:
    return {room_of(path) for path in SOURCE.rglob("*.py")}


def imported(text: str, package: tuple[str, ...], known: set[str]) -> Iterator[str]:
    """Modules that a module of ``package`` imports anywhere in its text, in any form."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            modules = [name.name.split(".") for name in node.names]
        elif isinstance(node, ast.ImportFrom):
            above = list(package[: len(package) + 1 - node.level]) if node.level else []
            base = above + (node.module.split(".") if node.module else [])
            # every module may import the version, which the package defines first
            modules = [[*base, name.name] for name in node.names if name.name != "__version__"]
        else:
            continue
        for module in modules:
            if module[0] == "polhode":
                yield module[1] if len(module) > 1 and module[1] in known else FACE


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("import polhode.tops", ["tops"]),
        ("import numpy, polhode.tops._cubic as c", ["tops"]),
        ("from polhode.tops import x", ["tops"]),
        ("from polhode.tops._cubic import x, y", ["tops", "tops"]),
        ("from polhode import tops, Scene", ["tops", FACE]),
        ("from polhode import *", [FACE]),
        ("import polhode", [FACE]),
        ("import polhode as ph", [FACE]),
        ("from ._motion import x", ["free"]),
        ("from . import _motion", ["free"]),
        ("from .. import tops", ["tops"]),
        ("from ..tops._cubic import x", ["tops"]),
        ("def f():\n    if True:\n        from polhode import tops", ["tops"]),
        ("from polhode import __version__", []),
        ("import polhodes, jax\nfrom numpy import tops", []),
    ],
)
def test_every_form_of_import_is_seen(text, found):
    assert list(imported(text, ("polhode", "free"), {"free", "tops"})) == found


def test_every_room_stands_in_the_table_once():
    listed = house()
    assert len(set(listed)) == len(listed), "a room stands twice in CONTRIBUTING.md"
    assert set(listed) == rooms(), "the table in CONTRIBUTING.md is not the rooms of src/polhode"


def test_imports_go_one_way():
    place = {room: i for i, room in enumerate(house())}
    known, wrong, seen = rooms(), [], 0
    for path in SOURCE.rglob("*.py"):
        room = room_of(path)
        package = ("polhode", *path.relative_to(SOURCE).parts[:-1])
        for used in imported(path.read_text(encoding="utf-8"), package, known):
            seen += 1
            if used != room and place[used] >= place[room]:
                wrong.append(f"{path.relative_to(SOURCE)} imports {used}")
    assert seen > 100
    assert not wrong, wrong


TESTS = Path(__file__).parent
PROGRAM_TEXT = {"as_text", "cost_analysis", "memory_analysis", "primitive", "eqns"}
"""Attributes by which the programs of XLA and JAX are read."""


def parsed_tests() -> list[tuple[Path, ast.Module]]:
    paths = sorted(TESTS.rglob("*.py"))
    return [(path.relative_to(TESTS), ast.parse(path.read_text("utf-8"))) for path in paths]


def test_tests_import_public_names_from_where_they_are_public():
    """Private names are imported only to test a formula or a kernel on its own."""
    wrong, seen = [], 0
    for path, tree in parsed_tests():
        for node in ast.walk(tree):
            if not (isinstance(node, ast.ImportFrom) and str(node.module).startswith("polhode._")):
                continue
            module = importlib.import_module(str(node.module))
            for name in (alias.name for alias in node.names):
                seen += 1
                same = name in dir(ph) and getattr(ph, name) is getattr(module, name, None)
                wrong += [f"{path}: {node.module}.{name}"] if same else []
    assert seen > 30
    assert not wrong, wrong


def test_programs_are_read_in_one_folder():
    """The contents of compiled programs are tested in ``tests/xla``; other folders test results."""
    readers = {
        path.as_posix()
        for path, tree in parsed_tests()
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute) and node.attr in PROGRAM_TEXT
    }
    assert len(readers) > 4
    outside = {path for path in readers if not path.startswith("xla/")}
    assert outside == {"ensemble/eight_devices.py"}  # collectives between devices


def test_the_formatter_sees_all_code():
    folders = (SOURCE, CONTRIBUTING.parent / "tests", CONTRIBUTING.parent / "benchmarks")
    files = [path for folder in folders for path in folder.rglob("*.py")]
    assert len(files) > 300
    is_left_out = re.compile(r"# fmt" + ": (skip|off)").search
    assert not [path.name for path in files if is_left_out(path.read_text(encoding="utf-8"))]


FOREIGN = {
    "jaxpr",
    "eqns",
    "dtype",
    "shape",
    "sharding",
    "is_fully_addressable",
    "term_structure",
    "faces",
    "as_quat",
    "_fields",
    "energy",
    "__module__",
    "O_DIRECTORY",
}
"""Attributes of objects of JAX, NumPy, SciPy, diffrax, trimesh, os and of the user."""

APPLICATIONS = ("cli", "ensemble", "files", "fit", "frames", "lightcurve", "plot")


def absences(text: str) -> list[str]:
    """Attributes of the package's own objects whose absence has a meaning."""
    calls = [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Call)]
    calls = [call for call in calls if isinstance(call.func, ast.Name)]
    names = [
        call.args[1].value
        for call in calls
        if (call.func.id == "getattr" and len(call.args) == 3) or call.func.id == "hasattr"
        if isinstance(call.args[1], ast.Constant)
    ]
    return [name for name in names if name not in FOREIGN]


def test_protocols_are_classes():
    """A class declares what an object can do; no attribute is optional."""
    assert absences("getattr(solver, 'spanning', None)") == ["spanning"]
    found = {
        str(path.relative_to(SOURCE)): names
        for path in SOURCE.rglob("*.py")
        if room_of(path) not in APPLICATIONS
        and (names := absences(path.read_text(encoding="utf-8")))
    }
    assert not found
