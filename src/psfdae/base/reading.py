"""Readers of YAML, JSON and CSV; of a wrong or damaged file, one line says what is wrong.

The path of a file goes in, and plain values or a table come out. What is wrong is a `ProductError`
that names the file and, if it is known, line and column.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from psfdae.base.errors import no_such_file, require_file
from psfdae.base.files import ProductError, map_texts, strip_apostrophe

if TYPE_CHECKING:
    from pandas import DataFrame


def read_yaml(path: Path) -> dict[str, Any]:
    """Read a YAML file with a mapping.

    Raises
    ------
    ProductError
        If the file is missing or has something else; names file, line and column.
    """
    tree = parse_yaml(path)
    if not isinstance(tree, dict):
        raise ProductError(f"{path}: damaged (no mapping in it); write it again")
    return tree


def parse_yaml(path: Path) -> Any:
    """Return the content of a YAML file, which is of any type: no code of a file is run.

    Raises
    ------
    ProductError
        If the file is missing or wrong, or has a key twice; names file, line and column.
    """
    # Errors of PyYAML take several lines; the place and the problem are in them.
    try:
        return yaml.load(_text(path), UniqueKeyLoader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        place = f": line {mark.line + 1}, column {mark.column + 1}" if mark else ""
        problem = " ".join(f"{error.context or ''} {error.problem or ''}".split())
        raise ProductError(f"{path}{place}: {problem or 'no YAML'}") from None
    except RecursionError:
        raise ProductError(f"{path}: nested too deeply") from None
    except (yaml.YAMLError, ValueError) as error:  # such as a character, or a date, that is none
        raise ProductError(f"{path}: no YAML ({' '.join(str(error).split())})") from None


class UniqueKeyLoader(yaml.SafeLoader):
    """Loader of plain values that refuses a mapping with a key twice; YAML takes the last."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """Return the mapping of a node; ConstructorError with the place of a repeated key."""
        keys = set()
        for key, _ in node.value:
            # The merge key << may be there several times.
            if isinstance(key, yaml.ScalarNode) and key.tag != "tag:yaml.org,2002:merge":
                if key.value in keys:
                    problem = f"key {key.value!r} is there twice"
                    raise yaml.constructor.ConstructorError(None, None, problem, key.start_mark)
                keys.add(key.value)
        return super().construct_mapping(node, deep)


def _text(path: Path) -> str:
    """Return the content of a file in UTF-8; raise ProductError if it cannot be read."""
    # The whole file at once: the files that people write are small.
    require_file(path)
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise ProductError(no_such_file(path)) from None
    except OSError as error:
        raise ProductError(f"{path}: {error.strerror}") from None
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError as error:
        # Position of the wrong byte, counted from line 1, column 1.
        lines = data[: error.start].decode("utf-8").split("\n")
        place = f"line {len(lines)}, column {len(lines[-1]) + 1}"
        byte = f"{data[error.start]:#04x}"
        raise ProductError(f"{path}: {place}: byte {byte} is not UTF-8") from None


def from_tree(
    path: Path, tree: Any, key: str, make: Callable[[Any], Any] = lambda value: value
) -> Any:
    """Return the value of a key in the content of a file, or what `make` makes of it.

    Parameters
    ----------
    path : Path
        The file, for messages.
    tree : object
        Its content.
    key : str
    make : callable, optional
        Makes the result from the value.

    Raises
    ------
    ProductError
        If the key is missing, or `make` refuses its value.
    """
    if not isinstance(tree, dict) or key not in tree:
        raise ProductError(f"{path}: key {key!r} is missing")
    # What `make` raises gets the names of file and key.
    try:
        return make(tree[key])
    except (ValueError, TypeError, ArithmeticError) as error:
        raise ProductError(f"{path}: {key}: {' '.join(str(error).split())}") from None


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON file with an object.

    Raises
    ------
    ProductError
        If the file is missing or damaged, or has something else.
    """
    try:
        tree = json.loads(_text(path))
    except (ValueError, RecursionError) as error:
        raise ProductError(f"{path}: damaged ({error}); write it again") from None
    if not isinstance(tree, dict):
        raise ProductError(f"{path}: damaged (no object in it); write it again")
    return tree


def read_table(path: Path, *columns: str, **options: Any) -> DataFrame:
    """Read a CSV or Parquet file as a DataFrame; texts are as they were before `no_formula`.

    Parameters
    ----------
    path : Path
    *columns : str
        Names of columns that it must have.
    **options
        Options of `pandas.read_csv`, or `pandas.read_parquet` if the name ends in .parquet.

    Raises
    ------
    ProductError
        If the file is missing or damaged, or lacks a column; the message names the file.
    """
    import pandas as pd

    # pandas raises ValueError for cells that are not of the type that is asked for.
    require_file(path)
    try:
        if path.suffix == ".parquet":
            # pyarrow verifies the checksums of pages only if it is asked to.
            table = pd.read_parquet(path, page_checksum_verification=True, **options)
        else:
            table = map_texts(pd.read_csv(path, **options), strip_apostrophe)
    except FileNotFoundError:
        raise ProductError(no_such_file(path)) from None
    except (OSError, ValueError, pd.errors.ParserError, RecursionError) as error:
        line = " ".join(str(error).split())
        raise ProductError(f"{path}: damaged ({line}); delete it and run again") from error
    # Columns beyond those that are asked for are allowed.
    if missing := [name for name in columns if name not in table]:
        raise ProductError(f"{path}: column {missing[0]!r} is missing")
    return table
