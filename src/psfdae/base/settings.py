"""Settings with their types, units, ranges, meanings and defaults, and how they are checked.

A group of settings is a class. Its keys are read from keywords, from words `group.key=value` of
a command line or from YAML; each wrong one is named with its value and the allowed range.

Plain mappings go into `parse_settings`, and checked, immutable groups come out. `deciding`,
`leaves` and `as_overrides` turn groups into mappings and texts again.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from typing import Annotated, Any, Literal, Protocol, TypeVar, get_args

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from psfdae.base.errors import Error, did_you_mean

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Fraction = Annotated[float, Field(ge=0, lt=1)]
Count = Annotated[int, Field(ge=1)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9_]+$")]

Reference = Literal["realisation", "template"]
SplitKind = Literal["random", "held_out"]


NEUTRAL = "cannot change a result"
"""Marks a setting of which no byte of a result depends: another value repeats no job."""

CheckpointSeconds = Annotated[float, Field(ge=0), NEUTRAL]


class Group(BaseModel):
    """Group of settings: immutable, and without keys beyond those that it declares."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)


Config = Any
"""Configuration whose attributes are groups. The methods decide which groups there are; therefore
the class is made when it is needed."""


class ConfigError(Error, ValueError):
    """Wrong settings; every line names a key, its value and the range."""


Model = TypeVar("Model", bound=BaseModel)


def parse_settings(model: type[Model], tree: Mapping[str, Any]) -> Model:
    """Check a configuration tree against a pydantic model.

    Parameters
    ----------
    model : type of pydantic model
    tree : mapping
        Values by key; groups are mappings.

    Returns
    -------
    pydantic model
        The settings, with defaults for keys that are not stated.

    Raises
    ------
    ConfigError
        With a line for each wrong value: key = value: what is allowed.
    """
    try:
        return model.model_validate(tree)
    except ValidationError as error:
        keys = list(keys_of(model))
        raise ConfigError("\n".join(_line(e, keys) for e in error.errors())) from None


def keys_of(model: type[BaseModel], prefix: str = "") -> Iterator[str]:
    """Yield the dotted keys of a pydantic model, those of its groups after each group's name."""
    for name, field in model.model_fields.items():
        yield prefix + name
        # A group may be one of several classes.
        for group in (field.annotation, *get_args(field.annotation)):
            if isinstance(group, type) and issubclass(group, Group):
                yield from keys_of(group, f"{prefix}{name}.")


def _line(error: Mapping[str, Any], keys: Iterable[str]) -> str:
    """Return an error of pydantic's as a line with the key, its value and what is allowed.

    `keys` are those that there are: one that is like an unknown key is named.
    """
    # Some of pydantic's messages say enough, or name the input already.
    key = ".".join(str(part) for part in error["loc"])
    message = error["msg"].removeprefix("Value error, ")
    if error["type"] == "extra_forbidden":
        return f"{key}: unknown key{did_you_mean(key, keys)}"
    if error["type"] == "missing":
        return f"{key}: missing"
    if error["type"] == "value_error":
        return f"{key}: {message}" if key else message
    # All others get the value, cut to a line or two of a terminal.
    value = repr(error["input"])
    value = value if len(value) <= 200 else f"{value[:200]}…"
    return f"{key} = {value}: {message[0].lower()}{message[1:]}"


def deciding(group: Group) -> dict[str, Any]:
    """Return the settings of a group and its groups, without those that change no result."""
    tree = group.model_dump()
    for name, field in type(group).model_fields.items():
        # Groups within the group have such settings of their own.
        value = getattr(group, name)
        if NEUTRAL in field.metadata:
            del tree[name]
        elif isinstance(value, Group):
            tree[name] = deciding(value)
    return tree


def as_overrides(tree: Mapping[str, Any]) -> list[str]:
    """Return Hydra overrides that pin every leaf of a tree, in a fixed order.

    The list is at once a command line, the trigger of a rerun (the same
    configuration gives the same text, comments and number formats do not count)
    and something that a person can paste.
    """

    # Lists without spaces and quotes, as Hydra reads them.
    def literal(value: Any) -> str:
        if isinstance(value, list):
            return "[" + ",".join(map(literal, value)) + "]"
        return value if isinstance(value, str) else json.dumps(value)

    return [f"++{key}={literal(value)}" for key, value in sorted(leaves(tree))]


def leaves(tree: Mapping[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    """Return the dotted key and the value of each leaf of a tree, in the order of the tree."""
    pairs: list[tuple[str, Any]] = []
    for key, value in tree.items():
        is_group = isinstance(value, Mapping)
        pairs += leaves(value, f"{prefix}{key}.") if is_group else [(prefix + key, value)]
    return pairs


Seed = Annotated[int, Field(ge=0, lt=2**63)]


class Stamp(Group):
    """Size and centring of stamps."""

    stamp_px: Annotated[int, Field(ge=8, le=256, multiple_of=2)] = 16
    """Side d of a stamp."""
    jitter_px: Annotated[int, Field(ge=0, le=8)] = 1
    """Centring error, uniform in ± this many whole pixels per axis."""
    subpixel: bool = True
    """Pixel grid of every realisation anywhere within ± ½ pixel, as for real stars."""


class Noise(Group):
    """Noise band: the levels λ that one dataset mixes."""

    name: Name
    """Name in titles and messages."""
    levels: Annotated[list[Positive], Field(min_length=1)]
    """Noise levels λ of the paper."""
    kappa: Positive
    """Pixel RMS of the normalised image per unit of λ."""
    background_photons: Annotated[float, Field(gt=0, le=1e12)]
    """Sky photons per pixel."""


class Parts(Group):
    """Sizes of the training, validation and test parts."""

    train_stars: Count = 3000
    """Training stars, validation included."""
    test_stars: Count = 300
    """Test stars of the random split."""
    validation_fraction: Annotated[float, Field(gt=0, le=0.5)] = 0.1
    """Part of the training stars that selects the best state."""


# Settings that a function needs, by what of them it uses: the class of all settings is made when
# it is needed (`Config`), and differs between the library and the paper.


class WithNoise(Protocol):
    """Settings with a noise model, which methods use."""

    @property
    def noise(self) -> Noise: ...


class OfFit(WithNoise, Protocol):
    """Settings that every fit depends on."""

    @property
    def seed(self) -> int: ...
    @property
    def parts(self) -> Parts: ...


class Evaluation(Group):
    """Settings of image metrics and of the restoration of test stars."""

    data_range: Positive = 0.66
    """SSIM dynamic range fitted to the paper's rows."""
    threads: Count = 1
    """Threads of the linear algebra."""


class OfTest(OfFit, Protocol):
    """Settings that every fit and its test depend on."""

    @property
    def evaluation(self) -> Evaluation: ...


class CalibrationStars(Group):
    """Choice of the stars of an image as training data, and the noise that they get."""

    snr_min: Positive | None = None
    """Least S/N of a star that is learnt from; null: 100, and lower, down to 10, where fewer than
    20 stars have that."""
    isolation_px: Positive = 12.0
    """Distance within which a neighbour is too close."""
    neighbour_ratio: Positive = 0.02
    """Brightness of such a neighbour, in that of the star, from which it disturbs."""
    misfit: Annotated[float, Field(gt=1, allow_inf_nan=False)] = 2.5
    """Difference of a misfit from the nearest stars, in that of the median star."""
    search_px: Annotated[int, Field(ge=1, le=16)] = 3
    """The brightest pixel is searched within ± this of the catalogue's position."""
    margin_px: Annotated[int, Field(ge=0, le=64)] = 8
    """Pixels around a stamp, in which the sky is measured."""
    stars_min: Annotated[int, Field(ge=1)] = 1
    """Fewest stars to learn from."""
    light_min: Annotated[float, Field(ge=0, lt=1)] = 0.95
    """Part of a star's light that stamps hold at least: where those of framing.stamp_px hold less,
    they are as wide as 98 % take. A stamp_px that is stated is taken as it is; so it is with 0."""
    centring_px: Annotated[float, Field(ge=0, le=64)] | None = None
    """FWHM of the Gaussian that smooths a star before its brightest pixel is searched; null: that
    of the stars, where their brightest pixels are off their middle."""
    bins: Annotated[int, Field(ge=1, le=64)] = 4
    """Parts of the field along a side; stars of a part are stacked."""
    snr_levels: Annotated[list[Positive], Field(min_length=1)] = Field([5.0, 10.0, 20.0, 50.0])
    """S/N to which bright stars are degraded, ascending; those above snr_min / 2, where the stars'
    own noise would count, are that."""

    @model_validator(mode="after")
    def _levels(self) -> CalibrationStars:
        """Refuse S/N that are not ascending."""
        if sorted(set(self.snr_levels)) != self.snr_levels:
            raise ValueError(f"snr_levels = {self.snr_levels}: must be ascending")
        return self

    @property
    def least_snr(self) -> float:
        """Least S/N of a star that is learnt from, where there are enough stars."""
        return 100.0 if self.snr_min is None else self.snr_min

    def lower_snr(self) -> list[float]:
        """Return the least S/N to try in turn if too few stars have more; none if one is stated."""
        return [70.0, 50.0, 35.0, 25.0, 20.0, 14.0, 10.0] if self.snr_min is None else []

    def degraded(self) -> list[float]:
        """Return the S/N to which bright stars are degraded, ascending, none above snr_min / 2."""
        return sorted({min(level, 0.5 * self.least_snr) for level in self.snr_levels})
