"""README and docs as tests see them: their shell and Python blocks."""

from __future__ import annotations

import re
import shlex
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
FENCE = re.compile(r"^(`{3,}|~{3,})(\w*)[^\n]*\n(.*?)^\1", re.M | re.S)


@dataclass(frozen=True)
class Command:
    """A line of a shell block: its words, the text of its heredoc, and what a user types."""

    words: tuple[str, ...]
    heredoc: str = ""
    typed: str = field(default="", compare=False)


def pages():
    """Names of all pages that a user reads."""
    docs = sorted(f"docs/{path.name}" for path in (ROOT / "docs").glob("*.md"))
    project = [f"{name}.md" for name in ("README", "CONTRIBUTING", "SECURITY", "CHANGELOG")]
    return [*project, "config/README.md", *docs]


def read(page):
    """Text of a page."""
    return (ROOT / page).read_text(encoding="utf-8")


def blocks(text, language):
    """Texts of the code blocks of a language."""
    return [body for _, block_language, body in FENCE.findall(text) if block_language == language]


def commands(text):
    """Commands of all `sh` blocks, in order."""
    command_lines = []
    for block in blocks(text, "sh"):
        lines = iter(block.replace("\\\n", " ").splitlines())
        for line in lines:
            heredoc = re.search(r"<<-?\s*'?(\w+)'?", line)
            typed, typed_and_output = [line], []
            while heredoc:
                typed.append(next(lines))
                if typed[-1].strip() == heredoc[1]:
                    break
                typed_and_output.append(typed[-1] + "\n")
            words = shlex.split(line.replace(heredoc[0], "") if heredoc else line, comments=True)
            if words:
                command_lines.append(
                    Command(tuple(words), "".join(typed_and_output), "\n".join(typed))
                )
    return command_lines
