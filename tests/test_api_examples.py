"""Every public name: its example is run, and the reference has it."""

from __future__ import annotations

import doctest
import re
import time
from types import ModuleType

import pytest

import psfdae
from docs_pages import blocks, read
from psfdae.model import packing

NAMES = [name for name in psfdae.__all__ if name != "__version__"]
LONGEST_S = 3.0
"""Of CPU time; an example is for trying it out."""

REFERENCE = "docs/api.md"


@pytest.fixture(scope="module")
def lines(tmp_path_factory):
    """What the lines at the head of the page leave, in a folder of their own."""
    folder = tmp_path_factory.mktemp("examples")
    (body,) = blocks(read(REFERENCE), "python")
    names = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        # Errors of models are measured on few noisy images.
        for name, value in (("NODES", 3), ("LEAST_STARS", 60), ("FEW_STARS", 40)):
            patch.setattr(packing, name, value)
        exec(compile(body, REFERENCE, "exec"), names)
        yield names


def examples(name):
    """The examples of a name, those of its members included."""
    found = doctest.DocTestFinder(recurse=True).find(
        getattr(psfdae, name), name, module=ModuleType(name), globs={}
    )
    return [test for test in found if test.examples]


@pytest.mark.parametrize("name", NAMES)
def test_the_example_gives_what_it_says(name, lines):
    tests = examples(name)
    assert any(test.name == name for test in tests), f"psfdae.{name} has no example"
    runner = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE)
    said, start = [], time.process_time()
    for test in tests:
        test.globs = dict(lines)
        runner.run(test, out=said.append)
    assert runner.failures == 0, "".join(said)
    assert time.process_time() - start < LONGEST_S


def test_the_reference_is_the_public_names():
    page = read(REFERENCE)
    listed = [place.rpartition(".") for place in re.findall(r"^::: (\S+)", page, re.M)]
    kinds = {name: getattr(psfdae, name) for name in NAMES}
    assert {(module, name) for module, _, name in listed} == {
        (kind.__module__, name) for name, kind in kinds.items()
    }
    assert "`psfdae.__version__`" in page and psfdae.__version__
