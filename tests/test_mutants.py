"""The list of mutants names code that is there; `python tests/mutants.py` applies them."""

from __future__ import annotations

import ast

import pytest

from mutants import ROOT, Mutant, find, mutated, read_list


@pytest.mark.parametrize("mutant", read_list(), ids=lambda mutant: mutant.function)
def test_every_mutant_changes_code_that_is_there(mutant):
    path, node = find(ROOT / "src", mutant)
    before = ast.dump(ast.parse(path.read_text(encoding="utf-8")))
    assert ast.dump(ast.parse(mutated(path, node, mutant.mutated))) != before


@pytest.mark.parametrize("change", [{"function": "fits"}, {"occurrence": 2}, {"original": "2"}])
def test_mutant_that_is_not_in_one_place_is_named(tmp_path, change):
    for name in ("a.py", "b.py") if "original" in change else ("a.py",):
        (tmp_path / name).write_text("def fit(x):\n    return 2 * x + (2 * x) ** 2\n")
    row = {"function": "fit", "original": "2 * x", "mutated": "x", "occurrence": 0}
    lost = Mutant(**{**row, "source": "", "equivalent": "", **change})
    with pytest.raises(LookupError, match=rf"{lost.function}: .* files, not 1"):
        find(tmp_path, lost)
