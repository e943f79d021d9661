"""The list of mutants names code that is there; `python tests/mutants.py` applies them."""

from __future__ import annotations

import ast

from mutants import ROOT, find, mutated, read_list


def test_every_mutant_changes_code_that_is_there():
    for mutant in read_list():
        ast.parse(mutated(*find(ROOT / "src", mutant), mutant.mutated))
        original_tree, mutated_tree = (
            ast.dump(ast.parse(m)) for m in (mutant.original, mutant.mutated)
        )
        assert original_tree != mutated_tree, mutant
