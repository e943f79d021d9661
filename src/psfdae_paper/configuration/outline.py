"""Dataset files that differ in their values alone, so that Hydra composes one for all of them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

HEADER = "# @package _global_\n"
"""First line of a dataset's file: its keys are those of the whole configuration."""

MARK = "\0"
"""Character before and after a key that stands for its value. No YAML file can contain it."""


def outline_of(path: Path) -> tuple[dict[str, Any], dict[str, Any]] | None:
    """Read a dataset's file; return it with a mark in place of every value, and the values.

    The list of defaults, null, and text with an interpolation are not replaced.

    Returns
    -------
    tuple of dict, or None
        The marked tree, and the values by their marks. None for a file that Hydra must read
        itself: it has another header, or is damaged.
    """
    from omegaconf import OmegaConf

    try:
        text = path.read_text(encoding="utf-8")
        # OmegaConf reads 4e-3 as a number; plain YAML takes it for text.
        tree = OmegaConf.to_container(OmegaConf.create(text), resolve=False)
    except Exception:  # Hydra reads the file again and reports the error
        return None
    if not (text.startswith(HEADER) and isinstance(tree, dict)):
        return None
    defaults = {key: tree.pop(key) for key in ("defaults",) if key in tree}
    values: dict[str, Any] = {}
    return {**defaults, **_marked(tree, "", values)}, values


def _marked(tree: Mapping[Any, Any], prefix: str, values: dict[str, Any]) -> dict[str, Any]:
    """Return a tree with marks in place of values, which are added to `values`.

    `prefix` is the dotted key of the tree, with a dot at the end.
    """
    marked: dict[Any, Any] = {}
    for key, value in tree.items():
        dotted_key = f"{prefix}{key}"
        if isinstance(value, Mapping):
            marked[key] = _marked(value, f"{dotted_key}.", values)
        elif value is None or any(sign in str(value) for sign in ("${", "???")):
            marked[key] = value
        else:
            marked[key] = f"{MARK}{dotted_key}{MARK}"
            values[marked[key]] = value
    return marked


def fill_marks(tree: Any, values: Mapping[str, Any]) -> Any:
    """Return a composed tree with the values in place of their marks.

    Raises
    ------
    KeyError
        If a mark has become part of another text.
    """
    if isinstance(tree, Mapping):
        return {key: fill_marks(value, values) for key, value in tree.items()}
    if isinstance(tree, list):
        return [fill_marks(value, values) for value in tree]
    return values[tree] if isinstance(tree, str) and MARK in tree else tree
