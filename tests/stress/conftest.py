"""Stress tests: where the package breaks, and that it says so.

Every case states beforehand what must come out: a bound that follows from rounding, counting
statistics or optics, or the error that refuses the input. Alone, the tests draw few stars of the
preset smoke; the rule `stability` hands them those of its run and has their tables written.
"""

import warnings
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pandas as pd
import pytest
import torch
from threadpoolctl import threadpool_limits

from psfdae.base.files import read_product, write_text
from psfdae_paper.configuration.compose import load, load_settings, part
from psfdae_paper.configuration.consistency import SIMULATION
from stress.bench import THREADS, Bench, Scene, simulated

OPTIONS = {
    "stars": "product of the stage stars, scene 1",
    "turbulence": "product of the stage stars, scene 2",
    "settings": "file of the settings in READS",
    "stability-csv": "table to write: all cases",
    "graded-csv": "table to write: error against stress",
}
READS = ("seed", "noise", "dae", "train", "baseline", "evaluation")
STARS = 1200  # of a product that are used, at most
ORDER = ("precision", "optics", "photometry", "mixture", "network", "metrics", "repeat")


class Record:
    """Rows of all cases, and points of error against stress; a row that fails stops no other."""

    def __init__(self):
        self.module, self.rows, self.points = "", [], []

    def row(self, case, quantity, expected, measured, passed):
        verdict = "pass" if passed else "fail"
        self.rows.append((self.module, case, quantity, str(expected), str(measured), verdict))

    def at_most(self, case, quantity, measured, bound):
        measured = float(measured)  # of single precision, it would round the bound
        self.row(case, quantity, f"≤ {bound:.3g}", f"{measured:.3g}", measured <= bound)

    def close(self, case, quantity, measured, expected, bound, over=1.0):
        """The largest difference over something is ≤ `bound`."""
        self.at_most(case, quantity, np.abs(measured - expected).max() / over, bound)

    def within(self, case, quantity, measured, low, high):
        expected = f"{low:.3g} … {high:.3g}"
        self.row(case, quantity, expected, f"{measured:.3g}", low <= measured <= high)

    def equal(self, case, quantity, measured, expected):
        """Both print alike; for counts, names and flags."""
        self.row(case, quantity, expected, measured, str(measured) == str(expected))

    def one_of(self, case, quantity, measured, *values):
        self.row(case, quantity, " or ".join(values), measured, measured in values)

    @contextmanager
    def refused(self, case, error):
        """Check that the block raises `error`."""
        outcome, passed = "no error", False
        try:
            yield
        except error as raised:
            outcome, passed = type(raised).__name__, True
        except Exception as raised:  # a row that fails
            outcome = repr(raised)[:160]
        self.row(case, "error raised", error.__name__, outcome, passed)

    def point(self, series, stress, error, bound):
        """A point of a series of growing stress; `error` is None where the input was refused."""
        numbers = ("" if n is None else f"{n:.6g}" for n in (stress, error, bound))
        self.points.append((self.module, series, *numbers))


RECORD = pytest.StashKey[Record]()


@pytest.fixture
def record(request):
    return request.config.stash[RECORD]


@pytest.fixture(scope="package")
def bench(request):
    """Input of every case."""
    # A run of all tests does not know the options.
    options = {name: request.config.getoption(name, None) for name in OPTIONS}
    smoke = [load([f"dataset={name}", "preset=smoke"]) for name in ("dataset3", "dataset8")]
    settings = load_settings(Path(options["settings"]), READS) if options["settings"] else smoke[0]
    with TemporaryDirectory() as folder, threadpool_limits(THREADS):
        torch.set_num_threads(1)
        scenes = map(_scene, (options["stars"], options["turbulence"]), smoke, [Path(folder)] * 2)
        yield Bench(settings, *scenes, Path(folder))


def _scene(path, config, folder):
    """The first stars of a product with the settings that made them; few new ones without."""
    path = Path(path) if path else simulated(config, folder)[1]
    product = read_product(path, "stars", ("realisation",))
    return Scene(part(SIMULATION, product.config), product["realisation"][:STARS])


def pytest_addoption(parser):
    for name, about in OPTIONS.items():
        parser.addoption(f"--{name}", help=about)


def pytest_configure(config):
    config.stash[RECORD] = Record()


def pytest_runtest_setup(item):
    item.config.stash[RECORD].module = item.path.stem.removeprefix("test_")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item):
    """A test fails if a row does."""
    rows = item.config.stash[RECORD].rows
    first_row = len(rows)
    # What a broken input does to intermediate numbers is not the point here.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        yield
    sentence = "{1}: {2}: expected {3}, got {4}"
    if failed := [sentence.format(*row) for row in rows[first_row:] if row[-1] == "fail"]:
        pytest.fail("\n".join(failed), pytrace=False)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item, call):
    """A test that breaks is a row that fails, too."""
    error = call.excinfo and call.excinfo.value
    if error and not isinstance(error, pytest.fail.Exception):
        record = item.config.stash[RECORD]
        record.row(item.name, "runs to its end", "no error", repr(error)[:160], False)
    return (yield)


def pytest_sessionfinish(session):
    record = session.config.stash[RECORD]
    for name, columns, rows in (
        ("stability-csv", ["case", "quantity", "expected", "measured", "verdict"], record.rows),
        ("graded-csv", ["case", "stress", "error", "bound"], record.points),
    ):
        if path := session.config.getoption(f"--{name}", None):
            table = pd.DataFrame(rows, columns=["module", *columns])
            table = table.sort_values("module", key=lambda m: m.map(ORDER.index), kind="stable")
            write_text(Path(path), table[columns].to_csv(index=False))
