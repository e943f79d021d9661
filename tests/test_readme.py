"""The commands of the README do what it says, on tiny sizes or as a dry run."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from test_workflow import planned

ROOT = Path(__file__).resolve().parents[1]
TINY = {
    "templates": ["grid.points=5"],
    "stars": ["grid.points=5", "stars.count=200"],
    "train": ["preset=smoke", "parts.train_stars=150", "parts.test_stars=50"],
    "config": [],
}


@pytest.fixture(scope="module")
def commands():
    """Lines of the README's shell blocks without comments."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```sh\n(.*?)```", text, re.S)
    lines = [line.split("#")[0].strip() for block in blocks for line in block.splitlines()]
    return [line for line in lines if line]


def test_steps_by_hand(commands, tmp_path):
    steps = [shlex.split(line)[1:] for line in commands if line.startswith("psfdae ")]
    assert [step[0] for step in steps] == ["templates", "stars", "train", "config"]
    for step in steps:
        command = [sys.executable, "-m", "psfdae", *step, *TINY[step[0]]]
        subprocess.run(command, cwd=tmp_path, check=True, capture_output=True)
    assert (tmp_path / "my_dae/dae.safetensors").is_file()


@pytest.mark.workflow
def test_targets_exist(commands, tmp_path):
    targets = [line.split()[1] for line in commands if line.startswith("snakemake ")]
    assert {"dataset3", "scene1", "scene2", "tables"} <= set(targets)
    for target in targets:
        if target != "dataset9":
            assert planned(tmp_path, target)


def test_make_targets_exist(commands):
    makefile = (ROOT / "Makefile").read_text()
    targets = {line.split()[1] for line in commands if line.startswith("make ")}
    assert {"reproduce", "test", "report", "mlflow", "clean"} <= targets
    for target in targets:
        assert re.search(rf"^{target}:", makefile, re.M), target
