"""Batches side by side in threads: numpy's and scipy's products leave Python's lock.

A function and batches go in, and results come out in the order of the batches, the same for any
number of threads. The number of threads of the linear algebra itself changes last digits, so that
it is fixed here, too.
"""

from __future__ import annotations

import os
import sys
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from threadpoolctl import ThreadpoolController

Batch = TypeVar("Batch")
Result = TypeVar("Result")


def side_by_side(
    work: Callable[[Batch], Result], batches: Iterable[Batch], threads: int
) -> list[Result]:
    """Return the results of `work` for every batch, in the order of the batches.

    The linear algebra should be on one thread meanwhile: on small matrices a core
    per batch does more than two cores per product. What `work` raises is raised.

    Parameters
    ----------
    work : callable of a batch
        Safe to be called from several threads at once.
    batches : iterable
    threads : int
        With one, everything runs in the caller's thread.
    """
    # Without a pool, in the caller's thread.
    if threads == 1:
        return [work(batch) for batch in batches]
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(work, batches))


def in_order(
    work: Callable[[Batch], Result], batches: Iterable[Batch], threads: int
) -> Iterator[tuple[Batch, Result]]:
    """Yield batches with their results, in the order of the batches, few of them in memory.

    Batches are taken as they are needed, by the caller's thread: at most `threads` + 1
    are under way. What `batches` or `work` raises is raised, and nothing new is begun.

    Parameters
    ----------
    work : callable of a batch
        Safe to be called from several threads at once.
    batches : iterable
    threads : int

    Yields
    ------
    batch, result
    """
    waiting: deque[tuple[Batch, Future[Result]]] = deque()
    with ThreadPoolExecutor(threads) as pool:
        try:
            # One batch more than there are threads waits, so that no thread does.
            for batch in batches:
                waiting.append((batch, pool.submit(work, batch)))
                if len(waiting) > threads:
                    first, future = waiting.popleft()
                    yield first, future.result()
            while waiting:
                first, future = waiting.popleft()
                yield first, future.result()
        finally:
            # Not all batches may have been asked for.
            for _, future in waiting:
                future.cancel()


def available_cores() -> int:
    """Cores that this process may use."""
    has_affinity = hasattr(os, "sched_getaffinity")
    return len(os.sched_getaffinity(0)) if has_affinity else os.cpu_count() or 1


@contextmanager
def fixed_threads(threads: int) -> Iterator[None]:
    """Linear algebra on so many threads, and as before afterwards, whatever a fit has set.

    Results depend on their number in the last digits.
    """
    from threadpoolctl import threadpool_limits

    # torch is not imported for this: it takes seconds, and may be loaded within the block.
    torch = sys.modules.get("torch")
    threads_before = torch.get_num_threads() if torch else available_cores()
    with threadpool_limits(threads):
        try:
            yield
        finally:
            if torch := sys.modules.get("torch"):
                torch.set_num_threads(threads_before)


def limit_threads(threads: int) -> None:
    """Use this many threads for linear algebra, whatever the environment says.

    Results depend on it in the last digits, so it comes from the config.
    """
    from threadpoolctl import threadpool_limits

    threadpool_limits(threads)


@contextmanager
def one_thread_each() -> Iterator[None]:
    """Limit linear algebra, and networks if torch is loaded, to one thread per calling thread."""
    # torch has threads of its own, which the limit of the libraries does not reach.
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
    """Return the libraries of linear algebra that are loaded; a search takes milliseconds."""
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()
