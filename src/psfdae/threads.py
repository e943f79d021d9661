"""Batches side by side in threads: numpy's and scipy's products leave Python's lock."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Batch = TypeVar("Batch")
Result = TypeVar("Result")


def side_by_side(
    work: Callable[[Batch], Result], batches: Iterable[Batch], threads: int
) -> list[Result]:
    """Results of `work` for every batch, in the order of the batches.

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
    if threads == 1:
        return [work(batch) for batch in batches]
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(work, batches))
