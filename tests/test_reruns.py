"""What an edit makes the workflow do again, and what not: the real DAG, planned on a copy."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from workflow_runs import ROOT, planned

pytestmark = pytest.mark.workflow

TARGETS = ("dataset3", "dataset8")


@pytest.fixture
def tree(tmp_path):
    """A copy of everything that decides what runs."""
    for name in ("Snakefile", "profiles", "workflow", "config", "src"):
        source = ROOT / name
        if source.is_dir():
            ignored = shutil.ignore_patterns("__pycache__")
            shutil.copytree(source, tmp_path / name, ignore=ignored)
        else:
            shutil.copy(source, tmp_path / name)
    return tmp_path


@pytest.fixture
def jobs(smoke, tree):
    """Jobs that the smoke run would repeat with the edited copy."""
    return lambda *targets: planned(smoke, *targets, root=tree)


def append(path: Path, text: str) -> None:
    assert path.is_file()
    path.write_text(path.read_text() + text)


def test_a_copy_and_comments_repeat_nothing(jobs, tree):
    assert jobs() == {}
    append(tree / "config/train/onecycle.yaml", "# A thought.\n")
    append(tree / "config/dataset/dataset3.yaml", "# Another.\n")
    append(tree / "src/psfdae/optics/propagation.py", "# And a third.\n")
    assert jobs() == {}


def test_learning_rate_of_one_dataset(jobs, tree):
    """Its four trainings and evaluations, its tables and figures, its import; no more."""
    append(tree / "config/dataset/dataset3.yaml", "  lr: 0.002\n")  # ends with train
    assert jobs(*TARGETS, "tables") == {
        "train": 4,
        "evaluate": 4,
        "paper_tables": 1,
        "psf_metrics": 1,
        "held_out": 1,
        "figure_curves": 1,
        "figure_errors": 1,
        "figure_strip": 2,
        "track": 1,
    }


CHANGE = "\nCHANGED = 1\n"


def test_plotting_functions(jobs, tree):
    """Figures, and their import into MLflow; nothing that computes."""
    append(tree / "src/psfdae_paper/evaluation/curves.py", CHANGE)
    found = jobs(*TARGETS, "tables")
    assert all(name.startswith(("figure_", "track")) for name in found)
    assert {"figure_curves", "figure_errors", "track"} <= set(found)


SIMULATED = {"templates": 2, "stars": 2}
LEARNED = {"train": 6, "evaluate": 6}


@pytest.mark.parametrize(
    ("module", "repeated", "left"),
    [
        ("psfdae/optics/propagation", SIMULATED | {"baseline": 4} | LEARNED, ()),
        ("psfdae/networks/dae", LEARNED, SIMULATED),
        ("psfdae/metrics", {"evaluate": 6}, (*SIMULATED, "baseline", "train")),
    ],
)
def test_what_computes(jobs, tree, module, repeated, left):
    """All that is made with it and from that, and nothing before."""
    append(tree / f"src/{module}.py", CHANGE)
    found = jobs(*TARGETS)
    assert found == {**found, **repeated}
    assert {"paper_tables", "track"} <= set(found)
    assert not set(left) & set(found)
