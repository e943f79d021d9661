"""Whether MLflow's database still says what was imported: it is a view of the results.

Every import notes, beside the digests of the products, a hash of each run as the database
and the folder of artifacts have it. What people add to runs, such as tags and notes, does
not count, and neither do runs that they have deleted. SQLite is read directly, because
MLflow takes seconds to start.
"""

from __future__ import annotations

import csv
import hashlib
import json
import sqlite3
from collections.abc import Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

from psfdae.files import DIGESTS, atomic_path

DATABASE, ARTIFACTS, RECEIPTS = "mlflow.db", "mlartifacts", "mlflow"
"""In the results: the database, the folder of the runs' files, that of the imports' CSVs."""

BUSY = (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED, sqlite3.SQLITE_CANTOPEN, sqlite3.SQLITE_PERM)
"""What SQLite says of a database that somebody uses, or that may not be read."""

PATIENCE_S = 20.0
"""How long to wait for somebody who writes to the database."""


def note(receipt: Path, runs: Mapping[str, tuple[Sequence[str], Sequence[str]]]) -> None:
    """Keep hashes of imported runs, if the results have digests; none for a server's runs.

    Parameters
    ----------
    receipt : CSV of the import, in the results' folder `RECEIPTS`
    runs : names of the tags and of the files of each run, by its id
    """
    results = receipt.parent.parent
    noted = _noted(receipt)
    if not (results / DIGESTS).is_dir() or receipt.parent.name != RECEIPTS:
        return
    if not runs:
        noted.unlink(missing_ok=True)
        return
    with _open(results) as database:
        tree = {
            run: {"tags": list(tags), "files": list(files)} for run, (tags, files) in runs.items()
        }
        for run, entry in tree.items():
            entry["sha256"] = _hash(database, results, run, entry)
    with atomic_path(noted, digest=False) as temporary:
        temporary.write_text(json.dumps(tree), encoding="utf-8")


def damage(results: Path) -> str:
    """What is wrong with the database or the runs' files; empty if nothing is known."""
    imports = _imports(results)
    if not imports:
        return ""
    if not (results / DATABASE).is_file():
        return "missing"
    changed = ""
    try:
        with _open(results) as database:
            if database.execute("PRAGMA integrity_check").fetchall() != [("ok",)]:
                return "damaged (SQLite's integrity check)"
            for receipt in imports:
                changed = changed or _changed(database, results, receipt)
    except sqlite3.Error as error:
        code = getattr(error, "sqlite_errorcode", None)
        return "" if code in BUSY else f"damaged ({error})"
    return changed and f"not what was imported ({changed})"


def files(results: Path) -> list[Path]:
    """What has to go for everything to be imported anew."""
    view = (results / DATABASE, results / ARTIFACTS)
    return [path for path in (*view, *_imports(results)) if path.exists()]


def _imports(results: Path) -> list[Path]:
    """CSVs of the imports whose runs were noted."""
    receipts = sorted((results / RECEIPTS).glob("*.csv"))
    return [receipt for receipt in receipts if _noted(receipt).exists()]


def _noted(receipt: Path) -> Path:
    return receipt.parent.parent / DIGESTS / DATABASE / f"{receipt.stem}.json"


def _open(results: Path) -> Any:
    # Not read-only: what a killed import has left half-done is rolled back.
    uri = f"{(results / DATABASE).resolve().as_uri()}?mode=rw"
    return closing(sqlite3.connect(uri, uri=True, timeout=PATIENCE_S))


def _changed(database: sqlite3.Connection, results: Path, receipt: Path) -> str:
    """Name of the first run of an import that is another one now."""
    if not _noted(receipt).is_file():  # a pipe would be read for ever
        return receipt.stem
    with receipt.open(newline="", encoding="utf-8") as file:
        imported = [row["run_id"] for row in csv.DictReader(file)]
    try:
        noted = json.loads(_noted(receipt).read_text(encoding="utf-8"))
        if list(noted) != imported:
            return receipt.stem
        for run, entry in noted.items():
            found = _hash(database, results, run, entry)
            if found not in (None, entry["sha256"]):
                return f"run {run} of {receipt.stem}"
    except (ValueError, KeyError, TypeError, AttributeError):
        return receipt.stem
    return ""


def _hash(
    database: sqlite3.Connection, results: Path, run: str, entry: Mapping[str, Any]
) -> str | None:
    """Hash of what was imported of a run; None if somebody has removed it for good."""

    def rows(columns: str, table: str) -> list[Any]:
        query = f"SELECT {columns} FROM {table} WHERE run_uuid = ?"
        return database.execute(query, (run,)).fetchall()

    about = rows("status, start_time, end_time, artifact_uri, experiment_id", "runs")
    if not about:
        return None
    tags = dict(rows("key, value", "tags"))
    points = "key, value, timestamp, step, is_nan"
    content = [
        about,
        sorted(rows("key, value", "params")),
        sorted(rows(points, "metrics")),
        sorted(rows(points, "latest_metrics")),
        [(name, tags.get(name)) for name in entry["tags"]],
        [(name, _sha256(results, run, name)) for name in entry["files"]],
    ]
    return hashlib.sha256(json.dumps(content).encode()).hexdigest()


def _sha256(results: Path, run: str, name: str) -> str | None:
    for path in (results / ARTIFACTS).glob(f"*/{run}/artifacts/{name}"):
        if path.is_file():
            with path.open("rb") as file:
                return hashlib.file_digest(file, "sha256").hexdigest()
    return None
