"""A type checker finds wrong calls in the program of a user, and nothing in right ones."""

from __future__ import annotations

import os
import re
import sys

import pytest

from workflow_runs import ROOT, captured

PROGRAM = """
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import psfdae

stars = psfdae.Stars.from_image("image.fits", catalogue=Path("stars.csv"), snr_min=50.0)
psfdae.Stars.from_image(np.zeros((9, 9)), catalogue={"x_fit": [1.0], "y_fit": [2.0]}, mask="DQ")
model = psfdae.fit(stars, method="field", orders=[0, 1])
model.save(Path("image.psf.safetensors"))
report = psfdae.validate(psfdae.load_model("image.psf.safetensors"), stars)
images: NDArray[np.float64] = model.psf_at([1.0, 2.0], np.arange(2), oversampling=2)
psf: NDArray[np.float64] = model.predict(np.zeros((3, 16, 16)), noise=1.0).psf
flag: psfdae.StarFlag = psfdae.StarFlag.FAINT

psfdae.Stars.from_image("image.fits", detect="5")  # wrong: arg-type
psfdae.fit("image.fits")  # wrong: arg-type
psfdae.validate(stars, model)  # wrong: arg-type
psfdae.read_telescope(["telescope.yaml"])  # wrong: arg-type
psfdae.fitted(stars)  # wrong: attr-defined
model.psf_at("a", 1.0)  # wrong: arg-type
model.predict(np.zeros((3, 16, 16)), nois=1.0)  # wrong: call-arg
number: int = model.psf_at(1.0, 2.0)  # wrong: assignment
"""


@pytest.mark.slow
def test_wrong_calls_are_found(tmp_path):
    """It takes seconds after `make lint`, whose cache it shares; else some 20 s."""
    path = tmp_path / "program.py"
    path.write_text(PROGRAM)
    variables = {**os.environ, "MYPYPATH": str(ROOT / "src")}
    run = captured([sys.executable, "-m", "mypy", path], cwd=ROOT, env=variables)
    errors = re.findall(r"program\.py:(\d+): error: .*\[([a-z-]+)\]$", run.stdout, re.M)
    lines = enumerate(PROGRAM.splitlines(), 1)
    wrong = [(n, line.partition("# wrong: ")[2]) for n, line in lines if "# wrong: " in line]
    assert sorted({(int(line), code) for line, code in errors}) == wrong, run.stdout + run.stderr
