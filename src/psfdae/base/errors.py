"""The class of all refusals, and the words in which they name settings and missing packages.

Everything that psfdae refuses is an `Error` with one line; a bug is any other exception. A line
names keywords (`snr_min=20`) in Python, and options (`--snr-min 20`) in a command.
"""

from __future__ import annotations

import json
import re
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from difflib import get_close_matches
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


class MissingExtraError(Error, ImportError):
    """A package of an extra is not installed; one line says which, and how to install it."""


_in_command: ContextVar[bool] = ContextVar("in_command", default=False)


@contextmanager
def words_of_a_command() -> Iterator[None]:
    """Make lines name options and commands meanwhile, in place of keywords and calls."""
    token = _in_command.set(True)
    try:
        yield
    finally:
        _in_command.reset(token)


def warn(lines: Iterable[str]) -> None:
    """Warn the user of a call in Python, line by line; a command prints the lines itself."""
    for line in () if _in_command.get() else lines:
        warnings.warn(line, UserWarning, stacklevel=5)


def keyword(name: str, value: object = None) -> str:
    """Return what a user types to state something: a keyword of Python, or an option.

    Parameters
    ----------
    name : str
        Name of the keyword.
    value : object, optional
        What is to be stated; True is an option without a value.

    Examples
    --------
    >>> keyword("snr_min", 20), keyword("detect", True), keyword("mask")
    ('snr_min=20', 'detect=True', 'mask=')
    >>> with words_of_a_command():
    ...     keyword("snr_min", 20), keyword("detect", True), keyword("pixel_scale_arcsec")
    ('--snr-min 20', '--detect', '--pixel-scale')
    """
    number = f"{value:.6g}" if isinstance(value, float) else None
    if not _in_command.get():
        return f"{name}=" if value is None else f"{name}={number or repr(value)}"
    # Options have no units in their names.
    option = f"--{name.removesuffix('_arcsec').replace('_', '-')}"
    return option if value is None or value is True else f"{option} {number or value}"


def call(python: str, command: str) -> str:
    """Return a call of Python, or in a command the command that does the same."""
    return command if _in_command.get() else python


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
    """Return the line that says what to install for `what`; None if no extra brings the module.

    Parameters
    ----------
    error : ModuleNotFoundError
    what : str
        Beginning of the line, such as "this command".
    """
    try:
        lines = requires("psfdae") or []
    except PackageNotFoundError:
        return None
    # Packages and extras of lines of the metadata such as: hydra-core>=1.3; extra == "paper".
    matches = (re.match(r"([A-Za-z0-9._-]+).*extra == [\"']([^\"']+)", line) for line in lines)
    extras = {match[1]: match[2] for match in reversed([*matches]) if match}
    # A package that is not installed does not say how its module is called: either as itself, or
    # as the first word of its name, as hydra of hydra-core.
    module = error.name or ""
    names = [name for name in extras if name == module or name.startswith(f"{module}-")]
    if not names:
        return None
    return f"{what} needs {min(names)}: {install_line(extras[min(names)])}"


def install_line(extra: str) -> str:
    """Return the command that installs psfdae with an extra, from where it was installed.

    psfdae is on no package index: pip needs the folder or wheel that it was installed from, which
    it has noted in direct_url.json (PEP 610).
    """
    # pip leaves no note for a package from an index, or from a folder on the path of Python.
    try:
        note = json.loads(distribution("psfdae").read_text("direct_url.json") or "{}")
    except (PackageNotFoundError, ValueError):
        note = {}
    place = urlsplit(note.get("url", ""))
    if place.scheme == "file" and (path := Path(unquote(place.path))).exists():
        return f'pip install "{path}[{extra}]"'
    return f'pip install ".[{extra}]" in the folder of psfdae\'s source'


def did_you_mean(word: str, names: Iterable[str]) -> str:
    """Return "; did you mean NAME?" with at most three names that are like a word, or "".

    Names whose last part is the word's are the likeliest: train.lr for lr. Others are alike in
    their letters.
    """
    names = [str(name) for name in names if name != word]
    last_part = word.rpartition(".")[2]
    alike = [name for name in names if "." in name and name.rpartition(".")[2] == last_part]
    alike = sorted(alike, key=len) or get_close_matches(word, names, n=1)
    return f"; did you mean {' or '.join(alike[:3])}?" if alike else ""


def require_file(path: Path) -> None:
    """Raise Error for a pipe or a device, whose opening or reading might never end."""
    # Readers have their own words for a path that is missing.
    with suppress(OSError):
        if path.exists() and not (path.is_file() or path.is_dir()):
            raise Error(f"{path}: a pipe or a device, expected a file")


def no_such_file(path: Path) -> str:
    """Return the line that refuses a file which does not exist, with one of its folder like it."""
    try:
        names = [neighbour.name for neighbour in path.parent.iterdir()]
    except OSError:
        return f"{path}: no such file, nor is there a folder {path.parent}"
    # File names are alike in their letters: parts between dots have no meaning of their own.
    alike = get_close_matches(path.name, names, n=1)
    return f"{path}: no such file" + "".join(f"; did you mean {name}?" for name in alike)
