"""Mutation testing of the numerical modules: which random errors do the fast tests detect?

    python studies/mutants/mutants.py FOLDER [--number 300] [--seed 63] [--only PATTERN …]

mutmut writes the mutants of all functions into a copy of the committed tree in FOLDER. The fast
tests run once, to record the functions that each of them calls. Then the tests of each mutant of a
random sample run, the cheapest first, until one fails. FOLDER/sample.csv has a row per mutant; the
same command continues a list that is not complete. README.md has the environment.
"""

from __future__ import annotations

import argparse
import ast
import csv
import difflib
import json
import os
import pkgutil
import random
import re
import resource
import signal
import subprocess
import sys
import textwrap
import time
from collections import defaultdict
from contextlib import chdir
from fnmatch import fnmatch
from pathlib import Path

import pytest
from mutmut.configuration import config
from mutmut.mutation import trampoline
from mutmut.state import state

ROOT = Path(__file__).resolve().parents[2]
# All modules are numerical but these, which read files, check arguments, or write tables and pages.
MODULES_LEFT_OUT = {
    ".": ["__init__", "api", "base/*", "commands/*"],
    "denoise": ["bundle", "description", "stamp_arrays"],
    "image": [
        *("catalogue", "containers", "errors", "fits_file", "header_units", "image_input"),
        *("list_formats", "observation", "opening", "position_columns", "selection_advice"),
        "tables",
    ],
    "psf": ["exchange", "photutils_grid"],
    "report": ["checks", "figures", "page", "plot"],
    "training": ["packing", "settings", "stars"],
}
LEFT_OUT = [
    str(Path("src/psfdae", room, f"{name}.py"))
    for room, names in MODULES_LEFT_OUT.items()
    for name in names
]
# Other tests of the paper, the workflow and the pages take long, and reach the library through its
# calls; these of the library look at texts and types.
TESTS = ["tests/library", "tests/commands", "tests/paper/evaluation/test_evaluation.py"]
TESTS_LEFT_OUT = ["api_examples", "arguments", "damaged_yaml", "extras", "files_and_cli", "fuzz"]
TESTS_LEFT_OUT += ["hostile_files", "typing_errors"]
OPTIONS = ["-q", "-n0", "-p", "no:cacheprovider", "--tb=short"]
OPTIONS += ["-m", "not slow and not written and not workflow"]
OPTIONS += [f"--ignore-glob=*/test_{name}.py" for name in TESTS_LEFT_OUT]


class CallRecorder:
    """Pytest plugin: functions that each test calls, also by its shared fixtures, and CPU time."""

    def __init__(self) -> None:
        self.calls: set[str] = state()._stats
        # Of tests and of shared fixtures, by their names.
        self.functions: dict[str, set[str]] = defaultdict(set)
        self.seconds: dict[str, float] = defaultdict(float)
        self.fixtures: dict[str, list[str]] = {}
        self.failed: set[str] = set()

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef, request):
        """Give the calls of a fixture that several tests share to all of them."""
        if fixturedef.scope == "function":
            return (yield)
        name, start = f"{fixturedef.baseid}:{fixturedef.argname}", time.process_time()
        outer = set(self.calls)
        self.calls.clear()
        value = yield
        self.functions[name] |= self.calls
        self.seconds[name] += time.process_time() - start
        self.calls.update(outer)
        return value

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_call(self, item):
        start = time.process_time()
        result = yield
        self.seconds[item.nodeid] = time.process_time() - start
        return result

    def pytest_runtest_logreport(self, report):
        if report.failed:
            self.failed.add(report.nodeid)

    def pytest_runtest_teardown(self, item):
        self.functions[item.nodeid] |= self.calls
        self.calls.clear()
        last = [found[-1] for found in item._fixtureinfo.name2fixturedefs.values()]
        shared = [fixture for fixture in last if fixture.scope != "function"]
        self.fixtures[item.nodeid] = [f"{f.baseid}:{f.argname}" for f in shared]

    def record(self) -> dict[str, object]:
        """Return the CPU time of each test, and the tests of each function, for tests that pass."""
        seconds, tests = {}, defaultdict(list)
        for test in set(self.fixtures) - self.failed:
            names = [test, *self.fixtures[test]]
            seconds[test] = sum(self.seconds[name] for name in names)
            for function in set().union(*(self.functions[name] for name in names)):
                tests[function].append(test)
        return {"seconds": seconds, "tests": tests, "failed": sorted(self.failed)}


class InOrder:
    """Pytest plugin: tests in the order that is given, and the first that fails."""

    def __init__(self, tests: list[str]) -> None:
        self.order = {test: number for number, test in enumerate(tests)}
        self.failed = ""

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items):
        items.sort(key=lambda item: self.order[item.nodeid])

    def pytest_runtest_logreport(self, report):
        if report.failed and not self.failed:
            self.failed = report.nodeid


def write_mutants(clone: Path) -> None:
    """Copy the committed tree, and let mutmut write all mutants of the numerical modules."""
    clone.mkdir(parents=True)
    archive = subprocess.run(["git", "archive", "HEAD"], cwd=ROOT, check=True, capture_output=True)
    subprocess.run(["tar", "x"], cwd=clone, input=archive.stdout, check=True)
    copied = sorted(path.name for path in clone.iterdir() if path.name != "src")
    with (clone / "pyproject.toml").open("a") as file:
        file.write('\n[tool.mutmut]\nsource_paths = ["src"]\n')
        file.write('only_mutate = ["src/psfdae/*"]\n')
        file.write(f"do_not_mutate = {json.dumps(LEFT_OUT)}\nalso_copy = {json.dumps(copied)}\n")
    steps = ("copy_src_dir()", "copy_also_copy_files()", "create_mutants(1)")
    code = "; ".join(["import mutmut.__main__ as m", *(f"m.{step}" for step in steps)])
    subprocess.run([sys.executable, "-c", code], cwd=clone, check=True, capture_output=True)


def record_tests(clone: Path, path: Path) -> None:
    """Run the tests without a mutant, and write which of them call which function."""
    with chdir(clone):
        config()  # mutmut reads it in the current folder, once
    # In this process only: programs that tests start do not record.
    trampoline._mutant_under_test = "stats"
    recorder = CallRecorder()
    with chdir(clone / "mutants"):
        pytest.main([*OPTIONS, *TESTS], plugins=[recorder])
    path.write_text(json.dumps(recorder.record()))


def run_tests(mutant: str, tests: list[str], seconds: float) -> str:
    """Return the first test that fails on a mutant, "" if none does.

    Parameters
    ----------
    mutant : str
    tests : list of str
        In the order in which they run.
    seconds : float
        CPU time after which the mutant is taken for an endless loop, which returns "time".
    """
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        os.environ["MUTANT_UNDER_TEST"] = mutant
        resource.setrlimit(resource.RLIMIT_CPU, (int(seconds), int(seconds) + 5))
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        plugin = InOrder(tests)
        code = pytest.main([*OPTIONS, "-x", *tests], plugins=[plugin])
        os.write(writer, (plugin.failed or ("" if code == 0 else f"exit code {code}")).encode())
        os._exit(0)
    os.close(writer)
    with os.fdopen(reader) as file:
        failed = file.read()
    _, status = os.waitpid(child, 0)
    if not os.WIFSIGNALED(status):
        return failed
    is_limit = os.WTERMSIG(status) in {signal.SIGXCPU, signal.SIGKILL}
    return "time" if is_limit else f"signal {os.WTERMSIG(status)}"


def change_of(mutant: str, tree: Path) -> str:
    """Return the lines of a function that a mutant changes, before and after."""
    module, _, name = mutant.rpartition(".")
    path = tree / "src" / module.replace(".", "/")
    code = (path / "__init__.py" if path.is_dir() else path.with_suffix(".py")).read_text()
    original = f"{name.rpartition('__mutmut_')[0]}__mutmut_orig"
    lines = {}
    for function in (original, name):
        # A module has megabytes of mutants: only these two functions are parsed. They end before
        # the next line that is not indented more than they are, but for the end of their arguments.
        end = r"(?=^(?!\1 ) *[^\s)]|\Z)"
        found = re.search(rf"^( *)def {function}\(.*?{end}", code, re.M | re.S)
        assert found is not None, mutant
        text = ast.unparse(ast.parse(textwrap.dedent(found[0])))
        lines[function] = text.replace(function, original).splitlines()
    difference = difflib.ndiff(lines[original], lines[name])
    return "\n".join(line for line in difference if line[0] in "+-")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--number", type=int, default=300)
    parser.add_argument("--seed", type=int, default=63)
    parser.add_argument("--only", nargs="*", help="patterns of mutants, instead of a sample")
    arguments = parser.parse_args()
    folder = arguments.folder.resolve()
    clone, record, table = folder / "clone", folder / "tests.json", folder / "sample.csv"
    if not clone.exists():
        write_mutants(clone)
    tree = clone / "mutants"
    os.environ["PYTHONPATH"] = str(tree / "src")
    sys.path.insert(0, str(tree / "src"))
    if not record.exists():
        record_tests(clone, record)
        # Again, without what these tests have left in memory.
        os.execv(sys.executable, [sys.executable, *sys.argv])
    os.chdir(tree)
    tests_of, seconds_of = (json.loads(record.read_text())[key] for key in ("tests", "seconds"))
    metas = [json.loads(path.read_text()) for path in Path("src").rglob("*.meta")]
    mutants = sorted(name for meta in metas for name in meta["exit_code_by_key"])
    if arguments.only:
        sample = [name for name in mutants if any(fnmatch(name, p) for p in arguments.only)]
    else:
        sample = random.Random(arguments.seed).sample(mutants, arguments.number)
    # Modules are imported once; each mutant has a process of its own, without results in caches.
    import psfdae

    for module in pkgutil.walk_packages(psfdae.__path__, "psfdae."):
        if not module.name.endswith("__main__"):
            __import__(module.name)
    done = {row["mutant"] for row in csv.DictReader(table.open())} if table.exists() else set()
    for mutant in sample:
        if mutant in done:
            continue
        tests = sorted(tests_of.get(mutant.rpartition("__mutmut_")[0], ()), key=seconds_of.get)
        limit = 60.0 + 10.0 * sum(seconds_of[test] for test in tests)
        killer = run_tests(mutant, tests, limit) if tests else ""
        row = {"mutant": mutant, "tests": len(tests), "killed_by": killer}
        row["change"] = change_of(mutant, tree)
        with table.open("a", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, row)
            if file.tell() == 0:
                writer.writeheader()
            writer.writerow(row)
        print(mutant, f"killed by {killer}" if killer else "survived", flush=True)


if __name__ == "__main__":
    main()
