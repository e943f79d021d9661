"""Stages `runtime` and `reference`: what a run cost, and the run of record."""

from __future__ import annotations

import csv
import hashlib
import json
import os
import platform
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Iterable, Mapping
from datetime import date
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any
from xml.etree import ElementTree

import numpy as np

from psfdae.files import ProductError, write_csv, write_text
from psfdae.options import File, Folder
from psfdae_paper.configuration.command import command
from psfdae_paper.source import git

if TYPE_CHECKING:
    import pandas as pd

    from psfdae_paper.configuration.schema import Config

VERSIONED = ("psfdae", "numpy", "scipy", "torch", "minisom")
"""Packages whose versions can change a number; recorded with the run."""

ON_REQUEST = "benchmarks_on_request"
"""Folder with the cost of the targets that are not part of `make reproduce`."""

TARGETS = (
    *("benchmark", "bounds", "own_stars", "prediction"),
    *("scaling", "stability", "training_knee"),
)
"""Those targets that a record is made of."""

DECISIVE = ("Snakefile", "config", "src", "workflow")
"""What decides over the products of a run."""

RECORDED = re.compile(
    r"runtime\.csv|(tables|figures)/.+|calibration/(fit|columns|scales|degeneracy)\.csv"
    r"|sweeps/\w+/(summary|cost)\.csv|paper/tables/psf_metrics\.csv"
)
"""Products that the record holds."""

MAY_STAY = re.compile(
    r"(sweeps|paper|figures/benchmark)/.+"
    r"|tables/(benchmark_\w+|scaling_stages|predict_poppy\w*)\.csv"
)
"""What takes too long, or a machine without other work, to be made for every record."""


@command("runtime")
def runtime(
    results: Annotated[Folder, "Folder of a run."],
    out: Annotated[File, "CSV with the cost of every job."],
) -> None:
    """Collect wall time, CPU time and memory of a run's jobs.

    Wall time and memory are Snakemake's; the CPU time of all of a job's processes stands in the
    last line of its log (`workflow/rules/cpu_time.smk`), which has the name of its benchmark.
    """
    write_csv(out, _costs(results), 6)


def _costs(results: Path) -> pd.DataFrame:
    import pandas as pd

    folder = results / "benchmarks"
    rows = []
    for path in sorted(folder.rglob("*.tsv")):
        job = path.relative_to(folder).with_suffix("")
        rule, *wildcards = job.parts
        wall_s, peak_mb = _cost(path, "s", "max_rss")
        cpu_s = _cpu_seconds(results / "logs" / job.with_name(f"{job.name}.log"))
        rows.append((rule, "/".join(wildcards), wall_s, cpu_s, peak_mb))
    return pd.DataFrame(rows, columns=["rule", "wildcards", "wall_s", "cpu_s", "peak_mb"])


def _cost(path: Path, *names: str) -> list[float]:
    """Columns of a job's last run, NaN where Snakemake has no number.

    A benchmark file that was damaged costs its numbers, with a line that says so: no job
    is to be repeated for them.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
        columns, *_, last = (line.split("\t") for line in lines)
        job = dict(zip(columns, last, strict=True))
        return [float("nan" if job[name] in ("-", "NA") else job[name]) for name in names]
    except (ValueError, KeyError) as error:
        print(f"{path}: damaged ({error}); its cost is left out", file=sys.stderr, flush=True)
        return [float("nan")] * len(names)


def _cpu_seconds(log: Path) -> float:
    """User and system time in the last line of a log, as bash's `times` writes them; else NaN."""
    try:
        *_, last = log.read_text(encoding="utf-8").splitlines()
        minutes = re.findall(r"(\d+)m(\d+)[.,](\d{3})s", last)
        user, system = (60.0 * int(m) + int(s) + 1e-3 * int(ms) for m, s, ms in minutes)
        return user + system
    except (OSError, ValueError) as error:
        print(f"{log}: no CPU time ({error}); it is left out", file=sys.stderr, flush=True)
        return float("nan")


@command("reference")
def reference(
    results: Annotated[Folder, "Folder of a finished run."],
    out: Annotated[Folder, "Folder of the run of record."],
    plans: Annotated[
        tuple[File, ...],
        {"flag": "--plan"},
        "What `snakemake --summary` says of the files that the record holds.",
    ],
) -> None:
    """Replace the committed run of record by a finished run.

    The new record is that of the commit checked out: refused unless code, workflow and settings
    are as committed and Snakemake finds every file up to date with them, wherever it was made.
    What takes long (`MAY_STAY`) stays from the record before if it is not; provenance names it
    with the commit it was recorded at, which has to be in the history, and the commit's date.
    """
    from psfdae_paper.configuration.compose import load

    commit = _commit_in_use()
    renewed = _up_to_date(results, plans)
    last = out / "provenance.json"
    before = json.loads(last.read_text()) if last.is_file() else {}
    stays = (path for path in sorted(out.rglob("*")) if path.is_file() and path != last)
    kept = {
        name: _since(name, before)
        for name in (path.relative_to(out).as_posix() for path in stays)
        if name not in renewed and MAY_STAY.fullmatch(name)
    }
    sources = {name: results / name for name in renewed}
    sources |= {name: out / name for name in kept}
    for name, found in kept.items():
        _require_history(name, found)
    staging = out.with_name(f".{out.name}.new")
    shutil.rmtree(staging, ignore_errors=True)
    for name, path in sources.items():
        target = staging / name
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, target)
    described = provenance(results, load()) | {"commit": commit, "kept": kept}
    text = json.dumps(described, indent=2, sort_keys=True)
    write_text(staging / "provenance.json", text + "\n")
    shutil.rmtree(out, ignore_errors=True)
    staging.rename(out)


def _commit_in_use() -> str:
    """The commit checked out; ProductError if code, workflow or settings differ from it."""
    try:
        changed = git("status", "--porcelain", "--", *DECISIVE)
        commit = git("rev-parse", "HEAD")
    except (OSError, subprocess.CalledProcessError) as error:
        raise ProductError(
            f"the run of record belongs to a commit, and git fails: {error}"
        ) from None
    if changed:
        raise ProductError(f"{changed.split()[-1]}: differs from commit {commit:.12}; commit first")
    return commit


def _up_to_date(results: Path, plans: Iterable[Path]) -> list[str]:
    """Files for the record that Snakemake would not make anew; ProductError if others must be."""
    found: dict[str, str] = {}
    for plan in plans:
        for row in csv.DictReader(plan.read_text(encoding="utf-8").splitlines(), delimiter="\t"):
            path = Path(row["output_file"])
            if path.is_relative_to(results):
                found[path.relative_to(results).as_posix()] = row["plan"]
    if "runtime.csv" not in found:
        raise ProductError(
            f"{', '.join(map(str, plans)) or 'no plan'}: says nothing of runtime.csv"
        )
    recorded = {name: plan for name, plan in found.items() if RECORDED.fullmatch(name)}
    due = {name for name, plan in recorded.items() if plan != "no update"}
    refused = sorted(name for name in due if not MAY_STAY.fullmatch(name))
    if refused:
        raise ProductError(
            f"{results / refused[0]}: missing, or not what this commit makes (so are"
            f" {len(refused)} files of {len(recorded)}); run the targets of the record first"
        )
    return [name for name in recorded if name not in due]


def _since(name: str, before: Mapping[str, Any]) -> dict[str, str]:
    """Commit and date at which a file of the record before was recorded."""
    earlier = before.get("kept", {}).get(name)
    return earlier or {key: before.get(key, "unknown") for key in ("commit", "date")}


def _require_history(name: str, found: Mapping[str, str]) -> None:
    try:
        git("merge-base", "--is-ancestor", found["commit"], "HEAD")
    except subprocess.CalledProcessError:
        raise ProductError(
            f"{name}: of commit {found['commit']:.12}, which is not in the history;"
            " make it anew, or remove it from the record"
        ) from None


def provenance(results: Path, config: Config) -> dict[str, object]:
    """Where a run comes from and what it took."""
    costs = _costs(results)
    canonical = json.dumps(config.model_dump(), sort_keys=True)
    return {
        "date": date.today().isoformat(),
        "config_sha256": hashlib.sha256(canonical.encode()).hexdigest(),
        "cpu": cpu_model(),
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "versions": {name: metadata.version(name) for name in VERSIONED},
        "threads": {
            "simulation": config.optics.threads,
            "training": config.train.threads,
            "evaluation": config.evaluation.threads,
        },
        "matrix_product_gflops": round(matrix_product_speed(), 1),
        "wall_s": round(_busy_seconds(results / "benchmarks"), 1),
        "on_request_s": {
            name: round(_busy_seconds(results / ON_REQUEST / name), 1)
            for name in TARGETS
            if (results / ON_REQUEST / name).is_dir()
        },
        **_installation(),
        "results_mb": round(_size_mb(results), 1),
        "tests_s": _test_seconds(results / "tests.xml"),
        "cpu_s": round(float(costs.cpu_s.sum()), 1),
        "peak_mb": round(float(costs.peak_mb.max()), 1),
    }


def cpu_model() -> str:
    """Model of the processor as the operating system names it."""
    info = Path("/proc/cpuinfo")
    if info.is_file():
        for line in info.read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def matrix_product_speed(size: int = 1024, repeats: int = 5) -> float:
    """Speed of a float32 matrix product in GFLOP/s, the best of some repeats.

    A yardstick: run times of two machines compare as their yardsticks do.
    """
    a = np.ones((size, size), dtype=np.float32)
    best = float("inf")
    for _ in range(repeats):
        start = time.perf_counter()
        a @ a
        best = min(best, time.perf_counter() - start)
    return 2.0 * size**3 / best / 1e9


def _busy_seconds(benchmarks: Path) -> float:
    """Wall time during which at least one job ran; a later visit adds its own time only."""
    files = benchmarks.rglob("*.tsv")
    ends = ((p.stat().st_mtime, np.nan_to_num(_cost(p, "s")[0])) for p in files)
    spans = sorted((end - float(seconds), end) for end, seconds in ends)
    busy, until = 0.0, float("-inf")
    for start, end in spans:
        busy += max(0.0, end - max(start, until))
        until = max(until, end)
    return busy


def _installation() -> dict[str, float]:
    """Time and disk of the environment that `make` created, as its files tell."""
    environment = Path(sys.prefix)
    start, end = environment / "pyvenv.cfg", environment / ".complete"
    if not (start.is_file() and end.is_file()):
        return {}
    seconds = end.stat().st_mtime - start.stat().st_mtime
    return {"install_s": round(seconds, 1), "environment_mb": round(_size_mb(environment), 1)}


def _size_mb(folder: Path) -> float:
    files = (path for path in folder.rglob("*") if path.is_file() and not path.is_symlink())
    return sum(path.stat().st_size for path in files) / 1e6


def _test_seconds(report: Path) -> float | None:
    """Wall time of the last `make test`, from its JUnit report."""
    if not report.is_file():
        return None
    try:
        suite = ElementTree.parse(report).getroot().find("testsuite")
    except ElementTree.ParseError as error:
        print(f"{report}: damaged ({error}); left out", file=sys.stderr, flush=True)
        return None
    return None if suite is None else round(float(suite.get("time", "nan")), 1)
