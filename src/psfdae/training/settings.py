"""Settings of a model of an image: defaults, and values from a command line or from keywords.

A word of a command line is `group.key=value`. A word that chooses a file of a configuration, such
as `dataset=field` or `preset=smoke`, is read by the extra "paper", by its entry point of the group
"psfdae.settings".
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, ClassVar

from pydantic import Field, create_model, field_validator, model_validator

from psfdae.base.entry_points import find_entry_points
from psfdae.base.errors import did_you_mean, keyword
from psfdae.base.reading import read_yaml
from psfdae.base.settings import (
    CalibrationStars,
    ConfigError,
    Evaluation,
    Group,
    Noise,
    Parts,
    Seed,
    Stamp,
    list_keys,
    parse_settings,
)
from psfdae.methods import MethodNames, all_methods

DATASET_CHOICE = "dataset=from_stars"
"""Word that chooses the files of the configuration with the same values as these defaults."""


class Settings(Group):
    """Settings of a training on the bright stars of an image, without the settings of the methods.

    Attributes
    ----------
    seed : int
        Seed of all random streams.
    methods : list of str
        Methods that are fitted; one of them becomes the model.
    calibration_stars : CalibrationStars
        Choice of the bright stars, and the S/N to which they are degraded.
    framing : Stamp
        Side of the stamps, and the jitter of their centres.
    noise : Noise
        Noise levels λ, their factor κ, and the sky.
    parts : Parts
        Numbers of training, validation and test images.
    evaluation : Evaluation
        Settings of metrics and of the linear algebra.
    image_groups : tuple of str
        Names of the groups that determine which stars are used, and which images are made of them.
    """

    image_groups: ClassVar[tuple[str, ...]] = ("calibration_stars", "framing", "parts", "seed")

    seed: Seed = 20200611
    # Without a network, which takes longer than all of these together.
    methods: MethodNames = Field(["noisy", "lmmse", "gmm", "field"])
    calibration_stars: CalibrationStars = CalibrationStars()
    framing: Stamp = Stamp()
    # With κ = 1 a noise level is the RMS of a pixel over the star's flux. The levels are replaced
    # by the levels of the given S/N, and the sky by the image's sky if its gain is known.
    noise: Noise = Noise(name="from_stars", levels=[1e-2], kappa=1.0, background_photons=1e4)
    parts: Parts = Parts()
    evaluation: Evaluation = Evaluation()

    @field_validator("noise")
    @classmethod
    def check_noise(cls, noise: Noise) -> Noise:
        """Require Poisson noise: its law gives the errors of stars of an image."""
        noise.require_poisson("stars of an image have errors")
        return noise

    @model_validator(mode="before")
    @classmethod
    def keep_stated_size(cls, tree: Any) -> Any:
        """Keep a given size of stamps: the light that they hold shall not change it."""
        # A value or group that is not a mapping is rejected later with its key.
        if not isinstance(tree, Mapping) or not isinstance(tree.get("framing"), Mapping):
            return tree
        stars = tree.get("calibration_stars", {})
        if "stamp_px" not in tree["framing"] or not isinstance(stars, Mapping):
            return tree
        return {**tree, "calibration_stars": {"light_min": 0.0, **stars}}

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the values alone: the class of all settings is made at run time."""
        return make_settings, (self.model_dump(exclude_unset=True),)


@cache
def settings_model() -> type[Settings]:
    """Return the class of all settings, with the groups of all installed methods."""
    # A field of the class for each group of each method, by the name of the group.
    groups: dict[str, Any] = {
        name: (group, Field(default_factory=group))
        for method_class in all_methods()
        for name, group in method_class.groups.items()
    }
    return create_model("Settings", __base__=Settings, **groups)


def from_words(words: Sequence[str] = ()) -> Settings:
    """Return settings from words `group.key=value`, the value as in YAML.

    Raises
    ------
    ConfigError
        Names each wrong key with its value and the allowed range.
    """
    import yaml

    # A tree of groups, keys and values, as a file would have it.
    groups, tree = tuple(settings_model().model_fields), dict[str, Any]()
    for word in words:
        key, equals, text = word.lstrip("+").partition("=")
        group, _, name = key.partition(".")
        # Seed and list of methods are groups of a single value.
        is_group = group in ("seed", "methods") and not name
        if not equals or group not in groups or not (name or is_group):
            # The word chooses a file of a configuration, or is wrong. The extra "paper" reads the
            # former, and its message on the latter is better.
            if any(argument.lstrip("+").startswith("framing.stamp_px=") for argument in words):
                words = ("++calibration_stars.light_min=0", *words)
            for point in find_entry_points("settings"):
                return make_settings(point.load()(groups, (DATASET_CHOICE, *words)))
            names, hint = ", ".join(groups), did_you_mean(key, list_keys(settings_model()))
            raise ConfigError(f"{word}: expected group.key=value, the group one of {names}{hint}")
        try:
            value = yaml.safe_load(text)
        except yaml.YAMLError:
            raise ConfigError(f"{word}: {text!r} is not a valid YAML value") from None
        tree[group] = value if is_group else {**tree.get(group, {}), name: value}
    return parse_settings(settings_model(), tree)


@dataclass(frozen=True)
class SettingsReader:
    """Reader of the settings of a command; see `psfdae.commands.cli.Reader`."""

    choice: tuple[str, ...] = ()

    def names(self, options: Mapping[str, object]) -> tuple[str, ...]:
        """Return the names of the groups of settings."""
        return tuple(settings_model().model_fields)

    def __call__(
        self, options: Mapping[str, object], file: Path | None, words: Sequence[str]
    ) -> Settings:
        """Return settings from words, or from a YAML file."""
        return make_settings(read_yaml(file)) if file is not None else from_words(words)


def make_settings(config: Group | Mapping[str, Any]) -> Settings:
    """Return the settings of this module from a configuration, which may have more.

    Raises
    ------
    ConfigError
        Names each wrong key with its value and the allowed range.
    """
    # Groups, and their keys, that these settings do not have are left out.
    tree = config if isinstance(config, Mapping) else config.model_dump()
    settings = {}
    for name in settings_model().model_fields:
        if name in tree:
            keys, value = _keys(name), tree[name]
            settings[name] = {k: v for k, v in value.items() if k in keys} if keys else value
    return parse_settings(settings_model(), settings)


def apply_keywords(
    settings: Settings, groups: Sequence[str], keywords: Mapping[str, object]
) -> Settings:
    """Return settings with other values, given by the names of keys of some groups.

    A name in several groups belongs to the first of them.

    Raises
    ------
    ConfigError
        If no group has a name, or a value is out of its range.
    """
    # Only given values: a default may depend on them.
    tree = settings.model_dump(exclude_unset=True)
    # A group without keys, such as the seed, is itself a key.
    group_keys = {group: _keys(group) or {group} for group in groups}
    typed_word: dict[str, str] = {}
    for name, value in keywords.items():
        owner = next((group for group, keys in group_keys.items() if name in keys), None)
        if owner is None:
            names = ", ".join(key for keys in group_keys.values() for key in sorted(keys))
            hint = did_you_mean(name, names.split(", "))
            raise ConfigError(f"{name}: unknown setting; there are {names}{hint}")
        tree[owner] = value if owner == name else {**tree.get(owner, {}), name: value}
        typed_word[f"{owner}.{name}"] = keyword(name).removesuffix("=")
    try:
        return parse_settings(settings_model(), tree)
    except ConfigError as error:
        # Name a setting as it was typed, without its group.
        message = str(error)
        for key, word in typed_word.items():
            message = re.sub(rf"^{re.escape(key)}\S* = ", f"{word} = ", message, flags=re.M)
        raise ConfigError(message) from None


def _keys(group: str) -> set[str]:
    """Return the keys of a group of settings; none if it is a single value such as the seed."""
    # The type of the group's field: a class of settings, or the type of a number.
    kind = settings_model().model_fields[group].annotation
    return {*kind.model_fields} if isinstance(kind, type) and issubclass(kind, Group) else set()
