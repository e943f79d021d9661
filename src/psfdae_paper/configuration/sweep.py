"""Configuration of a sweep (`config/sweep/*.yaml`): its axes, and the choice of the best point.

The input is the name of a sweep in one of these files, the output a checked `Sweep`.
`psfdae_paper.sweeps.points` computes its points.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, field_validator, model_validator

from psfdae.base.errors import did_you_mean
from psfdae.base.reading import read_yaml
from psfdae.base.settings import ConfigError, Count, Finite, Group, Name, Reference, SplitKind
from psfdae.methods import list_groups, method
from psfdae_paper.configuration.alignment import NETWORKS, Alignment
from psfdae_paper.configuration.base import config_dir
from psfdae_paper.configuration.compose import load_file
from psfdae_paper.configuration.estimators import ESTIMATORS, list_swept_networks
from psfdae_paper.configuration.methods import list_methods

Scalar = bool | int | float | str
Value = Scalar | list[Scalar]

AxisName = Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_.]*$")]
Metric = Literal["validation_mse", "validation_ssim", "validation_mae"]


class Axis(Group):
    """Setting that a sweep varies: listed values, named sets of values, or a range.

    A sweep has an axis for each name below `space`, such as
    `train.lr: {low: 1.0e-4, high: 1.0e-2, log: true}` or `gmm.components: [[4], [16], [64]]`.
    """

    # One of three forms: values, choices or a range.
    values: Annotated[list[Value], Field(min_length=1)] | None = None
    """Listed values; a bare list means the same."""
    choices: Annotated[dict[str, dict[str, Value]], Field(min_length=1)] | None = None
    """Name of each choice, and the keys with values that it stands for."""
    # Both ends belong to the range.
    low: Finite | None = None
    """Lower end of a range."""
    high: Finite | None = None
    """Upper end of a range."""
    log: bool = False
    """A range that is even in the logarithm."""
    integer: bool = False
    """A range of whole numbers."""
    # Keys to which the value of the axis is written.
    keys: Annotated[list[str], Field(min_length=1)] | None = None
    """Configuration keys that get the value; default: the axis' name."""
    repeat: Count | None = None
    """The key gets a list with the value this many times."""

    @model_validator(mode="before")
    @classmethod
    def expand_short_forms(cls, tree: object) -> object:
        """Accept a bare list as values, and names of choices that YAML reads as numbers.

        Parameters
        ----------
        tree : object
            An axis as YAML has it.

        Returns
        -------
        object
            The same as a mapping with the keys of this class; anything else is left to the check of
            the types, which rejects it.
        """
        # YAML reads a name such as 3 as a number; names of choices are text.
        if isinstance(tree, list):
            return {"values": tree}
        if isinstance(tree, Mapping) and isinstance(tree.get("choices"), Mapping):
            return {**tree, "choices": {str(name): v for name, v in tree["choices"].items()}}
        return tree

    @model_validator(mode="after")
    def check_form(self) -> Axis:
        """Require exactly one of the three forms, with its own keys only.

        Raises
        ------
        ValueError
            If there is not exactly one form, a range is empty or lacks an end, or keys of another
            form are given.
        """
        # Both ends of a range together are one form.
        end_count = (self.low is not None) + (self.high is not None)
        form_count = (self.values is not None) + (self.choices is not None) + (end_count > 0)
        if form_count != 1 or end_count == 1:
            raise ValueError("needs either values, or choices, or low and high")
        # Keys that only one of the forms has.
        if self.choices is not None and (self.keys or self.repeat):
            raise ValueError("choices contain their keys: remove keys and repeat")
        if self.low is not None and self.high is not None:
            # A range needs a length, and a logarithmic one numbers above 0.
            if not self.low < self.high:
                raise ValueError(f"low = {self.low:g}: must be below high = {self.high:g}")
            if self.log and self.low <= 0:
                raise ValueError(f"low = {self.low:g}: must be above 0 on a logarithmic range")
            if self.integer and not (self.low.is_integer() and self.high.is_integer()):
                raise ValueError(f"low = {self.low:g}, high = {self.high:g}: must be whole numbers")
        # The type of listed values is clear from the values.
        elif self.log or self.integer:
            raise ValueError("log and integer belong to a range, low and high")
        return self

    @property
    def options(self) -> list[Value]:
        """Listed values, or the names of the choices; empty for a range."""
        return list(self.values or self.choices or ())

    @property
    def ends(self) -> tuple[float, float]:
        """Lower and upper end of a range."""
        assert self.low is not None
        assert self.high is not None
        return self.low, self.high

    def changes(self, name: str, value: Value) -> dict[str, Value]:
        """Return the configuration keys and their values at a value of the axis `name`.

        A choice brings its own keys; any other value is set in `keys`, or in the key that names
        the axis, as a list of equal numbers if `repeat` is given.

        Parameters
        ----------
        name : str
            Name of the axis, which is the key that it changes unless `keys` has others.
        value : bool, int, float, str or list
            One of `options`, or a number between the ends.

        Returns
        -------
        dict
            Value of each key, such as {"train.lr": 0.001}.
        """
        if self.choices is not None:
            return dict(self.choices[str(value)])
        if self.repeat is not None:
            # A list of equal numbers, such as one width for all layers.
            assert not isinstance(value, list)
            return dict.fromkeys(self.keys or [name], [value] * self.repeat)
        return dict.fromkeys(self.keys or [name], value)


class Sweep(Group):
    """Points of one model that are trained alike and compared by one metric.

    A file of `config/sweep` has it by its name. `psfdae paper sweep list NAME` prints its points,
    the target `sweep` of the workflow trains and compares them, and `psfdae paper best NAME` prints
    the best one.
    """

    # Model and data of the trainings.
    kind: Literal["grid", "random", "adaptive"]
    """Every combination, random draws, or draws that depend on earlier results."""
    model: str
    """Method, or one of scene 3's networks."""
    dataset: Name | None = None
    """Dataset; none for scene 3's networks."""
    split: SplitKind = "random"
    """Split of the stars."""
    reference: Reference = "realisation"
    """Truth that the DAE is to restore."""
    # How the best point is chosen; errors on the test part choose nothing.
    metric: Metric
    """Chooses the best point: over all noise levels."""
    direction: Literal["minimize", "maximize"]
    """Direction of a better metric."""
    # Settings that all points share, and settings that are varied.
    overrides: dict[AxisName, Value] = Field(default={})
    """Configuration keys that all points share."""
    space: Annotated[dict[AxisName, Axis], Field(min_length=1)]
    """Axes that are varied, by name."""
    # Of random and adaptive sweeps.
    trials: Count | None = None
    """Number of draws; not for a grid."""
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 0
    """Seed of the draws."""
    startup: Count = 4
    """Adaptive: random trials at the start."""
    parallel: Count = 2
    """Adaptive: trials that may run at once."""

    @field_validator("model")
    @classmethod
    def check_name(cls, name: str) -> str:
        """Require a method that stores a model, or a network of scene 3.

        Raises
        ------
        ValueError
            With the names that are allowed.
        """
        # Methods without a file have nothing to train.
        names = (method_class.name for method_class in list_methods() if method_class.storage)
        models = (*names, *list_swept_networks())
        if name not in models:
            raise ValueError(f"{name!r} is not one of {', '.join(models)}")
        return name

    @property
    def choice(self) -> tuple[str, ...]:
        """Override that chooses the dataset, or scene 3."""
        return Alignment.choice if self.dataset is None else (f"dataset={self.dataset}",)

    @property
    def reads(self) -> tuple[str, ...]:
        """Groups of the configuration that decide a point."""
        return list_point_groups(self.model)

    @property
    def varied(self) -> tuple[str, ...]:
        """Keys and groups that may differ between points; all points share their stars."""
        return (
            ESTIMATORS[self.model].swept
            if self.model in list_swept_networks()
            else (*method(self.model).groups, "noise.levels")
        )

    @model_validator(mode="after")
    def check_model(self) -> Sweep:
        """Require a dataset and a metric that the model has, and trials for random draws.

        Raises
        ------
        ValueError
            For the first of these keys that does not go with the model or the kind of the sweep.
        """
        # A grid has as many points as combinations.
        if (self.kind == "grid") != (self.trials is None):
            raise ValueError("trials: random and adaptive sweeps need it, a grid has none")
        # Methods restore the stars of a dataset; networks of scene 3 have states.
        if (self.model in list_swept_networks()) != (self.dataset is None):
            raise ValueError("dataset: methods need one, scene 3's networks have none")
        if self.choice == Alignment.choice and self.dataset is not None:
            raise ValueError(f"dataset = {self.dataset}: scene 3 has no stars that methods restore")
        # Networks of scene 3 have errors of states of misalignment, methods of images of stars.
        metrics = ["validation_mae"]
        if self.dataset is not None:
            metrics = ["validation_mse", "validation_ssim"]
        if self.metric not in metrics:
            raise ValueError(
                f"metric = {self.metric}: model {self.model} has {' or '.join(metrics)}"
            )
        return self

    @model_validator(mode="after")
    def check_axes(self) -> Sweep:
        """Reject names of columns, ranges in a grid, and lists that would be repeated.

        Raises
        ------
        ValueError
            With the name of the axis.
        """
        # The summary has these columns in addition to the columns of the axes.
        columns = ("point", "status", "reason", "epochs", "attempt", "best")
        for name, axis in self.space.items():
            if name in columns or name.startswith(("validation_", "test_")):
                raise ValueError(f"space.{name}: is a column of the summary; choose another name")
            # A range is not a finite set of values.
            if self.kind == "grid" and not axis.options:
                raise ValueError(f"space.{name}: a grid needs values or choices, not a range")
            # A list of lists is not a value of a key.
            if axis.repeat and any(isinstance(value, list) for value in axis.options):
                raise ValueError(f"space.{name}: repeat needs single values, not lists")
        return self

    @model_validator(mode="after")
    def check_keys(self) -> Sweep:
        """Reject keys that the model does not read, and keys that are set by two axes.

        Raises
        ------
        ValueError
            With the key, and those that may be changed.
        """
        # An axis has the keys of all its choices; a range has the same keys at every value.
        keys = list(self.overrides)
        for name, axis in self.space.items():
            options = axis.options or [0]
            keys += {key for option in options for key in axis.changes(name, option)}
        # The key itself, or the group that it is in, must be one that may differ between points.
        for key in keys:
            if not any(key == prefix or key.startswith(f"{prefix}.") for prefix in self.varied):
                raise ValueError(
                    f"{key}: a sweep of {self.model} may change {', '.join(self.varied)}"
                )
            # The later axis would win silently.
            if keys.count(key) > 1:
                raise ValueError(f"{key}: set more than once")
        return self


def list_point_groups(model: str) -> tuple[str, ...]:
    """Return the groups of the configuration that a point of a model reads.

    Parameters
    ----------
    model : str
        Name of a method, or of a network of scene 3.

    Returns
    -------
    tuple of str
        Names of the groups. A point is named by the hash of their values, so that a change of any
        other group repeats no training.
    """
    if model in list_swept_networks():
        return ("seed", "noise", *NETWORKS, f"train_{model}", "evaluation")
    return (*list_groups(model), "evaluation")


def find_sweeps() -> dict[str, Path]:
    """Return the file of each sweep of the configuration folder, by the name of the sweep.

    Raises
    ------
    ConfigError, ProductError
        If a file is not a mapping of sweeps by their names, or a name is in two files.
    """
    files: dict[str, Path] = {}
    for path in sorted(config_dir().glob("sweep/[!_]*.yaml")):
        for name, sweep in read_yaml(path).items():
            if not isinstance(sweep, Mapping):
                raise ConfigError(f"{path}: {name}: expected sweeps by name, NAME: {{kind: …}}")
            if name in files:
                raise ConfigError(f"{path}: {name}: is also in {files[name].name}")
            files[str(name)] = path
    return files


def load_sweep(name: str) -> Sweep:
    """Read and check a sweep of `config/sweep`.

    Parameters
    ----------
    name : str
        Name of the sweep in its file.

    Raises
    ------
    ConfigError, ProductError
        If the sweep does not exist, or with one line per wrong key: file, key, allowed values.
    """
    files = find_sweeps()
    if name not in files:
        hint = did_you_mean(name, sorted(files))
        raise ConfigError(f"sweep = {name!r}: must be one of {', '.join(sorted(files))}{hint}")
    return load_file(Sweep, files[name], name)
