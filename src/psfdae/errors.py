"""The class of all refusals; where a package of an extra is missing, a line says which extra."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, distribution, requires
from pathlib import Path
from urllib.parse import unquote, urlsplit


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
    """Return the line that says what to install for `what`; None if no extra brings the module."""
    requirement = _source(error.name or "")
    if requirement is None:
        return None
    package, extra = requirement
    return f"{what} needs {package}: {install_line(extra)}"


def install_line(extra: str) -> str:
    """Return the command that installs psfdae with an extra, from where it was installed.

    psfdae is on no package index: pip needs the folder or wheel that it was installed from, which
    it has noted in direct_url.json (PEP 610).
    """
    try:
        note = json.loads(distribution("psfdae").read_text("direct_url.json") or "{}")
    except (PackageNotFoundError, ValueError):
        note = {}
    place = urlsplit(note.get("url", ""))
    if place.scheme == "file" and (path := Path(unquote(place.path))).exists():
        return f'pip install "{path}[{extra}]"'
    return f'pip install ".[{extra}]" in the folder of psfdae\'s source'


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
