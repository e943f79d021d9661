"""Time and error of the propagation kernel over its settings, and of its peers."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import astuple, dataclass, replace
from functools import partial
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np

from psfdae.benchmark.cases import Case, errors, pupil_of
from psfdae.benchmark.timing import Timing, time_in_rounds, use_threads
from psfdae.benchmark.training import pareto
from psfdae.configuration.schema import Benchmark, Optics
from psfdae.optics.propagation import StampPropagator
from psfdae.optics.sampling import SamplingError
from psfdae.stars.framing import normalise_flux
from psfdae.threads import side_by_side

if TYPE_CHECKING:
    import pandas as pd

COARSE_SAMPLES = (94, 126, 158, 190)
"""Pupil samples tried below the configured ladder; with guard cells multiples of 32."""

BATCHES = (1, 4, 16, 64)
"""Stamps per call whose effect on the time is shown."""

PRECISIONS = ("complex64", "complex128")

COLUMNS = (
    *("scene", "aberration", "method", "samples", "nodes", "precision", "backend", "threads"),
    *("batch", "repeats", "time_ms", "time_ms_low", "time_ms_high", "error_peak", "mse"),
    *("budget", "within_budget", "pareto", "used"),
)
"""Columns of the table of propagations; times are per stamp."""


@dataclass(frozen=True)
class Setting:
    """One way to run the kernel."""

    samples: int
    nodes: int
    precision: str
    backend: str
    threads: int
    batch: int


def candidate_samples(optics: Optics, thorough: bool) -> tuple[int, ...]:
    """Grid sizes N to try: the configured ladder and coarser ones, ascending."""
    coarse = [n for n in COARSE_SAMPLES if n < optics.pupil_samples[0]]
    return (*(coarse if thorough else coarse[-1:]), *optics.pupil_samples)


def candidate_nodes(optics: Optics, thorough: bool) -> tuple[int, ...]:
    """Numbers of nodes to try around the configured one, which is among them."""
    lowest = max(1, optics.nodes - 1)
    return tuple(range(lowest, optics.nodes + 3)) if thorough else (optics.nodes, optics.nodes + 2)


def kernel_settings(
    optics: Optics, benchmark: Benchmark, samples: int, backend: str
) -> list[Setting]:
    """Settings of the kernel that are timed for one case.

    The whole product of grid sizes, nodes and precisions at the configured batch
    and all threads; then batches and threads around the setting in use.

    Parameters
    ----------
    optics, benchmark : config groups
    samples : int
        Pupil samples N that the scene gives the wavefront.
    backend : "numpy" or "torch"
    """
    thorough = benchmark.peers
    used = configured_setting(optics, benchmark, samples, backend)
    chosen = [
        Setting(n, q, precision, backend, benchmark.threads, used.batch)
        for n, q, precision in product(
            candidate_samples(optics, thorough), candidate_nodes(optics, thorough), PRECISIONS
        )
    ]
    chosen += [
        Setting(samples, optics.nodes, precision, backend, threads, batch)
        for precision, threads, batch in product(
            PRECISIONS,
            sorted({1, benchmark.threads}),
            BATCHES if thorough else (1,),
        )
    ]
    return list(dict.fromkeys([*chosen, used]))


def batch_of(optics: Optics, benchmark: Benchmark) -> int:
    """Stamps per call: the configured batch, but no more than are timed."""
    return min(optics.batch, benchmark.stamps)


def configured_setting(
    optics: Optics, benchmark: Benchmark, samples: int, backend: str | None = None
) -> Setting:
    """The setting of the config for a wavefront that is given N `samples`."""
    return Setting(
        samples,
        optics.nodes,
        optics.precision,
        optics.backend if backend is None else backend,
        optics.threads,
        batch_of(optics, benchmark),
    )


@dataclass(frozen=True)
class Trial:
    """One setting of one method for one wavefront, ready to be timed.

    Attributes
    ----------
    case : Case
    method : str
    setting : tuple
        The fields of `Setting`, in order.
    stamp : ndarray, shape (d, d)
        What it makes, of sum 1.
    build : callable
        Sets up and warms up what the clock sees: a callable that propagates
        `batches` batches.
    batches : int
    """

    case: Case
    method: str
    setting: tuple[Any, ...]
    stamp: np.ndarray
    build: Callable[[], Callable[[], Any]]
    batches: int


def kernel_trials(
    cases: Sequence[Case], settings: Sequence[Sequence[Setting]], stamps: int
) -> list[Trial]:
    """Trials of the kernel's settings, one list of settings per case.

    Settings that a wavefront refuses (its grid would alias) are left out.

    Parameters
    ----------
    stamps : int
        Stamps per timing, at least.
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
            trials.append(Trial(case, "kernel", astuple(setting), stamp, build, batches))
    return trials


def _kernel_of(case: Case, setting: Setting) -> tuple[StampPropagator, np.ndarray]:
    pupil = pupil_of(setting.samples, case.obscuration)
    kernel = StampPropagator(
        pupil,
        case.stamp_px,
        case.pixel,
        setting.nodes,
        setting.precision,  # type: ignore[arg-type]
        setting.backend,  # type: ignore[arg-type]
    )
    return kernel, case.batch(pupil, setting.batch, kernel.real_dtype)


def _side_by_side(case: Case, setting: Setting, batches: int) -> Callable[[], Any]:
    """Numpy's batches run side by side as in a scene, torch's on threads of its own."""
    numpy = setting.backend == "numpy"
    use_threads(setting.backend, 1 if numpy else setting.threads)
    kernel, opd = _kernel_of(case, setting)
    offset = np.repeat(case.offset_px, setting.batch, axis=0)
    threads = setting.threads if numpy else 1

    def propagate(count: int) -> None:
        side_by_side(lambda _: kernel(opd, offset), range(count), threads)

    propagate(threads)
    return partial(propagate, batches)


def time_trials(trials: Sequence[Trial], repeats: int) -> list[dict[str, Any]]:
    """Rows of trials, timed in rounds; `pareto` and `used` follow when all rows are there."""
    timings = time_in_rounds([trial.build for trial in trials], repeats)
    return [
        _row(trial, timing.per(trial.batches))
        for trial, timing in zip(trials, timings, strict=True)
    ]


def _row(trial: Trial, timing: Timing) -> dict[str, Any]:
    """The row of a trial with the time of one batch, whatever ran beside it."""
    case, batch = trial.case, trial.setting[-1]
    error_peak, mse = errors(trial.stamp, case.truth)
    milliseconds = [1e3 * s / batch for s in (timing.median_s, timing.low_s, timing.high_s)]
    return {
        "scene": case.scene,
        "aberration": case.aberration,
        **dict(zip(COLUMNS[2:9], (trial.method, *trial.setting), strict=True)),
        "repeats": timing.repeats,
        **dict(zip(COLUMNS[10:13], milliseconds, strict=True)),
        "error_peak": error_peak,
        "mse": mse,
        "budget": case.budget,
        "within_budget": yes(mse <= case.budget),
    }


def yes(condition: bool) -> str:
    """How tables say it."""
    return "yes" if condition else "no"


def finish(rows: Iterable[dict[str, Any]], used: dict[str, Setting]) -> pd.DataFrame:
    """The table of propagations with its Pareto fronts and the settings in use.

    Parameters
    ----------
    rows : results of `time_trials`, all of one scene
    used : mapping of aberration to Setting
    """
    import pandas as pd

    table = pd.DataFrame(rows)
    table["pareto"] = "no"
    for _, group in table.groupby(["scene", "aberration"]):
        front = pareto(group["time_ms"].to_numpy(), group["mse"].to_numpy())
        table.loc[group.index[front], "pareto"] = "yes"
    keys = list(Setting.__dataclass_fields__)
    in_use = [
        r.method == "kernel" and tuple(getattr(r, k) for k in keys) == astuple(used[r.aberration])
        for r in table.itertuples()
    ]
    table["used"] = [yes(u) for u in in_use]
    return table[list(COLUMNS)]
