"""The class of all refusals; where a package of an extra is missing, a line says which extra."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, requires


class Error(Exception):
    """Something that was given cannot be used; the message names it and says what is expected.

    Examples
    --------
    >>> try:
    ...     psfdae.Stars.from_image("none.fits", detect=True)
    ... except psfdae.Error as error:
    ...     print(error)
    none.fits: no such file
    """


REQUIRED_BY_EXTRA = re.compile(r"([A-Za-z0-9._-]+).*extra == [\"']([^\"']+)[\"']")
"""A line of the package's metadata: name of a package, and of the extra that requires it."""


class MissingExtraError(Error, ImportError):
    """A package of an extra is not installed; one line says which, and how to install it."""


@contextmanager
def needed_by(what: str) -> Iterator[None]:
    """Around code that may import what an extra brings; `what` begins the message.

    Raises
    ------
    MissingExtraError
        In place of the ModuleNotFoundError of such a package.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        line = missing(error, what)
        if line is None:
            raise
        raise MissingExtraError(line, name=error.name) from error


def missing(error: ModuleNotFoundError, what: str) -> str | None:
    """One line that says what to install for `what`; None if no extra brings the module."""
    found = _source(error.name or "")
    if found is None:
        return None
    package, extra = found
    return f'{what} needs {package}: pip install "psfdae[{extra}]"'


def _source(module: str) -> tuple[str, str] | None:
    """The package of a top-level module and the extra that requires it, by psfdae's metadata.

    A package that is not installed does not say how its module is called: either as itself,
    or as the first word of its name, as hydra of hydra-core.
    """
    try:
        lines = requires("psfdae") or []
    except PackageNotFoundError:
        return None
    required = [(line[1], line[2]) for line in map(REQUIRED_BY_EXTRA.match, lines) if line]
    alike = [pair for pair in required if pair[0] == module]
    alike += [pair for pair in required if pair[0].startswith(f"{module}-")]
    return alike[0] if alike else None
