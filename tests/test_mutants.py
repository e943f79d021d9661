"""The list of mutants names code that is there; `python tests/mutants.py` applies them."""

from __future__ import annotations

import ast

import pytest

from mutants import ROOT, Mutant, find, mutated, read_list


def test_every_mutant_changes_code_that_is_there():
    for mutant in read_list():
        ast.parse(mutated(*find(ROOT / "src", mutant), mutant.mutated))
        before, after = (ast.dump(ast.parse(m)) for m in (mutant.original, mutant.mutated))
        assert before != after, mutant


def test_mutant_that_is_in_two_files_is_named(tmp_path):
    for name in ("a.py", "b.py"):
        (tmp_path / name).write_text("def fit(x):\n    return 2 * x\n")
    with pytest.raises(LookupError, match=r"fit: .* 2 files"):
        find(tmp_path, Mutant("fit", "2 * x", "x", 0, "", ""))
