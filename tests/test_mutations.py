"""The mutants change formulas that the package contains, and name tests that exist."""

import ast

import mutations
import pytest


@pytest.mark.parametrize("mutant", mutations.MUTANTS, ids=lambda m: m.effect)
def test_a_mutant_changes_one_formula_of_the_package(mutant):
    text = mutations.mutated_text(mutant)
    before = (mutations.PACKAGE / mutant.file).read_text(encoding="utf-8")
    assert ast.dump(ast.parse(text)) != ast.dump(ast.parse(before))
    for test in (*mutant.tests, *mutations.WIDER):
        file, _, name = test.partition("::")
        path = mutations.ROOT / "tests" / file
        assert path.exists(), test
        assert not name or f"def {name.partition('[')[0]}(" in path.read_text("utf-8"), test


def test_a_formula_that_is_gone_is_an_error():
    mutant = mutations.MUTANTS[0]
    with pytest.raises(ValueError, match="0 times, expected once"):
        mutations.mutated_text(mutant._replace(old="no such formula"))
    with pytest.raises(ValueError, match="does not exist"):
        mutations.mutated_text(mutant._replace(file="_no_such_file.py"))
    found = mutations.outcome_of(mutant._replace(old="no such formula"))
    assert found.state == "not run"
