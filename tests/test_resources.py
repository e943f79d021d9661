"""Memory and time that jobs ask of a cluster: a dry run with its profile."""

from __future__ import annotations

import os
import re
import shutil

import pandas as pd
import pytest

from command_line import psfdae
from workflow_runs import ROOT, captured, environment

SNAKEMAKE_MB = 250
"""Memory of the snakemake that starts a job on its node, which counts as the job's."""
ON_REQUEST = (
    *("benchmark", "stability", "bounds", "training_knee"),
    *("prediction", "from_stars_example", "bundles", "scaling"),
)


@pytest.mark.slow
@pytest.mark.workflow
def test_jobs_on_a_cluster_fit_a_node_of_one_cpu_with_what_the_record_measured(tmp_path):
    shutil.copytree(ROOT / "workflow", tmp_path / "workflow")
    shutil.copy(ROOT / "Snakefile", tmp_path)
    # A job with a message of its own does not print its resources.
    for rules in tmp_path.glob("workflow/rules/*.smk"):
        text = re.sub(r"^( +)message:\n(?:\1    .*\n)+", "", rules.read_text(), flags=re.M)
        rules.write_text(text)
    line = [
        "snakemake",
        "--dry-run",
        "--directory",
        tmp_path,
        "--snakefile",
        tmp_path / "Snakefile",
    ]
    line += ["--workflow-profile", ROOT / "profiles/slurm", "all", *ON_REQUEST]
    out = captured([*line, "--config", "results=results"], env=environment()).stdout
    record = pd.read_csv(ROOT / "results/reference/runtime.csv")
    measured = {f"{row.rule}/{row.wildcards}": row for row in record.itertuples()}
    compared = []
    for job in re.findall(r"^rule .*\n(?:    .*\n)+", out, re.M):
        assert re.findall(r"^    threads: (\d+)", job, re.M) in ([], ["1"])
        name = re.search(r"^    benchmark: results/benchmarks/(.*)\.tsv", job, re.M)
        if name is None:
            continue
        # CPU time stands in the log, wall time and memory in the benchmark.
        assert f"log: results/logs/{name[1]}.log" in job
        asked = dict(re.findall(r"(mem_mb|runtime)=(\d+)", job))
        if asked and name[1] in measured:
            cost = measured[name[1]]
            assert float(asked["mem_mb"]) >= 1.2 * cost.peak_mb + SNAKEMAKE_MB, name[1]
            assert float(asked["runtime"]) >= 5 * cost.wall_s / 60, name[1]
            compared.append(name[1])
    assert len(compared) > 100


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
