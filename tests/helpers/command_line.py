"""`psfdae` in this process: what it says, and the one line with which it refuses."""

from __future__ import annotations

from click.testing import CliRunner

from psfdae.commands.cli import main, present_name


def psfdae(*words):
    """A command's result; a test fails on a traceback. `paper` before a stage may be left out."""
    return typed(*present_name(str(words[0])), *words[1:])


def typed(*words):
    """The result of the words as they are typed."""
    result = CliRunner().invoke(main, list(map(str, words)))
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return result


def printed(*words):
    """The output of a command that ends with code 0."""
    result = psfdae(*words)
    assert result.exit_code == 0, (words, result.output)
    return result.output


def refused(*words):
    """The one line of a command that ends with code 2."""
    result = psfdae(*words)
    assert result.exit_code == 2, result.output
    assert len(result.output.splitlines()) == 1, result.output
    assert result.output.startswith("psfdae: "), result.output
    return result.output
