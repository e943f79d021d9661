"""Readers of YAML, JSON and CSV; of a wrong or damaged file, one line says what is wrong."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, SupportsFloat, TypeVar, overload

from psfdae.files import ProductError

if TYPE_CHECKING:
    from pandas import DataFrame

Value = TypeVar("Value")


def read_yaml(path: Path | None) -> dict[str, Any]:
    """Read a YAML file with a mapping of texts to plain values, as JSON could hold it.

    Raises
    ------
    ProductError
        If the file is missing or has something else; names file, line and column.
    """
    tree = parse_yaml(path)
    if not isinstance(tree, dict):
        raise ProductError(f"{path}: damaged (no mapping in it); write it again")
    _require_plain(path, tree)
    return tree


def _require_plain(path: Path | None, tree: Any) -> None:
    """Refuse keys that are no texts, and values such as dates that JSON does not know."""
    if isinstance(tree, dict):
        for key, value in tree.items():
            if not isinstance(key, str):
                raise ProductError(f"{path}: key {key!r} is no text")
            _require_plain(path, value)
    elif isinstance(tree, list):
        for value in tree:
            _require_plain(path, value)
    elif not isinstance(tree, str | int | float | None):
        raise ProductError(f"{path}: {tree!r} is neither text nor number")


def parse_yaml(path: Path | None) -> Any:
    """Return the content of a YAML file, which is of any type.

    Raises
    ------
    ProductError
        If the file is missing or wrong, or has a key twice; names file, line and column.
    """
    import yaml

    assert path is not None
    text = _text(path)
    try:
        loader = yaml.SafeLoader(text)
        node = loader.get_single_node()
        if node is None:
            return None
        # Before any value is made, because aliases of aliases may fill the memory.
        _count_values(node, {})
        return loader.construct_document(node)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        position = f": {_mark(mark)}" if mark is not None else ""
        problem = " ".join(f"{error.context or ''} {error.problem or ''}".split())
        raise ProductError(f"{path}{position}: {problem or 'no YAML'}") from None
    except yaml.reader.ReaderError as error:
        code = f"#x{ord(text[error.position]):04x}"
        raise ProductError(
            f"{path}: {_line_and_column(text[: error.position])}: character {code} is not allowed"
        ) from None
    except RecursionError:
        raise ProductError(f"{path}: nested too deeply") from None
    except ProductError as error:
        raise ProductError(f"{path}{error}") from None
    except Exception as error:  # PyYAML's constructors do not all have errors of their own
        raise ProductError(f"{path}: a value that cannot be read ({error})") from None


def _count_values(node: Any, counts: dict[int, int]) -> int:
    """Return the number of values of a YAML node once its aliases are written out.

    `counts` has those of nodes that were counted before, by identity: an alias is the same node.

    Raises
    ------
    ProductError
        If a mapping has a key twice, or there are more than a million values.
    """
    import yaml

    if id(node) in counts:
        return counts[id(node)]
    counts[id(node)] = 1
    children: list[Any] = []
    if isinstance(node, yaml.MappingNode):
        keys = set()
        for key, value in node.value:
            children += [key, value]
            # The merge key << may be there several times.
            if isinstance(key, yaml.ScalarNode) and key.tag != "tag:yaml.org,2002:merge":
                if (key.tag, key.value) in keys:
                    raise ProductError(
                        f": {_mark(key.start_mark)}: key {key.value!r} is there twice"
                    )
                keys.add((key.tag, key.value))
    elif isinstance(node, yaml.SequenceNode):
        children = node.value
    counts[id(node)] = 1 + sum(_count_values(child, counts) for child in children)
    # No file of ours has a thousandth of this.
    if counts[id(node)] > 1_000_000:
        raise ProductError(f": {_mark(node.start_mark)}: more than 1000000 values")
    return counts[id(node)]


def _mark(mark: Any) -> str:
    return f"line {mark.line + 1}, column {mark.column + 1}"


def _line_and_column(preceding_text: str) -> str:
    """Return the position in a file after a text, counted from line 1, column 1."""
    column = len(preceding_text) - preceding_text.rfind("\n")
    return f"line {preceding_text.count(chr(10)) + 1}, column {column}"


def _text(path: Path) -> str:
    """Return the content of a file in UTF-8; raise ProductError if it cannot be read."""
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise ProductError(f"{path}: no such file") from None
    except OSError as error:
        raise ProductError(f"{path}: {error.strerror}") from None
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError as error:
        position = _line_and_column(data[: error.start].decode("utf-8"))
        byte = f"{data[error.start]:#04x}"
        raise ProductError(f"{path}: {position}: byte {byte} is not UTF-8") from None


@overload
def from_tree(path: Path, tree: object, *keys: str) -> Any: ...
@overload
def from_tree(path: Path, tree: object, *keys: str, make: Callable[[Any], Value]) -> Value: ...
def from_tree(
    path: Path, tree: Any, *keys: str, make: Callable[[Any], Value] | None = None
) -> Any | Value:
    """Return a part of the content of a file, or what `make` makes of it.

    Parameters
    ----------
    path : Path
        The file, for messages.
    tree : object
        Its content.
    *keys : str
        Keys from the top of the tree to the part.
    make : callable, optional
        Makes the result from the part.

    Raises
    ------
    ProductError
        If a key is missing, or `make` refuses its value.
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
    """Read a JSON file with an object; raise ProductError that names file, line and column."""
    try:
        tree = json.loads(_text(path))
    except json.JSONDecodeError as error:
        position = f"line {error.lineno}, column {error.colno}"
        raise ProductError(f"{path}: {position}: {error.msg}") from None
    except RecursionError:
        raise ProductError(f"{path}: nested too deeply") from None
    except ValueError as error:
        raise ProductError(f"{path}: damaged ({error}); write it again") from None
    if not isinstance(tree, dict):
        raise ProductError(f"{path}: damaged (no object in it); write it again")
    return tree


def read_csv(path: Path, *columns: str) -> list[dict[str, str]]:
    """Read the rows of a CSV file; raise ProductError if one of the columns named is missing."""
    try:
        reader = csv.DictReader(_text(path).splitlines(keepends=True))
        missing = [name for name in columns if name not in (reader.fieldnames or ())]
        if missing:
            raise ProductError(f"{path}: column {missing[0]!r} is missing")
        return list(reader)
    except csv.Error as error:
        raise ProductError(f"{path}: damaged ({error}); delete it and run again") from error


def read_table(path: Path, **options: Any) -> DataFrame:
    """Read a CSV file as a DataFrame, with pandas' options; raise ProductError if it is damaged."""
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
    """Return a cell of a table as a number; raise ProductError, which names the file, if none."""
    try:
        return float(text)
    except (TypeError, ValueError):
        raise ProductError(f"{path}: damaged ({text!r} is no number)") from None
