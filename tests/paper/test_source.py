"""Edits of the code and the jobs that they repeat."""

from __future__ import annotations

import shutil

import pytest

from psfdae_paper import source
from psfdae_paper.source import source_hash

METHODS = ("dae", "gmm", "lmmse", "pca_som")
PLACES = {"pca_som": "psfdae_paper.methods.pca_som"}
ESTIMATORS = ("alignment train-network", "alignment train-dae")
TABLE = "psfdae_paper/evaluation/paper/tables_psf.csv"


def hashes():
    """Hashes of what takes long (stars, fits, trainings of scene 3) and of the tables."""
    source.module_digest.cache_clear()
    fits = {name: PLACES.get(name, f"psfdae.methods.{name}") for name in METHODS}
    commands = ("stars", "alignment states", *ESTIMATORS, "paper-tables")
    return {name: source_hash("fit", module) for name, module in fits.items()} | {
        name: source_hash(name) for name in commands
    }


@pytest.fixture(scope="module")
def before():
    return hashes()


@pytest.fixture
def changed(before, tmp_path, monkeypatch):
    """Names of the hashes that differ after an edit of files in a copy of the packages."""
    ignored = shutil.ignore_patterns("__pycache__")
    shutil.copytree(source.SOURCES, tmp_path / "src", ignore=ignored)
    monkeypatch.setattr(source, "SOURCES", tmp_path / "src")

    def edit(*paths, text="\nNEW = 1\n"):
        for path in paths:
            with (tmp_path / "src" / path).open("a") as file:
                file.write(text)
        new_hashes = hashes()
        return {name for name in before if before[name] != new_hashes[name]}

    yield edit
    source.module_digest.cache_clear()


def test_code_that_draws_reads_images_or_is_new_trains_nothing(changed):
    paths = [
        *("psfdae/methods/metrics.py", "psfdae/figure_style.py", "psfdae/strip.py"),
        *("psfdae/image/observation.py", "psfdae/image/fits_file.py", "psfdae/image/catalogue.py"),
        *("psfdae/report/page.py", "psfdae/report/validation.py", "psfdae/report/plot.py"),
        *("psfdae/commands/predict.py", "psfdae/commands/cli.py"),
        *("psfdae/methods/newest.py", "psfdae_paper/methods/newest.py"),
        *("psfdae_paper/evaluation/curves.py", "psfdae_paper/evaluation/figures.py"),
        *("psfdae_paper/bounds/sampling.py", "psfdae_paper/tracking.py"),
        *("psfdae_paper/stages/figures.py", "psfdae_paper/stages/evaluate.py"),
    ]
    assert changed(*paths) <= {"paper-tables"}


def test_comments_docstrings_and_formatting_change_no_hash(changed):
    paths = (
        "psfdae/methods/gmm.py",
        "psfdae/optics/propagation.py",
        "psfdae/base/settings.py",
    )
    assert changed(*paths, text='\n# A thought.\n"""A constant\'s docstring."""\n') == set()


@pytest.mark.parametrize(
    ("path", "repeated"),
    [
        ("psfdae/methods/gmm.py", {"gmm"}),
        ("psfdae/methods/networks/dae.py", {"dae", *ESTIMATORS}),
        ("psfdae_paper/methods/pca_som.py", {"pca_som"}),
        ("psfdae_paper/stars/scenes.py", {"stars"}),
        ("psfdae/stars/noise.py", {*METHODS, *ESTIMATORS, "paper-tables"}),
        ("psfdae/optics/propagation.py", {"stars", "alignment states", *ESTIMATORS}),
        (TABLE, {"paper-tables"}),
    ],
)
def test_code_that_computes_repeats_what_it_made(changed, path, repeated):
    assert changed(path, text="\n" if path == TABLE else "\nNEW = 1\n") == repeated


@pytest.mark.parametrize("name", ["no command", "workflow/nothing.py"])
def test_absent_code_is_named(name):
    with pytest.raises(ValueError, match=name):
        source_hash(name)
