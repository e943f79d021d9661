"""How many files a new stage or dataset touches: each is added here.

A new method is in test_new_method.py: its module, its name in the list, its file of settings.
"""

from __future__ import annotations

import shutil

import pytest

from workflow_runs import ROOT, planned, snakemake

pytestmark = pytest.mark.workflow

STAGE = '''
"""Stage `count-fields`."""

from typing import Annotated

from psfdae.files import write_text
from psfdae.options import File
from psfdae_paper.configuration.command import command
from psfdae_paper.configuration.schema import Config


@command("count-fields", reads=("grid",))
def count_fields(config: Config, out: Annotated[File, "Text."]) -> None:
    """Count the fields."""
    write_text(out, str(config.grid.points**2))
'''
RULE = """
rule count_fields:
    output:
        f"{RESULTS}/fields.txt",
    params:
        config=lambda w: settings("count-fields", "dataset=dataset3"),
        source=source_hash("count-fields"),
    shell:
        "psfdae count-fields --config {params.config} --out {output}"
"""
DATASET = """# @package _global_
defaults:
  - dataset3
  - _self_

dataset:
  name: mine
"""


@pytest.fixture
def tree(tmp_path):
    """A copy of the sources, to which a test adds."""
    root = tmp_path / "tree"
    for name in ("src", "config", "workflow", "profiles"):
        shutil.copytree(ROOT / name, root / name, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "Snakefile", root)
    return root


def added(root, name, text):
    """Append to a file."""
    with (root / name).open("a") as file:
        file.write(text)


@pytest.mark.slow
def test_a_stage_is_three(tree, tmp_path):
    added(tree, "src/psfdae_paper/stages/count_fields.py", STAGE)
    added(tree, "workflow/rules/count.smk", RULE)
    added(tree, "workflow/Snakefile", '\n\ninclude: "rules/count.smk"\n')
    snakemake(tmp_path, "results/fields.txt", root=tree, overrides="grid.points=3")
    assert (tmp_path / "results/fields.txt").read_text() == "9"


def test_a_dataset_is_one(tree, tmp_path):
    added(tree, "config/dataset/mine.yaml", DATASET)
    jobs = planned(tmp_path, "mine", root=tree)
    assert {"templates", "stars", "train", "evaluate", "track"} <= set(jobs)
