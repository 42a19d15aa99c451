"""Public names and docstrings use the terms of docs/glossary.md, not retired words."""

import re
from pathlib import Path

import vocabulary

WORDS, BARE = vocabulary.violations()
ALLOWED = {
    "polhode.Crossings: slope",
    "polhode.Inertia.turned: turned",
    "polhode.MassProperties.moved: moved",
    "polhode.files.SceneFileError: given",
    "polhode.rotation.multiply: left",
}
"""Names that are still bare. The list only becomes shorter."""


def test_docstrings_hold_no_retired_words():
    assert not WORDS


def test_no_further_name_is_bare():
    assert ALLOWED >= BARE


def test_retired_words_are_found_outside_of_code():
    text = "Tells the slope of ``told`` motion.\n\n    asked = mended(told)\n\nIt marched."
    assert vocabulary.retired_words(text) == ["tells", "slope", "marched"]
    assert vocabulary.retired_words("A steadying, unmarched total slopes-free") == ["slopes"]


def test_every_public_class_is_read():
    names = [name for name, _ in vocabulary.described()]
    assert {"polhode.simulate", "polhode.Trajectory.energy", "polhode.rotation"} <= set(names)
    assert len(names) > 250


def test_the_glossary_has_a_row_for_each_term_once():
    page = (Path(__file__).parents[1] / "docs" / "glossary.md").read_text(encoding="utf-8")
    terms = re.findall(r"^\| ([^|]+?) \|", page, re.MULTILINE)
    terms = [term for term in terms if term not in ("term", "---")]
    assert len(terms) == len(set(terms)) > 50
