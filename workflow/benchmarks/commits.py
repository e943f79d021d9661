"""The cost of a run at two commits, its targets by turns, so that no machine's day counts."""

import os
import subprocess
import sys
import threading
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter, sleep, time
from typing import Annotated

import click
import numpy as np
import pandas as pd
import psutil

from psfdae.base.files import write_csv
from psfdae.base.options import File
from psfdae.commands.cli import program
from psfdae.methods.metrics import cluster_ratio
from psfdae_paper.configuration.command import command

TARGETS = (*(f"dataset{n}" for n in range(1, 9)), "scene3", "all")
"""Targets of `make reproduce`, in order; each builds what those before it have not."""

COSTS = {"wall_s": "wall time", "cpu_s": "CPU time", "job_s": "wall time of all jobs together"}
EVERY_S = 0.2
"""Between looks at Snakemake's own CPU time, which ends with its process."""


@command("compare")
def compare(
    against: Annotated[str, "Commit that is compared with."],
    commit: Annotated[str, "Commit."] = "HEAD",
    targets: Annotated[
        tuple[str, ...],
        {"flag": "--target"},
        "Built in this order; repeat.  [default: a whole run]",
    ] = (),
    preset: Annotated[str, "Sizes of the run."] = "fast",
    cores: Annotated[int, click.IntRange(min=1), "Of every run."] = 2,
    *,
    out: Annotated[File, "CSV with a row per target and commit."],
) -> None:
    """Build targets at two commits by turns, each in an environment and a clone of its own."""
    root = Path(__file__).resolve().parents[2]
    rows = []
    with TemporaryDirectory() as folder:
        trees = {c: _tree(root, c, Path(folder)) for c in dict.fromkeys((against, commit))}
        if len(trees) < 2:
            raise click.UsageError(f"--against {against} is the commit itself")
        for turn, target in enumerate(targets or TARGETS):
            for tree in (*trees.values(),)[:: -1 if turn % 2 else 1]:
                rows.append(_built(tree, target, preset, cores))
                print(" ".join(f"{key} {value}" for key, value in rows[-1].items()), flush=True)
        table = pd.DataFrame(rows)
        write_csv(out, table, 6)
        print(summary(table, *(tree.name for tree in trees.values())))


def summary(table, old, new):
    """Ratios of the costs of two commits, in lines; `table` has a row per target and commit.

    Their scatter is that between targets, if there are several.
    """
    first, second = (table[table.commit == c].set_index("target") for c in (old, new))
    lines = [f"{new} over {old}, targets: {', '.join(first.index)}"]
    for name, about in COSTS.items():
        seconds = [second[name].to_numpy(float), first[name].reindex(second.index).to_numpy(float)]
        ratio, stderr = cluster_ratio(*seconds, np.arange(len(second)))
        scatter = f" ± {stderr:.3f}" if len(second) > 1 else ""
        lines.append(
            f"  {about} {seconds[1].sum():.0f} -> {seconds[0].sum():.0f} s: {ratio:.3f}{scatter}"
        )
    peaks = [f"{side.peak_mb.max():.0f}" for side in (first, second)]
    return "\n".join([*lines, f"  largest job {peaks[0]} -> {peaks[1]} MiB"])


def _tree(root, commit, folder):
    """A clone of a commit with its environment; its name is the commit's."""
    tree = folder / _output("git", "-C", root, "rev-parse", "--short=7", f"{commit}^{{commit}}")
    _output("git", "clone", "--quiet", "--no-checkout", root, tree)
    _output("git", "-C", tree, "checkout", "--quiet", "--detach", tree.name)
    _output("make", "-C", tree, "env", f"PYTHON={sys.executable}")
    return tree


def _output(*words):
    """Return the output of a command; a failure ends with its message."""
    process = subprocess.run([*map(str, words)], capture_output=True, text=True, check=False)
    if process.returncode:
        raise click.ClickException(f"{' '.join(map(str, words))}: {process.stderr.strip()}")
    return process.stdout.strip()


def _built(tree, target, preset, cores):
    """Row with what a target costs: seconds, of Snakemake itself, too, and the largest job."""
    started, clock, cpu = time(), perf_counter(), [0.0]
    programs = f"{tree / '.venv/bin'}{os.pathsep}{os.environ['PATH']}"
    words = ["snakemake", "--cores", str(cores), "--quiet", "all"]
    words += ["--config", f"preset={preset}", "set=", "results=results", "--", target]
    child = subprocess.Popen(
        words, cwd=tree, env={**os.environ, "PATH": programs, "PSFDAE_RESULTS": "results"}
    )
    watching = threading.Thread(target=_watch, args=(psutil.Process(child.pid), cpu))
    watching.start()
    _, status, used = os.wait4(child.pid, 0)
    child.returncode = os.waitstatus_to_exitcode(status)
    wall = perf_counter() - clock
    watching.join()
    if child.returncode:
        raise click.ClickException(f"{tree.name}: {target} failed")
    files = [p for p in (tree / "results/benchmarks").rglob("*.tsv") if p.stat().st_mtime > started]
    last = [pd.read_csv(path, sep="\t", na_values="-").tail(1) for path in files]
    jobs = pd.concat([pd.DataFrame({"s": [], "max_rss": []}), *last])
    return {
        "commit": tree.name,
        "target": target,
        "wall_s": round(wall, 2),
        "cpu_s": round(used.ru_utime + used.ru_stime, 2),
        "snakemake_cpu_s": round(cpu[0], 2),
        "jobs": len(jobs),
        "job_s": round(jobs.s.sum(), 2),
        "peak_mb": jobs.max_rss.max(),
    }


def _watch(process, cpu):
    """Keep the CPU time of a process without its children until it ends."""
    try:
        while process.status() != psutil.STATUS_ZOMBIE:
            times = process.cpu_times()
            cpu[0] = times.user + times.system
            sleep(EVERY_S)
    except psutil.Error:
        return


if __name__ == "__main__":
    program(compare)
