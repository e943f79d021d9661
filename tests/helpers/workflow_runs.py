"""Runs of the real workflow in a folder of a test, on tiny sizes."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PATH = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
QUIET = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
NO_CLUSTER = {"SLURM_CONF": os.devnull}
"""Snakemake asks SLURM's programs, where there are any, and waits 10 s for a cluster in vain."""
KERNELS = {
    name: value
    for name, value in os.environ.items()
    if name.startswith("OPENBLAS_") and "THREADS" not in name
}
"""Variable that chooses the kernels of linear algebra, which changes last digits."""


def environment(**variables):
    """The environment of a run, without what `make test` has in its own."""
    dropped = ("PSFDAE_RESULTS", "MAKEFLAGS", "MAKELEVEL")
    inherited = {key: value for key, value in os.environ.items() if key not in dropped}
    return {**inherited, "PATH": PATH, **variables}


def captured(args, **options):
    """A finished program with its output, whether it succeeded or not."""
    return subprocess.run(args, capture_output=True, text=True, check=False, **options)


def copy_of_sources(folder):
    """A copy in `folder` of everything that decides what runs."""
    for name in ("src", "config", "workflow", "profiles"):
        ignored = shutil.ignore_patterns("__pycache__")
        shutil.copytree(ROOT / name, folder / name, ignore=ignored)
    shutil.copy(ROOT / "Snakefile", folder)
    return folder


def clone(folder):
    """A fresh copy of the source tree in `folder`, with the environment of this one."""
    environment_of_make = Path(sys.prefix)
    if not (environment_of_make / ".complete").is_file():
        pytest.skip("the environment is not make's")
    patterns = shutil.ignore_patterns(
        *(".*_cache", ".cache", ".git", ".snakemake", ".venv*"),
        *("__pycache__", "dist", "site"),
    )

    def ignored(place, names):
        # Times are kept, so that make finds its environment newer than the lock file.
        return (
            set(names) - {"reference"}
            if Path(place) == ROOT / "results"
            else patterns(place, names)
        )

    shutil.copytree(ROOT, folder, ignore=ignored, dirs_exist_ok=True)
    (folder / ".venv").symlink_to(environment_of_make)
    return folder


def shell(folder, line, home=None, **options):
    """A line of README as a user types it: the environment active, nothing else set.

    `home` is the user's, by default the folder itself; options are those of `Popen`.
    """
    variables = {"HOME": str(home or folder), "PATH": PATH, "LANG": "C.UTF-8"}
    # An environment of the copy's own would be linked to the copy's source.
    variables |= {"PYTHONPATH": str(folder / "src"), **NO_CLUSTER, **KERNELS}
    return subprocess.Popen(["bash", "-c", line], cwd=folder, env=variables, **options)


def command(folder, *arguments, overrides="", preset="smoke", results="results", root=ROOT):
    """The command line of a run in `folder`, of the workflow in `root`."""
    return [
        "snakemake",
        *("--snakefile", str(root / "Snakefile"), "--directory", str(folder)),
        *arguments,
        *("--config", f"preset={preset}", f"results={results}", f"set={overrides}"),
    ]


def snakemake(folder, *arguments, check=True, path=PATH, **options):
    """Output of a run; fails the test if the run fails, unless told otherwise.

    `path` is where its jobs look for programs.
    """
    source = str(options.get("root", ROOT) / "src")
    variables = environment(PYTHONPATH=source, PATH=path, **NO_CLUSTER)
    result = captured(command(folder, *arguments, **options), env=variables)
    if check:
        assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout + result.stderr


def planned(folder, *targets, **options):
    """Jobs of a dry run: number by rule, without the target itself."""
    out = snakemake(folder, "--dry-run", *targets, **options)
    jobs = job_counts(out)
    if not jobs:
        assert "Nothing to be done" in out, out
    return {rule: n for rule, n in jobs.items() if rule not in ("total", "all", *targets)}


def job_counts(out):
    """The table of jobs that Snakemake prints, as a mapping."""
    table = re.search(r"^job +count\n-+ +-+\n(.*?)\n\n", out, re.M | re.S)
    rows = [] if table is None else [line.split() for line in table[1].splitlines()]
    return {rule: int(n) for rule, n in rows}


def locked(folder, *arguments, **options):
    """The command that `make reproduce` gives, for `subprocess`: arguments by name."""
    line = ["sh", str(ROOT / "workflow/locked.sh"), *command(folder, *arguments, **options)]
    return {"args": line, "cwd": folder, "env": environment(PSFDAE_RESULTS="results")}


def wait_until(condition, seconds, failure):
    """Wait for something, with 20 looks a second; a test fails if it takes too long."""
    for _ in range(20 * seconds):
        if condition():
            return
        time.sleep(0.05)
    pytest.fail(failure)
