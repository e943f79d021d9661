"""Stages `runtime` and `reference`: what a run cost, and the run of record."""

from __future__ import annotations

import hashlib
import json
import os
import platform
import shutil
import sys
import time
from collections.abc import Iterable, Mapping
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any
from xml.etree import ElementTree

import numpy as np

from psfdae.cli import File, Folder, command
from psfdae.files import ProductError, write_csv, write_text
from psfdae.source import git_commit

if TYPE_CHECKING:
    from psfdae.configuration.schema import Config

VERSIONED = ("psfdae", "numpy", "scipy", "torch", "scikit-learn", "minisom")
"""Packages whose versions can change a number; recorded with the run."""

COSTS = (
    *("wall_s", "cpu_s", "peak_mb", "on_request_s"),
    *("results_mb", "tests_s", "matrix_product_gflops"),
)
"""What provenance says of the cost of a run."""

ON_REQUEST = "benchmarks_on_request"
"""Folder with the cost of the targets that are not part of `make reproduce`."""


@command("runtime")
def runtime(
    results: Annotated[Folder, "Folder of a run."],
    out: Annotated[File, "CSV with the cost of every job."],
) -> None:
    """Collect wall time, CPU time and memory of a run's jobs."""
    write_csv(out, _costs(results), 6)


def _costs(results: Path):  # type: ignore[no-untyped-def]
    import pandas as pd

    folder = results / "benchmarks"
    rows = []
    for path in sorted(folder.rglob("*.tsv")):
        rule, *wildcards = path.relative_to(folder).with_suffix("").parts
        rows.append((rule, "/".join(wildcards), *_cost(path, "s", "cpu_time", "max_rss")))
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


@command("reference")
def reference(
    results: Annotated[Folder, "Folder of a finished run."],
    out: Annotated[Folder, "Folder of the run of record."],
    files: Annotated[tuple[File, ...], {"argument": True}],
    keep: Annotated[
        tuple[File, ...], "File, relative to the results, that may stay from the record before."
    ] = (),
) -> None:
    """Replace the committed run of record by a finished run.

    Provenance names each file that stays with the commit that it was recorded at. If `runtime.csv`
    stays, so does what provenance says of the run's cost.
    """
    from psfdae.configuration.compose import load

    missing = [path for path in files if not path.is_file()]
    if missing:
        raise ProductError(f"{missing[0]}: missing; run `make reproduce` first")
    staging = out.with_name(f".{out.name}.new")
    shutil.rmtree(staging, ignore_errors=True)
    renewable = [*files, *(results / path for path in keep if (results / path).is_file())]
    renewed = {path.relative_to(results): path for path in renewable}
    kept = {path: out / path for path in keep if path not in renewed and (out / path).is_file()}
    for name, path in (renewed | kept).items():
        target = staging / name
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, target)
    last = out / "provenance.json"
    before = json.loads(last.read_text()) if last.is_file() else {}
    described = provenance(results, load()) | {"kept": _kept_since(before, kept)}
    if Path("runtime.csv") in kept:  # what a run costs is said by one run alone
        described |= {key: before[key] for key in COSTS if key in before}
    text = json.dumps(described, indent=2, sort_keys=True)
    write_text(staging / "provenance.json", text + "\n")
    shutil.rmtree(out, ignore_errors=True)
    staging.rename(out)


def _kept_since(before: Mapping[str, Any], kept: Iterable[Path]) -> dict[str, str]:
    """Commit at which each kept file was recorded."""
    earlier, last = before.get("kept", {}), before.get("commit", "unknown")
    return {str(path): earlier.get(str(path), last) for path in kept}


def provenance(results: Path, config: Config) -> dict[str, Any]:
    """Where a run comes from and what it took."""
    costs = _costs(results)
    canonical = json.dumps(config.model_dump(), sort_keys=True)
    return {
        "commit": git_commit(),
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
            target.name: round(_busy_seconds(target), 1)
            for target in sorted((results / ON_REQUEST).glob("*/"))
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
