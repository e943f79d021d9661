"""How many files a new stage, figure, setting, dataset or option touches: each is added here.

A new method is in test_new_method.py: its module, its name in the list, its file of settings.
"""

from __future__ import annotations

import shutil
import subprocess
import sys

import pytest

from workflow_runs import ROOT, environment, planned, snakemake

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
DRAWING = '''

@styled
def dots(field: np.ndarray) -> Figure:
    """Fields as dots."""
    figure = new_figure(3.0)
    figure.add_subplot().plot(*field.T, "o")
    return figure
'''
FIGURE = '''

@command("figure dots")
def figure_dots(templates: Templates, out: Png) -> None:
    """Draw fields as dots."""
    from psfdae_paper.evaluation.figures import dots

    write_png(dots(read_product(templates, "templates", ("field",))["field"]), out)
'''
FIGURE_RULE = """

use rule figure_templates as figure_dots with:
    output:
        f"{RESULTS}/figures/{{scene}}/dots.png",
    log:
        f"{RESULTS}/logs/figure_dots/{{scene}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/figure_dots/{{scene}}.tsv"
    params:
        kind="dots",
        source=source_hash("figure dots"),
    message:
        "Drawing dots"
"""
KEY = """
    extra: Count = Field(1, description="Something new")
"""
USED = """

def extra(settings):
    return settings.{}extra
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


def added(root, name, text, after=None):
    """Append to a file, or insert behind a line of it; its name."""
    path = root / name
    old = path.read_text() if path.exists() else ""
    place = len(old) if after is None else old.index(after) + len(after)
    path.write_text(old[:place] + text + old[place:])
    return name


def python(root, program):
    done = subprocess.run(
        [sys.executable, "-c", program],
        env=environment(PYTHONPATH=str(root / "src")),
        capture_output=True,
        text=True,
        check=True,
    )
    return done.stdout.strip()


@pytest.mark.slow
def test_a_stage_and_a_figure_are_three_each(tree, tmp_path):
    stage = {
        added(tree, "src/psfdae_paper/stages/count_fields.py", STAGE),
        added(tree, "workflow/rules/count.smk", RULE),
        added(tree, "workflow/Snakefile", '\n\ninclude: "rules/count.smk"\n'),
    }
    figure = {
        added(tree, "src/psfdae_paper/evaluation/figures.py", DRAWING),
        added(tree, "src/psfdae_paper/stages/figures.py", FIGURE),
        added(tree, "workflow/rules/figures.smk", FIGURE_RULE),
    }
    assert len(stage) == len(figure) == 3
    targets = ("results/fields.txt", "results/figures/seidel/dots.png")
    snakemake(tmp_path, *targets, root=tree, overrides="grid.points=3")
    assert (tmp_path / targets[0]).read_text() == "9"
    assert (tmp_path / targets[1]).stat().st_size > 5_000


def test_a_setting_is_two_and_an_option_of_the_field_model_is_one_file(tree):
    """Its key with type, range, meaning and default; and where it is used."""
    own = 'description="Stars simulated per point of the scan")\n'
    places = [
        added(tree, "src/psfdae_paper/configuration/schema.py", KEY[1:], own),
        added(
            tree,
            "src/psfdae_paper/stages/calibrate.py",
            USED.format("calibration."),
        ),
    ]
    program = "from psfdae_paper.configuration.compose import load; c = load(['WORD'])"
    shown = program.replace("WORD", "calibration.extra=7")
    shown += "; from psfdae_paper.stages.calibrate import extra; print(extra(c))"
    assert python(tree, shown) == "7"
    modes = 'description="Leading modes of the residuals")\n'
    option = {
        added(tree, "src/psfdae/field_law.py", KEY[1:], modes),
        added(tree, "src/psfdae/field_law.py", USED.format("")),
    }
    program = "from psfdae.model.settings import from_words as f"
    program += "; from psfdae.field_law import extra; print(extra(f(['WORD']).field))"
    assert python(tree, program.replace("WORD", "field.extra=3")) == "3"
    assert len(places) == 2 and len(option) == 1


def test_a_dataset_is_one(tree, tmp_path):
    added(tree, "config/dataset/mine.yaml", DATASET)
    jobs = planned(tmp_path, "mine", root=tree)
    assert {"templates", "stars", "train", "evaluate", "track"} <= set(jobs)
