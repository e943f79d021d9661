"""What a method is: a class that restores the PSF of a star from its noisy image.

Each is in a module of its own in `psfdae.methods` or `psfdae_paper.methods`, with its settings;
where files give others, these are in `config/<group>/default.yaml`. The list `methods` of
`config/config.yaml` names those that the reproduction runs. Rules, tables, figures, sweeps, runs
of MLflow, bundles and `from-stars` ask the classes for all that they must know.

Modules of methods load neither torch nor scipy when they are imported: options of
commands follow from them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Self

import numpy as np

from psfdae.belonging import TRAINED_ON, require_training, write_origin
from psfdae.errors import Error
from psfdae.files import (
    Column,
    Product,
    as_csv,
    read_product,
    write_product,
    write_text,
)
from psfdae.noise import NoiseModel, mixed_levels
from psfdae.settings import Group

if TYPE_CHECKING:
    from psfdae.bundle_info import BundleInfo
    from psfdae.settings import Evaluation

CONFIG, HISTORY = "config.yaml", "history.csv"
"""Resolved configuration and course of a training, in the folder of a network."""


class FitError(Error, RuntimeError):
    """A method cannot be fitted; the message says why and what to change."""


class BrightStamps(NamedTuple):
    """The bright stars of an image as they are in it.

    Attributes
    ----------
    wide : ndarray, shape (n, s, s)
        Sky-subtracted, of flux 1 in the stamp, with a margin.
    peak : ndarray of int, shape (n, 2)
        Brightest pixel (row, column) from index (s//2, s//2).
    listed : ndarray, shape (n, 2)
        Centre that the star list says, likewise; NaN where none does.
    position : ndarray, shape (n, 2)
        (x, y) in the image; NaN where unknown.
    noise : ndarray, shape (n,)
        RMS of the sky in a pixel over the flux.
    star : ndarray of int
        Star of every image of the training set.
    """

    wide: np.ndarray
    peak: np.ndarray
    listed: np.ndarray
    position: np.ndarray
    noise: np.ndarray
    star: np.ndarray

    def of(self, chosen: np.ndarray) -> BrightStamps:
        """Some of the stars."""
        return BrightStamps(*(array[chosen] for array in self[:-1]), self.star)


@dataclass(frozen=True)
class TrainingSet:
    """All that a method may learn from.

    Attributes
    ----------
    images : ndarray, shape (n, d, d), float32
        Noise-free stars of sum 1, the reference "realisation".
    references : ndarray, shape (n, d, d), float32
        What is to be restored: the product's array `reference`, but for one fit that
        serves both references the templates.
    fit, validation : ndarray of int
        Star indices.
    levels : ndarray, shape (L,)
        Noise levels λ that are mixed.
    noise : NoiseModel
    seed : int
        Of the method's random streams.
    reference : str
        "realisation" or "template".
    positions : ndarray, shape (n, 2)
        Where the stars stand in the field, any unit; empty where nobody knows.
    own_noise : callable or None
        Of images that are not noise-free: from star indices (m,) and their mean image (P,)
        to what noise adds to their scatter (P, P) about it.
    bright : BrightStamps or None
        The stars of which the images were made, if these are an image's.
    start : Method or None
        Fit of the method to the realisations of the same stars, from which that to their
        templates goes on.
    checkpoint : Path or None
        Where a long fit may keep its state; the caller removes it once the result is safe.
    """

    images: np.ndarray
    references: np.ndarray
    fit: np.ndarray
    validation: np.ndarray
    levels: np.ndarray
    noise: NoiseModel
    seed: int = 0
    reference: str = "realisation"
    positions: np.ndarray = field(default_factory=lambda: np.empty((0, 2)))
    own_noise: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None
    bright: BrightStamps | None = None
    start: Method | None = None
    checkpoint: Path | None = None

    @property
    def train(self) -> np.ndarray:
        """All training stars, validation included, ascending."""
        return np.sort(np.concatenate([self.fit, self.validation]))

    def draw(self, stars: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Noisy images of `stars`, each at a random level, and these levels."""
        level = mixed_levels(self.levels, stars.size, rng)
        return self.noise.draw(self.images[stars], level, rng), level

    def without_validation(self) -> TrainingSet:
        """The same stars but for those that validate."""
        return replace(self, validation=self.validation[:0])


@dataclass(frozen=True)
class Measured:
    """What a method measures of stars besides their PSFs, in the unit of their stamps.

    Attributes
    ----------
    flux, background : ndarray, shape (n,)
    centre : ndarray, shape (n, 2)
        (row, column) from pixel (d//2, d//2).
    covariance : ndarray, shape (n, 4, 4)
        Of flux, background, row and column.
    """

    flux: np.ndarray
    background: np.ndarray
    centre: np.ndarray
    covariance: np.ndarray


@dataclass(frozen=True)
class Estimate:
    """PSFs, and what a method says of them.

    Attributes
    ----------
    psf : ndarray, shape (n, d, d)
    sigma : ndarray, shape (n, d, d), or None
        Standard deviation of each pixel of the PSF; of a method that measures stars, of the star
        over its flux, the doubt about the flux included.
    evidence : ndarray, shape (n,), or None
        Logarithm of the probability density of each noisy image.
    flux : ndarray, shape (n,), or None
        Flux of the star in that by which its image was divided, if the method was to find it;
        the PSF has this sum.
    measured : Measured or None
        Of a method that measures stars itself; its PSFs have the sum 1.
    strangeness : ndarray, shape (n,), or None
        As `Method.strangeness`, of a method that finds it on the way.
    """

    psf: np.ndarray
    sigma: np.ndarray | None = None
    evidence: np.ndarray | None = None
    flux: np.ndarray | None = None
    measured: Measured | None = None
    strangeness: np.ndarray | None = None


class Method:
    """Base of all methods; its name is that of its module.

    Attributes
    ----------
    label, color, marker : str
        In figures. What the method is given beside the image is added to its label.
    paper : (str, str) or None
        Its row in the paper's tables as data, and as printed.
    drawn : bool
        Shown among restored stars.
    restores : bool
        False for the noisy image itself, which is drawn on its own scale.
    needs_level : bool
        `predict` gets the noise level λ, too: of all images, or of each, shape (n,).
    needs_position : bool
        `predict` gets the positions in the field as well, shape (n, 2).
    measures : bool
        It measures flux, sky and centre of a star with its PSF: `measure` does, of stamps, and
        a model of it takes no photometry from elsewhere.
    groups : mapping
        Groups of the configuration that are its settings; `fit` gets them by name.
    stored : bool
        False if it is fitted where it is applied, in a moment, and leaves no file.
    per_reference : bool
        Of a stored one: fitted for each reference, or once for both.
    validates : bool
        The fit leaves out the validation stars, or only chooses by them.
    files : tuple of str
        Files of the folder that a fit leaves; empty if it leaves one HDF5 product.
    diagnostics : tuple of str
        Tables (CSV) beside them, of which a fitted method has the rows in `diagnosed`.
    arrays : mapping
        Attributes that are the HDF5 product, and of each its unit and what it is.
    rule, kind : str
        Name of its rule, and of its runs in MLflow.
    about : str
        What a fit leaves, for the help of commands.
    bundled : bool
        Packed as a model that `psfdae predict` takes.
    suffix : str
        Ends the names of its bundles.
    together : int
        Small images that `psfdae predict` has restored at once.
    padded : bool
        Fewer are made up to as many: other numbers of them round otherwise.
    memory_mb, minutes : int
        What a fit takes at most.
    """

    name: ClassVar[str] = ""
    label: ClassVar[str]
    color: ClassVar[str]
    marker: ClassVar[str] = "o"
    paper: ClassVar[tuple[str, str] | None] = None
    drawn: ClassVar[bool] = True
    restores: ClassVar[bool] = True
    needs_level: ClassVar[bool] = False
    needs_position: ClassVar[bool] = False
    measures: ClassVar[bool] = False
    groups: ClassVar[Mapping[str, type[Group]]] = {}
    stored: ClassVar[bool] = True
    per_reference: ClassVar[bool] = False
    validates: ClassVar[bool] = False
    files: ClassVar[tuple[str, ...]] = ()
    diagnostics: ClassVar[tuple[str, ...]] = ()
    arrays: ClassVar[Mapping[str, tuple[str, str]]] = {}
    rule: ClassVar[str]
    kind: ClassVar[str]
    about: ClassVar[str]
    bundled: ClassVar[bool] = True
    suffix: ClassVar[str]
    together: ClassVar[int] = 256
    padded: ClassVar[bool] = True
    memory_mb: ClassVar[int] = 1000
    minutes: ClassVar[int] = 30

    diagnosed: Mapping[str, list[dict[str, Any]]]

    if TYPE_CHECKING:
        fit: Callable[..., Any]
        """Class method: from a `TrainingSet` and the groups of settings to a fitted method."""
        predict: Callable[..., np.ndarray]
        """PSFs of flux-normalised noisy images, both of shape (n, d, d)."""
        measure: Callable[..., Estimate]
        """PSFs of stamps; see `psfdae.methods.field`, if `measures`."""

    def __init_subclass__(cls) -> None:
        cls.name = cls.__module__.rpartition(".")[2]
        own = vars(cls)
        if "label" in own:
            cls.label += cls.given()
        cls.rule = own.get("rule", f"fit_{cls.name}")
        cls.kind = own.get("kind", cls.name)
        cls.about = own.get("about", f"What `psfdae fit {cls.name}` leaves.")
        cls.suffix = own.get("suffix", f"-{cls.name}")

    @classmethod
    def given(cls) -> str:
        """What it is given beside the image, as the end of a label: " (given λ, position)"."""
        names = ["λ"] * cls.needs_level + ["position"] * cls.needs_position
        return f" (given {', '.join(names)})" if names else ""

    @classmethod
    def settings(cls, config: Any) -> dict[str, Any]:
        """Its groups of a configuration, as `fit` takes them."""
        return {name: getattr(config, name) for name in cls.groups}

    @classmethod
    def check(cls, config: Any) -> None:
        """Raise ValueError if its settings contradict other groups of a configuration."""

    @classmethod
    def threads(cls, config: Any) -> int:
        """Threads of a fit: the setting of that name, if there is one."""
        groups = cls.settings(config).values()
        return next((g.threads for g in groups if hasattr(g, "threads")), 1)

    @classmethod
    def continues(cls, config: Any) -> bool:
        """Whether a fit to templates goes on from that to the realisations."""
        return False

    def estimate(
        self, noisy: np.ndarray, level: float | np.ndarray, position: np.ndarray | None = None
    ) -> Estimate:
        """PSFs of noisy images at a noise level λ, or one of each image, shape (n,).

        A method that knows their uncertainty, or the images' evidence, gives it here.
        """
        return Estimate(self.restore(noisy, level, position))

    def restore(
        self, noisy: np.ndarray, level: float | np.ndarray, position: np.ndarray | None = None
    ) -> np.ndarray:
        """`predict`, given what the method wants to know beside the image."""
        given = (level,) * self.needs_level + (position,) * self.needs_position
        return self.predict(noisy, *given)

    def strangeness(self, noisy: np.ndarray, level: np.ndarray) -> np.ndarray | None:
        """How unlike all training stars images (n, d, d) are, if the method has a law of them.

        For a normal law it is the square of Mahalanobis' distance.
        """
        return None

    def free_flux(self) -> Self:
        """The same for images whose flux and sky are estimates, and their sum therefore 1.

        A method that can finds the `flux` of these.
        """
        return self

    def flux(self, noisy: np.ndarray, level: np.ndarray) -> np.ndarray:
        """Flux of each star in that by which its image was divided, shape (n,), if it is free."""
        return np.ones(len(noisy))

    def psf_at(self, position: np.ndarray, oversampling: int = 1) -> np.ndarray:
        """PSFs at positions (n, 2), of a method that knows them between the stars."""
        raise FitError(f"{self.label}: knows the PSF of a star alone, not that of a place")

    def facts(self) -> Mapping[str, str]:
        """What a fit knows of itself that its user should: a title and words for each."""
        return {}

    @classmethod
    def stem(cls, dataset: str, split: str, reference: str) -> str:
        """What tells its fits apart, as part of a path."""
        return f"{dataset}/{split}" + (f"-{reference}" if cls.per_reference else "")

    @classmethod
    def place(cls, dataset: str, split: str, reference: str) -> str:
        """Folder or file of a fit, below the folder of results."""
        return f"{cls.name}/{cls.stem(dataset, split, reference)}" + ("" if cls.files else ".h5")

    @classmethod
    def beside(cls, place: str | Path, name: str) -> Path:
        """A further file of a fit: in its folder, or beside its product."""
        place = Path(place)
        return place / name if cls.files else place.with_name(f"{place.stem}.{name}")

    @classmethod
    def outputs(cls, place: str | Path) -> list[Path]:
        """All files of a fit."""
        own = [Path(place, name) for name in cls.files] or [Path(place)]
        return own + [cls.beside(place, name) for name in (TRAINED_ON, *cls.diagnostics)]

    def again(self, data: TrainingSet, **settings: Any) -> Self:
        """A fit to `data` with its seed; settings that this fit has searched for are kept."""
        return type(self).fit(data, **settings)  # type: ignore[no-any-return]

    def save(self, place: Path, described: Mapping[str, Any]) -> None:
        """Write the fit with its resolved configuration."""
        columns = {name: Column(getattr(self, name), *said) for name, said in self.arrays.items()}
        write_product(place, self.name, columns, described)

    def store(self, place: Path, described: Mapping[str, Any], stars: Product) -> None:
        """Write all files of the fit, which is one to stars."""
        self.save(place, described)
        write_origin(place, stars)
        for name in self.diagnostics:
            write_text(self.beside(place, name), as_csv(self.diagnosed[name]))

    @classmethod
    def load(
        cls, place: Path, reference: str = "realisation", evaluation: Evaluation | None = None
    ) -> Self:
        """Read a fit, ready to restore a reference.

        Parameters
        ----------
        place : Path
        reference : str
            Counts for one fit that serves both.
        evaluation : config group
            Threads, and images at a time.

        Raises
        ------
        ProductError
            If a file is missing or damaged.
        """
        product = read_product(place, cls.name, tuple(cls.arrays))
        return cls.restored(product.arrays, product.config, reference)

    @classmethod
    def restored(
        cls, arrays: Mapping[str, np.ndarray], config: Mapping[str, Any], reference: str
    ) -> Self:
        """A fit from its arrays and the configuration that was saved with them."""
        return cls(**arrays)

    def pack(self, stamp_px: int, noise: float) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Arrays for a bundle, and fields of its `BundleInfo` that say what they are.

        `noise` is the least RMS per pixel, over the flux, that they are for.
        """
        return {name: np.asarray(getattr(self, name)) for name in self.arrays}, {}

    @classmethod
    def shapes(cls, info: BundleInfo) -> Mapping[str, tuple[int, ...] | None]:
        """Arrays that a bundle must have, with their shapes; None: any."""
        return dict.fromkeys(cls.arrays)

    @classmethod
    def unpack(cls, arrays: Mapping[str, np.ndarray], info: BundleInfo) -> Self:
        """A fit from a bundle."""
        return cls.restored(arrays, info.config["train"], info.reference or "realisation")

    def lawful(self) -> Iterator[tuple[str, str, Any]]:
        """What arrays of a bundle must have: name, words, and whether they have it, bool."""
        return iter(())

    def export(self, stamp_px: int, path: Path) -> None:
        """Write it as ONNX, if it is a network."""
        raise FitError(f"{self.label}: is no network, ONNX has no form for it")

    @classmethod
    def described(cls, place: Path) -> dict[str, Any]:
        """The resolved configuration of a fit."""
        return read_product(place, cls.name, ()).config

    @classmethod
    def require(cls, place: Path, stars: Product, config: Any, split: str, reference: str) -> None:
        """Refuse a fit that does not belong to test stars.

        Parameters
        ----------
        place : Path
        stars : product "stars" with its realisations
        config : stage config (seed, parts)
        split : "random" or "held_out"
        reference : "realisation" or "template"

        Raises
        ------
        ProductError
            With both values of what differs.
        """
        options = {"split": split} | ({"reference": reference} if cls.per_reference else {})
        require_training(place, cls.described(place), stars, config, **options)
