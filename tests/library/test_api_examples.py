"""Every public name: its example is run, and the reference has it."""

from __future__ import annotations

import doctest
import re
from types import ModuleType

import pytest

import psfdae
from docs_pages import blocks, read
from image_training import few_draws

NAMES = [name for name in psfdae.__all__ if name != "__version__"]
REFERENCE = "docs/python.md"


@pytest.fixture(scope="module")
def lines(tmp_path_factory):
    """Variables that the lines above the reference set, in a folder of their own."""
    folder = tmp_path_factory.mktemp("examples")
    body = blocks(read(REFERENCE), "python")[-1]
    names = {}
    with pytest.MonkeyPatch.context() as patch, few_draws():
        patch.chdir(folder)
        exec(compile(body, REFERENCE, "exec"), names)
        yield names


def examples(name):
    """The examples of a name, those of its members included."""
    finder = doctest.DocTestFinder(recurse=True)
    tests = finder.find(getattr(psfdae, name), name, module=ModuleType(name), globs={})
    return [test for test in tests if test.examples]


@pytest.mark.parametrize("name", NAMES)
def test_the_example_gives_what_it_says(name, lines):
    tests = examples(name)
    assert any(test.name == name for test in tests), f"psfdae.{name} has no example"
    runner = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE)
    output = []
    for test in tests:
        test.globs = dict(lines)
        runner.run(test, out=output.append)
    assert runner.failures == 0, "".join(output)


def test_the_reference_is_the_public_names():
    page = read(REFERENCE)
    listed = set(re.findall(r"^::: (psfdae\.\S+)", page, re.M))
    assert listed == {f"{getattr(psfdae, name).__module__}.{name}" for name in NAMES}
    assert "`psfdae.__version__`" in page and psfdae.__version__
