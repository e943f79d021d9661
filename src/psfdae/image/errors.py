"""The error raised for input files that cannot be used, and functions that make texts printable."""

from __future__ import annotations

import errno
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from traceback import walk_tb

import numpy as np

from psfdae.base.errors import Error, no_such_file


def one_line(text: object) -> str:
    """Return the text without line breaks and characters that do not print."""
    # Line breaks and tabs become blanks.
    words = " ".join(str(text).split())
    return "".join(c if c.isprintable() else "?" for c in words)


def ascii_line(text: object) -> str:
    """Return a text in the characters that FITS headers hold, others as question marks."""
    return one_line(text).encode("ascii", "replace").decode()


def shorten(names: list[str], length_max: int = 20) -> str:
    """Return a list of names for a message, cut after `length_max` of them.

    Parameters
    ----------
    names : list of str
        Names; each is cut after 40 characters.
    length_max : int
        Maximum number of names.
    """
    ellipsis = f", … ({len(names)} in all)" if len(names) > length_max else ""
    return ", ".join(name[:40] for name in names[:length_max]) + ellipsis if names else "none"


class ObservationError(Error, ValueError):
    """Input file that cannot be used; one line that names the file."""

    def __init__(self, path: str | Path, problem: str) -> None:
        super().__init__(one_line(f"{path}: {problem}"))


_ONE_AT_A_TIME = threading.RLock()
"""Filters of warnings belong to the process; threads would restore each other's."""


@contextmanager
def silent() -> Iterator[None]:
    """Silence warnings, log messages and floating-point errors of libraries.

    Filters of warnings belong to the process: one thread at a time is silent, and restores the
    filters afterwards.
    """
    from astropy import log

    with _ONE_AT_A_TIME, warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        level = log.level
        log.setLevel("CRITICAL")
        try:
            yield
        finally:
            log.setLevel(level)


NO_SPACE = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""Numbers of the errors of a disk, of a user's share of it, and of a file without more space."""


def _no_space(error: OSError) -> str:
    """Return why no temporary copy of an image can be written."""
    return f"no temporary copy of it ({error.strerror}): set TMPDIR to a folder with more space"


@contextmanager
def reading(path: str | Path) -> Iterator[None]:
    """Silence libraries while they read a file, and turn their errors into `ObservationError`.

    Libraries raise a dozen kinds of errors on damaged files (struct, index, key, assertion, zlib,
    …), which no list would complete; errors of the program itself pass unchanged.

    Raises
    ------
    ObservationError
        If the file is missing, cannot be read or is damaged; it names the file.
    """
    with silent():
        try:
            yield
        # Errors of our own pass; errors of the operating system get plain words.
        except ObservationError:
            raise
        except FileNotFoundError as error:
            # Python does not name a file if every folder for temporary files is full.
            if error.filename is None:
                raise ObservationError(path, _no_space(error)) from None
            reason = no_such_file(Path(path)).removeprefix(f"{path}: ")
            raise ObservationError(path, reason) from None
        except IsADirectoryError:
            raise ObservationError(path, "a folder, not a file") from None
        except PermissionError:
            raise ObservationError(path, "no permission to read it") from None
        except MemoryError:
            raise ObservationError(path, "does not fit into memory") from None
        except Exception as error:
            # Only the copy of a packed image is written while it is read.
            if isinstance(error, OSError) and error.errno in NO_SPACE:
                raise ObservationError(path, _no_space(error)) from None
            # A missing package and an undefined name are not faults of a file. Neither is a wrong
            # type, attribute, index or assertion in a line of psfdae's own; libraries raise these
            # on damaged files, in their own lines.
            *_, (frame, _) = walk_tb(error.__traceback__)
            package = str(frame.f_globals.get("__name__", "")).partition(".")[0]
            misuse = TypeError | AttributeError | LookupError | AssertionError
            is_own_misuse = package == "psfdae" and isinstance(error, misuse)
            if is_own_misuse or isinstance(error, ImportError | NameError):
                raise
            # The start of the library's message, which may be long, or the kind of error.
            problem = one_line(error)[:160] or type(error).__name__
            raise ObservationError(path, f"damaged or of a wrong format ({problem})") from error
