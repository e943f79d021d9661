"""Base class of all errors that a user can cause, and the wording of their messages.

Bad input raises an `Error` whose message is one line; any other exception is a bug. A message
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
    """Input that cannot be used; the message names it and the expected values.

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
def use_command_words() -> Iterator[None]:
    """Let messages name options and commands inside the block, not keywords and calls."""
    # A context variable: other threads keep their own wording.
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
    """Return the text with which a user sets a value: a keyword of Python, or an option.

    Parameters
    ----------
    name : str
        Name of the keyword.
    value : object, optional
        Value to set; True is an option without a value, None leaves the value out.

    Examples
    --------
    >>> keyword("snr_min", 20), keyword("detect", True), keyword("mask")
    ('snr_min=20', 'detect=True', 'mask=')
    >>> with use_command_words():
    ...     keyword("snr_min", 20), keyword("detect", True), keyword("pixel_scale_arcsec")
    ('--snr-min 20', '--detect', '--pixel-scale')
    """
    # Six digits are enough for a user to find the value.
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
def require_extra(user: str) -> Iterator[None]:
    """Name the extra to install if the code of the block imports a package of an extra.

    Parameters
    ----------
    user : str
        Beginning of the message: who needs the package, such as "this command".

    Raises
    ------
    MissingExtraError
        In place of the ModuleNotFoundError of such a package.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        line = missing(error, user)
        if line is None:
            raise
        raise MissingExtraError(line, name=error.name) from error


def missing(error: ModuleNotFoundError, user: str) -> str | None:
    """Return the line that names the extra to install; None if no extra has the module.

    Parameters
    ----------
    error : ModuleNotFoundError
        Error of an import, with the name of the module.
    user : str
        Beginning of the line: who needs the module, such as "this command".
    """
    try:
        lines = requires("psfdae") or []
    except PackageNotFoundError:
        return None
    # Packages and extras of lines of the metadata such as: hydra-core>=1.3; extra == "paper".
    matches = (re.match(r"([A-Za-z0-9._-]+).*extra == [\"']([^\"']+)", line) for line in lines)
    extras = {match[1]: match[2] for match in reversed([*matches]) if match}
    # The name of a package that is not installed need not be the name of its module. The module
    # has the same name, or its first word, as hydra of hydra-core.
    module = error.name or ""
    names = [name for name in extras if name == module or name.startswith(f"{module}-")]
    if not names:
        return None
    return f"{user} needs {min(names)}: {install_line(extras[min(names)])}"


def install_line(extra: str) -> str:
    """Return the command that installs psfdae with an extra from its present source.

    psfdae is on no package index: pip needs the folder or wheel from which it was installed. pip
    has written it to direct_url.json (PEP 610).
    """
    # The file is absent for a package from an index, or from a folder on the path of Python.
    try:
        note = json.loads(distribution("psfdae").read_text("direct_url.json") or "{}")
    except (PackageNotFoundError, ValueError):
        note = {}
    url = urlsplit(note.get("url", ""))
    if url.scheme == "file" and (path := Path(unquote(url.path))).exists():
        return f'pip install "{path}[{extra}]"'
    return f'pip install ".[{extra}]" in the folder of psfdae\'s source'


def did_you_mean(word: str, names: Iterable[str]) -> str:
    """Return "; did you mean NAME?" with at most three names that are similar to a word, or "".

    Names with the same last part come first: train.lr for lr. Otherwise the most similar spelling
    is chosen.
    """
    # Keys of settings are dotted; the last part is the name of the setting in its group.
    names = [str(name) for name in names if name != word]
    last_part = word.rpartition(".")[2]
    similar = [name for name in names if "." in name and name.rpartition(".")[2] == last_part]
    similar = sorted(similar, key=len) or get_close_matches(word, names, n=1)
    return f"; did you mean {' or '.join(similar[:3])}?" if similar else ""


def require_file(path: Path) -> None:
    """Raise Error for a pipe or a device, because opening or reading it might never end."""
    # Readers report a missing path themselves.
    with suppress(OSError):
        if path.exists() and not (path.is_file() or path.is_dir()):
            raise Error(f"{path}: a pipe or a device, expected a file")


def no_such_file(path: Path) -> str:
    """Return the message for a missing file, with the most similar name in its folder."""
    # The folder itself may be missing, or may not be readable.
    try:
        names = [neighbour.name for neighbour in path.parent.iterdir()]
    except OSError:
        return f"{path}: no such file, nor is there a folder {path.parent}"
    # By their spelling: parts between dots have no meaning of their own in file names.
    similar = get_close_matches(path.name, names, n=1)
    return f"{path}: no such file" + "".join(f"; did you mean {name}?" for name in similar)
