"""The points of a sweep, each with its configuration.

A `Plan` follows from the name of a sweep and the overrides of the workflow. Each of its points has
values of the axes, the whole configuration of a training, and a name, the hash of the latter.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

from psfdae.base.errors import Error, did_you_mean
from psfdae.base.settings import ConfigError, dump_deciding, leaves
from psfdae_paper.configuration.alignment import Alignment
from psfdae_paper.configuration.compose import (
    compose,
    part,
    select_overrides,
    select_stage_groups,
    validate_tree,
)
from psfdae_paper.configuration.consistency import SIMULATION
from psfdae_paper.configuration.sweep import Axis, Sweep, Value, find_sweeps, load_sweep
from psfdae_paper.sweeps import study


class SweepError(Error, ValueError):
    """A sweep cannot be used; the message names the file or key, and a remedy."""


def changes(space: Mapping[str, Axis], values: Mapping[str, Value]) -> dict[str, Value]:
    """Return the configuration keys and their values at a point of the space."""
    # An axis may stand for several keys.
    keys: dict[str, Value] = {}
    for name, axis in space.items():
        # Later axes cannot change the same key (`Sweep.check_keys`).
        keys |= axis.changes(name, values[name])
    return keys


def set_values(tree: Mapping[str, Any], keys: Mapping[str, Value]) -> dict[str, Any]:
    """Return a copy of a configuration tree with other values at dotted keys.

    Raises
    ------
    SweepError
        If a key does not exist, or is a whole group.
    """
    changed_tree, known_keys = dict(tree), [key for key, _ in leaves(tree)]
    for dotted_key, value in keys.items():
        # Copy each group on the way to the key, so that the given tree does not change.
        node, (*groups, key) = changed_tree, dotted_key.split(".")
        for group in groups:
            if not isinstance(node.get(group), Mapping):
                raise SweepError(f"{dotted_key}: unknown key{did_you_mean(dotted_key, known_keys)}")
            node[group] = dict(node[group])
            node = node[group]
        if key not in node or isinstance(node[key], Mapping):
            raise SweepError(f"{dotted_key}: unknown key{did_you_mean(dotted_key, known_keys)}")
        node[key] = value
    return changed_tree


@dataclass(frozen=True)
class Point:
    """One training of a sweep.

    Attributes
    ----------
    name : str
        Hash of all that decides the result.
    values : dict
        Value of every axis; empty for a trial of an adaptive sweep, whose values are proposed
        when it runs.
    keys : dict
        Configuration keys that differ from the dataset's, with those that all points share.
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
        Name of the sweep in a file of `config/sweep`.
    sweep : Sweep
        Checked sweep.
    tree : dict
        Whole configuration that the points start from.
    """

    name: str
    sweep: Sweep
    tree: dict[str, Any]

    @cached_property
    def points(self) -> dict[str, Point]:
        """Points by name in the order of the sweep; equal ones are one point."""
        # Values of adaptive trials are proposed when they run: only their limits can be checked.
        if self.sweep.kind == "adaptive":
            for name, axis in self.sweep.space.items():
                ends = [] if axis.options else [int(e) if axis.integer else e for e in axis.ends]
                for value in axis.options or ends:
                    keys = {**self.sweep.overrides, **axis.changes(name, value)}
                    self._point_config(keys, {name: value})
            points = [self._point({}, slot) for slot in range(self.sweep.trials or 0)]
        else:
            points = [self._point(values) for values in study.list_values(self.sweep)]
        # A later point of the same name is the same training.
        return {point.name: point for point in points}

    @property
    def levels(self) -> list[float]:
        """Noise levels λ of validation and test: always the dataset's."""
        return list(self.tree["noise"]["levels"])

    @property
    def search(self) -> dict[str, Any]:
        """Settings that decide the values which an adaptive sweep proposes."""
        # All that Optuna gets, or that its results depend on.
        keys = ("space", "seed", "metric", "direction", "startup", "parallel", "overrides")
        return self.sweep.model_dump(include=set(keys), exclude_none=True)

    def earlier_trials(self, point: Point) -> list[Point]:
        """Return the trials on whose results a trial of an adaptive sweep depends.

        These are all that are certain to be finished while `parallel` trials run at once,
        so that the proposed values do not depend on which trial happens to end first.
        """
        if point.slot is None:
            return []
        return list(self.points.values())[: max(0, point.slot + 1 - self.sweep.parallel)]

    def propose_values(self, point: Point, earlier_results: Sequence[Mapping[str, Any]]) -> Point:
        """Return a trial of an adaptive sweep with values, which follow from earlier results.

        Parameters
        ----------
        point : Point
            Trial without values.
        earlier_results : sequence of mappings
            Results of `earlier_trials`, in their order.

        Raises
        ------
        SweepError
            If the configuration does not allow the values.
        """
        assert point.slot is not None
        earlier_study = study.create_study(self.sweep, earlier_results, point.slot)
        values = study.ask(earlier_study, self.sweep)
        keys = {**self.sweep.overrides, **changes(self.sweep.space, values)}
        return replace(point, values=values, keys=keys, config=self._point_config(keys, values))

    def _point(self, values: dict[str, Value], slot: int | None = None) -> Point:
        """Make the point at some values of the axes, or the trial of a number."""
        # Keys that all points share, and keys of the axes.
        keys = {**self.sweep.overrides, **(changes(self.sweep.space, values) if values else {})}
        config = self._point_config(keys, values)
        # All that can change the result: points with the same content have the same name.
        content = {
            "model": self.sweep.model,
            "split": self.sweep.split,
            "reference": self.sweep.reference,
            "levels": self.levels,
            "data": self.data_config,
            "config": dump_deciding(part(self.sweep.reads, config)),
            "search": None if slot is None else {**self.search, "slot": slot},
        }
        # 12 hexadecimal digits: among 1e5 points, two names agree by chance once in 5e4 sweeps.
        return Point(compute_hash(content)[:12], values, keys, config, slot)

    def _point_config(
        self, keys: Mapping[str, Value], values: Mapping[str, Value]
    ) -> dict[str, Any]:
        """Return the groups of a point with some keys set; SweepError names file and point."""
        # A value that the configuration rejects is a mistake in the sweep.
        try:
            config = validate_tree(set_values(self.tree, keys)).model_dump()
        except (SweepError, ConfigError) as error:
            settings = ", ".join(f"{name}={value}" for name, value in values.items())
            point = f" (point {settings})" if values else ""
            path = find_sweeps()[self.name]
            message = f"{path}: {self.name}: {str(error).splitlines()[0]}{point}"
            raise SweepError(message) from None
        return select_stage_groups(self.sweep.reads, config)

    @cached_property
    def data_config(self) -> dict[str, Any]:
        """Configuration of the images that all points share."""
        # Axes do not change the images: all points are measured on the same.
        config = validate_tree(self.tree).model_dump()
        return select_stage_groups(
            SIMULATION if self.sweep.dataset else Alignment.state_groups, config
        )


def plan_sweep(name: str, overrides: Sequence[str] = ()) -> Plan:
    """Read a sweep and its dataset's configuration.

    Parameters
    ----------
    name : str
        Name of the sweep in a file of `config/sweep`.
    overrides : sequence of str
        Hydra overrides of the whole workflow, with the preset.

    Raises
    ------
    ConfigError, SweepError
        If a file is wrong; the message names file and key.
    """
    # What is varied.
    sweep = load_sweep(name)
    # The configuration of the sweep's dataset, with those overrides that concern it.
    tree = compose((*sweep.choice, *select_overrides(overrides, sweep.choice)))
    return Plan(name, sweep, tree)


def compute_hash(tree: object) -> str:
    """Return the SHA-256 of a tree as JSON with sorted keys and without spaces."""
    # The text does not depend on the order of the keys.
    canonical = json.dumps(tree, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(canonical.encode()).hexdigest()
