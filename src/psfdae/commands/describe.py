"""Command `describe`: what a model was trained for, and how accurately it restores stars."""

from __future__ import annotations

from typing import Annotated

from psfdae.base.options import File
from psfdae.commands.cli import command
from psfdae.denoise.bundle import Bundle, read_bundle
from psfdae.denoise.description import error_table, model_facts
from psfdae.image.errors import one_line


@command("describe")
def describe(bundle: Annotated[File | None, {"argument": True}] = None) -> None:
    """Say what BUNDLE (default: the shipped one) was trained for and how well it does."""
    print(description(read_bundle(bundle)))


def description(bundle: Bundle) -> str:
    """Return the facts about a model and the errors of its test stars as text.

    Facts stand one in a line; the table of errors has a row for each noise level.

    Parameters
    ----------
    bundle : Bundle
        Model to describe.
    """
    # Names are padded to the longest one, so that all facts begin in the same column.
    facts = model_facts(bundle)
    width = max(len(name) for name in facts)
    lines = [f"{name:<{width}}  {one_line(value)}" for name, value in facts.items()]
    if (table := error_table(bundle.info)) is None:
        return "\n".join(lines)
    # The second line is a rule of dashes below the headings.
    headings, _, *rows = table.pformat(max_lines=-1, max_width=-1, align=">")
    table_lines = [line.rstrip() for line in (headings, *rows)]
    return "\n".join([*lines, "", "Errors of the test stars:", *table_lines])
