"""Readers of YAML, JSON and CSV files, with messages of one line for wrong or damaged files.

Inputs: the path of a file. Outputs: plain values or a table. A wrong or damaged file raises a
`ProductError` that names the file and, where known, line and column.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import yaml

from psfdae.base.errors import no_such_file, require_file
from psfdae.base.files import ProductError, map_texts, strip_apostrophe
from psfdae.base.types import DataFrame


def read_yaml(path: Path) -> dict[str, Any]:
    """Read a YAML file with a mapping.

    Raises
    ------
    ProductError
        If the file is missing or its content is not a mapping; names file, line and column.
    """
    tree = parse_yaml(path)
    if not isinstance(tree, dict):
        raise ProductError(f"{path}: damaged (no mapping in it); write it again")
    return tree


def parse_yaml(path: Path) -> Any:
    """Return the content of a YAML file, of any plain type; a file cannot run code.

    Raises
    ------
    ProductError
        If the file is missing or wrong, or has a key twice; names file, line and column.
    """
    # Errors of PyYAML have several lines, which contain the position and the problem.
    try:
        return yaml.load(_text(path), UniqueKeyLoader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        location = f": line {mark.line + 1}, column {mark.column + 1}" if mark else ""
        problem = " ".join(f"{error.context or ''} {error.problem or ''}".split())
        raise ProductError(f"{path}{location}: {problem or 'no YAML'}") from None
    except RecursionError:
        raise ProductError(f"{path}: nested too deeply") from None
    except (yaml.YAMLError, ValueError) as error:  # a character or a date that is invalid
        raise ProductError(f"{path}: no YAML ({' '.join(str(error).split())})") from None


class UniqueKeyLoader(yaml.SafeLoader):
    """Loader of plain values that rejects repeated keys of a mapping; PyYAML takes the last."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """Return the mapping of a node; raise ConstructorError at a repeated key."""
        # Keys of this mapping that have been seen.
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
    # At once: files that people write are small.
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
        location = f"line {len(lines)}, column {len(lines[-1]) + 1}"
        byte = f"{data[error.start]:#04x}"
        raise ProductError(f"{path}: {location}: byte {byte} is not UTF-8") from None


def from_tree(
    path: Path, tree: Any, key: str, make: Callable[[Any], Any] = lambda value: value
) -> Any:
    """Return the value of a key in the content of a file, converted by `make`.

    Parameters
    ----------
    path : Path
        The file, for messages.
    tree : object
        Its content.
    key : str
        Key of the mapping at the top of the file.
    make : callable, optional
        Function that converts the value to the result; by default the value is returned.

    Raises
    ------
    ProductError
        If the key is missing, or `make` raises an error.
    """
    if not isinstance(tree, dict) or key not in tree:
        raise ProductError(f"{path}: key {key!r} is missing")
    # Errors of `make` are raised with the names of file and key.
    try:
        return make(tree[key])
    except (ValueError, TypeError, ArithmeticError) as error:
        raise ProductError(f"{path}: {key}: {' '.join(str(error).split())}") from None


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON file with an object.

    Raises
    ------
    ProductError
        If the file is missing or damaged, or its content is not an object.
    """
    # A damaged file may also be nested too deeply.
    try:
        tree = json.loads(_text(path))
    except (ValueError, RecursionError) as error:
        raise ProductError(f"{path}: damaged ({error}); write it again") from None
    if not isinstance(tree, dict):
        raise ProductError(f"{path}: damaged (no object in it); write it again")
    return tree


def read_table(path: Path, *columns: str, **options: Any) -> DataFrame:
    """Read a CSV or Parquet file as a DataFrame; apostrophes of `no_formula` are removed.

    Parameters
    ----------
    path : Path
        The file; a name that ends in .parquet is read as Parquet, any other as CSV.
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

    # pandas raises ValueError for cells that are not of the requested type.
    require_file(path)
    try:
        if path.suffix == ".parquet":
            # pyarrow verifies the checksums of pages only on request.
            table = pd.read_parquet(path, page_checksum_verification=True, **options)
        else:
            table = map_texts(pd.read_csv(path, **options), strip_apostrophe)
    except FileNotFoundError:
        raise ProductError(no_such_file(path)) from None
    except (OSError, ValueError, pd.errors.ParserError, RecursionError) as error:
        line = " ".join(str(error).split())
        raise ProductError(f"{path}: damaged ({line}); delete it and run again") from error
    # Further columns are allowed.
    if missing := [name for name in columns if name not in table]:
        raise ProductError(f"{path}: column {missing[0]!r} is missing")
    return table
