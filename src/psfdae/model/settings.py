"""Settings of a model of one's own stars: defaults in classes, words of a command line, keywords.

A word that chooses a file of a configuration, such as `train=onecycle` or `preset=smoke`, is for
what the extra "paper" adds by an entry point of the group "psfdae.settings".
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from pydantic import Field, create_model, model_validator

from psfdae.joined import joined
from psfdae.methods import MethodNames, known
from psfdae.reading import read_yaml
from psfdae.settings import (
    CalibrationStars,
    ConfigError,
    Evaluation,
    Group,
    Noise,
    Parts,
    Seed,
    Stamp,
    validate,
)

CHOSEN = "dataset=from_stars"
"""The choice of the configuration's files with the same values."""


class Settings(Group):
    """Settings of a training on the bright stars of an image, but for those of the methods."""

    seed: Seed = 20200611
    # A network takes longer than the others together.
    methods: MethodNames = Field(["noisy", "lmmse", "gmm", "field"])
    calibration_stars: CalibrationStars = CalibrationStars()
    framing: Stamp = Stamp()
    # κ = 1 makes a noise level the RMS of a pixel over the star's flux. The levels are replaced
    # by those of the S/N asked for, and the sky by that of the image where its gain is known.
    noise: Noise = Noise(name="from_stars", levels=[1e-2], kappa=1.0, background_photons=1e4)
    parts: Parts = Parts()
    evaluation: Evaluation = Evaluation()

    @model_validator(mode="before")
    @classmethod
    def _stated_size(cls, tree: Any) -> Any:
        """A size of stamps that is stated is taken as it is: no light asks for another one."""
        if not isinstance(tree, Mapping) or not isinstance(tree.get("framing"), Mapping):
            return tree
        stars = tree.get("calibration_stars", {})
        if "stamp_px" not in tree["framing"] or not isinstance(stars, Mapping):
            return tree
        return {**tree, "calibration_stars": {"light_min": 0.0, **stars}}

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the values alone: the class of all settings is made at run time."""
        return _unpickled, (), self.__getstate__()


def _unpickled() -> Settings:
    """Return settings without values, which pickle fills in."""
    kind = settings_model()
    return kind.__new__(kind)


@cache
def settings_model() -> type[Settings]:
    """The model of all settings, those of the methods of `config.yaml` included."""
    groups: dict[str, Any] = {
        name: (group, Field(default_factory=group))
        for kind in known()
        for name, group in kind.groups.items()
    }
    return create_model("Settings", __base__=Settings, **groups)


def from_words(words: Sequence[str] = ()) -> Settings:
    """Settings from words `group.key=value`, the value as in YAML.

    Raises
    ------
    ConfigError
        Names each wrong key with its value and the allowed range.
    """
    fields = settings_model().model_fields
    tree: dict[str, Any] = {}
    for word in words:
        key, equals, text = word.lstrip("+").partition("=")
        group, _, name = key.partition(".")
        plain = group in ("seed", "methods") and not name
        if not equals or (group in fields and not (name or plain)) or group not in fields:
            return of_config(_composed(tuple(fields), word, words))
        value = _value(text, word)
        tree |= {group: value} if plain else {group: {**tree.get(group, {}), name: value}}
    return validate(settings_model(), tree)


def _composed(groups: tuple[str, ...], word: str, words: Sequence[str]) -> Group:
    """Groups of settings where a word chooses a file, or is wrong, of which Hydra says more."""
    if any(word.lstrip("+").startswith("framing.stamp_px=") for word in words):
        words = ("++calibration_stars.light_min=0", *words)
    for point in joined("settings"):
        settings: Group = point.load()(groups, (CHOSEN, *words))
        return settings
    raise ConfigError(f"{word}: expected group.key=value, the group one of {', '.join(groups)}")


@dataclass(frozen=True)
class Words:
    """Reads the settings of a command; see `psfdae.cli.Reader`."""

    choice: tuple[str, ...] = ()

    def of(self, options: Mapping[str, object]) -> tuple[str, ...]:
        """Names of the groups of settings."""
        return tuple(settings_model().model_fields)

    def __call__(
        self, options: Mapping[str, object], file: Path | None, words: Sequence[str]
    ) -> Settings:
        """The settings of words, or of a YAML file."""
        return of_config(read_yaml(file)) if file is not None else from_words(words)


def of_config(config: Group | Mapping[str, Any]) -> Settings:
    """The settings among those of a configuration, a model or a tree, which may have more.

    Raises
    ------
    ConfigError
        As `from_words`.
    """
    tree = config if isinstance(config, Mapping) else config.model_dump()
    found = {}
    for name in settings_model().model_fields:
        if name in tree:
            keys = _keys(name)
            value = tree[name]
            found[name] = {k: v for k, v in value.items() if k in keys} if keys else value
    return validate(settings_model(), found)


def _value(text: str, word: str) -> Any:
    import yaml

    try:
        return yaml.safe_load(text)
    except yaml.YAMLError:
        raise ConfigError(f"{word}: {text!r} is no value") from None


def with_keywords(
    settings: Settings, groups: Sequence[str], keywords: Mapping[str, object]
) -> Settings:
    """Settings with other values, given by the names of keys of some groups.

    A name that several of the groups have is that of the first one.

    Raises
    ------
    ConfigError
        If no group has a name, or a value is out of its range.
    """
    tree = settings.model_dump(exclude_unset=True)
    for name, value in keywords.items():
        owner = next((group for group in groups if _has(group, name)), None)
        if owner is None:
            known = [key for group in groups for key in sorted(_keys(group) or (group,))]
            raise ConfigError(f"{name}: unknown setting; there are {', '.join(known)}")
        tree[owner] = value if owner == name else {**tree.get(owner, {}), name: value}
    return validate(settings_model(), tree)


def _has(group: str, name: str) -> bool:
    return name in _keys(group) or (group == name and not _keys(group))


def _keys(group: str) -> set[str]:
    kind = settings_model().model_fields[group].annotation
    return {*kind.model_fields} if isinstance(kind, type) and issubclass(kind, Group) else set()


IMAGE_GROUPS = ("calibration_stars", "framing", "parts", "seed")
"""Groups that decide which stars are used, and which images are made of them."""
