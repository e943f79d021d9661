"""Bookkeeping of the stress tests: rows with a verdict, points of graded stress."""

from __future__ import annotations

import csv
import io
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from psfdae.files import ProductError, write_text

PASS, FAIL = "pass", "fail"


class StabilityError(RuntimeError):
    """A stress test failed; the message names the rows of the table."""


@dataclass(frozen=True)
class Row:
    """One line of the table: what was expected and what was measured."""

    case: str
    quantity: str
    expected: str
    measured: str
    verdict: str


@dataclass(frozen=True)
class Point:
    """One point of a series of growing stress; `error` is None where the input was refused."""

    case: str
    stress: float
    error: float | None
    bound: float


Entry = Row | Point


def at_most(case: str, quantity: str, measured: float, bound: float) -> Row:
    """Row that passes if `measured` ≤ `bound`; NaN fails."""
    return _row(case, quantity, f"≤ {bound:.3g}", f"{measured:.3g}", measured <= bound)


def within(case: str, quantity: str, measured: float, low: float, high: float) -> Row:
    """Row that passes if `low` ≤ `measured` ≤ `high`; NaN fails."""
    expected = f"{low:.3g} … {high:.3g}"
    return _row(case, quantity, expected, f"{measured:.3g}", low <= measured <= high)


def equal(case: str, quantity: str, measured: Any, expected: Any) -> Row:
    """Row that passes if both print alike; for counts, names and flags."""
    return _row(case, quantity, str(expected), str(measured), str(measured) == str(expected))


def one_of(case: str, quantity: str, measured: str, allowed: Sequence[str]) -> Row:
    """Row that passes if `measured` is one of several outcomes."""
    return _row(case, quantity, " or ".join(allowed), measured, measured in allowed)


def refused(
    case: str, action: Callable[[], Any], error: type[Exception], quantity: str = "error raised"
) -> Row:
    """Row that passes if `action` raises `error`."""
    outcome = attempt(action)
    raised = type(outcome).__name__ if isinstance(outcome, error) else _describe(outcome)
    return _row(case, quantity, error.__name__, raised, isinstance(outcome, error))


def agrees_or_refused(
    case: str,
    quantity: str,
    action: Callable[[], float],
    bound: float,
    errors: tuple[type[Exception], ...],
) -> tuple[Row, float | None]:
    """Row that passes if the number that `action` returns is ≤ `bound` or it was refused.

    Returns
    -------
    row : Row
    measured : float or None
        None if the input was refused.
    """
    expected = f"≤ {bound:.3g} or {' or '.join(e.__name__ for e in errors)}"
    outcome = attempt(action)
    if isinstance(outcome, errors):
        return _row(case, quantity, expected, type(outcome).__name__, True), None
    if isinstance(outcome, Exception):
        return _row(case, quantity, expected, _describe(outcome), False), None
    return _row(case, quantity, expected, f"{outcome:.3g}", outcome <= bound), outcome


def attempt(action: Callable[[], Any]) -> Any:
    """The result of an action, or the exception that it raised."""
    try:
        return action()
    except Exception as error:  # which one is the caller's question
        return error


def run_cases(
    cases: Iterable[Callable[[Any], Iterator[Entry]]],
    bench: Any,
    report: Callable[[str], None] = lambda name: None,
) -> tuple[list[Row], list[Point]]:
    """Run every case; one that breaks becomes a failing row and stops no other.

    Parameters
    ----------
    cases : functions of `bench` that yield rows and points
    bench : what the cases share
    report : called with the name of each case before it runs
    """
    rows: list[Row] = []
    points: list[Point] = []
    for case in cases:
        name = case.__name__.replace("_", " ")
        report(name)
        try:
            # What a broken input does to intermediate numbers is not the point here.
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", RuntimeWarning)
                for entry in case(bench):
                    (rows if isinstance(entry, Row) else points).append(entry)  # type: ignore[arg-type]
        except Exception as error:  # the table must be written whatever happens
            rows.append(_row(name, "runs to its end", "no error", _describe(error), False))
    return rows, points


def failures(rows: Iterable[Row]) -> list[Row]:
    """Rows that did not pass."""
    return [row for row in rows if row.verdict != PASS]


def check(rows: Sequence[Row]) -> None:
    """Refuse a table with a failing row, and one without any.

    Raises
    ------
    StabilityError
        Names every failing row with what was expected and measured.
    """
    if not rows:
        raise StabilityError("the table of stress tests is empty")
    failed = failures(rows)
    if failed:
        lines = [f"{r.case}: {r.quantity}: expected {r.expected}, got {r.measured}" for r in failed]
        raise StabilityError(
            f"{len(failed)} of {len(rows)} stress tests failed\n  " + "\n  ".join(lines)
        )


def write_table(path: Path, entries: Sequence[Entry], kind: type[Row] | type[Point]) -> None:
    """Write rows or points as CSV; `error` stays empty where the input was refused."""
    text = io.StringIO()
    writer = csv.DictWriter(text, [f.name for f in fields(kind)], lineterminator="\n")
    writer.writeheader()
    for entry in entries:
        writer.writerow({k: _cell(v) for k, v in asdict(entry).items()})
    write_text(path, text.getvalue())


def read_rows(path: Path) -> list[Row]:
    """Rows of a table written by `write_table`.

    Raises
    ------
    ProductError
        If the file is missing or has other columns.
    """
    try:
        with path.open(encoding="utf-8", newline="") as file:
            reader = csv.DictReader(file)
            if reader.fieldnames != [f.name for f in fields(Row)]:
                raise ProductError(f"{path}: columns {reader.fieldnames}, not those of a table")
            return [Row(**line) for line in reader]
    except FileNotFoundError:
        raise ProductError(f"{path}: no such file") from None


def _row(case: str, quantity: str, expected: str, measured: str, passed: Any) -> Row:
    return Row(case, quantity, expected, measured, PASS if bool(passed) else FAIL)


def _describe(outcome: Any) -> str:
    if isinstance(outcome, Exception):
        first = (str(outcome).splitlines() or [""])[0]
        return f"{type(outcome).__name__}: {first[:160]}"
    return "no error"


def _cell(value: Any) -> Any:
    if isinstance(value, float | np.floating):
        return f"{value:.6g}"
    return value
