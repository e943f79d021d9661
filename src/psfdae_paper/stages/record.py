"""Stages `runtime` and `reference`: the cost of a run, and the run of record.

Input: a finished run in `results`. Outputs: `runtime.csv` with the cost of each job, and
`results/reference` with tables and figures of the run and their provenance (`provenance.json`). The
record is in git, and pages take their numbers from it.
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
from typing import Annotated
from xml.etree import ElementTree

import numpy as np
import pandas as pd

from psfdae.base.files import ProductError, write_csv, write_text
from psfdae.base.options import File, Folder
from psfdae.base.reading import read_table
from psfdae_paper.configuration.command import command
from psfdae_paper.configuration.compose import load
from psfdae_paper.configuration.schema import Config
from psfdae_paper.source import cpu_model, git

IMAGE_COSTS = ("tables/benchmark_images.csv", "figures/benchmark/images.png")
"""Files of `make benchmark TARGETS=images`, which names date and commit in its table."""

METHOD_COSTS = (
    *("tables/benchmark_costs.csv", "figures/benchmark/costs.png"),
    *("tables/posterior_network.csv", "figures/benchmark/posterior_network.png"),
)
"""Files of the target `posterior_network`, which times all methods."""

MAY_STAY = re.compile(
    "|".join([r"(sweeps|paper)/.+", *map(re.escape, (*IMAGE_COSTS, *METHOD_COSTS))])
)
"""Names of files that may stay from an earlier record, because they take too long to compute."""


@command("paper runtime")
def runtime(results: Folder, out: File) -> None:
    """Collect wall time, CPU time and memory of a run's jobs.

    Snakemake measures wall time and memory. The CPU time of all processes of a job is in the last
    line of its log.

    Columns are the rule, its wildcards, wall_s and cpu_s in seconds, and peak_mb in MiB.

    Parameters
    ----------
    results : Path
        Folder of a run.
    out : Path
        CSV with the cost of every job.
    """
    write_csv(out, read_job_costs(results), 6)


def read_job_costs(results: Path) -> pd.DataFrame:
    """Return a table with wall time (s), CPU time (s) and peak memory (MiB) of every job.

    Values that are missing in Snakemake's table or in the log of a job are NaN.

    Parameters
    ----------
    results : Path
        Folder of a run, with the folders `benchmarks` and `logs`.
    """
    # A table of Snakemake for each job: RULE/WILDCARDS.tsv.
    folder = results / "benchmarks"
    rows = []
    for path in sorted(folder.rglob("*.tsv")):
        job = path.relative_to(folder).with_suffix("")
        rule, *wildcards = job.parts
        # The last line of a log is from bash's `times`, 1m2.003s for user and system each
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
    """Return Snakemake's row for the last run of a job; ProductError if the table is damaged."""
    return read_table(benchmark, "s", "max_rss", sep="\t", na_values=["-"]).iloc[-1]


@command("paper reference")
def reference(
    results: Folder, out: Folder, plans: Annotated[tuple[File, ...], {"flag": "--plan"}]
) -> None:
    """Replace the committed run of record by a finished run, or complete it.

    The new record belongs to the commit that is checked out. Code, workflow and settings must not
    differ from it, and Snakemake must find every file up to date with them, on whatever machine it
    was computed. Files that take long (`MAY_STAY`) and are not up to date stay from the earlier
    record. A run without runtime.csv completes the earlier record: such files, and all files if it
    has the same commit, are added; the others stay.

    The folder receives tables, figures, runtime.csv and provenance.json; pages take their numbers
    from these files alone. Provenance describes the run of runtime.csv; its entry `other_runs` has
    date and commit of each file of another run, and its processor if it completed a record. These
    commits must be in the history.

    Parameters
    ----------
    results : Path
        Folder of a finished run.
    out : Path
        Folder of the run of record.
    plans : sequence of Path
        Outputs of `snakemake --summary` for the files of the record.
    """
    # Nothing may differ from the commit, and all files must be up to date with it.
    commit = clean_commit()
    provenance_path = out / "provenance.json"
    earlier = json.loads(provenance_path.read_text()) if provenance_path.is_file() else {}
    is_completed = bool(earlier) and not (results / "runtime.csv").is_file()
    may_stay = re.compile(".+") if is_completed else MAY_STAY
    new_names = list_current_files(results, plans, may_stay)
    if is_completed and earlier.get("commit") != commit:
        new_names = [name for name in new_names if MAY_STAY.fullmatch(name)]
    new_names += [name for name in IMAGE_COSTS if (results / name).is_file()]
    # Files of the earlier record that stay; those of a run of its own keep its date and commit.
    files = (path for path in sorted(out.rglob("*")) if path.is_file() and path != provenance_path)
    names = (path.relative_to(out).as_posix() for path in files)
    old_names = [name for name in names if name not in new_names and may_stay.fullmatch(name)]
    other_runs = {name: earlier.get("other_runs", {}).get(name) for name in old_names}
    if is_completed:
        record = earlier
        today = {"commit": commit, "date": date.today().isoformat(), "cpu": cpu_model()}
        other_runs = {name: run for name, run in other_runs.items() if run}
        other_runs |= dict.fromkeys(new_names, today)
    else:
        record = provenance(results, load()) | {"commit": commit}
        earlier_run = {key: earlier.get(key, "unknown") for key in ("commit", "date")}
        other_runs = {name: run or earlier_run for name, run in other_runs.items()}
    if IMAGE_COSTS[0] in new_names:
        row = read_table(results / IMAGE_COSTS[0], "commit", "date").iloc[-1]
        image_run = {"commit": row.commit, "date": row.date}
        other_runs |= {name: image_run for name in IMAGE_COSTS if name in new_names}
    # A commit that is in the history can be checked out again.
    for name, run in other_runs.items():
        try:
            git("merge-base", "--is-ancestor", run["commit"], "HEAD")
        except subprocess.CalledProcessError:
            raise ProductError(
                f"{name}: recorded at commit {run['commit']:.12}, which is not in the history;"
                " compute it again, or remove it from the record"
            ) from None
    sources = {name: results / name for name in new_names}
    sources |= {name: out / name for name in old_names}
    # The new record is complete before it replaces the earlier one.
    staging = out.with_name(f".{out.name}.new")
    shutil.rmtree(staging, ignore_errors=True)
    for name, path in sources.items():
        target = staging / name
        target.parent.mkdir(parents=True, exist_ok=True)
        # Contents only: dates of the files are not part of the record.
        shutil.copyfile(path, target)
    text = json.dumps(record | {"other_runs": other_runs}, indent=2, sort_keys=True)
    write_text(staging / "provenance.json", text + "\n")
    shutil.rmtree(out, ignore_errors=True)
    staging.rename(out)


def clean_commit() -> str:
    """Return the commit that is checked out.

    Raises
    ------
    ProductError
        If files that determine the products of a run differ from it, or git fails.
    """
    # Pages, tests and tables may differ: products do not depend on them.
    try:
        status = git("status", "--porcelain", "--", "Snakefile", "config", "src", "workflow")
        commit = git("rev-parse", "HEAD")
    except (OSError, subprocess.CalledProcessError) as error:
        raise ProductError(
            f"the run of record belongs to a commit, and git fails: {error}"
        ) from None
    # The last word of the status is the name of a file.
    if status:
        raise ProductError(f"{status.split()[-1]}: differs from commit {commit:.12}; commit first")
    return commit


def list_current_files(
    results: Path, plans: Iterable[Path], may_stay: re.Pattern[str]
) -> list[str]:
    """Return the files of the record that Snakemake finds up to date.

    Parameters
    ----------
    results : Path
        Folder of the run.
    plans : iterable of Path
        Outputs of `snakemake --summary`.
    may_stay : Pattern
        Names of files that need not be up to date.

    Returns
    -------
    list of str
        Paths of files, relative to `results`.

    Raises
    ------
    ProductError
        If files that may not stay from an earlier record are not up to date, or if the plans do not
        contain `runtime.csv`.
    """
    # Snakemake's plan for every file of the run: "no update", or the reason for an update.
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
    # All files of a record belong to one commit, except those that take too long.
    record_names = re.compile(
        r"runtime\.csv|(tables|figures)/.+|calibration/(fit|columns|scales|degeneracy)\.csv"
        r"|sweeps/\w+/(summary|cost)\.csv|paper/tables/psf_metrics\.csv"
    )
    entries = {name: plan for name, plan in plan_by_name.items() if record_names.fullmatch(name)}
    outdated_names = {name for name, plan in entries.items() if plan != "no update"}
    required_names = sorted(name for name in outdated_names if not may_stay.fullmatch(name))
    if required_names:
        raise ProductError(
            f"{results / required_names[0]}: missing or out of date (in all {len(required_names)}"
            f" of {len(entries)} files); run the targets of the record first"
        )
    return [name for name in entries if name not in outdated_names]


def provenance(results: Path, config: Config) -> dict[str, object]:
    """Describe a run: date, machine, versions, threads, and its cost.

    Times are in seconds, sizes in MB, but `peak_mb` in MiB, as Snakemake measures it. `wall_s` is
    the time during which jobs of `make reproduce` ran, `on_request_s` the time of each further
    target. `cpu_s` is None if the log of a job lacks its CPU time.

    Parameters
    ----------
    results : Path
        Folder of a run.
    config : Config
        Configuration of the run, for its numbers of threads.

    Returns
    -------
    dict
        Content of `provenance.json`, except commit and files of earlier records.
    """
    # Jobs of `make reproduce`: the CPU time of all together and the largest memory of one.
    costs = read_job_costs(results)
    # Jobs of further targets, such as the bounds.
    on_request = sorted(
        path for path in (results / "benchmarks_on_request").glob("*") if path.is_dir()
    )
    # The last `make test` leaves its time in a report in JUnit's format.
    report = results / "tests.xml"
    tests = ElementTree.parse(report).getroot().find("testsuite") if report.is_file() else None
    # Time and size of the environment that `make` created: venv writes pyvenv.cfg first, and make
    # writes .complete last.
    environment, installation = Path(sys.prefix), {}
    start, end = environment / "pyvenv.cfg", environment / ".complete"
    if start.is_file() and end.is_file():
        seconds = end.stat().st_mtime - start.stat().st_mtime
        installation["install_s"] = round(seconds, 1)
        installation["environment_mb"] = round(_size_mb(environment), 1)
    # Packages whose versions can change results.
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
        "matrix_product_gflops": round(measure_matrix_speed(), 1),
        "wall_s": round(_busy_seconds(results / "benchmarks"), 1),
        "on_request_s": {path.name: round(_busy_seconds(path), 1) for path in on_request},
        **installation,
        "results_mb": round(_size_mb(results), 1),
        "tests_s": None if tests is None else round(float(tests.get("time", "nan")), 1),
        "cpu_s": None if costs.cpu_s.isna().any() else round(float(costs.cpu_s.sum()), 1),
        "peak_mb": round(float(costs.peak_mb.max()), 1),
    }


def measure_matrix_speed() -> float:
    """Measure the speed of a float32 matrix product in GFLOP/s, the best of five repeats.

    Run times of two machines are expected to be in the inverse ratio of these speeds.
    """
    # The speed does not depend on the values.
    a = np.ones((1024, 1024), dtype=np.float32)
    # A product takes 2 n³ operations. Other work on the machine rarely slows all repeats.
    return 2.0 * len(a) ** 3 / min(timeit.repeat(lambda: a @ a, repeat=5, number=1)) / 1e9


def _busy_seconds(benchmarks: Path) -> float:
    """Return the wall time during which at least one job ran.

    Pauses between jobs, such as before a run is resumed, are left out.

    Parameters
    ----------
    benchmarks : Path
        Folder with a table of Snakemake for each job.
    """
    # Start and end of each job: its table is written when it ends.
    ends = ((path.stat().st_mtime, _last_run(path)["s"]) for path in benchmarks.rglob("*.tsv"))
    spans = sorted((end - np.nan_to_num(seconds), end) for end, seconds in ends)
    # Length of the union of all jobs' intervals, which are sorted by their start.
    busy_seconds, covered_until = 0.0, float("-inf")
    for start, end in spans:
        busy_seconds += max(0.0, end - max(start, covered_until))
        covered_until = max(covered_until, end)
    return busy_seconds


def _size_mb(folder: Path) -> float:
    """Return the size of all files of a folder in MB, without symbolic links."""
    files = (path for path in folder.rglob("*") if path.is_file() and not path.is_symlink())
    return sum(path.stat().st_size for path in files) / 1e6
