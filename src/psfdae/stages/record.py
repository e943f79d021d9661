"""Stages `runtime` and `reference`: what a run cost, and the run of record."""

from __future__ import annotations

import hashlib
import json
import os
import platform
import shutil
import subprocess
import time
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from psfdae.files import ProductError, write_text

VERSIONED = ("psfdae", "numpy", "scipy", "torch", "scikit-image", "scikit-learn", "minisom")
"""Packages whose versions can change a number; recorded with the run."""


def runtime(results: Path, out: Path) -> None:
    """Cost of the last run of every job, from Snakemake's benchmark files.

    Parameters
    ----------
    results : folder that holds `benchmarks/<rule>/<wildcards>.tsv`
    out : CSV, columns rule, wildcards, wall_s, cpu_s, peak_mb
    """
    write_text(out, _costs(results).to_csv(index=False, float_format="%.6g"))


def _costs(results: Path):  # type: ignore[no-untyped-def]
    import pandas as pd

    folder = results / "benchmarks"
    rows = []
    for path in sorted(folder.rglob("*.tsv")):
        rule, *wildcards = path.relative_to(folder).with_suffix("").parts
        job = pd.read_csv(path, sep="\t", na_values="-").iloc[-1]
        rows.append((rule, "/".join(wildcards), job["s"], job["cpu_time"], job["max_rss"]))
    return pd.DataFrame(rows, columns=["rule", "wildcards", "wall_s", "cpu_s", "peak_mb"])


def reference(results: Path, config: Any, files: Sequence[Path], out: Path) -> None:
    """Replace the run of record by the tables and figures of a finished run.

    Parameters
    ----------
    results : folder of the run
    config : whole config of the run's default dataset
    files : tables and figures to keep, all inside `results`
    out : folder of the run of record; replaced as a whole

    Raises
    ------
    ProductError
        If a file is missing.
    """
    missing = [path for path in files if not path.is_file()]
    if missing:
        raise ProductError(f"{missing[0]}: missing; run `make reproduce` first")
    staging = out.with_name(f".{out.name}.new")
    shutil.rmtree(staging, ignore_errors=True)
    for path in files:
        target = staging / path.relative_to(results)
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, target)
    text = json.dumps(provenance(results, config), indent=2, sort_keys=True)
    write_text(staging / "provenance.json", text + "\n")
    shutil.rmtree(out, ignore_errors=True)
    staging.rename(out)


def provenance(results: Path, config: Any) -> dict[str, Any]:
    """Where a run comes from and what it took.

    The wall time counts from the start of the first job to the end of the last.
    """
    costs = _costs(results)
    ends = {path: path.stat().st_mtime for path in (results / "benchmarks").rglob("*.tsv")}
    starts = [end - _seconds(path) for path, end in ends.items()]
    canonical = json.dumps(config.model_dump(), sort_keys=True)
    return {
        "commit": git_commit(),
        "config_sha256": hashlib.sha256(canonical.encode()).hexdigest(),
        "cpu": _cpu(),
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "versions": {name: metadata.version(name) for name in VERSIONED},
        "threads": {
            "simulation": config.optics.threads,
            "training": config.train.threads,
            "evaluation": config.evaluation.threads,
        },
        "matrix_product_gflops": round(matrix_product_speed(), 1),
        "wall_s": round(max(ends.values()) - min(starts), 1),
        "cpu_s": round(float(costs.cpu_s.sum()), 1),
        "peak_mb": round(float(costs.peak_mb.max()), 1),
    }


def git_commit() -> str:
    """Commit of the source tree, with `-dirty` if files differ; "unknown" outside git."""
    source = Path(__file__).resolve().parent
    command = ["git", "-C", str(source), "describe", "--always", "--abbrev=40", "--dirty"]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    return result.stdout.strip() or "unknown"


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


def _seconds(benchmark: Path) -> float:
    return float(benchmark.read_text().splitlines()[-1].split("\t")[0])


def _cpu() -> str:
    info = Path("/proc/cpuinfo")
    if info.is_file():
        for line in info.read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()
