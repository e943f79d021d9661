"""Progress of long calculations: tasks report their steps, and a display shows them.

A calculation that may take more than some seconds iterates over its pieces by `steps`, or reports
them to a `task`. A task inside a step of another task is a part of it: the bar or line of the outer
task advances by the corresponding fraction. Nothing is shown until `show_with` sets a display; the
package does so for terminals, and the command line for logs (`psfdae.commands.terminal`). Tasks in
other threads are not shown.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from contextvars import ContextVar
from typing import TypeAlias, TypeVar

Item = TypeVar("Item")

Advance: TypeAlias = Callable[..., object]
"""Function of the number of steps done since its last call, and optionally a text on them."""

Show: TypeAlias = Callable[[float, str], object]
"""Function of the fraction of a task that is done, 0 … 1, and a text on its last step."""

Display: TypeAlias = Callable[[str], AbstractContextManager[Show]]
"""Function that shows a task of the given name while its context is open."""

_display: ContextVar[Display | None] = ContextVar("display", default=None)


def show_with(display: Display | None) -> None:
    """Show tasks by this display from now on; None shows nothing.

    Examples
    --------
    Without any bar, also in a terminal:

    >>> from psfdae import progress
    >>> progress.show_with(None)
    """
    _display.set(display)


@contextmanager
def use_display(display: Display | None) -> Iterator[None]:
    """Show tasks by this display inside the block; None shows nothing."""
    # A context variable: other threads keep their own display.
    token = _display.set(display)
    try:
        yield
    finally:
        _display.reset(token)


@contextmanager
def task(name: str, count: int) -> Iterator[Advance]:
    """Show the progress of a task.

    Parameters
    ----------
    name : str
        Name of the task, in a few words.
    count : int
        Largest number of steps; the task may end earlier.

    Yields
    ------
    callable
        Takes the number of steps done since its last call, and optionally a text on them.
    """
    # Without a display, steps are counted by nobody.
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
            """Show a task inside a step of this one, as a fraction of the step."""
            yield lambda fraction, text: show(
                (completed_steps + fraction) / max(count, 1), text or part_name
            )

        with use_display(part):
            yield advance
        show(1.0, "")  # a task may need fewer steps


def steps(name: str, items: Iterable[Item]) -> Iterator[Item]:
    """Iterate over items as a task of this name; each item is a step."""
    # A list, because the number of steps is needed at the beginning.
    pieces = list(items)
    with task(name, len(pieces)) as advance:
        for item in pieces:
            yield item
            advance(1)
