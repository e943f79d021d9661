"""The list of mutants names code that is there; `python tests/mutants.py run` applies them."""

from __future__ import annotations

import ast

import pytest

from mutants import DRAWN, ROOT, LostError, Mutant, apply, find, read_list, units_of

SOURCE = '''
class Model:
    """±"""

    def fit(self, x):
        return 2 * x + (2 * x) ** 2

    def name(self): return "λ", 2 * self.x
'''


@pytest.fixture(scope="module")
def units():
    return units_of(ROOT / "src" / "psfdae")


def test_every_mutant_changes_code_that_is_there(units):
    for mutant in read_list():
        path, node = find(units, mutant)
        before = ast.dump(ast.parse(path.read_text(encoding="utf-8")))
        assert ast.dump(ast.parse(apply(path, node, mutant.mutated))) != before, mutant


def test_list_has_sixty_drawn_mutants_besides_the_equivalent():
    drawn = [mutant for mutant in read_list() if mutant.source == "drawn"]
    assert sum(not mutant.equivalent for mutant in drawn) == DRAWN
    assert len(set(read_list())) == len(read_list())


@pytest.mark.parametrize(
    "change", [{"function": "Model.fits"}, {"occurrence": 2}, {"original": "2"}]
)
def test_mutant_that_is_nowhere_is_named(tmp_path, change):
    (tmp_path / "a.py").write_text(SOURCE, encoding="utf-8")
    row = {"function": "Model.fit", "original": "2 * x", "mutated": "x", "occurrence": 0}
    lost = Mutant(**{**row, "source": "", "equivalent": "", **change})
    if "original" in change:
        (tmp_path / "b.py").write_text(SOURCE, encoding="utf-8")
    with pytest.raises(LostError, match=rf"{lost.function}: .* is (nowhere|in 2 files)"):
        find(units_of(tmp_path), lost)
