"""Dataset files that differ in their values alone, so that Hydra composes one for all of them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

HEADER = "# @package _global_\n"
"""First line of a dataset's file: its keys are those of the whole configuration."""

MARK = "\0"
"""Around a key that stands for its value. No YAML file can hold this character."""


def outline_of(path: Path) -> tuple[dict[str, Any], dict[str, Any]] | None:
    """Content of a dataset's file with a mark in place of every value, and the marked values.

    Left as they are: the list of defaults, null, and what contains an interpolation.

    Returns
    -------
    tuple of dict, or None
        None for a file that Hydra must read itself: it has another header, or is damaged.
    """
    from omegaconf import OmegaConf

    try:
        text = path.read_text(encoding="utf-8")
        # OmegaConf reads 4e-3 as a number; plain YAML takes it for text.
        tree = OmegaConf.to_container(OmegaConf.create(text), resolve=False)
    except Exception:  # what is wrong is for Hydra to say
        return None
    if not (text.startswith(HEADER) and isinstance(tree, dict)):
        return None
    defaults = {key: tree.pop(key) for key in ("defaults",) if key in tree}
    values: dict[str, Any] = {}
    return {**defaults, **_marked(tree, "", values)}, values


def _marked(tree: Mapping[Any, Any], above: str, values: dict[str, Any]) -> dict[str, Any]:
    marked: dict[Any, Any] = {}
    for key, value in tree.items():
        place = f"{above}{key}"
        if isinstance(value, Mapping):
            marked[key] = _marked(value, f"{place}.", values)
        elif value is None or any(sign in str(value) for sign in ("${", "???")):
            marked[key] = value
        else:
            marked[key] = f"{MARK}{place}{MARK}"
            values[marked[key]] = value
    return marked


def filled(tree: Any, values: Mapping[str, Any]) -> Any:
    """A composed tree with the values in place of their marks.

    Raises
    ------
    KeyError
        If a mark has become part of another text.
    """
    if isinstance(tree, Mapping):
        return {key: filled(value, values) for key, value in tree.items()}
    if isinstance(tree, list):
        return [filled(value, values) for value in tree]
    return values[tree] if isinstance(tree, str) and MARK in tree else tree
