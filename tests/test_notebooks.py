"""The stored outputs of the notebooks are those of this code; notebooks run without the repository.

``tests/stored_outputs.py`` executes the notebooks.
"""

import re

import jupytext
import nbformat
import pytest
import stored_outputs as outputs

FOLDER = outputs.FOLDER
NAMES = sorted({path.stem for path in FOLDER.glob("*.*") if path.suffix in (".py", ".ipynb")})
LIMIT = 600_000  # bytes of an executed notebook
BADGE = re.compile(
    r"\[!\[Open in Colab\]\(https://colab\.research\.google\.com/assets/colab-badge\.svg\)\]"
    r"\(https://colab\.research\.google\.com/github/([\w-]+/[\w-]+)/blob/main/notebooks/(\w+)\.ipynb\)"
)
AGAIN = "execute the notebook again: python tests/stored_outputs.py"


def stored(name: str) -> nbformat.NotebookNode:
    path = FOLDER / f"{name}.ipynb"
    assert path.exists(), f"{AGAIN} {name}"
    return nbformat.read(path, as_version=4)


@pytest.mark.parametrize("name", NAMES)
def test_a_notebook_is_its_text_form_executed_with_this_interface(name):
    text, executed = jupytext.read(FOLDER / f"{name}.py"), stored(name)
    kept = [[(cell.cell_type, cell.source) for cell in book.cells] for book in (text, executed)]
    assert kept[0] == kept[1], f"{name}.ipynb is not {name}.py executed: {AGAIN} {name}"
    assert executed.metadata.get("polhode") == outputs.stamp(name), (
        f"names that {name} uses changed since it was executed: {AGAIN} {name}"
    )
    code = [cell for cell in executed.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1))
    each = [output for cell in code for output in cell.outputs]
    assert all(output.output_type != "error" for output in each)
    streams = [output for output in each if output.output_type == "stream"]
    assert all(output.name == "stdout" for output in streams)
    machine = re.compile(r"(?<![\w.])/(home|root|tmp|opt|usr|work|Users)/|site-packages|C:\\\\")
    assert not [output.text for output in streams if machine.search(output.text)]
    assert (FOLDER / f"{name}.ipynb").stat().st_size < LIMIT


SECONDS = {"quick_start"}  # executed among the fast tests


@pytest.mark.parametrize(
    "name", [n if n in SECONDS else pytest.param(n, marks=pytest.mark.slow) for n in NAMES]
)
def test_stored_outputs_are_those_of_this_code(name):
    old, new = outputs.texts(stored(name)), outputs.texts(outputs.executed(name))
    assert [row[0] for row in old] == [row[0] for row in new], f"other outputs: {AGAIN} {name}"
    for (number, before, timed), (_, after, _) in zip(old, new, strict=True):
        found = outputs.difference(before, after, timed=timed)
        assert found is None, f"cell {number}: {found}; {AGAIN} {name}"


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("k = 1.2345678901", "k = 1.2345679901"),  # 1e-7 of its size
        ("[ 1.234 -0.5]", "[1.235 -0.5]"),  # one unit of the last digit, other padding
        ("drift 3e-09", "drift 8e-09"),
        ("drift 2.66453e-15", "drift 0.0"),
        ("drift 3.4e-14", "drift 7e-16"),
    ],
)
def test_last_digits_may_differ(old, new):
    assert outputs.difference(old, new) is None


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("cost about 61 us", "error about 61 us"),
        ("12 of 12", "11 of 12"),
        ("k = 1.234567890", "k = 1.234571890"),
        ("k = 1.23", "k = 1.25"),
        ("drift 3e-09", "drift 5e-08"),
        ("drift 3e-15", "drift 2e-09"),
        ("drift 3e-15", "drift nan"),
        ("yes 1", "yes 1 2"),
        ("k = 1.5", "k = -1.5"),
    ],
)
def test_other_outputs_are_found(old, new):
    assert outputs.difference(old, new) is not None


def test_numbers_of_timings_are_not_compared():
    assert outputs.difference("0.14 us", "0.3 us", timed=True) is None
    assert outputs.difference("0.14 us", "0.3 s", timed=True) is not None


def test_the_stamp_follows_the_names_that_a_notebook_uses():
    found = outputs.interface({"ph", "simulate", "Inertia", "from_moments", "rtol"})
    assert "rtol=" in found["polhode.simulate"]
    assert "polhode.Inertia.from_moments" in found
    assert "polhode.Inertia.from_box" not in found
    assert "polhode.Scene" not in found


def test_every_notebook_opens_in_colab_and_says_how_to_install():
    repositories = set()
    for name in NAMES:
        first, second = jupytext.read(FOLDER / f"{name}.py").cells[:2]
        assert first.cell_type == "markdown"
        badge = BADGE.search(first.source)
        assert badge, f"{name}: the first cell has no badge"
        assert badge[2] == name
        repositories.add(badge[1])
        lines = second.source.split("\n")
        assert second.cell_type == "code"
        assert all(line.startswith("#") for line in lines)
        installs = [line for line in lines if line.startswith("# %pip install")]
        assert ["..[all]" in installs[0], ".tar.gz[all]" in installs[1]] == [True, True], name
    assert len(repositories) == 1, "badges name different repositories"


@pytest.mark.parametrize("name", NAMES)
def test_a_notebook_needs_no_file_of_the_repository(name):
    """Nor private modules: it runs wherever polhode is installed."""
    code = [c.source for c in jupytext.read(FOLDER / f"{name}.py").cells if c.cell_type == "code"]
    text = "\n".join(code[1:])
    assert not re.search(r"\.\./|sys\.path|\bbenchmarks\b|polhode\._|import _|\bscenes/", text)
