"""How far a long calculation is: what it reports, and what shows it.

A calculation that may take minutes goes through its pieces by `steps`, or reports them to a `task`.
Nothing is shown before `show_with` says what shows it, as the package does for terminals
(`psfdae.commands.terminal`). Of tasks within a task, and of those in other threads, nothing is
shown.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from contextvars import ContextVar
from typing import TypeAlias, TypeVar

Item = TypeVar("Item")

Advance: TypeAlias = Callable[[int], object]
"""Is called with the number of steps that have been done since the last call."""

Display: TypeAlias = Callable[[str, int], AbstractContextManager[Advance]]
"""Shows a task of this name with so many steps."""

_display: ContextVar[Display | None] = ContextVar("display", default=None)


def show_with(display: Display | None) -> None:
    """Show tasks from now on by this display; None shows nothing.

    Examples
    --------
    Without any bar, also in a terminal:

    >>> from psfdae import progress
    >>> progress.show_with(None)
    """
    _display.set(display)


@contextmanager
def silence() -> Iterator[None]:
    """Show no tasks meanwhile."""
    # The value is that of this thread: others go on showing their tasks.
    token = _display.set(None)
    try:
        yield
    finally:
        _display.reset(token)


@contextmanager
def task(name: str, count: int) -> Iterator[Advance]:
    """Show how far a task is that has at most so many steps.

    Parameters
    ----------
    name : str
        What is done, in a few words.
    count : int

    Yields
    ------
    callable
        Takes the number of steps that have been done since its last call.
    """
    display = _display.get()
    if display is None:
        yield lambda steps: None
        return
    # Of tasks within this one nothing is shown: their bars would mix.
    with silence(), display(name, count) as advance:
        yield advance


def steps(name: str, items: Iterable[Item]) -> Iterator[Item]:
    """Go through items as a task of this name, each of which is a step."""
    pieces = list(items)
    with task(name, len(pieces)) as advance:
        for item in pieces:
            yield item
            advance(1)
