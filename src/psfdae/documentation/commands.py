"""Reference of the command line: every command with its usage, arguments and options."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator

import click


def command_reference(group: click.Group, name: str) -> str:
    """Sections of a group and of all its commands, in Markdown.

    Parameters
    ----------
    group : click.Group
    name : str
        What the user types.
    """
    context = click.Context(group, info_name=name)
    return "\n".join(_section(group, context, level=2)).strip()


def command_names(group: click.Group, name: str) -> list[str]:
    """Full names of all commands that are not groups."""
    context = click.Context(group, info_name=name)
    return [
        found.command_path
        for command, found in _walk(group, context)
        if not isinstance(command, click.Group)
    ]


def _walk(
    command: click.Command, context: click.Context
) -> Iterator[tuple[click.Command, click.Context]]:
    yield command, context
    if isinstance(command, click.Group):
        for name in command.list_commands(context):
            member = command.get_command(context, name)
            if member is not None and not member.hidden:
                yield from _walk(member, click.Context(member, info_name=name, parent=context))


def _section(command: click.Command, context: click.Context, level: int) -> Iterator[str]:
    for number, (member, found) in enumerate(_walk(command, context)):
        if number > 0:
            depth = min(level + found.command_path.count(" ") - 1, 4)
            yield f"{'#' * depth} `{found.command_path}`"
            yield ""
        # Click ends a help text at a form feed.
        text = inspect.cleandoc(member.help or "").split("\f")[0]
        yield from (_prose(part) for part in text.split("\n\n") if part)
        if not isinstance(member, click.Group):
            usage = " ".join([found.command_path, *member.collect_usage_pieces(found)])
            yield f"```text\n{usage}\n```\n"
        yield from _options(member, found)


def _prose(paragraph: str) -> str:
    """A paragraph; one that click prints as it stands keeps its lines."""
    if paragraph.startswith("\b"):
        lines = paragraph.removeprefix("\b").strip("\n")
        return f"```text\n{lines}\n```\n"
    return " ".join(paragraph.split()).replace("<", "&lt;") + "\n"


def _options(command: click.Command, context: click.Context) -> list[str]:
    records = [
        record
        for parameter in command.get_params(context)
        if (record := parameter.get_help_record(context)) is not None
        # The usage line has the arguments; those with a help text are listed, too.
        and "--help" not in parameter.opts
        and (record[1] or isinstance(parameter, click.Option))
    ]
    if not records:
        return []
    rows = [f"| `{_cell(names)}` | {_meaning(about)} |" for names, about in records]
    return ["| option | meaning |", "|---|---|", *rows, ""]


def _cell(text: str) -> str:
    return re.sub(r"\s+", " ", text).replace("|", " / ").strip()


def _meaning(text: str) -> str:
    """A help text; what click adds in brackets, which Markdown reads as a link, in italics."""
    return re.sub(r"\s*\[([^\]]*)\]$", r" *(\1)*", _cell(text)).strip()
