"""How long Snakemake plans: dry runs of the real rules over made-up datasets and sweeps."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

Kind = Literal["models", "points"]
"""What a DAG is made of: datasets with stars and a network each, or points of a sweep."""

KINDS: tuple[Kind, ...] = ("models", "points")

PRESET = "made_up"

DATASET = """\
# @package _global_
defaults:
  - /stars: {name}
  - /noise: noise3
  - _scene1
  - _self_

dataset:
  name: {name}
  splits: [random]
  references: [realisation]
  shown_levels: [1.0e-3]
"""

STARS = """\
# @package _global_
defaults:
  - seidel_10pct
  - _self_

stars:
  name: {name}
"""

SWEEP = """\
kind: random
model: dae
dataset: dataset3
metric: validation_mse
direction: minimize
trials: {count}
seed: 1
space:
  train.lr: {{low: 1.0e-4, high: 1.0e-1, log: true}}
  train.grad_clip: {{low: 0.1, high: 10.0, log: true}}
"""
"""Two settings, because drawn values are rounded and equal points are one job."""


class PlanError(RuntimeError):
    """A dry run has failed; the message holds the end of its output."""


@dataclass(frozen=True)
class Planned:
    """A dry run.

    Attributes
    ----------
    seconds, cpu_s : float
        Wall time and CPU time of the process.
    peak_mb : float
        Its largest memory.
    jobs : mapping of str to int
        Number of jobs by rule.
    output : str
        What it printed.
    """

    seconds: float
    cpu_s: float
    peak_mb: float
    jobs: Mapping[str, int]
    output: str

    @property
    def total(self) -> int:
        """Number of all jobs."""
        return sum(self.jobs.values())


@contextmanager
def made_up_config(shipped: Path, kind: Kind, count: int) -> Iterator[Path]:
    """A copy of the configuration with as many datasets, or points of a sweep, as asked for."""
    with TemporaryDirectory() as folder:
        config = Path(folder) / "config"
        shutil.copytree(shipped, config)
        names = [f"model{i:06d}" for i in range(count)] if kind == "models" else ["dataset3"]
        if kind == "models":
            for name in names:
                (config / f"dataset/{name}.yaml").write_text(DATASET.format(name=name))
                (config / f"stars/{name}.yaml").write_text(STARS.format(name=name))
        else:
            (config / f"sweep/{PRESET}.yaml").write_text(SWEEP.format(count=count))
        chosen = f"# @package _global_\nworkflow:\n  datasets: [{', '.join(names)}]\n"
        (config / f"preset/{PRESET}.yaml").write_text(chosen)
        (config / f"alignment_preset/{PRESET}.yaml").write_text("# @package _global_\n")
        yield config


def plan(snakefile: Path, config: Path, kind: Kind, target: str = "") -> Planned:
    """Dry run of the workflow over a made-up configuration.

    Parameters
    ----------
    snakefile : of the workflow
    config : folder from `made_up_config`
    kind : what the DAG is made of
    target : a file; default everything

    Raises
    ------
    PlanError
        If Snakemake fails.
    """
    settings = [f"preset={PRESET}", "results=results"]
    settings += [f"sweep={PRESET}"] if kind == "points" else []
    with TemporaryDirectory() as folder:
        command = [
            *(sys.executable, "-m", "snakemake", "--dry-run", "--cores", "1"),
            *("--snakefile", str(snakefile), "--directory", folder),
            *("--config", *settings, "--"),
            target or {"models": "scene1", "points": "sweep"}[kind],
        ]
        out = Path(folder) / "output"
        with out.open("w") as file:
            start = time.perf_counter()
            process = subprocess.Popen(
                command,
                stdout=file,
                stderr=subprocess.STDOUT,
                env={**os.environ, "PSFDAE_CONFIG": str(config)},
            )
            _, status, used = os.wait4(process.pid, 0)
            process.returncode = os.waitstatus_to_exitcode(status)
            seconds = time.perf_counter() - start
        text = out.read_text(encoding="utf-8", errors="replace")
    if process.returncode:
        raise PlanError(f"snakemake --dry-run over {kind}: {text[-2000:]}")
    per_mb = 2**20 if sys.platform == "darwin" else 2**10
    cpu = used.ru_utime + used.ru_stime
    return Planned(seconds, cpu, used.ru_maxrss / per_mb, job_counts(text), text)


def job_counts(text: str) -> dict[str, int]:
    """Number of jobs by rule from the table that Snakemake prints."""
    table = re.search(r"^job +count\n-+ +-+\n(.*?)\n\n", text, re.M | re.S)
    rows = [line.split() for line in table[1].splitlines()] if table else []
    return {rule: int(count) for rule, count in rows if rule != "total"}


def one_job(kind: Kind, planned: Planned) -> str:
    """An output of the DAG whose dry run costs what every job of a cluster pays to start."""
    if kind == "models":
        return "results/data/seidel/templates.h5"
    name = re.search(r"\b[0-9a-f]{12}\b", planned.output.partition("\ntotal")[2])
    if name is None:
        raise PlanError("snakemake --dry-run over points: names no point")
    return f"results/sweeps/{PRESET}/points/{name[0]}/result.json"


def measure(snakefile: Path, shipped: Path, kind: Kind, counts: list[int]) -> list[dict[str, Any]]:
    """Time the planning of DAGs of several sizes.

    Parameters
    ----------
    snakefile : of the workflow
    shipped : folder of the configuration
    kind : what the DAGs are made of
    counts : numbers of models or points

    Returns
    -------
    list of dict
        kind, count, jobs, plan_s, plan_cpu_s, peak_mb, start_s, start_cpu_s (dry run of one
        job), by_rule (jobs by rule).
    """
    rows = []
    for count in counts:
        with made_up_config(shipped, kind, count) as config:
            whole = plan(snakefile, config, kind)
            single = plan(snakefile, config, kind, one_job(kind, whole))
        rows.append(
            {
                "kind": kind,
                "count": count,
                "jobs": whole.total,
                "plan_s": whole.seconds,
                "plan_cpu_s": whole.cpu_s,
                "peak_mb": whole.peak_mb,
                "start_s": single.seconds,
                "start_cpu_s": single.cpu_s,
                "by_rule": dict(whole.jobs),
            }
        )
    return rows
