"""The one error of this package, and how errors of the libraries become it."""

from __future__ import annotations

import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from psfdae.safe_text import one_line

LONGEST = 160
"""Characters of a library's message that are passed on."""


class ObservationError(ValueError):
    """An input file cannot be used; one line that names the file."""

    def __init__(self, path: str | Path, problem: str) -> None:
        super().__init__(one_line(f"{path}: {problem}"))


_ONE_AT_A_TIME = threading.RLock()
"""Filters of warnings belong to the process; threads would restore each other's."""


@contextmanager
def reading(path: str | Path) -> Iterator[None]:
    """Around calls of astropy on a file of unknown content: silent, and one kind of error.

    Only such calls belong inside. On damaged files astropy raises a dozen kinds of
    errors (struct, index, key, assertion, zlib, …) that no list would complete.

    Raises
    ------
    ObservationError
        Instead of any other error.
    """
    from astropy import log

    with _ONE_AT_A_TIME, warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        level = log.level
        log.setLevel("CRITICAL")
        try:
            yield
        except ObservationError:
            raise
        except FileNotFoundError:
            raise ObservationError(path, "no such file") from None
        except IsADirectoryError:
            raise ObservationError(path, "a folder, not a file") from None
        except PermissionError:
            raise ObservationError(path, "no permission to read it") from None
        except MemoryError:
            raise ObservationError(path, "does not fit into memory") from None
        except Exception as error:
            what = one_line(error)[:LONGEST] or type(error).__name__
            raise ObservationError(path, f"damaged or of a wrong format ({what})") from error
        finally:
            log.setLevel(level)


def shorten(names: list[str], most: int = 20) -> str:
    """A list of names for a message, cut after `most`."""
    if not names:
        return "none"
    more = f", … ({len(names)} in all)" if len(names) > most else ""
    return ", ".join(name[:40] for name in names[:most]) + more
