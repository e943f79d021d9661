"""Which edits of the code repeat which jobs."""

from __future__ import annotations

import shutil

import pytest

from psfdae_paper import source
from psfdae_paper.source import source_hash

METHODS = ("dae", "gmm", "lmmse", "pca_som")
PLACES = {"pca_som": "psfdae_paper.methods.pca_som"}


def hashes():
    """Of what takes long: stars, the fit of each method, and the trainings of scene 3."""
    source._module.cache_clear()
    fits = {name: PLACES.get(name, f"psfdae.methods.{name}") for name in METHODS}
    commands = ("stars", "alignment states", "alignment train-network", "alignment train-dae")
    return {name: source_hash("fit", chosen=[module]) for name, module in fits.items()} | {
        name: source_hash(name) for name in commands
    }


@pytest.fixture
def changed(tmp_path, monkeypatch):
    """Names of the hashes that differ after an edit of a copy of the packages."""
    before = hashes()
    for package in ("psfdae", "psfdae_paper"):
        ignored = shutil.ignore_patterns("__pycache__")
        shutil.copytree(source.SOURCES / package, tmp_path / "src" / package, ignore=ignored)
    monkeypatch.setattr(source, "SOURCES", tmp_path / "src")

    def edit(path, text="\nNEW = 1\n"):
        file = tmp_path / "src" / path
        file.write_text((file.read_text() if file.exists() else "") + text)
        after = hashes()
        return {name for name in before if before[name] != after[name]}

    yield edit
    source._module.cache_clear()


@pytest.mark.parametrize(
    "path",
    [
        *("psfdae/metrics.py", "psfdae/figure_style.py", "psfdae/strip.py"),
        *("psfdae/image/observation.py", "psfdae/image/fits_file.py", "psfdae/image/catalogue.py"),
        *("psfdae/model/report.py", "psfdae/model/validation.py", "psfdae/model/plot.py"),
        *("psfdae/commands/predict.py", "psfdae/cli.py"),
        *("psfdae/methods/newest.py", "psfdae_paper/methods/newest.py"),
        *("psfdae_paper/evaluation/curves.py", "psfdae_paper/evaluation/figures.py"),
        *("psfdae_paper/bounds/sampling.py", "psfdae_paper/tracking.py"),
        *("psfdae_paper/stages/figures.py", "psfdae_paper/stages/evaluate.py"),
    ],
)
def test_what_looks_reads_images_or_is_new_trains_nothing(changed, path):
    assert changed(path) == set()


def test_comments_docstrings_and_formatting_train_nothing(changed):
    for path in ("psfdae/method.py", "psfdae/optics/propagation.py", "psfdae/settings.py"):
        assert changed(path, '\n# A thought.\n"""A constant\'s docstring."""\n') == set()


@pytest.mark.parametrize(
    ("path", "repeated"),
    [
        ("psfdae/methods/gmm.py", {"gmm"}),
        ("psfdae/networks/dae.py", {"dae", "alignment train-dae", "alignment train-network"}),
        ("psfdae/networks/training.py", {"dae", "alignment train-dae", "alignment train-network"}),
        ("psfdae_paper/methods/pca_som.py", {"pca_som"}),
        ("psfdae_paper/stars/scenes.py", {"stars"}),
    ],
)
def test_what_computes_repeats_what_it_made(changed, path, repeated):
    assert changed(path) == repeated


def test_noise_repeats_all_fits_but_no_stars(changed):
    found = changed("psfdae/noise.py")
    assert {*METHODS} <= found and "stars" not in found


def test_optics_repeat_all_simulations(changed):
    found = changed("psfdae/optics/propagation.py")
    assert {"stars", "alignment states"} <= found and not {*METHODS} & found


def test_a_table_of_a_package_counts(tmp_path, monkeypatch):
    before = source_hash("paper-tables")
    shutil.copytree(source.SOURCES, tmp_path / "src")
    monkeypatch.setattr(source, "SOURCES", tmp_path / "src")
    (table, *_) = sorted((tmp_path / "src/psfdae_paper/evaluation/paper").glob("*.csv"))
    table.write_text(table.read_text() + "\n")
    source._module.cache_clear()
    assert source_hash("paper-tables") != before


@pytest.mark.parametrize("name", ["no command", "psfdae.nothing", "workflow/nothing.py"])
def test_what_is_absent_is_named(name):
    with pytest.raises(ValueError, match=f"{name}: no such"):
        source_hash(name)
