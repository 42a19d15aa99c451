"""The map of equations names what exists, and notebooks do not drift from their text forms."""

import ast
import importlib
import re
from functools import cache
from pathlib import Path

import jupytext
import pytest

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOKS = ROOT / "notebooks"
PAIRS = sorted({path.stem for path in NOTEBOOKS.glob("*.*") if path.suffix in (".py", ".ipynb")})
NUMBERED = {"000": 39, "002": 12, "003": 29}
LIMIT = 600_000  # bytes of an executed notebook


def rows() -> list[tuple[str, list[str]]]:
    """(document, cells) of every row of the tables."""
    found, document = [], None
    for line in (ROOT / "docs" / "equations.md").read_text(encoding="utf-8").splitlines():
        heading = re.match(r"## Document (\d+)", line)
        if heading:
            document = heading[1]
        if document and line.startswith("|") and not re.match(r"\|(---| equation )", line):
            cells = [cell.strip() for cell in line.strip("|").split("|")]
            assert len(cells) == 5, line
            found.append((document, cells))
    return found


def equations(cell: str) -> list[str]:
    """The numbers of a cell such as "8, 9", "18-21" or "x"."""
    numbers = []
    for part in cell.split(","):
        first, _, last = part.strip().partition("-")
        if last:
            numbers += [str(n) for n in range(int(first), int(last) + 1)]
        else:
            numbers.append(first)
    return numbers


def names(cell: str) -> list[str]:
    return re.findall(r"`([^`]+)`", cell)


def resolve(dotted: str) -> object:
    """Import the longest prefix that is a module, then take attributes."""
    parts = dotted.split(".")
    for size in range(len(parts), 0, -1):
        try:
            found = importlib.import_module(".".join(parts[:size]))
        except ModuleNotFoundError:
            continue
        for part in parts[size:]:
            found = getattr(found, part)
        return found
    raise ModuleNotFoundError(dotted)


@cache
def functions_of(path: Path) -> set[str]:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    return {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}


@pytest.mark.parametrize("document", NUMBERED)
def test_every_equation_is_on_the_map_once(document):
    listed = [n for where, cells in rows() if where == document for n in equations(cells[0])]
    wanted = [str(n) for n in range(1, NUMBERED[document] + 1)]
    assert sorted(listed) == sorted(wanted + ["x"] * (document == "000"))


def test_functions_on_the_map_exist():
    for _, cells in rows():
        assert names(cells[2]), cells
        for name in names(cells[2]):
            assert callable(resolve(name)), name


def test_tests_on_the_map_exist():
    for _, cells in rows():
        assert names(cells[3]), cells
        for name in names(cells[3]):
            path, _, function = name.partition("::")
            assert function.startswith("test_"), name
            assert function in functions_of(ROOT / path), name


@pytest.mark.parametrize("name", PAIRS)
def test_a_notebook_is_its_text_form_executed(name):
    text = jupytext.read(NOTEBOOKS / f"{name}.py")
    path = NOTEBOOKS / f"{name}.ipynb"
    assert path.exists(), f"execute it: cd notebooks && jupytext --to ipynb --execute {name}.py"
    executed = jupytext.read(path)
    kept = [[(cell.cell_type, cell.source) for cell in book.cells] for book in (text, executed)]
    assert kept[0] == kept[1], f"{name}.ipynb is not {name}.py executed: run it again"
    code = [cell for cell in executed.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1))
    outputs = [output for cell in code for output in cell.outputs]
    assert all(output.output_type != "error" for output in outputs)
    written = [output.text for output in outputs if output.output_type == "stream"]
    machine = re.compile(r"(?<![\w.])/(home|root|tmp|opt|usr|work|Users)/|site-packages|C:\\\\")
    assert not [text for text in written if machine.search(text)]
    assert path.stat().st_size < LIMIT
