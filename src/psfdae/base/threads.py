"""Batches in parallel threads: products of numpy and scipy release Python's lock.

Inputs: a function and batches. Outputs: results in the order of the batches, the same for any
number of threads. The number of threads of the linear algebra itself changes the last digits of
results; therefore it is fixed here as well.
"""

from __future__ import annotations

import os
import sys
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache
from typing import TypeVar

from psfdae.base.types import ThreadpoolController

Batch = TypeVar("Batch")
Result = TypeVar("Result")


def run_parallel(
    work: Callable[[Batch], Result], batches: Iterable[Batch], threads: int
) -> list[Result]:
    """Return the results of `work` for every batch, in the order of the batches.

    The linear algebra should use one thread meanwhile: for small matrices, one core
    per batch is faster than two cores per product. Errors of `work` are raised.

    Parameters
    ----------
    work : callable of a batch
        Function that may be called from several threads at once.
    batches : iterable
        Arguments of `work`; all are in memory at once.
    threads : int
        Number of threads, ≥ 1; with one, everything runs in the caller's thread.
    """
    # One thread needs no pool.
    if threads == 1:
        return [work(batch) for batch in batches]
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(work, batches))


def run_ordered(
    work: Callable[[Batch], Result], batches: Iterable[Batch], threads: int
) -> Iterator[tuple[Batch, Result]]:
    """Yield batches with their results, in the order of the batches, few of them in memory.

    The caller's thread takes batches as they are needed: at most `threads` + 1 are in
    work or waiting. Errors of `batches` or `work` are raised, and no further batch begins.

    Parameters
    ----------
    work : callable of a batch
        Function that may be called from several threads at once.
    batches : iterable
        Arguments of `work`, such as a generator that reads a large file.
    threads : int
        Number of threads, ≥ 1.

    Yields
    ------
    batch, result
        Argument and result of `work`.
    """
    # Batches whose results have not been yielded, in their order.
    waiting: deque[tuple[Batch, Future[Result]]] = deque()
    with ThreadPoolExecutor(threads) as pool:
        try:
            # One batch more than there are threads, so that no thread is idle.
            for batch in batches:
                waiting.append((batch, pool.submit(work, batch)))
                if len(waiting) > threads:
                    first, future = waiting.popleft()
                    yield first, future.result()
            # The remaining results, after the last batch was submitted.
            while waiting:
                first, future = waiting.popleft()
                yield first, future.result()
        finally:
            # The caller may have stopped before the last batch.
            for _, future in waiting:
                future.cancel()


def available_cores() -> int:
    """Return the number of cores that this process may use."""
    # The scheduler's affinity, where the system has it, can be below the number of cores.
    has_affinity = hasattr(os, "sched_getaffinity")
    return len(os.sched_getaffinity(0)) if has_affinity else os.cpu_count() or 1


@contextmanager
def fix_threads(threads: int) -> Iterator[None]:
    """Run linear algebra with `threads` threads inside the block, then restore their number.

    It is restored even if a fit inside the block has changed it. The last digits of results depend
    on the number of threads.
    """
    from threadpoolctl import threadpool_limits

    # torch is not imported only for this: it takes seconds, and may be loaded inside the block.
    torch = sys.modules.get("torch")
    threads_before = torch.get_num_threads() if torch else available_cores()
    with threadpool_limits(threads):
        try:
            yield
        finally:
            if torch := sys.modules.get("torch"):
                torch.set_num_threads(threads_before)


def limit_threads(threads: int) -> None:
    """Set the number of threads of the linear algebra; it overrides environment variables.

    The last digits of results depend on it, therefore it is a setting.
    """
    from threadpoolctl import threadpool_limits

    threadpool_limits(threads)


@contextmanager
def use_one_thread_each() -> Iterator[None]:
    """Limit linear algebra, and networks if torch is loaded, to one thread per calling thread."""
    # torch has its own threads, which the limit of the libraries does not change.
    torch = sys.modules.get("torch")
    threads_before = torch.get_num_threads() if torch else 0
    if torch:
        torch.set_num_threads(1)
    try:
        with _libraries().limit(limits=1, user_api="blas"):
            yield
    finally:
        if torch:
            torch.set_num_threads(threads_before)


@cache
def _libraries() -> ThreadpoolController:
    """Return the libraries of linear algebra that are loaded."""
    # Cached, because the search takes milliseconds.
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()
