"""Memory and time that jobs ask of a cluster: a dry run with its profile."""

from __future__ import annotations

import os
import shutil

import pytest

from command_line import psfdae
from workflow_runs import captured, environment

"""Memory of the snakemake that starts a job on its node, which counts as the job's."""


@pytest.mark.slow
@pytest.mark.skipif(
    shutil.which("taskset") is None or os.cpu_count() < 2,
    reason="needs two CPUs and a way to leave out one",
)
def test_number_of_cpus_does_not_change_a_product(tmp_path):
    """Two threads of linear algebra, as configured, on two CPUs and on one."""
    sizes = ["grid.points=3", "stars.count=48", "optics.threads=2"]
    templates = tmp_path / "templates.h5"
    assert psfdae("templates", "--out", templates, "scene=seidel", *sizes).exit_code == 0
    products = []
    for cpus, threads in (("0,1", "2"), ("0", "1")):
        out = tmp_path / f"{threads}.h5"
        line = ["taskset", "--cpu-list", cpus, "psfdae", "stars", "--templates", templates]
        variables = environment(OMP_NUM_THREADS=threads)
        run = captured([*line, "--out", out, *sizes], env=variables)
        assert run.returncode == 0, run.stderr
        products.append(out.read_bytes())
    assert products[0] == products[1]
