"""Measurements in processes of their own: nothing leaks from one into another.

The thread pools of numpy, torch and onnxruntime in one process wait actively
and take each other's cores, a thread count once set is not always obeyed when
set again, and the peak of a process's memory never falls.
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
from collections.abc import Callable
from importlib import import_module
from inspect import signature
from pathlib import Path
from typing import Any

THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


class MeasurementError(RuntimeError):
    """A measuring process has failed; the message holds the end of its output."""


def run_isolated(function: Callable[..., Any], threads: int, **arguments: Any) -> Any:
    """Call a module's function in a fresh interpreter.

    A function with a parameter `threads` is told their number.

    Parameters
    ----------
    function : callable
        A function at the top of an importable module.
    threads : int
        Threads of the linear algebra in that process.
    **arguments
        Anything that JSON can carry.

    Returns
    -------
    object
        What the function returns, as JSON carries it.

    Raises
    ------
    MeasurementError
        If the process fails.
    """
    if "threads" in signature(function).parameters:
        arguments["threads"] = threads
    done = subprocess.run(
        [sys.executable, "-m", __name__, f"{function.__module__}:{function.__name__}"],
        input=json.dumps(arguments),
        env={**os.environ, **dict.fromkeys(THREAD_VARIABLES, str(threads))},
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        raise MeasurementError(f"{function.__name__}({arguments}): {done.stderr[-2000:]}")
    # Libraries may print; the result is the last line.
    return json.loads(done.stdout.splitlines()[-1])


def resident_mb() -> float:
    """Memory of this process now, in MB; its peak where the system tells only that."""
    return _status_mb("VmRSS")


def peak_mb() -> float:
    """Largest memory of this process so far (since `forget_peak`), in MB."""
    return _status_mb("VmHWM")


def forget_peak() -> None:
    """Start the peak anew from the present memory, where the system can (Linux)."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return


def _status_mb(entry: str) -> float:
    # Not getrusage on Linux: its peak survives exec and so may be the parent's.
    status = Path("/proc/self/status")
    if status.is_file():
        line = next(x for x in status.read_text().splitlines() if x.startswith(entry + ":"))
        return int(line.split()[1]) / 1024.0
    unit = 2**20 if sys.platform == "darwin" else 2**10
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit


def _main() -> None:
    module, name = sys.argv[1].split(":")
    result = getattr(import_module(module), name)(**json.load(sys.stdin))
    sys.stdout.write(f"\n{json.dumps(result)}\n")


if __name__ == "__main__":
    _main()
