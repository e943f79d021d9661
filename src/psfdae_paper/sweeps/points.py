"""The points of a sweep: every combination or random draws, each with its configuration."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np

from psfdae.errors import Error
from psfdae.rng import stream
from psfdae.settings import ConfigError
from psfdae_paper.configuration.alignment import STATE_GROUPS
from psfdae_paper.configuration.base import config_dir
from psfdae_paper.configuration.compose import (
    compose,
    decisive_settings,
    overrides_for,
    stage_tree,
    validate_tree,
)
from psfdae_paper.configuration.consistency import SIMULATION
from psfdae_paper.configuration.sweep import Axis, Sweep, Value, load_sweep

DIGITS = 4
"""Significant digits of a drawn number: enough for a search, and short to paste."""


class SweepError(Error, ValueError):
    """A sweep cannot be used; the message names the file or key and says what to do."""


def grid(space: Mapping[str, Axis]) -> list[dict[str, Value]]:
    """Every combination of the options of all axes, none of them a range, the last axis fastest."""
    names = list(space)
    return [
        dict(zip(names, options, strict=True))
        for options in product(*(space[name].options for name in names))
    ]


def draws(space: Mapping[str, Axis], trials: int, seed: int) -> list[dict[str, Value]]:
    """Random values of all axes, uniform in each option or along the range.

    Each axis has a stream of its own for each draw: more trials extend the list, and
    the order of axes does not matter.
    """
    return [
        {name: _draw(axis, stream(seed, "sweep", name, i)) for name, axis in space.items()}
        for i in range(trials)
    ]


def _draw(axis: Axis, rng: np.random.Generator) -> Value:
    if axis.options:
        return axis.options[int(rng.integers(len(axis.options)))]
    # Half a step beyond the ends makes all whole numbers equally likely.
    margin = 0.5 if axis.integer else 0.0
    low, high = axis.ends
    ends = np.array([low - margin, high + margin])
    value = np.exp(rng.uniform(*np.log(ends))) if axis.log else rng.uniform(*ends)
    return tidy(axis, float(value))


def tidy(axis: Axis, value: float) -> int | float:
    """A number of a range, whole or with few digits, and inside the range."""
    if axis.integer:
        return int(np.clip(round(value), *axis.ends))
    return float(np.clip(float(f"{value:.{DIGITS}g}"), *axis.ends))


def changes(space: Mapping[str, Axis], values: Mapping[str, Value]) -> dict[str, Value]:
    """Configuration keys and their values at a point of the space."""
    keys: dict[str, Value] = {}
    for name, axis in space.items():
        keys |= axis.changes(name, values[name])
    return keys


def with_values(tree: Mapping[str, Any], keys: Mapping[str, Value]) -> dict[str, Any]:
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


NAME_LENGTH = 12
"""Hexadecimal digits of a point's name: in 1e5 points, two alike by chance once in 5e4 sweeps."""


@dataclass(frozen=True)
class Point:
    """One training of a sweep.

    Attributes
    ----------
    name : str
        Hash of all that decides the result.
    values : dict
        Value of every axis; empty for a trial of an adaptive sweep, which finds its own.
    keys : dict
        Configuration keys that differ from the dataset's, those that all points share included.
    config : dict
        Groups that the point's stage reads.
    slot : int or None
        Number of a trial of an adaptive sweep.
    """

    name: str
    values: dict[str, Value]
    keys: dict[str, Value]
    config: dict[str, Any]
    slot: int | None = None


@dataclass(frozen=True)
class Plan:
    """A sweep with its points.

    Attributes
    ----------
    name : str
    sweep : Sweep
    given : tuple of str
        The workflow's overrides, for all points.
    tree : dict
        Whole configuration that the points start from.
    """

    name: str
    sweep: Sweep
    given: tuple[str, ...]
    tree: dict[str, Any]

    @cached_property
    def points(self) -> dict[str, Point]:
        """Points by name in the order of the sweep; equal ones are one point."""
        if self.sweep.kind == "adaptive":
            self._check_range()
            found = [self._point({}, slot) for slot in range(self.sweep.trials or 0)]
        elif self.sweep.kind == "random":
            drawn = draws(self.sweep.space, self.sweep.trials or 0, self.sweep.seed)
            found = [self._point(values) for values in drawn]
        else:
            found = [self._point(values) for values in grid(self.sweep.space)]
        return {point.name: point for point in found}

    @property
    def levels(self) -> list[float]:
        """Noise levels λ of validation and test: the dataset's, whatever a point trains on."""
        return list(self.tree["noise"]["levels"])

    @property
    def search(self) -> dict[str, Any]:
        """What decides the values that an adaptive sweep asks for."""
        keys = ("space", "seed", "metric", "direction", "startup", "parallel", "overrides")
        return self.sweep.model_dump(include=set(keys), exclude_none=True)

    def known(self, point: Point) -> list[Point]:
        """Trials that a trial of an adaptive sweep learns from.

        They are all that are certain to be finished while `parallel` trials run at once,
        so that the values asked for do not depend on which one happens to end first.
        """
        if point.slot is None:
            return []
        return list(self.points.values())[: max(0, point.slot + 1 - self.sweep.parallel)]

    def _point(self, values: dict[str, Value], slot: int | None = None) -> Point:
        keys = {**self.sweep.overrides, **(changes(self.sweep.space, values) if values else {})}
        config = self._checked(keys, values)
        content = {
            "model": self.sweep.model,
            "split": self.sweep.split,
            "reference": self.sweep.reference,
            "levels": self.levels,
            "data": self._data,
            "config": decisive_settings(config),
            "search": None if slot is None else {**self.search, "slot": slot},
        }
        return Point(hash_of(content)[:NAME_LENGTH], values, keys, config, slot)

    def _checked(self, keys: Mapping[str, Value], values: Mapping[str, Value]) -> dict[str, Any]:
        """The stage's groups with some keys set, or an error that names file and point."""
        where = config_dir() / "sweep" / f"{self.name}.yaml"
        try:
            tree = with_values(self.tree, keys)
            whole = validate_tree(tree).model_dump()
        except (SweepError, ConfigError) as error:
            at = f" (point {', '.join(f'{k}={v}' for k, v in values.items())})" if values else ""
            raise SweepError(f"{where}: {str(error).splitlines()[0]}{at}") from None
        return stage_tree(self.sweep.reads, whole)

    @cached_property
    def _data(self) -> dict[str, Any]:
        """Configuration of the images that all points share."""
        return stage_tree(SIMULATION if self.sweep.dataset else STATE_GROUPS, self._base)

    @cached_property
    def _base(self) -> dict[str, Any]:
        return validate_tree(self.tree).model_dump()

    def _check_range(self) -> None:
        """Refuse a space with a corner that the configuration does not allow."""
        ends = [
            {name: option}
            for name, axis in self.sweep.space.items()
            for option in axis.options or [int(end) if axis.integer else end for end in axis.ends]
        ]
        for values in ends:
            (name,) = values
            keys = self.sweep.space[name].changes(name, values[name])
            self._checked({**self.sweep.overrides, **keys}, values)


def plan_sweep(name: str, given: Sequence[str] = ()) -> Plan:
    """Read a sweep and its dataset's configuration.

    Parameters
    ----------
    name : str
        A file of `config/sweep`.
    given : sequence of str
        Hydra overrides of the whole workflow, the preset among them.

    Raises
    ------
    ConfigError, SweepError
        Name file and key.
    """
    sweep = load_sweep(name)
    chosen = (*sweep.choice, *overrides_for(given, sweep.choice))
    return Plan(name, sweep, tuple(given), compose(chosen))


def hash_of(tree: object) -> str:
    """Hash of a tree in its canonical JSON."""
    canonical = json.dumps(tree, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(canonical.encode()).hexdigest()
