"""Text files that people write or disks damage: YAML, JSON and CSV; one line says what is wrong."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, SupportsFloat, TypeVar, overload

from psfdae.files import ProductError

if TYPE_CHECKING:
    from pandas import DataFrame

Made = TypeVar("Made")

MOST_NODES = 1_000_000
"""Values that a YAML file may have once its aliases are written out."""


def read_yaml(path: Path | None) -> dict[str, Any]:
    """A YAML file with a mapping of texts to plain values, as JSON could hold it.

    Raises
    ------
    ProductError
        Names file, line and column of what is wrong.
    """
    tree = parse_yaml(path)
    if not isinstance(tree, dict):
        raise ProductError(f"{path}: damaged (no mapping in it); write it again")
    _plain(path, tree)
    return tree


def _plain(path: Path | None, tree: Any) -> None:
    if isinstance(tree, dict):
        for key, value in tree.items():
            if not isinstance(key, str):
                raise ProductError(f"{path}: key {key!r} is no text")
            _plain(path, value)
    elif isinstance(tree, list):
        for value in tree:
            _plain(path, value)
    elif not isinstance(tree, str | int | float | None):
        raise ProductError(f"{path}: {tree!r} is neither text nor number")


def parse_yaml(path: Path | None) -> Any:
    """Return the content of a YAML file; a key given twice is a mistake.

    Raises
    ------
    ProductError
        As `read_yaml`.
    """
    import yaml

    assert path is not None
    text = _text(path)
    try:
        loader = yaml.SafeLoader(text)
        node = loader.get_single_node()
        if node is None:
            return None
        _check(node, {})
        return loader.construct_document(node)
    except yaml.MarkedYAMLError as error:
        raise ProductError(_complaint(path, error)) from None
    except yaml.reader.ReaderError as error:
        where = _place(text, error.position)
        found = f"character #x{ord(text[error.position]):04x} is not allowed"
        raise ProductError(f"{path}: {where}: {found}") from None
    except RecursionError:
        raise ProductError(f"{path}: nested too deeply") from None
    except ProductError as error:
        raise ProductError(f"{path}{error}") from None
    except Exception as error:  # PyYAML's constructors do not all have errors of their own
        raise ProductError(f"{path}: a value that cannot be read ({error})") from None


def _check(node: Any, sizes: dict[int, int]) -> int:
    """Number of values below a node; refuses equal keys, and aliases that multiply."""
    import yaml

    if id(node) in sizes:
        return sizes[id(node)]
    sizes[id(node)] = 1
    parts: list[Any] = []
    if isinstance(node, yaml.MappingNode):
        seen = set()
        for key, value in node.value:
            parts += [key, value]
            if isinstance(key, yaml.ScalarNode) and key.tag != "tag:yaml.org,2002:merge":
                if (key.tag, key.value) in seen:
                    where = _mark(key.start_mark)
                    raise ProductError(f": {where}: key {key.value!r} is there twice")
                seen.add((key.tag, key.value))
    elif isinstance(node, yaml.SequenceNode):
        parts = node.value
    sizes[id(node)] = 1 + sum(_check(part, sizes) for part in parts)
    if sizes[id(node)] > MOST_NODES:
        raise ProductError(f": {_mark(node.start_mark)}: more than {MOST_NODES} values")
    return sizes[id(node)]


def _complaint(path: Path, error: Any) -> str:
    mark = error.problem_mark or error.context_mark
    where = f": {_mark(mark)}" if mark is not None else ""
    what = " ".join(part for part in (error.context, error.problem) if part)
    return f"{path}{where}: {' '.join(what.split()) or 'no YAML'}"


def _mark(mark: Any) -> str:
    return f"line {mark.line + 1}, column {mark.column + 1}"


def _place(text: str, position: int) -> str:
    before = text[:position]
    return f"line {before.count(chr(10)) + 1}, column {position - before.rfind(chr(10))}"


def _text(path: Path) -> str:
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise ProductError(f"{path}: no such file") from None
    except OSError as error:
        raise ProductError(f"{path}: {error.strerror}") from None
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError as error:
        before = data[: error.start].decode("utf-8")
        where = _place(before, len(before))
        found = f"byte {data[error.start]:#04x} is not UTF-8"
        raise ProductError(f"{path}: {where}: {found}") from None


@overload
def from_tree(path: Path, tree: object, *keys: str) -> Any: ...
@overload
def from_tree(path: Path, tree: object, *keys: str, make: Callable[[Any], Made]) -> Made: ...
def from_tree(
    path: Path, tree: Any, *keys: str, make: Callable[[Any], Made] | None = None
) -> Any | Made:
    """A part of what a file holds, by its keys, made into something.

    Raises
    ------
    ProductError
        If a key is missing, or `make` refuses what it finds.
    """
    name = ".".join(keys)
    for key in keys:
        if not isinstance(tree, dict) or key not in tree:
            raise ProductError(f"{path}: key {name!r} is missing")
        tree = tree[key]
    if make is None:
        return tree
    try:
        return make(tree)
    except (ValueError, TypeError, ArithmeticError) as error:
        line = " ".join(str(error).split())
        raise ProductError(f"{path}: {name}: {line}") from None


def read_json(path: Path) -> dict[str, Any]:
    """A JSON file with an object; raises ProductError that names file, line and column."""
    try:
        tree = json.loads(_text(path))
    except json.JSONDecodeError as error:
        where = f"line {error.lineno}, column {error.colno}"
        raise ProductError(f"{path}: {where}: {error.msg}") from None
    except RecursionError:
        raise ProductError(f"{path}: nested too deeply") from None
    except ValueError as error:
        raise ProductError(f"{path}: damaged ({error}); write it again") from None
    if not isinstance(tree, dict):
        raise ProductError(f"{path}: damaged (no object in it); write it again")
    return tree


def read_csv(path: Path, *columns: str) -> list[dict[str, str]]:
    """Rows of a CSV with the columns named; raises ProductError."""
    try:
        reader = csv.DictReader(_text(path).splitlines(keepends=True))
        missing = [name for name in columns if name not in (reader.fieldnames or ())]
        if missing:
            raise ProductError(f"{path}: column {missing[0]!r} is missing")
        return list(reader)
    except csv.Error as error:
        raise ProductError(f"{path}: damaged ({error}); delete it and run again") from error


def read_table(path: Path, **options: Any) -> DataFrame:
    """A CSV as a pandas DataFrame, read with its options; raises ProductError."""
    import pandas as pd

    try:
        table: DataFrame = pd.read_csv(path, **options)
    except FileNotFoundError:
        raise ProductError(f"{path}: no such file") from None
    except (ValueError, pd.errors.ParserError, RecursionError) as error:
        line = " ".join(str(error).split())
        raise ProductError(f"{path}: damaged ({line}); delete it and run again") from error
    return table


def number(path: Path, text: str | SupportsFloat) -> float:
    """A number of a table; raises ProductError that names the file."""
    try:
        return float(text)
    except (TypeError, ValueError):
        raise ProductError(f"{path}: damaged ({text!r} is no number)") from None
