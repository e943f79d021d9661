"""The list of mutants names code that is there; `python tests/mutants.py run` applies them."""

from __future__ import annotations

import ast

import pytest

import mutants
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


def test_only_mutants_that_tell_their_place_are_drawn(tmp_path, monkeypatch):
    """Two files may have one name with one fragment, and a fragment may be assigned to."""
    package = tmp_path / "src" / "psfdae"
    package.mkdir(parents=True)
    shared = "STEP = 0.4\ndef put(x, a):\n    x[1] = 2 * a\n"
    (package / "a.py").write_text(f"{shared}def g(x):\n    return x * 3 + 5\n", encoding="utf-8")
    (package / "b.py").write_text("STEP = 0.4\n", encoding="utf-8")
    few = {"ROOT": tmp_path, "SCIENCE": ["a.py", "b.py"], "LATEST": ["a.py"], "DRAWN": 8}
    for name, value in few.items():
        monkeypatch.setattr(mutants, name, value)
    drawn = mutants.draw([])
    assert len(drawn) == 8
    assert {mutant.function for mutant in drawn} == {"put", "g"}
    assert not any(mutant.original == "x[1]" for mutant in drawn)
