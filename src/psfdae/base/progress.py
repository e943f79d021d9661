"""How far a long calculation is: what it reports, and what shows it.

A calculation that may take more than some seconds goes through its pieces by `steps`, or reports
them to a `task`. A task within a step of another one is a part of it: the bar or line of the outer
one goes on by as much. Nothing is shown before `show_with` says what shows it, as the package does
for terminals and the command line for logs (`psfdae.commands.terminal`). Of tasks in other threads
nothing is shown.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from contextvars import ContextVar
from typing import TypeAlias, TypeVar

Item = TypeVar("Item")

Advance: TypeAlias = Callable[..., object]
"""Is called with the number of steps done since its last call, and perhaps a text on them."""

Show: TypeAlias = Callable[[float, str], object]
"""Is called with the part of a task that is done, from 0 to 1, and a text on its last step."""

Display: TypeAlias = Callable[[str], AbstractContextManager[Show]]
"""Shows a task of this name."""

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
def displayed_by(display: Display | None) -> Iterator[None]:
    """Show tasks by this display meanwhile; None shows nothing."""
    # The value is that of this thread: others go on showing their tasks.
    token = _display.set(display)
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
        Takes the number of steps that have been done since its last call, and perhaps a text.
    """
    display, completed_steps = _display.get(), 0
    if display is None:
        yield lambda steps, text="": None
        return
    with ExitStack() as stack:
        show = stack.enter_context(display(name))

        def advance(steps: int, text: str = "") -> None:
            nonlocal completed_steps
            completed_steps = min(completed_steps + steps, count)
            show(completed_steps / max(count, 1), text)

        @contextmanager
        def part(part_name: str) -> Iterator[Show]:
            """Show a task within a step of this one."""
            yield lambda fraction, text: show(
                (completed_steps + fraction) / max(count, 1), text or part_name
            )

        with displayed_by(part):
            yield advance
        show(1.0, "")  # a task may need fewer steps


def steps(name: str, items: Iterable[Item]) -> Iterator[Item]:
    """Go through items as a task of this name, each of which is a step."""
    pieces = list(items)
    with task(name, len(pieces)) as advance:
        for item in pieces:
            yield item
            advance(1)
