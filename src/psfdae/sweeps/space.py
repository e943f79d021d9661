"""Points of a search space: every combination, or random draws."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product
from typing import Any

import numpy as np

from psfdae.rng import stream

DIGITS = 4
"""Significant digits of a drawn number: enough for a search, and short to paste."""


class SweepError(ValueError):
    """A sweep cannot be used; the message names the file or key and says what to do."""


def grid(space: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Every combination of the options of all axes, the last axis fastest.

    Parameters
    ----------
    space : mapping of name to config group `Axis`
        Without ranges.
    """
    names = list(space)
    return [
        dict(zip(names, options, strict=True))
        for options in product(*(space[name].options for name in names))
    ]


def draws(space: Mapping[str, Any], trials: int, seed: int) -> list[dict[str, Any]]:
    """Random values of all axes, uniform in each option or along the range.

    Each axis has a stream of its own for each draw: more trials extend the list, and
    the order of axes does not matter.

    Parameters
    ----------
    space : mapping of name to config group `Axis`
    trials, seed : int
    """
    return [
        {name: _draw(axis, stream(seed, "sweep", name, i)) for name, axis in space.items()}
        for i in range(trials)
    ]


def _draw(axis: Any, rng: np.random.Generator) -> Any:
    if axis.options:
        return axis.options[int(rng.integers(len(axis.options)))]
    # Half a step beyond the ends makes all whole numbers equally likely.
    margin = 0.5 if axis.integer else 0.0
    ends = np.array([axis.low - margin, axis.high + margin])
    value = np.exp(rng.uniform(*np.log(ends))) if axis.log else rng.uniform(*ends)
    return tidy(axis, float(value))


def tidy(axis: Any, value: float) -> int | float:
    """A number of a range, whole or with few digits, and inside the range."""
    if axis.integer:
        return int(np.clip(round(value), axis.low, axis.high))
    return float(np.clip(float(f"{value:.{DIGITS}g}"), axis.low, axis.high))


def changes(space: Mapping[str, Any], values: Mapping[str, Any]) -> dict[str, Any]:
    """Configuration keys and their values at a point of the space."""
    keys: dict[str, Any] = {}
    for name, axis in space.items():
        keys |= axis.changes(name, values[name])
    return keys


def with_values(tree: Mapping[str, Any], keys: Mapping[str, Any]) -> dict[str, Any]:
    """A configuration tree with other values at dotted keys; the tree itself stays.

    Raises
    ------
    SweepError
        If the tree has no such key, or a whole group there.
    """
    new = dict(tree)
    for key, value in keys.items():
        node, parts = new, key.split(".")
        for part in parts[:-1]:
            if not isinstance(node.get(part), Mapping):
                raise SweepError(f"{key}: unknown key")
            node[part] = dict(node[part])
            node = node[part]
        if parts[-1] not in node or isinstance(node[parts[-1]], Mapping):
            raise SweepError(f"{key}: unknown key")
        node[parts[-1]] = value
    return new
