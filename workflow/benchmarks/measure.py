"""How long something takes, how much memory, in which interpreter and on which machine."""

import os
import platform
import resource
import sys
from concurrent.futures import ProcessPoolExecutor
from importlib.metadata import PackageNotFoundError, version
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter, process_time
from timeit import Timer
from unittest.mock import patch

import numpy as np

from psfdae.base.files import write_text
from psfdae.commands.cli import main, stage
from psfdae_paper.configuration.compose import write_settings
from psfdae_paper.source import cpu_model

VERSIONED = ("psfdae", "numpy", "scipy", "torch", "numexpr", "poppy", "hcipy")
"""Packages whose versions can change a time; recorded where they are installed."""

PATIENCE_S = 600.0  # until a process gives up to wait for those beside it
THREAD_VARIABLES = [f"{name}_NUM_THREADS" for name in ("OMP", "OPENBLAS", "MKL", "NUMEXPR")]


def time_in_rounds(builders, repeats):
    """Seconds of callables, shape (callables, repeats), timed in turn so that ratios hold.

    A machine that others share is slower for seconds at a time; rounds spread the repeats of
    every callable over the whole run. Builders set up what is timed and warm it up, anew in
    every round. Processes that run side by side (see `isolate`) begin every timing together.
    """
    return np.array([[_timed(build()) for build in builders] for _ in range(repeats)]).T


_BARRIERS: list = []  # where a process waits for those that run beside it


def _timed(function):
    for barrier in _BARRIERS:
        barrier.wait(timeout=PATIENCE_S)
    return Timer(function).timeit(1)


def _meet(barrier):
    _BARRIERS.append(barrier)


def isolate(threads, function, *arguments, processes=1):
    """Results of a module's function in interpreters of their own with so many threads.

    That of one process as it is, those of several that run side by side as a list.

    Idle threads of one linear algebra library spin and slow those of another, a library that
    has started with some threads does not always obey a new number, and the peak of a
    process's memory never falls.
    """
    context = get_context("spawn")
    meeting = (_meet, (context.Barrier(processes),))
    pool = ProcessPoolExecutor(processes, context, *meeting, max_tasks_per_child=1)
    with patch.dict(os.environ, dict.fromkeys(THREAD_VARIABLES, str(threads))), pool:
        running = [pool.submit(function, *arguments) for _ in range(processes)]
        results = [task.result() for task in running]
    return results if processes > 1 else results[0]


def measure_command(words, out, tree=None):
    """Return the cost of a command of psfdae in this process, run as users run it.

    `words` are its name and options but for `--out`, `tree` the configuration that its groups
    are from, if it reads any. Seconds are `time_s` and `cpu_s`, bytes those of the memory
    before and at most (`resting_b`, `peak_b`) and of new files in the folder (`disk_b`).
    """
    (name, *options), files_before = [*map(str, words), "--out", str(out)], _files(out.parent)
    with TemporaryDirectory() as folder:
        if tree is not None:
            # A command that fits a method reads the groups of the method that it names.
            reads = stage(name).stage.settings.names({"name": options[0]})
            settings = write_settings(Path(folder), name, reads, tree)
            options += ["--config", str(settings)]
        resting, start, start_cpu = _memory("VmRSS", forget=True), perf_counter(), process_time()
        if code := main([*name.split(), *options], standalone_mode=False):
            raise RuntimeError(f"psfdae {name}: ends with {code}")
        cost = {"time_s": perf_counter() - start, "cpu_s": process_time() - start_cpu}
    peak, new = _memory("VmHWM"), _files(out.parent) - files_before
    return cost | {"resting_b": resting, "peak_b": peak, "disk_b": sum(size for *_, size in new)}


def _files(folder):
    """Path, time and size of the files of a folder."""
    paths = ((path, path.stat()) for path in folder.rglob("*") if path.is_file())
    return {(path, about.st_mtime_ns, about.st_size) for path, about in paths}


def _memory(entry, forget=False):
    """Bytes of this process; its peak starts anew if that is to be forgotten (Linux).

    Not by getrusage on Linux: its peak survives exec and so may be the parent's.
    """
    status = Path("/proc/self/status")
    if not status.is_file():
        unit = 1 if sys.platform == "darwin" else 2**10
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit
    if forget:
        Path("/proc/self/clear_refs").write_text("5")
    line = next(x for x in status.read_text().splitlines() if x.startswith(entry + ":"))
    return int(line.split()[1]) * 2**10


def use_threads(backend, threads):
    """Let a backend compute on this many threads, and numpy on one beside torch."""
    from threadpoolctl import threadpool_limits

    if backend == "torch":
        import torch

        torch.set_num_threads(threads)
    threadpool_limits(1 if backend == "torch" else threads, user_api="blas")


def machine():
    """CPU, cores, load before the timings, and versions, as text by name."""
    load = f"{os.getloadavg()[0]:.2f}" if hasattr(os, "getloadavg") else "unknown"
    described = {"cpu": cpu_model(), "cores": str(os.cpu_count()), "load before": load}
    described["python"] = platform.python_version()
    for name in VERSIONED:
        try:
            described[name] = version(name)
        except PackageNotFoundError:
            continue
    return described


def pareto(time, error):
    """Points that no other one beats in both time and error: indices by ascending time."""
    order = np.lexsort((error, time))
    lowest = np.minimum.accumulate(error[order])
    return order[np.r_[True, error[order][1:] < lowest[:-1]]]


def yes(condition):
    """How tables say it."""
    return "yes" if condition else "no"


def write(out, rows, digits=6):
    """Write rows, or a DataFrame, as CSV."""
    import pandas as pd

    write_text(out, pd.DataFrame(rows).to_csv(index=False, float_format=f"%.{digits}g"))
