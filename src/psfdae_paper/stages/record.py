"""Stages `runtime` and `reference`: the cost of a run, and the run of record.

A finished run in `results` goes in. Out come `runtime.csv` with the cost of each job, and
`results/reference` with tables and figures of the run and, in `provenance.json`, how they were
made. The record is in git, and pages take their numbers from it.
"""

from __future__ import annotations

import json
import os
import platform
import re
import shutil
import subprocess
import sys
import timeit
from collections.abc import Iterable
from datetime import date
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Annotated
from xml.etree import ElementTree

import numpy as np

from psfdae.base.files import ProductError, write_csv, write_text
from psfdae.base.options import File, Folder
from psfdae.base.reading import read_table
from psfdae_paper.configuration.command import command
from psfdae_paper.source import git

if TYPE_CHECKING:
    import pandas as pd

    from psfdae_paper.configuration.schema import Config

MAY_STAY = re.compile(r"(sweeps|paper)/.+")
"""Names of products that may stay from an earlier record: they take too long for every record."""


@command("paper runtime")
def runtime(results: Folder, out: File) -> None:
    """Collect wall time, CPU time and memory of a run's jobs.

    Wall time and memory are Snakemake's. The CPU time of all processes of a job is in the last
    line of its log, which has the name of its benchmark.

    Columns are the rule, its wildcards, wall_s and cpu_s in seconds, and peak_mb.

    Parameters
    ----------
    results : Path
        Folder of a run.
    out : Path
        CSV with the cost of every job.
    """
    write_csv(out, job_costs(results), 6)


def job_costs(results: Path) -> pd.DataFrame:
    """Return a table with wall time, CPU time (s) and peak memory (MB) of every job.

    NaN stands where Snakemake has no number, or the log of a job no CPU time.

    Parameters
    ----------
    results : Path
        Folder of a run, with the folders `benchmarks` and `logs`.
    """
    import pandas as pd

    # A table of Snakemake for each job: RULE/WILDCARDS.tsv.
    folder = results / "benchmarks"
    rows = []
    for path in sorted(folder.rglob("*.tsv")):
        job = path.relative_to(folder).with_suffix("")
        rule, *wildcards = job.parts
        # The last line of a log is that of bash's `times`, 1m2.003s for user and system each
        # (workflow/rules/cpu_time.smk).
        log = results / "logs" / job.with_name(f"{job.name}.log")
        last_line = log.read_text(encoding="utf-8").splitlines()[-1:] if log.is_file() else []
        times = re.findall(r"(\d+)m(\d+)[.,](\d{3})s", " ".join(last_line))
        seconds = [60.0 * int(m) + int(s) + 1e-3 * int(ms) for m, s, ms in times]
        cpu_s = sum(seconds) if len(seconds) == 2 else float("nan")
        last_run = _last_run(path)
        rows.append((rule, "/".join(wildcards), last_run["s"], cpu_s, last_run["max_rss"]))
    return pd.DataFrame(rows, columns=["rule", "wildcards", "wall_s", "cpu_s", "peak_mb"])


def _last_run(benchmark: Path) -> pd.Series[float]:
    """Return Snakemake's numbers of the last run of a job; ProductError if they are damaged."""
    return read_table(benchmark, "s", "max_rss", sep="\t", na_values=["-"]).iloc[-1]


@command("paper reference")
def reference(
    results: Folder, out: Folder, plans: Annotated[tuple[File, ...], {"flag": "--plan"}]
) -> None:
    """Replace the committed run of record by a finished run.

    The new record belongs to the commit that is checked out. It is refused unless code, workflow
    and settings are as committed, and Snakemake finds every file up to date with them, on whatever
    machine it was made. Files that take long (`MAY_STAY`) and are not up to date stay from the
    earlier record; provenance names them with the commit of that record, which must be in the
    history, and its date.

    The folder gets tables, figures, runtime.csv and provenance.json; pages take their numbers from
    these files alone.

    Parameters
    ----------
    results : Path
        Folder of a finished run.
    out : Path
        Folder of the run of record.
    plans : sequence of Path
        Output of `snakemake --summary` for the files of the record.
    """
    from psfdae_paper.configuration.compose import load

    # What a commit does not have, and what it would make anew, is refused.
    commit = clean_commit()
    renewed = files_up_to_date(results, plans)
    # Files of the earlier record that stay, with its commit and date.
    provenance_path = out / "provenance.json"
    earlier = json.loads(provenance_path.read_text()) if provenance_path.is_file() else {}
    names = (path.relative_to(out).as_posix() for path in sorted(out.rglob("*")) if path.is_file())
    earlier_record = {key: earlier.get(key, "unknown") for key in ("commit", "date")}
    retained: dict[str, dict[str, str]] = {
        name: earlier.get("kept", {}).get(name) or earlier_record
        for name in names
        if name not in renewed and MAY_STAY.fullmatch(name)
    }
    # A commit that is in the history can be checked out again.
    for name, record in retained.items():
        try:
            git("merge-base", "--is-ancestor", record["commit"], "HEAD")
        except subprocess.CalledProcessError:
            raise ProductError(
                f"{name}: recorded at commit {record['commit']:.12}, which is not in the history;"
                " make it anew, or remove it from the record"
            ) from None
    sources = {name: results / name for name in renewed}
    sources |= {name: out / name for name in retained}
    # The new record is complete before it replaces the earlier one.
    staging = out.with_name(f".{out.name}.new")
    shutil.rmtree(staging, ignore_errors=True)
    for name, path in sources.items():
        target = staging / name
        target.parent.mkdir(parents=True, exist_ok=True)
        # Bytes only: dates of the files are not part of the record.
        shutil.copyfile(path, target)
    described = provenance(results, load()) | {"commit": commit, "kept": retained}
    text = json.dumps(described, indent=2, sort_keys=True)
    write_text(staging / "provenance.json", text + "\n")
    shutil.rmtree(out, ignore_errors=True)
    staging.rename(out)


def clean_commit() -> str:
    """Return the commit that is checked out.

    Raises
    ------
    ProductError
        If files that decide the products of a run differ from it, or git fails.
    """
    # Pages, tests and tables may differ: they make no product.
    try:
        changed = git("status", "--porcelain", "--", "Snakefile", "config", "src", "workflow")
        commit = git("rev-parse", "HEAD")
    except (OSError, subprocess.CalledProcessError) as error:
        raise ProductError(
            f"the run of record belongs to a commit, and git fails: {error}"
        ) from None
    # The last word of the status is the name of a file.
    if changed:
        raise ProductError(f"{changed.split()[-1]}: differs from commit {commit:.12}; commit first")
    return commit


def files_up_to_date(results: Path, plans: Iterable[Path]) -> list[str]:
    """Return the files of the record that Snakemake finds up to date.

    Parameters
    ----------
    results : Path
        Folder of the run.
    plans : iterable of Path
        Tables of `snakemake --summary`.

    Returns
    -------
    list of str
        Names of files, relative to the folder.

    Raises
    ------
    ProductError
        If others, which may not stay from an earlier record, are not up to date.
    """
    # Snakemake's plan for every file of the run: "no update", or the reason to make it.
    plan_by_name: dict[str, str] = {}
    for path in plans:
        table = read_table(path, "output_file", "plan", sep="\t")
        for name, plan in zip(table["output_file"], table["plan"], strict=True):
            if Path(name).is_relative_to(results):
                plan_by_name[Path(name).relative_to(results).as_posix()] = plan
    if "runtime.csv" not in plan_by_name:
        raise ProductError(
            f"{', '.join(map(str, plans)) or 'no plan'}: does not contain runtime.csv"
        )
    # A record is of one commit, but for files that take too long to be made for each.
    in_record = re.compile(
        r"runtime\.csv|(tables|figures)/.+|calibration/(fit|columns|scales|degeneracy)\.csv"
        r"|sweeps/\w+/(summary|cost)\.csv|paper/tables/psf_metrics\.csv"
    )
    recorded = {name: plan for name, plan in plan_by_name.items() if in_record.fullmatch(name)}
    outdated = {name for name, plan in recorded.items() if plan != "no update"}
    refused = sorted(name for name in outdated if not MAY_STAY.fullmatch(name))
    if refused:
        raise ProductError(
            f"{results / refused[0]}: missing, or not what this commit makes (so are"
            f" {len(refused)} files of {len(recorded)}); run the targets of the record first"
        )
    return [name for name in recorded if name not in outdated]


def provenance(results: Path, config: Config) -> dict[str, object]:
    """Describe a run: date, machine, versions, threads, and its cost.

    Times are in seconds, sizes in MB. `wall_s` is the time during which a job of `make reproduce`
    ran, `on_request_s` that of each target beyond it.

    Parameters
    ----------
    results : Path
        Folder of a run.
    config : Config
        Configuration of the run, for its numbers of threads.

    Returns
    -------
    dict
        What `provenance.json` holds, but for commit and retained files.
    """
    # Jobs of `make reproduce`: the CPU time of all together and the largest memory of one.
    costs = job_costs(results)
    # Jobs of targets beyond `make reproduce`, such as the bounds.
    on_request = sorted(
        path for path in (results / "benchmarks_on_request").glob("*") if path.is_dir()
    )
    # The last `make test` leaves its time in a report of JUnit's form.
    report = results / "tests.xml"
    tests = ElementTree.parse(report).getroot().find("testsuite") if report.is_file() else None
    # Time and size of the environment that `make` created, from its files: venv writes pyvenv.cfg
    # first, and make the other file last.
    environment, installation = Path(sys.prefix), {}
    start, end = environment / "pyvenv.cfg", environment / ".complete"
    if start.is_file() and end.is_file():
        seconds = end.stat().st_mtime - start.stat().st_mtime
        installation["install_s"] = round(seconds, 1)
        installation["environment_mb"] = round(_size_mb(environment), 1)
    # Packages whose versions can change a number.
    packages = ("psfdae", "numpy", "scipy", "torch", "scikit-learn", "minisom")
    return {
        "date": date.today().isoformat(),
        "cpu": cpu_model(),
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "versions": {name: metadata.version(name) for name in packages},
        "threads": {
            "simulation": config.optics.threads,
            "training": config.train.threads,
            "evaluation": config.evaluation.threads,
        },
        "matrix_product_gflops": round(matrix_product_speed(), 1),
        "wall_s": round(_busy_seconds(results / "benchmarks"), 1),
        "on_request_s": {path.name: round(_busy_seconds(path), 1) for path in on_request},
        **installation,
        "results_mb": round(_size_mb(results), 1),
        "tests_s": None if tests is None else round(float(tests.get("time", "nan")), 1),
        "cpu_s": round(float(costs.cpu_s.sum()), 1),
        "peak_mb": round(float(costs.peak_mb.max()), 1),
    }


def cpu_model() -> str:
    """Return the model of the processor as the operating system names it."""
    # Linux; others say it to Python.
    info = Path("/proc/cpuinfo")
    if info.is_file():
        for line in info.read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def matrix_product_speed(size: int = 1024, repeats: int = 5) -> float:
    """Measure the speed of a float32 matrix product in GFLOP/s, the best of some repeats.

    Run times of two machines are expected to be in the inverse ratio of these speeds.

    Parameters
    ----------
    size : int
        Rows and columns of the matrices.
    repeats : int
        Number of products; other work on the machine slows most of them, but hardly all.
    """
    # Values do not matter for the speed.
    a = np.ones((size, size), dtype=np.float32)
    # A product takes 2 n³ operations.
    return 2.0 * size**3 / min(timeit.repeat(lambda: a @ a, repeat=repeats, number=1)) / 1e9


def _busy_seconds(benchmarks: Path) -> float:
    """Return the wall time during which at least one job ran.

    Pauses between jobs, such as those before a run is resumed, do not count.

    Parameters
    ----------
    benchmarks : Path
        Folder with a table of Snakemake for each job.
    """
    # Start and end of each job: a benchmark is written when its job ends.
    ends = ((path.stat().st_mtime, _last_run(path)["s"]) for path in benchmarks.rglob("*.tsv"))
    spans = sorted((end - np.nan_to_num(seconds), end) for end, seconds in ends)
    # Length of the union of all jobs' intervals, which are sorted by their start.
    busy_seconds, covered_until = 0.0, float("-inf")
    for start, end in spans:
        busy_seconds += max(0.0, end - max(start, covered_until))
        covered_until = max(covered_until, end)
    return busy_seconds


def _size_mb(folder: Path) -> float:
    """Return the size of all files of a folder in MB, links left out."""
    files = (path for path in folder.rglob("*") if path.is_file() and not path.is_symlink())
    return sum(path.stat().st_size for path in files) / 1e6
