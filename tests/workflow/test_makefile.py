"""The Makefile: short, and safe with a text that comes from a colleague's file."""

from __future__ import annotations

import re

import pytest

from docs_pages import ROOT, read
from workflow_runs import captured

GIVEN = re.search(r"^GIVEN := (.*)", read("Makefile"), re.M)[1].split()


def test_it_is_short_and_its_head_lists_what_a_user_may_give():
    head, _, body = read("Makefile").partition("\nGIVEN")
    assert len(body.splitlines()) + len(head.splitlines()) <= 120
    assert {*re.findall(r"\b([A-Z_]{3,})=", head)} == {*GIVEN}


@pytest.mark.parametrize("name", GIVEN)
def test_no_recipe_contains_what_a_user_gives(name, tmp_path):
    """Recipes read it from the environment: neither make nor a shell can run what is in it."""
    text = f"$(shell touch {tmp_path}/make)$$(touch {tmp_path}/shell)"
    run = captured(
        ["make", "--dry-run", "reproduce", "night", "nightly", f"{name}={text}"], cwd=ROOT
    )
    assert run.returncode == 0 and "locked.sh" in run.stdout, run.stderr
    assert "touch" not in run.stdout.replace("touch .venv/.complete", "").replace("touch $@", "")
    assert not list(tmp_path.iterdir())
