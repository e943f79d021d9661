"""The command line: a stage is a function, and its signature is its command.

`@command("name")` on a function makes it one: parameters become options,
the docstring the help. Which module has which command is read from the text of the modules,
so that `psfdae --help` imports none of them.

Words of a command line go in, and a call of the function comes out, or one line that says what is
wrong and exit code 2.
"""

from __future__ import annotations

import math
import os
import re
import types
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, redirect_stdout
from dataclasses import dataclass, is_dataclass
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from inspect import Parameter, cleandoc, signature
from pathlib import Path
from textwrap import shorten
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import click

from psfdae.base.entry_points import find_entry_points
from psfdae.base.errors import Error, did_you_mean, install_line, missing, use_command_words
from psfdae.base.progress import use_display
from psfdae.base.version import __version__
from psfdae.commands import FORMER_NAMES
from psfdae.commands.terminal import bar_or_lines

Function = TypeVar("Function", bound=Callable[..., Any])


Reader = Callable[[Mapping[str, Any], Path | None, Sequence[str]], Any]
"""Makes what a parameter `config` receives of the other options, a file, and overrides."""


@dataclass(frozen=True)
class Stage:
    """Command of a function: its words, and the reader of its settings."""

    name: str
    settings: Reader | None = None


def command(name: str, settings: Reader | None = None) -> Callable[[Function], Function]:
    """Make a function the command `psfdae NAME`.

    Parameters of the function are options: required without a default, repeatable as
    `tuple[X, ...]`, a flag as bool, all fields of a dataclass. `Annotated` adds a click type, or a
    dict of what click's option takes, where "flag" names it and "argument" makes it positional.
    Help of the command is the docstring; help of an option is its entry under Parameters, or a text
    in `Annotated`.

    Parameters
    ----------
    name : str
        Words of the command, such as "paper alignment states".
    settings : Reader, optional
        Makes what a parameter `config` receives, from trailing words or a file. Of the words of a
        repeatable argument beside `config`, those with = are settings.

    Returns
    -------
    callable
        Decorator that returns the function itself, with the attribute `stage`.
    """

    def mark(function: Function) -> Function:
        function.stage = Stage(name, settings)  # type: ignore[attr-defined]
        return function

    return mark


class Careful(click.Group):
    """Group of commands in which wrong input ends in one line and exit code 2."""

    def invoke(self, ctx: click.Context) -> Any:
        """Run a command, and print one line for an error that is not a bug of the package.

        Such errors are wrong input, a file that cannot be read or written, a lack of memory, and a
        missing package that belongs to an extra. A bug ends in a traceback.
        """
        try:
            return super().invoke(ctx)
        except Exception as error:
            message = refusal(error)
            if message is None:
                raise
            click.echo(f"psfdae: {message}", err=True)
            ctx.exit(2)


def refusal(error: Exception) -> str | None:
    """Return the line for an error that is not a bug; None if it is one."""
    # Errors of Python that say what the machine lacks, then the package's own.
    if isinstance(error, MemoryError):
        return f"not enough memory ({error or 'no more is known'})"
    if isinstance(error, OSError):
        return None if error.errno is None else str(error)
    # A package of an extra, which the message says how to install.
    if isinstance(error, ModuleNotFoundError):
        return missing(error, "this command")
    if isinstance(error, Error):
        return str(error)
    # torch reports a lack of memory as a RuntimeError that only its text distinguishes from others.
    return " ".join(str(error).split()) if "not enough memory" in str(error) else None


class Commands(Careful):
    """All commands that begin with the words `prefix`, whose modules are imported when needed."""

    def __init__(self, prefix: str = "", **attributes: Any) -> None:
        super().__init__(**attributes)
        self.prefix = prefix

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the words that may follow the group's words."""
        # Commands have up to four words; the first ones belong to the group.
        prefix = self.prefix.split()
        size = len(prefix)
        names = [name.split() for name in command_modules()]
        return sorted({w[size] for w in names if w[:size] == prefix and w[size:]})

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Return a group, or the command of a stage, whose module is imported now."""
        name = f"{self.prefix} {cmd_name}".strip()
        if name in groups():
            return Commands(name, name=cmd_name, help=groups()[name])
        return as_click(stage(name)) if name in command_modules() else None

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Return the command that is typed; UsageError names one that is like an unknown one.

        A former name works, with a line that says the new one.
        """
        if not self.prefix and (words := present_name(args[0])) != args[:1]:
            click.echo(f"psfdae: {args[0]} is now psfdae {' '.join(words)}", err=True)
            args = [*words, *args[1:]]
        try:
            return super().resolve_command(ctx, args)
        except click.UsageError as error:
            hint = did_you_mean(args[0], self.list_commands(ctx))
            raise click.UsageError(error.message.removesuffix(".") + hint, ctx) from None

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """List the commands with the first sentence of their help, from the modules' text."""
        # Sentences are cut to what a line has room for beside the longest name.
        words = self.list_commands(ctx)
        sections_of_words = {"Commands": words} if self.prefix else sections(words)
        width = formatter.width - 6 - max(map(len, words))
        for heading, commands in sections_of_words.items():
            with formatter.section(heading):
                rows = []
                for word in commands:
                    name = f"{self.prefix} {word}".strip()
                    text = groups()[name] if name in groups() else command_modules()[name][1]
                    sentence = text.partition(". ")[0].removesuffix(".")
                    sentence += "." if len(sentence) < width else ""
                    rows.append((word, shorten(sentence, width, placeholder="...")))
                formatter.write_dl(rows)
        if absent := len(words) - sum(map(len, sections_of_words.values())):
            formatter.write_paragraph()
            formatter.write_text(f'{absent} more with the extra "paper": {install_line("paper")}')


class SettingsCommand(click.Command):
    """Command that shows its progress, or with `--quiet` nothing but errors.

    Options of other programs are refused with what does the same here.
    """

    foreign_options: Mapping[str, str]
    field_options: Mapping[str, list[click.Parameter]]
    """Options that are fields of a dataclass, by the heading of their group in the help."""

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """List the options of the command, then the options of each dataclass below a heading."""
        fields = [option for options in self.field_options.values() for option in options]
        command_options: list[click.Parameter] = [
            option
            for option in self.get_params(ctx)
            if isinstance(option, click.Option) and option not in fields
        ]
        for heading, options in {"Options": command_options, **self.field_options}.items():
            records = [option.get_help_record(ctx) for option in options]
            if rows := [record for record in records if record is not None]:
                with formatter.section(heading):
                    formatter.write_dl(rows)

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command with its progress and summary, or without them if it is quiet.

        `--quiet` is not a parameter of its function.
        """
        is_quiet = ctx.params.pop("quiet")
        with ExitStack() as stack:
            stack.enter_context(use_command_words())
            stack.enter_context(use_display(None if is_quiet else bar_or_lines))
            if is_quiet:  # errors are written to the other stream
                null = stack.enter_context(Path(os.devnull).open("w", encoding="utf-8"))
                stack.enter_context(redirect_stdout(null))
            return super().invoke(ctx)

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Read the command line; UsageError says what to type in place of a foreign option.

        No option takes NaN or infinity, which click reads as numbers.
        """
        try:
            words = super().parse_args(ctx, args)
        except click.NoSuchOption as error:
            advice = self.foreign_options.get(error.option_name)
            if advice is None:
                raise
            raise click.UsageError(f"{error.option_name}: {advice}", ctx) from None
        for option in self.params:
            value = ctx.params.get(option.name or "")
            for number in value if isinstance(value, tuple) else (value,):
                if isinstance(number, float) and not math.isfinite(number):
                    raise click.BadParameter(f"{number} is not a finite number", ctx, option)
        return words


@click.group(cls=Commands, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__)
def main() -> None:
    """Model the PSF of astronomical images, and reproduce the paper on denoising autoencoders.

    OVERRIDES are words group.key=value, such as train.lr=1e-3; with the extra "paper" also
    choices of files of the config folder, such as dataset=dataset5.
    """


@cache
def command_modules() -> dict[str, tuple[str, str]]:
    """Return the module of each command, and the first paragraph of its help, by its name.

    They are found in the text of the modules, none of which is imported.
    """
    # Lines such as @command("train", …), perhaps with the name on the next line; then the
    # docstring of the function.
    pattern = re.compile(
        r'^@command\(\s*"([^"]+)".*?"""(.*?)(?:\n\n|""")', re.MULTILINE | re.DOTALL
    )
    commands = {}
    for package in _packages():
        for folder in find_spec(package).submodule_search_locations:  # type: ignore[union-attr]
            for path in sorted(Path(folder).glob("*.py")):
                for name, text in pattern.findall(path.read_text(encoding="utf-8")):
                    commands[name] = f"{package}.{path.stem}", " ".join(text.split())
    return commands


def _packages() -> list[str]:
    """Return the packages with commands: our own, and those that join by entry points."""
    return ["psfdae.commands", *(point.value for point in find_entry_points("commands"))]


def sections(words: Sequence[str]) -> dict[str, list[str]]:
    """Return the first words of commands that this installation can run, by their heading.

    The packages' `SECTIONS` have the commands of each heading, and their `REQUIRED` the module
    that a command needs.

    Parameters
    ----------
    words : sequence of str
        First words of all commands.

    Returns
    -------
    dict of str to list of str
        Words by their heading, without headings of none.
    """
    # Headings of all packages, in their order; packages may share a heading.
    available: dict[str, list[str]] = {}
    for package in map(import_module, _packages()):
        requirements = getattr(package, "REQUIRED", {})
        for heading, commands in getattr(package, "SECTIONS", {}).items():
            for word in commands:
                if word in words and (word not in requirements or find_spec(requirements[word])):
                    available.setdefault(heading, []).append(word)
    return available


def present_name(word: str) -> list[str]:
    """Return the words of the command that was called by a word, or still is.

    The stages of the reproduction had no `paper` before their names.
    """
    names = {name.partition(" ")[0] for name in command_modules()}
    stages = {name.split()[1] for name in command_modules() if name.startswith("paper ")}
    if word not in names and word in stages:
        return ["paper", word]
    return FORMER_NAMES.get(word, word).split()


@cache
def groups() -> dict[str, str]:
    """Return the help of groups of commands, by their words, from the packages' `GROUPS`."""
    help_texts: dict[str, str] = {}
    for package in _packages():
        help_texts |= getattr(import_module(package), "GROUPS", {})
    return help_texts


def full_name(name: str) -> str:
    """Return the name of a command; `paper` before the name of a stage may be left out."""
    stage_name = f"paper {name}"
    return stage_name if stage_name in command_modules() else name


def stage(name: str) -> Callable[..., Any]:
    """Return the function of a command (`full_name`), whose module is imported."""
    name = full_name(name)
    module = import_module(command_modules()[name][0])
    stages = (f for f in vars(module).values() if isinstance(getattr(f, "stage", None), Stage))
    function: Callable[..., Any] = next(f for f in stages if f.stage.name == name)
    return function


def as_click(function: Callable[..., Any]) -> click.Command:
    """Return the click command of a function that `command` has marked."""
    spec: Stage = function.stage  # type: ignore[attr-defined]
    # Parameters of the function are options; a dataclass has an option for each of its fields.
    help_text, meanings = read_docstring(function)
    dataclasses: dict[str, Any] = {}
    field_options: dict[str, list[click.Parameter]] = {}
    parameters: list[click.Parameter] = []
    for name, hint, default in _parameters(function):
        if name == "config":
            continue
        if is_dataclass(hint):
            dataclasses[name] = hint
            heading = cleandoc(hint.__doc__ or "").partition(";")[0].partition(".")[0]
            field_options[heading] = [_option(*field) for field in _parameters(hint)]
            parameters += field_options[heading]
        else:
            parameters.append(_option(name, hint, default, meanings.get(name)))
    # A parameter `config` comes from a file, or from words group.key=value.
    read_settings = spec.settings if "config" in signature(function).parameters else None
    if read_settings is not None:
        path = click.Path(path_type=Path, dir_okay=False)
        file_help = "Settings as the workflow writes them, instead of overrides."
        parameters.append(click.Option(["--settings", "--config"], type=path, help=file_help))
        if not any(p.nargs == -1 for p in parameters):
            parameters.append(click.Argument(["overrides"], nargs=-1))
    quiet_help = "Print neither progress nor summary."
    parameters.append(click.Option(["--quiet"], is_flag=True, help=quiet_help))

    def run(**values: Any) -> None:
        # Settings come first, because what they are may depend on the other options.
        config = {}
        if read_settings is not None:
            file, overrides = values.pop("settings"), _settings(parameters, values)
            if file is not None and overrides:
                raise click.UsageError("--settings and overrides exclude each other")
            config["config"] = read_settings(values, file, overrides)
        # Options of a dataclass become one value again.
        for name, dataclass_type in dataclasses.items():
            names = [field_name for field_name, *_ in _parameters(dataclass_type)]
            values[name] = dataclass_type(**{key: values.pop(key) for key in names})
        function(**config, **values)

    # The last word is the command's own; the others belong to its groups.
    word = spec.name.split()[-1]
    click_command = SettingsCommand(word, callback=run, params=parameters, help=help_text)
    click_command.field_options = field_options
    click_command.foreign_options = getattr(spec.settings, "foreign_options", {})
    return click_command


def read_docstring(function: Callable[..., Any]) -> tuple[str, dict[str, str]]:
    """Return the docstring of a function up to its parameters, and their meanings by name."""
    # In numpydoc's form a name begins a line, and its meaning is indented below it.
    help_text, _, section = cleandoc(function.__doc__ or "").partition(
        "\n\nParameters\n----------\n"
    )
    entries = re.findall(r"^(\w+) : .*((?:\n +.*)+)", section, re.MULTILINE)
    # Two blanks before a default, as click has them.
    meanings = {name: " ".join(text.split()) for name, text in entries}
    return help_text, {k: v.replace(" [default:", "  [default:") for k, v in meanings.items()}


def _settings(parameters: Sequence[click.Parameter], values: dict[str, Any]) -> Sequence[str]:
    """Remove the words group.key=value from the values of a command, and return them.

    They stand among the files of an argument with several values: a word with = before any / is a
    setting, so that a file a=b.fits is to be named ./a=b.fits.

    Parameters
    ----------
    parameters : sequence of click.Parameter
        All parameters of the command.
    values : dict
        Their values by name, which lose the words.

    Raises
    ------
    click.MissingParameter
        If no files are left of a required argument.
    """
    # Without files, the words have an argument of their own (`as_click`).
    if "overrides" in values:
        overrides: Sequence[str] = values.pop("overrides")
        return overrides
    # Otherwise they stand among the files of the only argument that takes several values.
    argument = next(p for p in parameters if p.nargs == -1)
    name = argument.name or ""
    settings = [str(word) for word in values[name] if re.match("[^/]*=", str(word))]
    values[name] = tuple(word for word in values[name] if str(word) not in settings)
    if not values[name] and argument.required:
        raise click.MissingParameter(param=argument)
    return settings


def format_as_words(options: Any) -> list[str]:
    """Return the fields of a dataclass that differ from their defaults, as options are typed."""
    words = []
    for name, hint, default in _parameters(type(options)):
        if (value := getattr(options, name)) != default:
            flag = _option(name, hint, default).opts[0]
            words += [flag] if value is True else [flag, str(value)]
    return words


def parse_options(options: Any, texts: Mapping[str, str]) -> dict[str, Any]:
    """Return values of a dataclass's fields from texts by name, as options take them.

    Names of no field and empty texts are left out.

    Raises
    ------
    Error
        If a text is not a value of its field; names both.
    """
    values = {}
    for name, hint, default in _parameters(options):
        if text := texts.get(name):
            try:
                values[name] = _option(name, hint, default).type(text)
            except click.BadParameter as error:
                raise Error(f"{name} = {text}: {error.message}") from None
    return values


def program(*functions: Callable[..., Any]) -> None:
    """Run commands of a program outside the package, such as of `workflow/benchmarks`."""
    Careful(commands=[as_click(function) for function in functions])()


def _parameters(function: Any) -> list[tuple[str, Any, Any]]:
    """Return name, type and default of each parameter of a function or dataclass."""
    # Annotations are texts in the modules, and classes only now.
    parameters = signature(function).parameters
    hints = get_type_hints(function, include_extras=True)
    return [(name, hints.get(name, Any), p.default) for name, p in parameters.items()]


def _option(name: str, hint: Any, default: Any, meaning: str | None = None) -> click.Parameter:
    """Return click's option or argument for a parameter of a function; see `command`."""
    # What the annotation says overrules what follows from the type.
    value_type, attributes = _click_type(hint)
    attributes = {"type": value_type, **attributes}
    attributes |= {"help": meaning} if meaning else {}
    if value_type is bool:
        attributes |= {"type": None, "is_flag": True}
    # A parameter without a default must be given.
    is_required = default is Parameter.empty
    if attributes.pop("argument", False):
        nargs = -1 if attributes.pop("multiple", False) else 1
        # Before version 8.5, arguments of click do not take a help text.
        if "help" not in signature(click.Argument).parameters:
            attributes.pop("help", None)
        return click.Argument([name], required=is_required, nargs=nargs, **attributes)
    # The help shows a default, unless it is that nothing is given.
    attributes["required"] = is_required
    if not is_required and default is not False and default not in (None, ()):
        attributes = {"default": default, "show_default": True, **attributes}
    flag = attributes.pop("flag", f"--{name.replace('_', '-')}")
    return click.Option([flag, name], **attributes)


def _click_type(hint: Any) -> tuple[Any, dict[str, Any]]:
    """Return click's type for an annotation, and further attributes of the option.

    Examples
    --------
    `Annotated[tuple[int, ...], "Sizes."]` gives int, and {"multiple": True, "help": "Sizes."}.
    """
    if get_origin(hint) is Annotated:
        # A text is the help; a dict has attributes; anything else is a type of click's.
        value_type, attributes = _click_type(get_args(hint)[0])
        for metadata in hint.__metadata__:
            if isinstance(metadata, str):
                attributes["help"] = metadata
            else:
                attributes |= metadata if isinstance(metadata, dict) else {"type": metadata}
        return attributes.pop("type", value_type), attributes
    # The first type of a union that is not None: None is the default of an option.
    if get_origin(hint) in (Union, types.UnionType):
        return _click_type(next(part for part in get_args(hint) if part is not type(None)))
    # One of some words.
    if get_origin(hint) is Literal:
        return click.Choice(get_args(hint)), {}
    if get_origin(hint) is tuple:
        # tuple[X, ...] is an option that may be repeated; tuple[X, Y] takes two values.
        elements = get_args(hint)
        if elements[-1] is ...:
            value_type, attributes = _click_type(elements[0])
            return value_type, {**attributes, "multiple": True}
        return tuple(_click_type(element)[0] for element in elements), {}
    return hint, {}
