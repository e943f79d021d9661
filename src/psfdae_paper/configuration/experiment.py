"""Experiments: settings of datasets that are compared, each with several seeds.

An experiment is a file `config/experiment/NAME.yaml`. Each combination of a setting, a seed and a
dataset is a `Variant`, a dataset with overrides, which the workflow builds like any other dataset.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

from pydantic import Field, field_validator, model_validator

from psfdae.base.errors import did_you_mean
from psfdae.base.settings import ConfigError, Group, Name, Seed, as_literal
from psfdae_paper.configuration.base import config_dir
from psfdae_paper.configuration.compose import list_datasets, load_file
from psfdae_paper.configuration.sweep import AxisName, Value

WITHOUT_SIMULATION = ("alignment", "from_stars")
"""Datasets that have no simulated stars."""


@dataclass(frozen=True)
class Variant:
    """A dataset with the overrides of one setting and one seed of an experiment.

    Attributes
    ----------
    dataset : str
        Dataset whose configuration is changed.
    setting : str
        Name of the setting.
    seed : int
        Seed of all random draws.
    overrides : tuple of str
        Hydra overrides, the seed included.
    """

    dataset: str
    setting: str
    seed: int
    overrides: tuple[str, ...]

    @property
    def name(self) -> str:
        """Name in paths: the dataset and a hash of the overrides."""
        # Equal overrides have the same results in every experiment.
        digest = hashlib.sha256("\n".join(self.overrides).encode()).hexdigest()
        return f"{self.dataset}_{digest[:8]}"


class Experiment(Group):
    """Datasets, settings and seeds that the target `experiment` builds and compares.

    The first setting is the one that the others are divided by.
    """

    preset: Name = "fast"
    """Option of the group config/preset, unless the command line has another."""
    datasets: Annotated[list[Name], Field(min_length=1)]
    """Datasets with simulated stars."""
    overrides: dict[AxisName, Value] = Field(default={})
    """Configuration keys of all settings."""
    settings: Annotated[dict[Name, dict[AxisName, Value] | None], Field(min_length=1)]
    """Configuration keys of each setting, by its name."""
    seeds: Annotated[list[Seed], Field(min_length=1)]
    """Seeds of stars, noise and trainings; their scatter gives the standard errors."""

    @field_validator("datasets")
    @classmethod
    def check_datasets(cls, datasets: list[str]) -> list[str]:
        """Require datasets with simulated stars.

        Raises
        ------
        ValueError
            With the name, and the names that are allowed.
        """
        names = [name for name in list_datasets() if name not in WITHOUT_SIMULATION]
        for name in datasets:
            if name not in names:
                hint = did_you_mean(name, names)
                raise ValueError(f"{name}: must be one of {', '.join(names)}{hint}")
        return datasets

    @model_validator(mode="after")
    def check_differences(self) -> Experiment:
        """Require that datasets, seeds and settings differ, and leave the seed to `seeds`.

        Raises
        ------
        ValueError
            With the values that are equal, or the key.
        """
        keys = [
            *self.overrides,
            *(key for changes in self.settings.values() for key in changes or {}),
        ]
        for key in ("seed", "preset", "dataset"):
            if key in keys:
                raise ValueError(f"{key}: is a key of the experiment itself, not of its settings")
        for name in ("datasets", "seeds"):
            values = getattr(self, name)
            if len({*values}) < len(values):
                raise ValueError(f"{name} = {values}: must differ")
        names: dict[tuple[str, ...], str] = {}
        for setting in self.settings:
            first_name = names.setdefault(self.list_overrides(setting), setting)
            if first_name != setting:
                raise ValueError(f"settings.{setting}: is the same as {first_name}")
        return self

    def list_overrides(self, setting: str) -> tuple[str, ...]:
        """Return the Hydra overrides of a setting, without the seed."""
        # A key of the setting replaces the same key of all settings.
        keys: Mapping[str, Value] = {**self.overrides, **(self.settings[setting] or {})}
        return tuple(f"{key}={as_literal(value)}" for key, value in keys.items())

    @property
    def variants(self) -> tuple[Variant, ...]:
        """All combinations of a setting, a dataset and a seed, the seeds fastest."""
        return tuple(
            Variant(dataset, setting, seed, (*self.list_overrides(setting), f"seed={seed}"))
            for setting in self.settings
            for dataset in self.datasets
            for seed in self.seeds
        )


def list_experiments() -> list[str]:
    """Return the names of the experiments of the configuration folder."""
    return sorted(path.stem for path in config_dir().glob("experiment/[!_]*.yaml"))


def load_experiment(name: str) -> Experiment:
    """Read and check a file of `config/experiment`.

    Parameters
    ----------
    name : str
        Name of the file, without its suffix.

    Raises
    ------
    ConfigError
        If the experiment does not exist, or with one line per wrong key.
    """
    if name not in (names := list_experiments()):
        hint = did_you_mean(name, names)
        raise ConfigError(f"name = {name!r}: must be one of {', '.join(names)}{hint}")
    return load_file(Experiment, config_dir() / "experiment" / f"{name}.yaml")
