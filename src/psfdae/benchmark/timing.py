"""How long something takes, and on which machine."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import metadata
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

VERSIONED = ("psfdae", "numpy", "scipy", "torch", "numexpr", "poppy", "hcipy")
"""Packages whose versions can change a time; recorded where they are installed."""

THREAD_VARIABLES = (
    *("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS"),
)


@dataclass(frozen=True)
class Timing:
    """Time of one call in seconds: median and quartiles of some repeats."""

    median_s: float
    low_s: float
    high_s: float
    repeats: int

    @classmethod
    def of(cls, seconds: np.ndarray) -> Timing:
        """Median and quartiles of repeats, `seconds` of shape (n,)."""
        low, median, high = np.percentile(seconds, [25, 50, 75])
        return cls(float(median), float(low), float(high), len(seconds))

    def per(self, parts: int) -> Timing:
        """The same for one of equal parts of the call."""
        seconds = (s / parts for s in (self.median_s, self.low_s, self.high_s))
        return Timing(*seconds, self.repeats)


def time_calls(function: Callable[[], Any], repeats: int, calls: int = 1) -> Timing:
    """Time a callable after one call to warm up.

    Parameters
    ----------
    function : callable without arguments
    repeats : int
        Independent timings.
    calls : int
        Calls within a timing, for functions that are too fast for the clock.

    Raises
    ------
    ValueError
        If `repeats` or `calls` is below 1.
    """
    if repeats < 1 or calls < 1:
        raise ValueError(f"repeats = {repeats}, calls = {calls}: must be at least 1")
    function()
    seconds = np.empty(repeats)
    for i in range(repeats):
        start = time.perf_counter()
        for _ in range(calls):
            function()
        seconds[i] = (time.perf_counter() - start) / calls
    return Timing.of(seconds)


def time_in_rounds(
    builders: Sequence[Callable[[], Callable[[], Any]]], repeats: int
) -> list[Timing]:
    """Time callables in turn, each once per round, so that their ratios hold.

    A machine that others share is slower for seconds at a time. Rounds spread the
    repeats of every callable over the whole run, so that all meet the same machine.

    Parameters
    ----------
    builders : callables
        Each sets up what is timed and warms it up, anew in every round.
    repeats : int
        Rounds.

    Raises
    ------
    ValueError
        If `repeats` is below 1.
    """
    if repeats < 1:
        raise ValueError(f"repeats = {repeats}: must be at least 1")
    seconds = np.empty((repeats, len(builders)))
    for i in range(repeats):
        for j, build in enumerate(builders):
            function = build()
            start = time.perf_counter()
            function()
            seconds[i, j] = time.perf_counter() - start
    return [Timing.of(column) for column in seconds.T]


def in_fresh_process(threads: int, function: Callable[..., Any], *arguments: Any) -> Any:
    """Result of a module-level function that runs in an interpreter of its own.

    The idle threads of one linear algebra library spin and slow those of
    another, so numpy and torch are never timed in the same process; and a
    library that has started with some threads does not always obey a new number.

    Parameters
    ----------
    threads : int
        What the process finds in the environment.
    """
    variables = dict.fromkeys(THREAD_VARIABLES, str(threads))
    pool = ProcessPoolExecutor(1, mp_context=get_context("spawn"))
    with _environment(variables), pool:
        return pool.submit(function, *arguments).result()


@contextmanager
def _environment(variables: dict[str, str]) -> Iterator[None]:
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def call_all(jobs: Sequence[tuple[Callable[..., Any], tuple[Any, ...]]]) -> list[Any]:
    """Results of functions with their arguments, one after the other."""
    return [function(*arguments) for function, arguments in jobs]


def use_threads(backend: str, threads: int) -> None:
    """Let a backend compute on this many threads, and numpy on one beside torch."""
    from threadpoolctl import threadpool_limits

    if backend == "torch":
        import torch

        torch.set_num_threads(threads)
    threadpool_limits(1 if backend == "torch" else threads, user_api="blas")


def machine() -> dict[str, str]:
    """CPU, cores, load before the timings, and versions, as text by name."""
    described = {
        "cpu": cpu_model(),
        "cores": str(os.cpu_count()),
        "load before": f"{os.getloadavg()[0]:.2f}" if hasattr(os, "getloadavg") else "unknown",
        "python": platform.python_version(),
    }
    for name in VERSIONED:
        try:
            described[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return described


def cpu_model() -> str:
    """Model of the processor as the operating system names it."""
    info = Path("/proc/cpuinfo")
    if info.is_file():
        for line in info.read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()
