"""The workflow on a real SLURM cluster of two nodes with one CPU each, all on this machine.

Runs where PSFDAE_SLURM=1, as root, and only where no cluster is configured.
"""

from __future__ import annotations

import os
import re
import subprocess

import pytest

from slurm_cluster import ask, cluster, obstacle, states, wait_for
from workflow_runs import ROOT, captured, environment

pytestmark = [pytest.mark.workflow, pytest.mark.slow]

TARGETS = (
    "dataset8",
    "results/tables/dataset3_mse.csv",
    "results/tables/alignment_telescope.csv",
    "results/alignment/original/network.safetensors",
)
QUICK = [
    # A cluster without accounting answers squeue only; the rest is for jobs of a second.
    *("--slurm-status-command", "squeue"),
    *("--slurm-init-seconds-before-status-checks", "5"),
    *("--seconds-between-status-checks", "1"),
    *("--latency-wait", "10"),
]
SUFFIXES = {".h5", ".safetensors", ".parquet", ".png", ".md"}
TIMED = ("curves.png",)


@pytest.fixture(scope="module")
def nodes(tmp_path_factory):
    """The running cluster."""
    if os.environ.get("PSFDAE_SLURM") != "1":
        pytest.skip("PSFDAE_SLURM=1 asks for a cluster on this machine")
    reason = obstacle()
    if reason:
        pytest.skip(reason)
    with cluster(tmp_path_factory.mktemp("slurm")):
        yield


@pytest.fixture(scope="module")
def run(nodes, tmp_path_factory):
    """A run of the smoke preset that loses a node on the way: its folder and jobs."""
    folder = tmp_path_factory.mktemp("cluster_run")
    log = folder / "snakemake.out"
    with log.open("w") as out:
        process = subprocess.Popen(
            command(folder, *TARGETS), env=environment(), stdout=out, stderr=subprocess.STDOUT
        )
        try:
            lost = lose_node_in_mid_training(process)
            assert process.wait(1200) == 0, log.read_text()
        finally:
            process.kill()
            process.wait()
    jobs = ask("scontrol", "--oneliner", "show", "job").splitlines()
    return folder, {job["JobId"]: job for job in map(_fields, jobs)}, lost


def command(folder, *targets):
    """The command of docs/cluster.md with short waits."""
    return [
        "snakemake",
        *("--snakefile", str(ROOT / "Snakefile"), "--directory", str(folder)),
        *("--workflow-profile", str(ROOT / "profiles/slurm"), *QUICK, *targets),
        *("--config", "preset=smoke", "results=results"),
    ]


def lose_node_in_mid_training(process):
    """Drain the first node that trains and send its job back to the queue; node and job."""

    def training():
        assert process.poll() is None, "the run ended before a node could be lost"
        running = ask("squeue", "--noheader", "--states=R", "--format=%N %A %k")
        return re.findall(r"^(n\d) (\d+) rule_train", running, re.M)

    wait_for(training, 600, "a training")
    node, job = training()[0]
    ask("scontrol", "update", f"NodeName={node}", "State=DRAIN", "Reason=test")
    ask("scontrol", "requeue", job)
    pending = ["squeue", "--noheader", f"--jobs={job}", "--states=PD"]
    wait_for(lambda: ask(*pending), 60, "the job to be back in the queue")
    # Otherwise it would be held for two minutes, and its place with it.
    ask("scontrol", "update", f"JobId={job}", "StartTime=now")
    return node, job


def _fields(line):
    return dict(item.split("=", 1) for item in line.split() if "=" in item)


def test_products_are_those_of_the_local_run(smoke, run):
    local, folder = smoke, run[0]
    products = [path for path in (folder / "results").rglob("*") if path.suffix in SUFFIXES]
    products += (folder / "results/tables").glob("*.csv")
    products += (folder / "results/evaluation").rglob("*.csv")
    products = [p for p in products if "mlartifacts" not in p.parts and p.name not in TIMED]
    assert {path.suffix for path in products} == {*SUFFIXES, ".csv"}
    for path in products:
        assert path.read_bytes() == (local / path.relative_to(folder)).read_bytes(), path


def test_the_drained_node_takes_no_job_and_its_training_runs_elsewhere(run):
    _, jobs, (node, requeued) = run
    assert states()[node].startswith("drain")
    assert jobs[requeued]["Restarts"] == "1"
    assert jobs[requeued]["NodeList"] != node
    assert {job["JobState"] for job in jobs.values()} == {"COMPLETED"}
    assert {job["NodeList"] for job in jobs.values()} == {"n1", "n2"}


def test_every_job_fits_a_node_of_one_cpu(run):
    for job in run[1].values():
        assert job["NumCPUs"] == "1"
        assert job["TimeLimit"] != "UNLIMITED"
        assert 0 < float(job["MinMemoryNode"].removesuffix("M")) < 4000


def test_databases_and_joined_tables_stay_at_home(run):
    folder, jobs, _ = run
    rules = {re.match(r"rule_(.*?)(_wildcards|$)", job["Comment"])[1] for job in jobs.values()}
    assert {"stars", "train", "evaluate", "alignment_network"} <= rules
    assert not rules & {"track", "paper_tables"}
    assert (folder / "results/mlflow.db").is_file()


def test_nothing_is_left_to_do_at_home(run):
    folder = run[0]
    line = [*command(folder, *TARGETS), "--executor", "local", "--cores", "2", "--dry-run"]
    done = captured(line, env=environment())
    assert "Nothing to be done" in done.stdout + done.stderr, done.stdout + done.stderr
