"""The rule `stability` writes its tables, whatever the cases say."""

from __future__ import annotations

import shutil
import sys

import pandas as pd

from workflow_runs import ROOT, captured

CASES = """
def test_case(record):
    record.at_most("at its end", "q", 1.0, 1.0)
    record.at_most("beyond", "q", 1.0001, 1.0)
    record.at_most("not a number", "q", float("nan"), 1.0)
    record.within("inside, with a comma", "q", 0.5, 0.5, 1.0)
    record.one_of("outcome", "q", "a dead network", "TrainingError", "a live network")
    with record.refused("refusal", KeyError):
        raise KeyError("k")
    with record.refused("another error", KeyError):
        raise TypeError("no\\nway")
    with record.refused("no refusal", KeyError):
        pass
    record.point("series", 2.0, None, 1e-12)

def test_that_breaks(record):
    record.equal("count", "q", 3, 3)
    raise ZeroDivisionError("oh")
"""
FAILED = {
    "1st": "1",
    "beyond": "1",
    "not a number": "nan",
    "outcome": "a dead network",
    "another error": "TypeError('no\\nway')",
    "no refusal": "no error",
    "test_that_breaks": "ZeroDivisionError('oh')",
}


def test_a_row_that_fails_and_a_case_that_breaks_stop_no_other(tmp_path):
    stress, table, graded = (tmp_path / name for name in ("stress", "t.csv", "g.csv"))
    shutil.copytree(ROOT / "tests/stress", stress, ignore=shutil.ignore_patterns("test_*", "__py*"))
    (stress / "test_optics.py").write_text(CASES)
    first = "def test_one(record): record.equal('1st', 'q', 1, 2)"
    (stress / "test_precision.py").write_text(first)
    line = [sys.executable, "-m", "pytest", stress, "--confcutdir", stress]
    line += ["-p", "no:cacheprovider", "--stability-csv", table, "--graded-csv", graded]
    run = captured(line)
    assert run.returncode == 1, run.stdout
    assert "beyond: q: expected ≤ 1, got 1" in run.stdout
    rows = pd.read_csv(table, keep_default_na=False)
    assert list(rows.columns) == ["case", "quantity", "expected", "measured", "verdict"]
    assert rows.case[0] == "1st"
    assert rows[rows.verdict == "fail"].set_index("case").measured.to_dict() == FAILED
    assert len(rows) == 11
    assert graded.read_text() == "case,stress,error,bound\nseries,2,,1e-12\n"
