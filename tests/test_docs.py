"""Documents say what is: examples run, names and equations exist, the site holds every name.

Notebooks do not drift from their text forms.
"""

import ast
import importlib
import re
import subprocess
import sys
import zlib
from functools import cache
from pathlib import Path

import jupytext
import pytest

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOKS = ROOT / "notebooks"
PAIRS = sorted({path.stem for path in NOTEBOOKS.glob("*.*") if path.suffix in (".py", ".ipynb")})
NUMBERED = {"000": 39, "002": 12, "003": 29}
LIMIT = 600_000  # bytes of an executed notebook
PAGES = sorted([ROOT / "README.md", *(ROOT / "docs").glob("*.md")])
SKETCHES = {"identifiability.md": 2, "light_curves.md": 1}  # need what polhode does not bring
BADGE = re.compile(
    r"\[!\[Open in Colab\]\(https://colab\.research\.google\.com/assets/colab-badge\.svg\)\]"
    r"\(https://colab\.research\.google\.com/github/([\w-]+/[\w-]+)/blob/main/notebooks/(\w+)\.ipynb\)"
)


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


def test_every_notebook_opens_in_colab():
    found = {}
    for name in PAIRS:
        first = next(c for c in jupytext.read(NOTEBOOKS / f"{name}.py").cells)
        assert first.cell_type == "markdown"
        badge = BADGE.search(first.source)
        assert badge, f"{name}: the first cell has no badge"
        assert badge[2] == name
        found[name] = badge[1]
    assert len(set(found.values())) == 1, "badges name different repositories"


def examples(path: Path) -> str:
    """The Python examples of a page, one after another."""
    return "\n".join(re.findall(r"^```python\n(.*?)^```", path.read_text("utf-8"), re.S | re.M))


def test_examples_are_marked_so_that_they_are_run():
    for path in PAGES:
        text = path.read_text(encoding="utf-8")
        marks = re.findall(r"^```(?!sh|toml|text)(.+)$", text, re.M)
        others = [mark for mark in marks if mark.strip() != "python"]
        assert len(others) == SKETCHES.get(path.name, 0), (path.name, others)


@pytest.mark.slow
@pytest.mark.parametrize("path", [p for p in PAGES if examples(p)], ids=lambda p: p.stem)
def test_examples_run(path, tmp_path):
    script = tmp_path / "example.py"
    script.write_text(examples(path), encoding="utf-8")
    # in a process of its own: an example chooses its precision before the first array
    done = subprocess.run([sys.executable, script], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]


def public_names() -> set[str]:
    """What the packages' ``__init__.py`` files export (``from a import b as b``), dotted."""
    package = ROOT / "src" / "polhode"
    found = set()
    for path in [package / "__init__.py", *package.glob("[a-z]*/__init__.py")]:
        module = ".".join(("polhode", *path.parent.relative_to(package).parts))
        if module in ("polhode.cli", "polhode._parts"):  # a command; what the parts are made of
            continue
        holder = importlib.import_module(module)
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            for alias in node.names if isinstance(node, ast.ImportFrom) else ():
                if alias.asname == alias.name and not alias.name.startswith("_"):
                    found.add(f"{module}.{alias.name}")
        found -= {name for name in found if isinstance(resolve(name), type(holder))}
    return found


def test_every_public_name_has_a_docstring():
    bare = sorted(name for name in public_names() if not (resolve(name).__doc__ or "").strip())
    assert not bare


def test_the_source_cites_what_a_reader_can_open():
    """Pages of the documentation that are there; no notes that only their authors have."""
    for path in sorted((ROOT / "src" / "polhode").rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        assert not re.search(r"\b(theory|errata|display)s? (section |sections )?\d", text), path
        for page in re.findall(r"\bdocs/(\w+\.md)\b", text):
            assert (ROOT / "docs" / page).exists(), (path, page)


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    """The built site; the build itself fails at a broken link."""
    pytest.importorskip("mkdocstrings", reason="the group docs is not installed")
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--site-dir", folder]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    return folder


@pytest.mark.slow
def test_the_reference_holds_every_public_name(site):
    packed = (site / "objects.inv").read_bytes().split(b"\n", 4)[4]
    listed = {line.split(" ", 1)[0] for line in zlib.decompress(packed).decode().splitlines()}
    missing = sorted(name for name in public_names() if name not in listed)
    assert not missing
    assert "polhode.no_such_name" not in listed


@pytest.mark.slow
def test_the_site_needs_no_network(site):
    fetched = re.compile(
        r"<(?:script|img|iframe|source)[^>]*\bsrc=\"(https?:[^\"]+)"
        r"|<link[^>]*rel=\"(?:stylesheet|preconnect|icon)\"[^>]*href=\"(https?:[^\"]+)"
    )
    pages = sorted(site.rglob("*.html"))
    assert len(pages) > 30
    asked = {
        address
        for page in pages
        for found in fetched.findall(page.read_text(encoding="utf-8"))
        for address in found
        if address
    }
    assert not asked
    assert "<math xmlns" in (site / "equations.html").read_text(encoding="utf-8")
    assert "arithmatex" not in (site / "equations.html").read_text(encoding="utf-8")
    assert (site / "motion" / "t_handle.html").stat().st_size > 500_000
