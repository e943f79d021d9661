"""Progress bars of click on standard error, where that is a terminal."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

from psfdae.base.progress import Advance


@contextmanager
def bar(name: str, count: int) -> Iterator[Advance]:
    """Show how far a task of so many steps is, after its first second.

    Nothing is shown where standard error is no terminal, and in a process that another one has
    started: bars of several would mix. `psfdae.base.progress.show_with` takes it.
    """
    from multiprocessing import parent_process

    if not sys.stderr.isatty() or parent_process() is not None:
        yield lambda steps: None
        return

    import click

    # The bar begins to be drawn when a second has passed, as of the start.
    start, completed_steps, is_shown = time.time(), 0, False
    progress_bar = click.progressbar(length=count, label=name, file=sys.stderr)
    with ExitStack() as stack:

        def advance(steps: int) -> None:
            nonlocal completed_steps, is_shown
            completed_steps = min(completed_steps + steps, count)
            if not is_shown and time.time() > start + 1.0:
                stack.enter_context(progress_bar)
                # The time that is left follows from both.
                progress_bar.start = progress_bar.last_eta = start
                is_shown = True
            if is_shown:
                progress_bar.update(completed_steps - progress_bar.pos)

        yield advance
        if is_shown:
            advance(count)  # a task may need fewer steps
