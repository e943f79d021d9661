"""Settings of the propagation kernel, their times and their errors."""

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import product
from typing import Any

import numpy as np

from measure import pareto, time_in_rounds, use_threads, yes
from psfdae.optics.propagation import StampPropagator
from psfdae.optics.pupil import SamplingError
from psfdae.stars.framing import normalise_flux
from psfdae.threads import side_by_side
from scenes import Case, pupil_of

COARSE_SAMPLES = (94, 126, 158, 190)  # tried below the ladder; with guard cells multiples of 32
BATCHES = (1, 4, 16, 64)  # stamps per call
PRECISIONS = ("complex64", "complex128")


@dataclass(frozen=True)
class Setting:
    """One way to run a method: `nodes` are sub-samples per pixel where it has no nodes."""

    samples: int
    nodes: int
    precision: str
    backend: str
    threads: int
    batch: int


def candidate_samples(optics, thorough):
    """Grid sizes N to try: the configured ladder and coarser ones, ascending."""
    coarse = [n for n in COARSE_SAMPLES if n < optics.pupil_samples[0]]
    return (*(coarse if thorough else coarse[-1:]), *optics.pupil_samples)


def candidate_nodes(optics, thorough):
    """Numbers of nodes to try around the configured one, which is among them."""
    lowest = max(1, optics.nodes - 1)
    return tuple(range(lowest, optics.nodes + 3)) if thorough else (optics.nodes, optics.nodes + 2)


def batch_of(optics, benchmark):
    """Stamps per call: the configured batch, but no more than are timed."""
    return min(optics.batch, benchmark.stamps)


def configured_setting(optics, benchmark, samples):
    """The setting of the config for a wavefront that is given N `samples`."""
    rest = (optics.backend, optics.threads, batch_of(optics, benchmark))
    return Setting(samples, optics.nodes, optics.precision, *rest)


def kernel_settings(optics, benchmark, samples, backend):
    """Settings that are timed for a wavefront that is given N `samples`.

    The whole product of grid sizes, nodes and precisions at the configured batch and all
    threads; then batches and threads around the setting in use.
    """
    used = replace(configured_setting(optics, benchmark, samples), backend=backend)
    grids = candidate_samples(optics, benchmark.peers)
    nodes = candidate_nodes(optics, benchmark.peers)
    threads, batches = sorted({1, benchmark.threads}), BATCHES if benchmark.peers else (1,)
    rest = (backend, benchmark.threads, used.batch)
    chosen = [Setting(*point, *rest) for point in product(grids, nodes, PRECISIONS)]
    for precision, t, batch in product(PRECISIONS, threads, batches):
        chosen.append(replace(used, precision=precision, threads=t, batch=batch))
    return list(dict.fromkeys([*chosen, used]))


@dataclass(frozen=True)
class Trial:
    """One setting of one method for one wavefront, ready to be timed.

    `stamp`, shape (d, d), is what it makes, of sum 1. `build` sets up and warms up what the
    clock sees: a callable that propagates `batches` batches.
    """

    case: Case
    method: str
    setting: Setting
    stamp: np.ndarray
    build: Callable[[], Callable[[], Any]]
    batches: int


def kernel_trials(cases, settings, stamps):
    """Trials of the kernel with at least so many stamps per timing, a list of settings per case.

    Settings that a wavefront refuses (its grid would alias) are left out.
    """
    trials = []
    for case, chosen in zip(cases, settings, strict=True):
        for setting in chosen:
            try:
                kernel, opd = _kernel_of(case, replace(setting, batch=1))
            except SamplingError:
                continue
            stamp = normalise_flux(kernel(opd, case.offset_px).astype(np.float64))[0][0]
            batches = max(setting.threads, stamps // setting.batch)
            build = partial(_side_by_side, case, setting, batches)
            trials.append(Trial(case, "kernel", setting, stamp, build, batches))
    return trials


def _kernel_of(case, setting):
    pupil = pupil_of(setting.samples, case.obscuration)
    settings: Any = (setting.nodes, setting.precision, setting.backend)
    kernel = StampPropagator(pupil, case.stamp_px, case.pixel, *settings)
    return kernel, case.batch(pupil, setting.batch, kernel.real_dtype)


def _side_by_side(case, setting, batches):
    """Numpy's batches run side by side as in a scene, torch's on threads of its own."""
    numpy = setting.backend == "numpy"
    use_threads(setting.backend, 1 if numpy else setting.threads)
    kernel, opd = _kernel_of(case, setting)
    offset = np.repeat(case.offset_px, setting.batch, axis=0)
    threads = setting.threads if numpy else 1

    def propagate(count):
        side_by_side(lambda _: kernel(opd, offset), range(count), threads)

    propagate(threads)
    return partial(propagate, batches)


def time_trials(trials, repeats):
    """Rows of trials, timed in rounds; times are those of one stamp, whatever ran beside it."""
    rows = []
    timed = time_in_rounds([trial.build for trial in trials], repeats)
    for trial, seconds in zip(trials, timed, strict=True):
        case, stamps = trial.case, trial.batches * trial.setting.batch
        low, median, high = 1e3 * np.percentile(seconds, [25, 50, 75]) / stamps
        difference = trial.stamp - case.truth
        mse = float((difference**2).mean())
        row = {"scene": case.scene, "aberration": case.aberration, "method": trial.method}
        row |= {**asdict(trial.setting), "repeats": repeats}
        row |= {"time_ms": median, "time_ms_low": low, "time_ms_high": high}
        row |= {"error_peak": np.abs(difference).max() / case.truth.max(), "mse": mse}
        rows.append({**row, "budget": case.budget, "within_budget": yes(mse <= case.budget)})
    return rows


def finish(rows, used):
    """The table with its Pareto fronts and the settings in use, by aberration."""
    import pandas as pd

    table = pd.DataFrame(rows).assign(pareto="no")
    for _, group in table.groupby(["scene", "aberration"]):
        front = pareto(group["time_ms"].to_numpy(), group["mse"].to_numpy())
        table.loc[group.index[front], "pareto"] = "yes"
    in_use = [
        row["method"] == "kernel" and asdict(used[row["aberration"]]).items() <= row.items()
        for row in rows
    ]
    return table.assign(used=np.where(in_use, "yes", "no"))


def kernel_times(table, optics, benchmark):
    """Time of a stamp in ms by (samples, nodes, precision), mean over the cases.

    Backend and batch are the configured ones, threads the benchmark's.
    """
    wanted = {"method": "kernel", "backend": optics.backend, "threads": benchmark.threads}
    wanted["batch"] = batch_of(optics, benchmark)
    rows = table[(table[list(wanted)] == list(wanted.values())).all(axis=1)]
    return dict(rows.groupby(["samples", "nodes", "precision"])["time_ms"].mean())
