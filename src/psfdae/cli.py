"""The command line: a stage is a function, and its signature is its command.

`@command("name")` on a function makes it one: parameters become options,
the docstring the help. Which module has which command is read from the text of the modules,
so that `psfdae --help` imports none of them.
"""

from __future__ import annotations

import ast
import re
import types
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, is_dataclass
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from inspect import Parameter, cleandoc, signature
from pathlib import Path
from typing import (
    Annotated,
    Any,
    Literal,
    Protocol,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

import click

from psfdae.errors import Error, install_line, missing
from psfdae.joined import joined
from psfdae.version import __version__

OWN = "psfdae.commands"
"""The package's own commands; those of others join it by entry points "psfdae.commands"."""


Function = TypeVar("Function", bound=Callable[..., Any])


class Reader(Protocol):
    """Makes what a command's parameter `config` receives."""

    def __call__(self, options: Mapping[str, Any], file: Path | None, words: Sequence[str]) -> Any:
        """Return settings from the other options, a file, or words of the command line."""


@dataclass(frozen=True)
class Stage:
    """Command of a function: its words, and the reader of its settings."""

    name: str
    settings: Reader | None = None


def command(name: str, settings: Reader | None = None) -> Callable[[Function], Function]:
    """Make a function the command `psfdae NAME`.

    A parameter `config` receives what `settings` reads from trailing words or a file. Other
    parameters are options: required without a default, repeatable as `tuple[X, ...]`, a flag as
    bool, all fields of a dataclass. `Annotated` adds help (a text), a click type, or a dict of
    what click's option takes, where "flag" names it and "argument" makes it positional. Help is
    the docstring. Of the words of a repeatable argument beside `config`, those with = are settings.
    """

    def mark(function: Function) -> Function:
        function.stage = Stage(name, settings)  # type: ignore[attr-defined]
        return function

    return mark


REFUSABLE = (OSError, MemoryError, RuntimeError, ValueError, ImportError)
"""Errors of which some are no bugs; `refusal` tells which."""


class Careful(click.Group):
    """Commands whose mistakes are one message and exit code 2."""

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command; a refusal of ours is a message, a bug stays a traceback.

        So is a file that the system does not let us read or write, a lack of memory, and a
        package that an extra brings.
        """
        try:
            return super().invoke(ctx)
        except REFUSABLE as error:
            said = refusal(error)
            if said is None:
                raise
            click.echo(f"psfdae: {said}", err=True)
            ctx.exit(2)


def refusal(error: Exception) -> str | None:
    """Return the line for an error that is no bug; None if it is one."""
    if isinstance(error, MemoryError):
        return f"not enough memory ({error or 'no more is known'})"
    if isinstance(error, OSError):
        return None if error.errno is None else str(error)
    if isinstance(error, ModuleNotFoundError):
        return missing(error, "this command")
    if isinstance(error, Error):
        return str(error)
    # HDF5 reports a full disk as a RuntimeError without a number of its own.
    # So does torch a lack of memory, as its own RuntimeError.
    known = re.search("errno = |not enough memory", str(error))
    return " ".join(str(error).split()) if known else None


class Commands(Careful):
    """The commands of all stages."""

    def __init__(self, prefix: str = "", **more: Any) -> None:
        super().__init__(**more)
        self.prefix = prefix

    def list_commands(self, ctx: click.Context) -> list[str]:
        """First words after the group's own."""
        size = len(self.prefix.split())
        names = [name.split() for name in found()]
        words = {w[size] for w in names if w[:size] == self.prefix.split() and w[size:]}
        return sorted(words)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """A group, or the command of a stage, whose module is imported now."""
        name = f"{self.prefix} {cmd_name}".strip()
        if name in groups():
            return Commands(name, name=cmd_name, help=groups()[name])
        return as_click(stage(name)) if name in found() else None

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """List the commands with the first sentence of their help, from the modules' text."""
        words = self.list_commands(ctx)
        listed = {"Commands": words} if self.prefix else sections(words)
        width = formatter.width - 6 - max(map(len, words))
        for heading, commands in listed.items():
            with formatter.section(heading):
                names = [f"{self.prefix} {word}".strip() for word in commands]
                formatter.write_dl([(n.split()[-1], _shortened(_about(n), width)) for n in names])
        if absent := len(words) - sum(map(len, listed.values())):
            formatter.write_paragraph()
            formatter.write_text(f'{absent} more with the extra "paper": {install_line("paper")}')


@click.group(cls=Commands, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__)
def main() -> None:
    """Model the PSF of astronomical images, and reproduce the paper on denoising autoencoders.

    OVERRIDES are words group.key=value, such as train.lr=1e-3; with the extra "paper" also
    choices of files of the config folder, such as dataset=dataset5.
    """


@cache
def found() -> dict[str, tuple[str, Path]]:
    """Module and its file by command."""
    pattern = re.compile(r'^@command\(\s*"([^"]+)"', re.MULTILINE)
    commands = {}
    for package in _packages():
        for folder in find_spec(package).submodule_search_locations:  # type: ignore[union-attr]
            for path in sorted(Path(folder).glob("*.py")):
                for name in pattern.findall(path.read_text(encoding="utf-8")):
                    commands[name] = f"{package}.{path.stem}", path
    return commands


def _packages() -> list[str]:
    return [OWN, *(point.value for point in joined("commands"))]


def sections(words: Sequence[str]) -> dict[str, list[str]]:
    """Return those first words of commands that this installation can run, below their headings.

    The packages' `SECTIONS` say what stands where, and their `REQUIRED` which module a command
    needs; what is in no section is a stage of the paper's.
    """
    headings: dict[str, list[str]] = {}
    required: dict[str, str] = {}
    for package in map(import_module, _packages()):
        for heading, commands in getattr(package, "SECTIONS", {}).items():
            headings.setdefault(heading, []).extend(commands)
        required |= getattr(package, "REQUIRED", {})
    placed = {word for commands in headings.values() for word in commands}
    headings["The paper's stages"] = [word for word in words if word not in placed]

    def runs(word: str) -> bool:
        module = required.get(word, "" if word in placed else required.get("*", ""))
        return word in words and (not module or find_spec(module) is not None)

    available = {heading: list(filter(runs, names)) for heading, names in headings.items()}
    return {heading: commands for heading, commands in available.items() if commands}


@cache
def groups() -> dict[str, str]:
    """Help of the first words of commands of two and three words, from the packages' `GROUPS`."""
    known: dict[str, str] = {}
    for package in _packages():
        known |= getattr(import_module(package), "GROUPS", {})
    return known


def stage(name: str) -> Callable[..., Any]:
    """The function of a command; its module is imported."""
    module = import_module(found()[name][0])
    marked = (f for f in vars(module).values() if isinstance(getattr(f, "stage", None), Stage))
    function: Callable[..., Any] = next(f for f in marked if f.stage.name == name)
    return function


def _shortened(text: str, width: int) -> str:
    """The first sentence, as much of it as fits."""
    from textwrap import shorten

    first = " ".join(text.split()).partition(". ")[0].removesuffix(".")
    return first + "." if len(first) < width else shorten(first, width, placeholder="...")


def _about(name: str) -> str:
    """First paragraph of a command's help, nothing being imported."""
    if name in groups():
        return groups()[name]
    for node in ast.parse(found()[name][1].read_text(encoding="utf-8")).body:
        for call in getattr(node, "decorator_list", []):
            if isinstance(call, ast.Call) and ast.unparse(call).startswith(f"command('{name}'"):
                return (ast.get_docstring(node) or "").split("\n\n")[0]  # type: ignore[arg-type]
    return ""


def as_click(function: Callable[..., Any]) -> click.Command:
    """The command of a stage."""
    spec: Stage = function.stage  # type: ignore[attr-defined]
    fields: dict[str, Any] = {}
    parameters: list[click.Parameter] = []
    for name, hint, default in _parameters(function):
        if name == "config":
            continue
        if is_dataclass(hint):
            fields[name] = hint
            parameters += [_option(*field) for field in _parameters(hint)]
        else:
            parameters.append(_option(name, hint, default))
    read = spec.settings if "config" in signature(function).parameters else None
    if read is not None:
        path = click.Path(path_type=Path, dir_okay=False)
        about = "Settings as the workflow writes them, instead of overrides."
        parameters.append(click.Option(["--config", "settings"], type=path, help=about))
        if not any(p.nargs == -1 for p in parameters):
            parameters.append(click.Argument(["overrides"], nargs=-1))

    def run(**given: Any) -> None:
        config = {}
        if read is not None:
            file, overrides = given.pop("settings"), _settings(parameters, given)
            if file is not None and overrides:
                raise click.UsageError("--config and overrides exclude each other")
            config["config"] = read(given, file, overrides)
        for name, kind in fields.items():
            given[name] = kind(**{key: given.pop(key) for key, *_ in _parameters(kind)})
        function(**config, **given)

    help_text = cleandoc(function.__doc__ or "")
    return click.Command(spec.name.split()[-1], callback=run, params=parameters, help=help_text)


def _settings(parameters: Sequence[click.Parameter], given: dict[str, Any]) -> Sequence[str]:
    """Take the settings from what is given; a file among them is one as ./a=b.fits."""
    if "overrides" in given:
        found: Sequence[str] = given.pop("overrides")
        return found
    files = next(p for p in parameters if p.nargs == -1)
    words = given[files.name or ""]
    settings = [str(word) for word in words if re.match("[^/]*=", str(word))]
    if not (kept := tuple(word for word in words if str(word) not in settings)):
        raise click.MissingParameter(param=files)
    given[files.name or ""] = kept
    return settings


def program(*functions: Callable[..., Any]) -> None:
    """Run commands of a program outside the package, as those of `workflow/benchmarks` are."""
    Careful(commands=[as_click(function) for function in functions])()


def _parameters(function: Any) -> list[tuple[str, Any, Any]]:
    """Name, type and default of each parameter."""
    kept = signature(function).parameters
    hints = get_type_hints(function, include_extras=True)
    return [(name, hints.get(name, Any), p.default) for name, p in kept.items()]


def _option(name: str, hint: Any, default: Any) -> click.Parameter:
    kind, attributes = _unfolded(hint)
    attributes = {"type": kind, **attributes}
    if kind is bool:
        attributes |= {"type": None, "is_flag": True}
    required = default is Parameter.empty
    if attributes.pop("argument", False):
        many = attributes.pop("multiple", False)
        return click.Argument([name], required=required, nargs=-1 if many else 1, **attributes)
    attributes["required"] = required
    if not required and default is not False and default not in (None, ()):
        attributes = {"default": default, "show_default": True, **attributes}
    flag = attributes.pop("flag", f"--{name.replace('_', '-')}")
    return click.Option([flag, name], **attributes)


def _unfolded(hint: Any) -> tuple[Any, dict[str, Any]]:
    """Click's type of an annotation, and what else it says of an option."""
    attributes: dict[str, Any] = {}
    if get_origin(hint) is Annotated:
        kind, attributes = _unfolded(get_args(hint)[0])
        for said in hint.__metadata__:
            if isinstance(said, str):
                attributes["help"] = said
            else:
                attributes |= said if isinstance(said, dict) else {"type": said}
        return attributes.pop("type", kind), attributes
    if get_origin(hint) in (Union, types.UnionType):
        return _unfolded(next(part for part in get_args(hint) if part is not type(None)))
    if get_origin(hint) is Literal:
        return click.Choice(get_args(hint)), {}
    if get_origin(hint) is tuple:
        inner = get_args(hint)
        if inner[-1] is ...:
            kind, attributes = _unfolded(inner[0])
            return kind, {**attributes, "multiple": True}
        return tuple(_unfolded(part)[0] for part in inner), {}
    return hint, {}
