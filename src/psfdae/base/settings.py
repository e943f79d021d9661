"""Settings with their types, units, ranges, meanings and defaults, and their check.

A group of settings is a class. Its keys are read from keywords, from words `group.key=value` of
a command line or from YAML. An error names each wrong key with its value and the allowed range.

`parse_settings` converts plain mappings to checked, immutable groups. `dump_deciding`, `leaves`
and `as_overrides` convert groups to mappings and texts.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from typing import Annotated, Any, Literal, Protocol, TypeVar, get_args

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    SerializerFunctionWrapHandler,
    ValidationError,
    model_serializer,
    model_validator,
)

from psfdae.base.errors import Error, did_you_mean

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Fraction = Annotated[float, Field(ge=0, lt=1)]
Count = Annotated[int, Field(ge=1)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9_]+$")]

Reference = Literal["realisation", "template"]
SplitKind = Literal["random", "held_out"]


NEUTRAL = "cannot change a result"
"""Marks a setting that does not change any byte of a result: a new value repeats no job."""

CheckpointSeconds = Annotated[float, Field(ge=0), NEUTRAL]


class Group(BaseModel):
    """Group of settings: immutable, and without other keys than it declares."""

    model_config = ConfigDict(extra="forbid", frozen=True)


Config = Any
"""Configuration whose attributes are groups. Methods add groups; therefore the class is made when
it is needed."""


class ConfigError(Error, ValueError):
    """Wrong settings; each line of the message names a key, its value and the allowed range."""


Model = TypeVar("Model", bound=BaseModel)


def parse_settings(model: type[Model], tree: Mapping[str, Any], source: object = "") -> Model:
    """Check a configuration tree against a pydantic model.

    Parameters
    ----------
    model : type of pydantic model
        Class that declares the keys, their types and their ranges.
    tree : mapping
        Values by key; groups are mappings.
    source : Path or str
        File of the tree, with which each line of the message begins.

    Returns
    -------
    pydantic model
        The settings, with defaults for keys that are not given.

    Raises
    ------
    ConfigError
        With a line for each wrong value: key = value: allowed range.
    """
    try:
        return model.model_validate(tree)
    except ValidationError as error:
        # All keys of the model, for suggestions in place of an unknown one.
        keys, prefix = list(list_keys(model)), f"{source}: " if source else ""
        lines = (prefix + _line(e, keys) for e in error.errors())
        raise ConfigError("\n".join(lines)) from None


def list_keys(model: type[BaseModel], prefix: str = "") -> Iterator[str]:
    """Yield the dotted keys of a pydantic model; keys of a group follow the group's name."""
    for name, field in model.model_fields.items():
        yield prefix + name
        # A group may be one of several classes.
        for group in (field.annotation, *get_args(field.annotation)):
            if isinstance(group, type) and issubclass(group, Group):
                yield from list_keys(group, f"{prefix}{name}.")


def _line(error: Mapping[str, Any], keys: Iterable[str]) -> str:
    """Return an error of pydantic as a line with the key, its value and the allowed range.

    `keys` are all keys that exist: the message names one that is similar to an unknown key.
    """
    # Some messages of pydantic are complete, or name the input already.
    key = ".".join(str(part) for part in error["loc"])
    message = error["msg"].removeprefix("Value error, ")
    if error["type"] == "extra_forbidden":
        return f"{key}: unknown key{did_you_mean(key, keys)}"
    if error["type"] == "missing":
        return f"{key}: missing"
    if error["type"] == "value_error":
        return f"{key}: {message}" if key else message
    # All others get the value, cut to one or two lines of a terminal.
    value = repr(error["input"])
    value = value if len(value) <= 200 else f"{value[:200]}…"
    return f"{key} = {value}: {message[0].lower()}{message[1:]}"


def dump_deciding(group: Group) -> dict[str, Any]:
    """Return the settings of a group and its groups, except settings that change no result."""
    # Neutral settings are removed, group by group.
    tree = group.model_dump()
    for name, field in type(group).model_fields.items():
        # Groups inside the group may have neutral settings as well; a group that is left out of the
        # tree, because it has its defaults, stays out.
        value = getattr(group, name)
        if NEUTRAL in field.metadata:
            del tree[name]
        elif isinstance(value, Group) and name in tree:
            tree[name] = dump_deciding(value)
    return tree


def as_overrides(tree: Mapping[str, Any]) -> list[str]:
    """Return Hydra overrides that set every leaf of a tree, in a fixed order.

    The list can be pasted as a command line. A rule of the workflow runs again when it changes:
    the same configuration gives the same text, whatever its comments and number formats.
    """
    return [f"++{key}={as_literal(value)}" for key, value in sorted(leaves(tree))]


def as_literal(value: Any) -> str:
    """Return the text of a value in an override; lists are without spaces and quotes."""
    if isinstance(value, list):
        return "[" + ",".join(map(as_literal, value)) + "]"
    return value if isinstance(value, str) else json.dumps(value)


def leaves(tree: Mapping[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    """Return the dotted key and the value of each leaf of a tree, in the order of the tree."""
    # Keys of a group follow the prefix of the group.
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


NoiseLaw = Literal["poisson", "gaussian", "detector", "correlated"]

NOISE_KEYS: Mapping[str, tuple[str, ...]] = {
    "detector": ("read_noise_e", "gain_e"),
    "correlated": ("shift_px",),
}
"""Keys of the group `noise` that only one noise law has; they are 0 for all other laws."""


class Noise(Group):
    """Noise band: the levels λ that one dataset mixes, and the noise law.

    The laws are classes of `psfdae.stars.noise`. Keys that the law does not have are not part of
    the dumped settings, nor is the law itself if it is the paper's, Poisson noise.
    """

    name: Name
    """Name in titles and messages."""
    levels: Annotated[list[Positive], Field(min_length=1)]
    """Noise levels λ of the paper."""
    kappa: Positive
    """Pixel RMS of the normalised image per unit of λ."""
    background_photons: Annotated[float, Field(gt=0, le=1e12)]
    """Sky photons per pixel."""
    law: NoiseLaw = "poisson"
    """Noise law: photons of star and sky, Gaussian noise, a detector, or interpolated pixels."""
    read_noise_e: Annotated[float, Field(ge=0, le=1e6)] = 0.0
    """Law detector: RMS of the read noise in electrons."""
    gain_e: Annotated[float, Field(ge=0, le=1e6)] = 0.0
    """Law detector: electrons per count, to which images are rounded; 0: not rounded."""
    shift_px: Annotated[float, Field(ge=0, le=0.5)] = 0.0
    """Law correlated: shift in pixels, per axis, by which pixels were interpolated linearly."""

    @model_validator(mode="after")
    def check_law(self) -> Noise:
        """Require the keys of the law, and no keys of other laws.

        Raises
        ------
        ValueError
            With the key and the law that has it.
        """
        for law, keys in NOISE_KEYS.items():
            positive_keys = [key for key in keys if getattr(self, key)]
            if law == self.law and not positive_keys:
                raise ValueError(f"law = {law}: needs {' or '.join(keys)} above 0")
            if law != self.law and positive_keys:
                key, value = positive_keys[0], getattr(self, positive_keys[0])
                raise ValueError(
                    f"{key} = {value:g}: law {self.law} does not have it, law {law} has"
                )
        # Rounding adds noise of RMS gain_e / √12 that is independent of the star only if steps are
        # not much wider than the noise before it.
        coarsest_e = 2.0 * (self.background_photons + self.read_noise_e**2) ** 0.5
        if self.gain_e > coarsest_e:
            raise ValueError(
                f"gain_e = {self.gain_e:g}: must be at most {coarsest_e:.3g}, twice the noise of "
                "sky and read noise in electrons; coarser steps depend on the star"
            )
        return self

    @model_serializer(mode="wrap")
    def dump_law(self, dump: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Return the settings without the keys of other laws."""
        hidden_keys = {key for law, keys in NOISE_KEYS.items() if law != self.law for key in keys}
        hidden_keys |= {"law"} if self.law == "poisson" else set()
        return {key: value for key, value in dump(self).items() if key not in hidden_keys}

    def require_poisson(self, subject: str) -> None:
        """Raise ConfigError if the law is not Poisson noise; `subject` begins the message."""
        if self.law != "poisson":
            raise ConfigError(f"{subject} for Poisson noise only, not for noise.law = {self.law}")


class Parts(Group):
    """Sizes of the training, validation and test parts."""

    train_stars: Count = 3000
    """Training stars, validation included."""
    test_stars: Count = 300
    """Test stars of the random split."""
    validation_fraction: Annotated[float, Field(gt=0, le=0.5)] = 0.1
    """Part of the training stars that selects the best state."""


# Protocols name the settings that a function uses: the class of all settings is made when it is
# needed (`Config`), and differs between the library and the reproduction of the paper.


class WithNoise(Protocol):
    """Configuration with a noise model, which methods use."""

    @property
    def noise(self) -> Noise:
        """Noise band of the stars."""


class OfFit(WithNoise, Protocol):
    """Configuration on which every fit depends."""

    @property
    def seed(self) -> int:
        """Seed of all random streams."""

    @property
    def parts(self) -> Parts:
        """Sizes of the training, validation and test parts."""


class Evaluation(Group):
    """Settings of image metrics and of the restoration of test stars."""

    data_range: Positive = 0.66
    """SSIM dynamic range fitted to the paper's rows."""
    threads: Count = 1
    """Threads of the linear algebra."""


class OfTest(OfFit, Protocol):
    """Configuration on which every fit and its test depend."""

    @property
    def evaluation(self) -> Evaluation:
        """Settings of the metrics of test stars."""


class CalibrationStars(Group):
    """Choice of the stars of an image as training data, and the noise that they get."""

    snr_min: Positive | None = None
    """Minimum S/N of training stars; null: 100, or lower, down to 10, where fewer than 20 stars
    reach it."""
    isolation_px: Positive = 12.0
    """Distance within which a neighbour is too close."""
    neighbour_ratio: Positive = 0.02
    """Smallest brightness of a disturbing neighbour, as a fraction of the star's."""
    misfit: Annotated[float, Field(gt=1, allow_inf_nan=False)] = 2.5
    """Difference of a misfit from its nearest stars, in units of the median star's."""
    search_px: Annotated[int, Field(ge=1, le=16)] = 3
    """The brightest pixel is searched within ± this of the catalogue's position."""
    margin_px: Annotated[int, Field(ge=0, le=64)] = 8
    """Pixels around a stamp, in which the sky is measured."""
    stars_min: Annotated[int, Field(ge=1)] = 1
    """Minimum number of training stars."""
    light_min: Annotated[float, Field(ge=0, lt=1)] = 0.95
    """Minimum fraction of a star's light in its stamp. Where stamps of framing.stamp_px hold less,
    they become wide enough for 98 %. A stamp_px that is given is not changed; 0: never changed."""
    centring_px: Annotated[float, Field(ge=0, le=64)] | None = None
    """FWHM of the Gaussian that smooths a star before its brightest pixel is searched; null: FWHM
    of the stars where their brightest pixels are off their middle."""
    bins: Annotated[int, Field(ge=1, le=64)] = 4
    """Parts of the field along a side; stars of a part are stacked."""
    snr_levels: Annotated[list[Positive], Field(min_length=1)] = Field([5.0, 10.0, 20.0, 50.0])
    """S/N to which bright stars are degraded, ascending. Values above snr_min / 2, where the noise
    of the stars themselves would matter, are replaced by snr_min / 2."""

    @model_validator(mode="after")
    def _levels(self) -> CalibrationStars:
        """Raise ValueError if the S/N are not ascending."""
        if sorted(set(self.snr_levels)) != self.snr_levels:
            raise ValueError(f"snr_levels = {self.snr_levels}: must be ascending")
        return self

    @property
    def effective_snr_min(self) -> float:
        """Minimum S/N of training stars, where there are enough stars."""
        return 100.0 if self.snr_min is None else self.snr_min

    def list_lower_snr(self) -> list[float]:
        """Return lower limits of the S/N to try in turn where stars are too few.

        The list is empty if `snr_min` is given.
        """
        # From the default limit down to 10, where stars still determine a PSF.
        return [70.0, 50.0, 35.0, 25.0, 20.0, 14.0, 10.0] if self.snr_min is None else []

    def list_degraded_snr(self) -> list[float]:
        """Return the S/N to which bright stars are degraded, ascending, at most snr_min / 2."""
        # Above half of the limit, the noise of the stars themselves would matter.
        return sorted({min(level, 0.5 * self.effective_snr_min) for level in self.snr_levels})
