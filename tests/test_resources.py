"""What every job asks of a cluster: enough memory and time, and no more CPUs than a node has."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys

import pandas as pd
import psutil
import pytest

from workflow_runs import ROOT, captured, environment

pytestmark = [pytest.mark.workflow, pytest.mark.slow]

SNAKEMAKE_MB = 250
"""Memory of the snakemake that starts a job on its node, which counts as the job's."""
ON_REQUEST = (
    *("benchmark", "stability", "bounds", "training_knee"),
    *("prediction", "from_stars_example", "bundles", "scaling"),
)
PROFILES = ROOT / "profiles"
RULES = "".join(path.read_text() for path in (ROOT / "workflow/rules").glob("*.smk"))
HEAD = r"(?:use rule \w+ as|rule) (\w+)(?: with)?:\n"
LOCAL = set(re.findall(rf"^{HEAD}(?:(?!{HEAD}).*\n)*?    localrule: True", RULES, re.M))
LOCAL = {names[0] for names in LOCAL}


@pytest.fixture(scope="module")
def plan(tmp_path_factory):
    """Jobs of a dry run of everything under a profile: a list of their printed keys."""
    folder = tmp_path_factory.mktemp("plan")
    shutil.copytree(ROOT / "workflow", folder / "workflow")
    shutil.copy(ROOT / "Snakefile", folder)
    # A job with a message of its own does not print its resources.
    for rules in folder.glob("workflow/rules/*.smk"):
        text = re.sub(r"^( +)message:\n(?:\1    .*\n)+", "", rules.read_text(), flags=re.M)
        rules.write_text(text)

    def jobs(profile, *arguments):
        line = ["snakemake", "--dry-run", "--directory", str(folder)]
        line += ["--snakefile", str(folder / "Snakefile")]
        line += ["--workflow-profile", str(PROFILES / profile), *arguments, "all", *ON_REQUEST]
        out = captured([*line, "--config", "results=results"], env=environment()).stdout
        return [_job(part) for part in re.findall(r"^rule .*\n(?:    .*\n)+", out, re.M)]

    return jobs


def _job(text):
    head, *lines = text.splitlines()
    keys = dict(line.strip().split(": ", 1) for line in lines)
    resources = dict(item.split("=", 1) for item in keys.get("resources", "").split(", ") if item)
    rule = head.split()[1].rstrip(":")
    # A dry run runs everything at home and does not tell what else would not.
    local = rule in LOCAL or "output" not in keys
    return {**keys, "rule": rule, "local": local, "resources": resources}


@pytest.fixture(scope="module")
def everything(plan):
    jobs = plan("default", "--cores", "2")
    assert len(jobs) > 200
    return jobs


def test_measured_jobs_of_the_record_fit_into_what_they_ask_for(everything):
    record = pd.read_csv(ROOT / "results/reference/runtime.csv")
    measured = {f"{row.rule}/{row.wildcards}": row for row in record.itertuples()}
    compared, lacking = 0, []
    for job in everything:
        name = job.get("benchmark", "").removeprefix("results/benchmarks/").removesuffix(".tsv")
        if name in measured and not job["local"]:
            resources, cost = job["resources"], measured[name]
            needed = {"mem_mb": 1.2 * cost.peak_mb + SNAKEMAKE_MB, "runtime": 5 * cost.wall_s / 60}
            lacking += [(name, k, v) for k, v in needed.items() if float(resources[k]) < v]
            compared += 1
    assert not lacking
    assert compared > 100


def test_a_job_of_the_run_has_one_name_for_its_log_and_its_costs(everything):
    """Its CPU time stands in the log, wall time and memory in the benchmark."""
    costs = [
        job for job in everything if job.get("benchmark", "").startswith("results/benchmarks/")
    ]
    assert len(costs) > 150
    for job in costs:
        name = job["benchmark"].removeprefix("results/benchmarks/").removesuffix(".tsv")
        assert job["log"] == f"results/logs/{name}.log"


def test_what_writes_sqlite_or_only_joins_tables_stays_at_home(everything):
    local = {job["rule"] for job in everything if job["local"]}
    tables = {"runtime", "paper_tables", "psf_metrics", "held_out"}
    assert {"track", "track_alignment", *tables} <= local
    assert not local & {"train", "stars", "evaluate", "baseline", "alignment_network"}


def test_no_job_asks_for_more_cpus_than_the_smallest_node_has(plan, everything):
    assert any(int(job.get("threads", 1)) > 1 for job in everything)
    jobs = plan("slurm")
    assert len(jobs) == len(everything)
    assert {int(job.get("threads", 1)) for job in jobs} == {1}


@pytest.mark.skipif(
    not hasattr(psutil.Process, "cpu_affinity") or psutil.cpu_count() < 2,
    reason="needs two CPUs and a way to leave out one",
)
def test_number_of_cpus_does_not_change_a_product(tmp_path):
    """Two threads of linear algebra, as configured, on two CPUs and on one."""
    sizes = ["grid.points=5", "stars.count=96", "optics.threads=2"]
    templates = tmp_path / "templates.h5"
    psfdae = [sys.executable, "-m", "psfdae"]
    make = [*psfdae, "templates", "--out", str(templates), "scene=seidel", *sizes]
    subprocess.run(make, check=True, capture_output=True)
    products = []
    for cpus in ([0, 1], [0]):
        out = tmp_path / f"{len(cpus)}.h5"
        stars = [*psfdae, "stars", "--templates", str(templates), "--out", str(out), *sizes]
        threads = {"OMP_NUM_THREADS": str(len(cpus))}
        with subprocess.Popen(
            [sys.executable, "-c", PINNED, ",".join(map(str, cpus)), *stars],
            env=environment(**threads),
        ) as process:
            assert process.wait() == 0
        products.append(out.read_bytes())
    assert products[0] == products[1]


PINNED = """
import os, sys
os.sched_setaffinity(0, map(int, sys.argv[1].split(",")))
os.execv(sys.argv[2], sys.argv[2:])
"""
