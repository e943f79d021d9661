"""What runs far past one machine cost: lines through measured costs, and what breaks first."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from psfdae.benchmark.scaling import PowerLaw

HOUR = 3600.0
GB = 1e9
MB = 1e6


class CostError(ValueError):
    """The measurements do not allow a prediction; the message says why."""


@dataclass(frozen=True)
class Line:
    """A cost with a fixed part and a part per unit: y = fixed + slope · x, both at least 0."""

    fixed: float
    slope: float

    def __call__(self, x: float) -> float:
        """Cost of x units."""
        return self.fixed + self.slope * x

    def reaches(self, limit: float) -> float:
        """Units at which the cost is `limit`; infinite if it never is, 0 if it always is."""
        if limit <= self.fixed:
            return 0.0
        return (limit - self.fixed) / self.slope if self.slope > 0 else np.inf


def fit_line(x: np.ndarray, y: np.ndarray) -> Line:
    """Least squares of relative deviations, so that small and large sizes count alike.

    Unlike a power law, it does not carry the fixed part of small sizes on to large ones.

    Parameters
    ----------
    x, y : ndarray, shape (n,)
        Sizes and costs, positive, of at least two different sizes.

    Raises
    ------
    CostError
        If there are fewer sizes or a value is not positive.
    """
    x, y = np.asarray(x, float), np.asarray(y, float)
    if np.unique(x).size < 2 or not (x > 0).all() or not (y > 0).all():
        raise CostError(f"no line through sizes {x.tolist()} and costs {y.tolist()}")
    design = np.stack([1.0 / y, x / y], axis=1)
    fixed, slope = np.linalg.lstsq(design, np.ones(x.size), rcond=None)[0]
    if fixed < 0:
        return Line(0.0, float((x / y).sum() / ((x / y) ** 2).sum()))
    if slope < 0:
        return Line(float((1.0 / y).sum() / (1.0 / y**2).sum()), 0.0)
    return Line(float(fixed), float(slope))


@dataclass(frozen=True)
class Stage:
    """Costs of a stage over the number of stars it is given.

    Attributes
    ----------
    seconds, memory_bytes, storage_bytes : Line
        CPU time of a job with one CPU, its largest memory, what it leaves on disk.
    """

    seconds: Line
    memory_bytes: Line
    storage_bytes: Line


@dataclass(frozen=True)
class Site:
    """Limits of a cluster. The defaults are common ones, not those of a certain cluster.

    Attributes
    ----------
    walltime_h, memory_gb : float
        Longest run and largest memory of a job.
    storage_tb : float
        Space on the shared file system.
    files : int
        Number of files on it.
    array_tasks : int
        Tasks of a job array; SLURM's default MaxArraySize of 1001 allows 1000.
    patience_s : float
        How long a dry run may take.
    """

    walltime_h: float = 24.0
    memory_gb: float = 8.0
    storage_tb: float = 10.0
    files: int = 1_000_000
    array_tasks: int = 1000
    patience_s: float = 3600.0


@dataclass(frozen=True)
class Planning:
    """What Snakemake itself costs over the number of models or points in one DAG.

    Attributes
    ----------
    seconds : PowerLaw
        A dry run of everything.
    start_s : Line
        What a job pays before its own command: the workflow is read again.
    memory_bytes : Line
        Memory of the dry run.
    jobs : mapping of str to Line
        Jobs by rule: those that are there once, and those per unit.
    """

    seconds: PowerLaw
    start_s: Line
    memory_bytes: Line
    jobs: Mapping[str, Line]


@dataclass(frozen=True)
class Footprint:
    """Files of one trained network with its tables, figures, logs and records."""

    files: float
    storage_bytes: float


def stars_per_job(stages: list[Stage], site: Site) -> float:
    """Largest power of ten of stars whose job takes half of what the site allows.

    Raises
    ------
    CostError
        If not even one star fits.
    """
    most = min(
        min(
            stage.seconds.reaches(site.walltime_h * HOUR / 2),
            stage.memory_bytes.reaches(site.memory_gb * GB / 2),
        )
        for stage in stages
    )
    if most < 1:
        raise CostError(f"half of {site.walltime_h} h and {site.memory_gb} GB hold no star")
    return float(10.0 ** np.floor(np.log10(most)))


def count_per_dag(planning: Planning, start_s: float) -> float:
    """Largest power of ten of models or points in one DAG that start a job within a time.

    Never below one: then every start takes longer, whatever is done.
    """
    most = max(planning.start_s.reaches(start_s), 1.0)
    return float(10.0 ** np.floor(np.log10(min(most, 1e12))))


def step(
    case: str, rule: str, jobs: float, seconds: float, storage: float, memory: float
) -> dict[str, Any]:
    """A row of the plan: jobs of one kind, with one CPU each.

    Parameters
    ----------
    case, rule : str
    jobs : float
    seconds, storage, memory : float
        CPU time, bytes on disk and bytes of memory of one of them.
    """
    return {
        "case": case,
        "rule": rule,
        "jobs": int(np.ceil(jobs)),
        "core_h": jobs * seconds / HOUR,
        "storage_gb": jobs * storage / GB,
        "longest_h": seconds / HOUR,
        "memory_gb": memory / GB,
    }


def submission(row: Mapping[str, Any], home: frozenset[str], start_s: float) -> str:
    """How jobs of a row are best handed in.

    Returns
    -------
    str
        "home" (beside snakemake), "single", "array" or, where starting a job takes
        more than a tenth of its time, "group"; "" for what Snakemake adds.
    """
    if row["rule"] == "snakemake":
        return ""
    if row["rule"] in home:
        return "home"
    if row["jobs"] == 1:
        return "single"
    return "group" if row["longest_h"] * HOUR < 10.0 * start_s else "array"


def stars_case(amount: float, stages: Mapping[str, Stage], site: Site, train: Stage, fit: float):
    """Plan of simulating many stars and predicting their PSFs with one network.

    Parameters
    ----------
    amount : float
        Stars.
    stages : mapping with "simulate" and "predict"
    site : Site
    train : Stage
        The whole training, over the stars that it is given.
    fit : float
        Stars of the training.

    Returns
    -------
    list of dict
        Rows as of `step`.
    """
    share = min(amount, stars_per_job([stages["simulate"], stages["predict"]], site))
    jobs = amount / share
    rows = [step("stars", "train", 1, *_costs(train, fit))]
    rows += [
        step("stars", rule, jobs, *_costs(stages[name], share))
        for rule, name in (("stars", "simulate"), ("predict", "predict"))
    ]
    return rows


def dag_case(
    case: str, amount: float, planning: Planning, costs: Mapping[str, tuple[float, float, float]]
) -> list[dict[str, Any]]:
    """Plan of many models, or many points of a sweep, from the jobs of their DAG.

    Parameters
    ----------
    case : str
    amount : float
        Models or points.
    planning : Planning
    costs : mapping of rule to (seconds, bytes on disk, bytes of memory) of one job
    """
    rows = []
    for rule, line in planning.jobs.items():
        jobs = float(np.rint(line(amount)))
        if jobs >= 1 and rule in costs:
            rows.append(step(case, rule, jobs, *costs[rule]))
    return rows


def snakemake_row(case: str, jobs: float, amount: float, planning: Planning) -> dict[str, Any]:
    """What Snakemake adds when `amount` models or points are in one DAG."""
    row = step(case, "snakemake", jobs, planning.start_s(amount), 0.0, 0.0)
    return {**row, "memory_gb": planning.memory_bytes(amount) / GB}


def _costs(stage: Stage, stars: float) -> tuple[float, float, float]:
    return stage.seconds(stars), stage.storage_bytes(stars), stage.memory_bytes(stars)


def stars_limits(amount: float, stages: Mapping[str, Stage], site: Site) -> list[dict[str, Any]]:
    """Numbers of stars at which a stage that takes them all in one job fails."""
    rows = []
    for name, stage in stages.items():
        time = stage.seconds.reaches(site.walltime_h * HOUR)
        rows.append(_limit("stars", name, "walltime", f"{site.walltime_h:g} h", time, amount))
        memory = stage.memory_bytes.reaches(site.memory_gb * GB)
        rows.append(_limit("stars", name, "memory", f"{site.memory_gb:g} GB", memory, amount))
    per_star = sum(stages[name].storage_bytes.slope for name in ("simulate", "predict"))
    room = site.storage_tb * 1e12 / per_star
    return [*rows, _limit("stars", "all", "storage", f"{site.storage_tb:g} TB", room, amount)]


def dag_limits(
    case: str, amount: float, planning: Planning, each: Footprint, work_s: float, site: Site
) -> list[dict[str, Any]]:
    """Numbers of models or points in one DAG at which something fails.

    Parameters
    ----------
    case, amount, planning
        As of `dag_case`.
    each : Footprint
        Of one model or point.
    work_s : float
        Mean CPU time of its jobs: where a start takes as long, half of the cluster waits.
    site : Site
    """
    found = [
        (
            "snakemake",
            "dry run",
            f"{site.patience_s / 60:g} min",
            planning.seconds.reaches(site.patience_s),
        ),
        ("snakemake", "start of a job", f"{work_s:.3g} s", planning.start_s.reaches(work_s)),
        (
            "snakemake",
            "memory",
            f"{site.memory_gb:g} GB",
            planning.memory_bytes.reaches(site.memory_gb * GB),
        ),
        ("all", "files", f"{site.files}", site.files / each.files),
        ("all", "storage", f"{site.storage_tb:g} TB", site.storage_tb * 1e12 / each.storage_bytes),
    ]
    return [_limit(case, *entry, amount) for entry in found]


def _limit(
    case: str, where: str, limit: str, allowed: str, reached_at: float, asked: float
) -> dict[str, Any]:
    return {
        "case": case,
        "where": where,
        "limit": limit,
        "allowed": allowed,
        "reached_at": reached_at,
        "asked": asked,
        "breaks": "yes" if reached_at < asked else "no",
    }
