"""How far tasks are, on standard error: as a bar in a terminal, as lines in a log.

Displays for `psfdae.base.progress.show_with`. They show nothing in a process that another one has
started: bars of several would mix.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from multiprocessing import parent_process
from threading import Lock, Timer

from psfdae.base.progress import Show

DELAY_S = 0.5
"""Shorter tasks have no bar. A command takes up to 1.5 s to begin its first task."""


@contextmanager
def bar(name: str) -> Iterator[Show]:
    """Show a task as a bar of click's after half a second; without a terminal, show nothing.

    The bar appears even if no step of the task has ended by then.
    """
    if not sys.stderr.isatty() or parent_process() is not None:
        yield lambda fraction, text: None
        return

    import click

    # The bar has a thousand steps, so that parts of a long step move it, too.
    start, length, is_shown = time.time(), 1000, False
    progress_bar = click.progressbar(
        length=length, label=name, file=sys.stderr, item_show_func=lambda text: text or None
    )
    lock = Lock()
    with ExitStack() as stack:

        def begin() -> None:
            nonlocal is_shown
            # The time that is left follows from the start of the task.
            stack.enter_context(progress_bar)
            progress_bar.start = progress_bar.last_eta = start
            is_shown = True

        def begin_late() -> None:
            with lock:
                if not is_shown:
                    begin()

        def show(fraction: float, text: str) -> None:
            with lock:
                if not is_shown and time.time() > start + DELAY_S:
                    begin()
                if is_shown:
                    # Two parts of one step both begin at 0: the bar never goes back.
                    steps = max(round(length * fraction) - progress_bar.pos, 0)
                    progress_bar.update(steps, text)

        timer = Timer(DELAY_S, begin_late)
        timer.daemon = True
        timer.start()
        try:
            yield show
        finally:
            # A timer that has fired may be about to begin: no bar is drawn after the end of a task.
            timer.cancel()
            timer.join()


@contextmanager
def bar_or_lines(name: str, interval_s: float = 10.0) -> Iterator[Show]:
    """Show a task as a bar in a terminal, and in a log by a line at most every ten seconds."""
    if sys.stderr.isatty() or parent_process() is not None:
        with bar(name) as show_bar:
            yield show_bar
        return
    start = last_line = time.time()

    def show(fraction: float, text: str) -> None:
        nonlocal last_line
        now = time.time()
        # Nothing is left of a task that has ended.
        if now < last_line + interval_s or fraction >= 1.0:
            return
        last_line = now
        # What is left takes as long as what is done, in proportion.
        remaining_s = (now - start) * (1.0 / fraction - 1.0)
        parts = [f"{name}: {fraction:.0%}", f"about {remaining_s:.0f} s left", text]
        print(*filter(None, parts), sep="  ", file=sys.stderr, flush=True)

    yield show
