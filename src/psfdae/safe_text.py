"""Text out of other people's files, made fit for a terminal and for a spreadsheet."""

from __future__ import annotations

FORMULA = ("=", "+", "-", "@", "\t", "\r")
"""First characters of what a spreadsheet takes for a formula and executes."""


def one_line(text: object) -> str:
    """The text without line breaks and characters that do not print."""
    words = " ".join(str(text).split())
    return "".join(c if c.isprintable() else "?" for c in words)


def no_formula(text: str) -> str:
    """The text, with an apostrophe before it if a spreadsheet would execute it; numbers stay."""
    if not text.startswith(FORMULA):
        return text
    try:
        float(text)
    except ValueError:
        return "'" + text
    return text
