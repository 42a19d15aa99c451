"""Documentation agrees with the code: examples run, cited names and equations exist, and the
reference lists every public name.
"""

import ast
import enum
import importlib
import inspect
import re
import subprocess
import sys
import zlib
from functools import cache
from pathlib import Path

import pytest

import polhode as ph

ROOT = Path(__file__).resolve().parents[1]
sys.path.append(str(ROOT / "docs" / "_ext"))

import page_outputs
import stored_outputs
from polhode_docs import public_names, reference_pages, signatures

NUMBERED = {"000": 39, "002": 12, "003": 29}
PAGES = page_outputs.pages()
SKETCHES = {
    "identifiability": 2,
    "scale": 1,
    "how-to/use_tables": 2,
    "how-to/import_mass_properties": 1,
}  # `py` blocks, which need other packages and are not run
WIDTH = 100  # columns of a code block


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


EXECUTED = [path for path in PAGES if page_outputs.blocks(path.read_text("utf-8"))]
HOW_TO = [path for path in EXECUTED if path.parent.name == "how-to"]
AGAIN = "run: python tests/page_outputs.py"


def test_examples_are_marked_so_that_they_are_run():
    for path in PAGES:
        text = path.read_text(encoding="utf-8")
        marks = re.findall(r"^```(?!sh|toml|text|output|\{)(.+)$", text, re.M)  # {include}
        others = [mark for mark in marks if mark.strip() != "python"]
        assert len(others) == SKETCHES.get(page_outputs.name_of(path), 0), (path.name, others)


@pytest.mark.parametrize("path", PAGES, ids=page_outputs.name_of)
def test_examples_fit_into_the_box(path):
    boxes = re.findall(r"^```python\n(.*?)^```", path.read_text(encoding="utf-8"), re.S | re.M)
    assert not [line for box in boxes for line in box.split("\n") if len(line) > WIDTH]


@pytest.mark.parametrize("path", EXECUTED, ids=page_outputs.name_of)
def test_examples_show_what_they_print_and_draw(path):
    text = path.read_text(encoding="utf-8")
    for code, output in page_outputs.blocks(text):
        assert bool(output) == ("print(" in code), f"{AGAIN} {path.name}: {code}"
    drawn = set(re.findall(r'"([\w.-]+\.(?:png|svg))"', text))
    assert set(page_outputs.figures(text)) == drawn
    assert all((page_outputs.FIGURES / name).exists() for name in drawn), AGAIN


@pytest.mark.parametrize("path", HOW_TO, ids=page_outputs.name_of)
def test_a_how_to_asks_a_question_and_answers_it_with_output_and_figure(path):
    text = path.read_text(encoding="utf-8")
    assert re.match(r"# .*\?\n", text)
    assert any(output for _, output in page_outputs.blocks(text))
    assert page_outputs.figures(text)


def test_every_figure_is_shown():
    shown = {name for path in PAGES for name in page_outputs.figures(path.read_text("utf-8"))}
    assert {path.name for path in page_outputs.FIGURES.iterdir()} == shown


@pytest.mark.slow
@pytest.mark.parametrize("path", EXECUTED, ids=page_outputs.name_of)
def test_examples_print_what_the_page_shows(path, tmp_path):
    text = path.read_text(encoding="utf-8")
    printed = page_outputs.executed(text, tmp_path)
    for (code, stored), new in zip(page_outputs.blocks(text), printed, strict=True):
        found = stored_outputs.difference(stored, new)
        assert found is None, f"{found} in\n{code}{AGAIN} {path.name}"
    for name in page_outputs.figures(text):
        assert (tmp_path / name).stat().st_size > 5000


NAMES = public_names.public_names()


def public_callables(kind: type | tuple[type, ...]) -> list:
    """Public classes or functions, each once."""
    return list({id(x): x for x in map(resolve, NAMES) if isinstance(x, kind)}.values())


def test_the_stub_lists_what_the_package_exports():
    assert len(NAMES) > 50
    assert len(NAMES) == len(set(NAMES))
    top = {name for name in NAMES if name.count(".") == 1}
    assert top == {f"polhode.{name}" for name in ph.__all__}
    for name in NAMES:
        resolve(name)
    for namespace in public_names.namespaces():
        assert public_names.names_in(namespace), namespace


def test_every_public_name_has_a_docstring():
    bare = sorted(name for name in NAMES if not (resolve(name).__doc__ or "").strip())
    assert not bare


def directives(text: str, page: str) -> list[str]:
    """The full names that a page of the reference documents."""
    module = page
    found = []
    for directive, name in re.findall(r"^\.\. (py:\w+|auto\w+):: (\S+)$", text, re.M):
        if directive == "py:currentmodule":
            module = name
        elif directive == "py:module":
            module = name
            found.append(name)
        else:
            found.append(name if name.startswith(f"{module}.") else f"{module}.{name}")
    return found


def test_the_reference_documents_every_public_name_once():
    pages = reference_pages.pages()
    found = [name for page, text in pages.items() for name in directives(text, page)]
    assert sorted(found) == sorted(NAMES)
    listed = re.findall(r":py:obj:`\w+ <([\w.]+)>`", pages["index.rst"])
    assert sorted(listed) == sorted(set(NAMES) - {n for n in NAMES if inspect.ismodule(resolve(n))})


def test_the_reference_leaves_out_what_only_polhode_uses():
    pages = "\n".join(reference_pages.pages().values())
    entries = dict(
        re.findall(
            r"^\.\. autoclass:: polhode\.(\w+)\n(?:   .*\n)*?   :exclude-members: (.*)$",
            pages,
            re.M,
        )
    )
    hidden = entries["Scene"].split(", ")
    assert {"settled", "dynamics"} & set(vars(ph.Scene)) <= set(hidden)
    assert not {"is_free", "momentum", "rates", "hamiltonian"} & set(hidden)
    assert "body_components" in entries["LinearDamping"]
    assert "body_components" not in entries.get("AbstractTorque", "")
    for name in ("Trajectory", "State", "Inertia"):
        shown = set(entries.get(name, "").split(", "))
        assert not shown & {"at", "energy", "euler", "from_euler", "from_moments", "tensor"}


def test_the_groups_of_the_reference_hold_public_names_alone():
    grouped = [name for _, _, row in public_names.grouped().values() for name in row]
    assert grouped == public_names.names_in()
    assert len(public_names.grouped()) > 5


def parameters(signature: str) -> list[str]:
    arguments = ast.parse(f"def f{signature}: pass").body[0].args
    each = [*arguments.posonlyargs, *arguments.args, arguments.vararg, *arguments.kwonlyargs]
    return [argument.arg for argument in [*each, arguments.kwarg] if argument is not None]


@pytest.mark.parametrize(
    "thing",
    [x for x in public_callables(type) if not issubclass(x, enum.Enum | Exception)],
    ids=lambda x: x.__name__,
)
def test_classes_show_the_arguments_of_their_constructor(thing):
    if getattr(thing, "__parameters__", ()) or not inspect.isclass(thing):
        pytest.skip("a type alias")
    if hasattr(thing, "model_fields"):
        pytest.skip("pydantic changes its signature when it is first used")
    assert parameters(signatures.of_class(thing)) == list(inspect.signature(thing).parameters)


def test_functions_show_their_arguments():
    functions = [x for x in public_callables(object) if inspect.isfunction(x)]
    assert len(functions) > 50
    for function in functions:
        shown, _ = signatures.of_function(function)
        assert parameters(shown) == list(inspect.signature(function).parameters), function


def test_signatures_are_those_of_the_source():
    shown, returned = signatures.of_function(ph.simulate)
    assert "ts: Float[ArrayLike, '*#b t']" in shown
    assert "method: AbstractMethod | None=None" in shown
    assert returned == "Trajectory"
    assert signatures.of_class(ph.Crossings).startswith("(times: Float[Array, '*b m'], ")
    assert signatures.of_property(ph.Trajectory.energy) == "Float[Array, '*b t']"
    assert signatures.of_class(ph.Status) is None


def test_docstrings_become_markup():
    text = "Of |L| and ``|L|``: 2 * 3, **bold**, see docs/a/b.md.\n\n    x = 2 * y\n\n- one\n"
    made = reference_pages.markup(text)
    assert made == (
        "Of \\|L\\| and ``|L|``: 2 \\* 3, **bold**, see :doc:`docs/a/b.md </a/b>`.\n\n"
        ".. code-block:: python\n\n    x = 2 * y\n\n- one\n"
    )


def test_formulas_become_mathml():
    pytest.importorskip("latex2mathml", reason="the group docs is not installed")
    pytest.importorskip("sphinx", reason="the group docs is not installed")
    mathml = importlib.import_module("polhode_docs.mathml")
    assert mathml.TAG.search("a = b. \\tag{12}")[1] == "12"
    assert mathml.TAG.search("a = b") is None
    formula = mathml.mathml(r"\sin v / |L| = -1", "block")
    assert formula.startswith("<math xmlns")
    assert '<mi>sin</mi><mspace width="0.167em" /><mi>v</mi>' in formula
    assert '<mo lspace="0" rspace="0">/</mo>' in formula
    assert '<mo form="prefix">&#x02212;</mo>' in formula


def test_the_source_cites_what_a_reader_can_open():
    """Cited pages exist, and no notes are cited that are not part of the repository."""
    for path in sorted((ROOT / "src" / "polhode").rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        assert not re.search(r"\b(theory|errata|display)s? (section |sections )?\d", text), path
        for page in re.findall(r"\bdocs/([\w/-]+\.md)\b", text):
            assert (ROOT / "docs" / page).exists(), (path, page)


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    """The built site; a warning, such as one of a broken link, fails the build."""
    for module in ("sphinx", "furo", "myst_nb", "latex2mathml"):
        pytest.importorskip(module, reason="the group docs is not installed")
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "docs"]
    command += ["-d", folder / "doctrees", folder / "site"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    return folder / "site"


@pytest.mark.slow
def test_the_inventory_lists_every_public_name(site):
    packed = (site / "objects.inv").read_bytes().split(b"\n", 4)[4]
    rows = [line.split(" ") for line in zlib.decompress(packed).decode().splitlines()]
    listed = {row[0] for row in rows if row[1].startswith("py:")}
    assert sorted(set(NAMES) - listed) == []
    public = {name for name in listed if not re.search(r"\._|^_", name)}
    members = {name for name in public if name.rpartition(".")[0] in NAMES}
    assert sorted(public - members - set(NAMES) - {"polhode"}) == []
    assert {"polhode.Trajectory.energy", "polhode.Inertia.from_moments"} <= members


@pytest.mark.slow
def test_a_class_shows_its_constructor_and_links_its_types(site):
    page = (site / "reference" / "simulation.html").read_text(encoding="utf-8")
    entry = page[page.index('id="polhode.Scene"') :]
    entry = entry[: entry.index("</dt>")]
    assert re.findall(r'class="n"><span class="pre">(\w+)<', entry)[:4] == [
        "inertia",
        "potential",
        "torque",
        "rotors",
    ]
    assert 'href="bodies.html#polhode.Inertia"' in entry
    assert "jaxlib" not in page


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
    styles = "".join(path.read_text(encoding="utf-8") for path in site.rglob("*.css"))
    assert not re.findall(r"(?:url\(|@import )[\"']?https?:[^)\"']*", styles)
    assert '<script src="searchindex.js"' in (site / "search.html").read_text(encoding="utf-8")
    assert "crossings" in (site / "searchindex.js").read_text(encoding="utf-8")
    assert (site / "motion" / "t_handle.html").stat().st_size > 500_000


@pytest.mark.slow
def test_pages_hold_formulas_figures_and_stored_outputs(site):
    formulas = (site / "free_motion.html").read_text(encoding="utf-8")
    assert len(re.findall(r'class="eqno" id="equation-\d+"', formulas)) == 16
    assert "<math xmlns" in formulas
    assert "\\frac" not in re.sub(r"<[^>]+>", "", formulas)
    assert ".svg" in (site / "benchmarks.html").read_text(encoding="utf-8")
    for name in [path.stem for path in (ROOT / "notebooks").glob("*.py")]:
        page = (site / "notebooks" / f"{name}.html").read_text(encoding="utf-8")
        assert "cell_output" in page, name
    answers = (site / "faq.html").read_text(encoding="utf-8")
    assert answers.count("<dd>") > 10


def test_the_meaning_of_rtol_stands_in_one_place_that_all_cite():
    page = (ROOT / "docs" / "methods.md").read_text(encoding="utf-8")
    assert page.count("## What `rtol` means") == 1
    assert "What `rtol` means" in ph.simulate.__doc__
    scene = ph.Scene(ph.Inertia.from_moments([1, 2, 2.5]), torque=ph.LinearDamping([1, 2, 3]))
    plan = ph.explain(scene, ph.State([1, 0, 0, 0], [0.1, 1.0, 0.1]), [0.0, 1.0])
    assert "docs/methods.md: What rtol means" in str(plan)
    for name in ("tutorial/first_torque", "glossary", "sharp_bits", "comparison", "scene_files"):
        text = (ROOT / "docs" / f"{name}.md").read_text(encoding="utf-8")
        assert "methods.md#what-rtol-means" in text, name
