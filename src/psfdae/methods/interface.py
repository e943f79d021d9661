"""Base class of methods, which restore the PSF of a star from its noisy image.

Each is in a module of its own in `psfdae.methods` or `psfdae_paper.methods`, with its settings;
where files give others, these are in `config/<group>/default.yaml`. The list `methods` of
`config/config.yaml` names those that the reproduction runs. Rules, tables, figures, sweeps, runs
of MLflow, bundles and `from-stars` ask the classes for all that they must know: how a method
looks, what it needs, how a fit is stored, how it is packed.

A method has at least `look`, `fit` and `predict`. All else has a default in the base class: a
method with a product names its arrays in `storage`. All ask a method by `estimate`; one that knows
more than the PSF, such as uncertainties, has it in place of `predict`. Two capabilities tell what
only some methods can do, `knows_field` and `finds_flux`.

Modules of methods load neither torch nor scipy when they are imported: options of
commands follow from them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np

from psfdae.base.errors import Error
from psfdae.base.files import Column, read_product, write_product
from psfdae.base.settings import Config, Group
from psfdae.stars.noise import NoiseModel, mixed_levels

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from psfdae.base.settings import Evaluation
    from psfdae.methods.bundle_info import BundleInfo
    from psfdae.stars.bright_stars import BrightStars

CONFIG, HISTORY = "config.yaml", "history.csv"
"""Resolved configuration and course of a training, in the folder of a network."""


class FitError(Error, RuntimeError):
    """A method cannot be fitted; the message says why and what to change."""


@dataclass(frozen=True)
class TrainingSet:
    """Stars and facts that a method may learn from.

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
        Seed of the method's random streams.
    reference : str
        "realisation" or "template".
    positions : ndarray, shape (n, 2) or (n, 4)
        Positions of the stars in the field, in any unit, and for stars of an image their magnitudes
        and colours; empty where unknown.
    own_noise : callable or None
        Noise of images that are not noise-free: a function of star indices (m,) and their mean
        image (P,) that returns what noise adds to their scatter about it, (P, P).
    bright : BrightStars or None
        The bright stars of an image from which the images were made, in counts.
    star : ndarray of int, shape (n,)
        Bright star of every image; empty if there are none.
    simulation : mapping
        Configuration of the simulation that made the stars; empty for those of an image.
    start : Method or None
        Fit of the method to the realisations of the same stars, from which that to their
        templates goes on.
    checkpoint : Path or None
        File in which a long fit may keep its state; the caller removes it after the fit.
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
    bright: BrightStars | None = None
    star: np.ndarray = field(default_factory=lambda: np.empty(0, int))
    simulation: Mapping[str, Any] = field(default_factory=dict)
    start: Method | None = None
    checkpoint: Path | None = None

    @property
    def train(self) -> np.ndarray:
        """Indices of all training stars, validation included, ascending."""
        return np.sort(np.concatenate([self.fit, self.validation]))

    def draw(self, stars: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Draw noisy images of `stars`, each at a random level, and return these levels, too."""
        level = mixed_levels(self.levels, stars.size, rng)
        return self.noise.draw(self.images[stars], level, rng), level

    def without_validation(self) -> TrainingSet:
        """Return this set without its validation stars."""
        return replace(self, validation=self.validation[:0])


@dataclass(frozen=True)
class Measured:
    """Photometry and astrometry of stars by a method, in the unit of their stamps.

    Attributes
    ----------
    flux, background : ndarray, shape (n,)
    centre : ndarray, shape (n, 2)
        (row, column) from pixel (d//2, d//2).
    covariance : ndarray, shape (n, 4, 4)
        Covariance of flux, background, row and column.
    """

    flux: np.ndarray
    background: np.ndarray
    centre: np.ndarray
    covariance: np.ndarray


@dataclass(frozen=True)
class Estimate:
    """PSFs that a method restored, with their uncertainty and what else it measured.

    Attributes
    ----------
    psf : ndarray, shape (n, d, d)
    sigma : ndarray, shape (n, d, d), or None
        Standard deviation of each pixel of the PSF; for a method that measures stars, that of the
        star over its flux, the error of the flux included.
    evidence : ndarray, shape (n,), or None
        Logarithm of the probability density of each noisy image.
    flux : ndarray, shape (n,), or None
        Flux of the star over that by which its image was divided, if the method measures it; the
        PSF has this sum.
    measured : Measured or None
        Measurements of a method that measures stars itself; its PSFs have the sum 1.
    outlier_score : ndarray, shape (n,), or None
        See `Method.outlier_score`, if the method computes it together with the PSFs.
    explained : ndarray of bool, shape (n,), or None
        True if the method's own model explains the star; otherwise its PSF is another method's.
    """

    psf: np.ndarray
    sigma: np.ndarray | None = None
    evidence: np.ndarray | None = None
    flux: np.ndarray | None = None
    measured: Measured | None = None
    outlier_score: np.ndarray | None = None
    explained: np.ndarray | None = None


# The parts of a method's class.


@dataclass(frozen=True)
class Look:
    """Label, colour and marker of a method in tables and figures.

    Attributes
    ----------
    label, color, marker : str
        What the method is given besides the image (`Needs`) is added to the label.
    paper : (str, str) or None
        Its row in the paper's tables as data, and as printed.
    drawn : bool
        Shown among restored stars.
    restores : bool
        False for the noisy image itself, which is drawn on its own scale.
    title : str
        Name in messages and reports on stars of an image, in full words; by default the label.
    """

    label: str
    color: str
    marker: str = "o"
    paper: tuple[str, str] | None = None
    drawn: bool = True
    restores: bool = True
    title: str = ""


@dataclass(frozen=True)
class Needs:
    """Inputs of a method besides the image, and resources of a fit.

    Attributes
    ----------
    level : bool
        `predict` gets the noise level λ, too: of all images, or of each, shape (n,).
    position : bool
        `predict` gets the positions in the field as well, shape (n, 2); of an image with
        magnitudes and colours (n, 4), NaN where unknown.
    validation : bool
        The fit leaves out the validation stars, or only chooses by them.
    memory_mb, minutes : int
        Memory and time of a fit at most.
    """

    level: bool = False
    position: bool = False
    validation: bool = False
    memory_mb: int = 1000
    minutes: int = 30

    def __str__(self) -> str:
        """Return the inputs as the end of a label: " (given λ, position)"."""
        names = ["λ"] * self.level + ["position"] * self.position
        return f" (given {', '.join(names)})" if names else ""


@dataclass(frozen=True)
class Storage:
    """Files of a fit, and the name of the rule that makes them; see `fit_files`.

    Attributes
    ----------
    arrays : mapping
        Attributes that are the HDF5 product, and of each its unit and what it is.
    files : tuple of str
        Files of the folder that a fit leaves in place of a product.
    diagnostics : tuple of str
        Tables (CSV) beside them, of which a fitted method has the rows in `diagnosed`.
    per_reference : bool
        Fitted for each reference, or once for both.
    rule : str
        Name of its rule; by default it follows from the method's name.
    """

    arrays: Mapping[str, tuple[str, str]] = field(default_factory=dict)
    files: tuple[str, ...] = ()
    diagnostics: tuple[str, ...] = ()
    per_reference: bool = False
    rule: str = ""


@dataclass(frozen=True)
class Packing:
    """How a fit is part of a model bundle.

    Attributes
    ----------
    suffix : str or None
        Ends the names of its bundles; by default "-" and the method's name.
    together : int
        Small images that `psfdae predict` has restored at once.
    padded : bool
        Fewer are made up to as many: other numbers of them round otherwise.
    """

    suffix: str | None = None
    together: int = 256
    padded: bool = True


class Method:
    """Base of all methods; its name is that of its module.

    Attributes
    ----------
    look : Look
    needs : Needs
    storage : Storage or None
        None if it is fitted where it is applied, in a moment, and leaves no file.
    packing : Packing or None
        None if no bundle holds it.
    groups : mapping
        Groups of the configuration that are its settings; `fit` gets them by name.
    knows_field : bool
        It has a model of the PSF at every place of the field, by which it measures flux, sky and
        centre of a star together with its PSF: it has `measure`, `psf_at`, `order` and
        `draw_stars`. `TrainingSet.bright` is for it.
    finds_flux : bool
        Its form `free_flux` measures the flux of an image, of which only an estimate was known: it
        has `flux`.
    """

    name: ClassVar[str] = ""
    look: ClassVar[Look]
    needs: ClassVar[Needs] = Needs()
    storage: ClassVar[Storage | None] = Storage()
    packing: ClassVar[Packing | None] = Packing()
    groups: ClassVar[Mapping[str, type[Group]]] = {}
    knows_field: ClassVar[bool] = False
    finds_flux: ClassVar[bool] = False

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.look.title or self.look.label})"

    diagnosed: Mapping[str, list[dict[str, Any]]]

    if TYPE_CHECKING:
        # Class method: from a `TrainingSet` and the groups of settings to a fitted method.
        fit: Callable[..., Self]
        # PSFs of flux-normalised noisy images, both of shape (n, d, d); see `estimate`.
        predict: Callable[..., np.ndarray]
        # `finds_flux`: fluxes of images over those by which they were divided, (n,), and which
        # clusters are near an image, (n, K): `estimate` and `outlier_score` look at no others.
        flux: Callable[..., tuple[np.ndarray, np.ndarray]]
        # `knows_field`, explained in `psfdae.methods.field.FieldMixture`: PSFs at positions (n, 2),
        # or with magnitudes and colours (n, 4); the posterior of stars on stamps in any unit;
        # images, positions and centres of stars drawn from their distribution; the error of a flux
        # on a known sky; and stars of a magnitude or colour outside of the training range.
        psf_at: Callable[..., np.ndarray]
        measure: Callable[..., Estimate]
        draw_stars: Callable[..., tuple[np.ndarray, np.ndarray, np.ndarray]]
        fitted_flux_error: Callable[..., tuple[float, np.ndarray, np.ndarray]]
        is_out_of_range: Callable[..., np.ndarray]

        @property
        def order(self) -> int:
            """Order of the polynomial by which the PSF changes over the field."""

    def __init_subclass__(cls) -> None:
        cls.name = cls.__module__.rpartition(".")[2]
        if "look" in vars(cls):
            label, title = cls.look.label, cls.look.title or cls.look.label
            cls.look = replace(cls.look, label=f"{label}{cls.needs}", title=title)

    @classmethod
    def settings(cls, config: Config) -> dict[str, Group]:
        """Return its groups of a configuration, as `fit` takes them."""
        return {name: getattr(config, name) for name in cls.groups}

    @classmethod
    def check(cls, config: Config) -> None:
        """Raise ValueError if its settings contradict other groups of a configuration."""

    @classmethod
    def threads(cls, config: Config) -> int:
        """Return the threads of a fit: the setting of that name, or 1 if there is none."""
        groups = cls.settings(config).values()
        return next((g.threads for g in groups if hasattr(g, "threads")), 1)

    @classmethod
    def continues(cls, config: Config) -> bool:
        """Return True if training on templates starts from a fit to the realisations."""
        return False

    # What a fitted method knows besides the PSF of a star; most know nothing of it.

    def free_flux(self) -> Self:
        """Return the form for images whose flux and sky are estimates, and their sum is 1."""
        return self

    def facts(self) -> Mapping[str, str]:
        """Return facts that a user should know, by their titles; no full stop ends them."""
        return {}

    def conditions(self) -> Iterable[tuple[str, str, ArrayLike]]:
        """Return conditions that the arrays of any fit fulfil, to detect damaged files.

        Each is the name of an array, what it must have in words, and whether it has it.
        """
        return ()

    def estimate(
        self,
        noisy: np.ndarray,
        level: float | np.ndarray,
        position: np.ndarray | None = None,
        with_sigma: bool = True,
    ) -> Estimate:
        """Return the PSFs of noisy images (n, d, d), and what else the method knows of them.

        By default those of `predict`, which gets what the method needs besides the image.

        Parameters
        ----------
        noisy : ndarray, shape (n, d, d)
            Images of flux 1 without sky; estimates of both for the form `free_flux`.
        level : float or ndarray, shape (n,)
            Noise level λ.
        position : ndarray, shape (n, 2) or (n, 4), optional
            See `Needs.position`.
        with_sigma : bool
            False if the standard deviations are not needed, without which some methods are faster.
        """
        inputs = (level,) * self.needs.level + (position,) * self.needs.position
        return Estimate(self.predict(noisy, *inputs))

    def outlier_score(
        self, noisy: np.ndarray, level: np.ndarray, near_clusters: np.ndarray | None = None
    ) -> np.ndarray | None:
        """Return how unlike all training stars images (n, d, d) are, shape (n,).

        −2 ln of the probability density; for a normal law the square of Mahalanobis' distance. None
        if the method does not know the distribution of the training stars, or has the score in its
        `estimate`. `near_clusters` is what `flux` returned of these images.
        """
        return None

    # A fit as files, and as part of a bundle.

    def save(self, place: Path, described: Mapping[str, Any]) -> None:
        """Write the fit with its resolved configuration."""
        arrays, facts = self.stored_arrays(), self.stored()
        columns = {name: Column(array, *facts[name]) for name, array in arrays.items()}
        write_product(place, self.name, columns, described)

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
        product = read_product(place, cls.name, tuple(cls.stored()))
        return cls.restored(product.arrays, product.config, reference)

    @classmethod
    def stored(cls) -> Mapping[str, tuple[str, str]]:
        """Return unit and meaning of each array of a fit; none if the method leaves no file."""
        return cls.storage.arrays if cls.storage else {}

    def stored_arrays(self) -> dict[str, np.ndarray]:
        """Return the arrays of a fit by their names in files: those of its attributes."""
        return {name: getattr(self, name) for name in self.stored()}

    @classmethod
    def described(cls, place: Path) -> dict[str, Any]:
        """Return the resolved configuration of a fit."""
        return read_product(place, cls.name, ()).config

    @classmethod
    def restored(
        cls, arrays: Mapping[str, np.ndarray], config: Mapping[str, Any], reference: str
    ) -> Self:
        """Return a fit from its arrays and the configuration that was saved with them."""
        return cls(**arrays)

    def pack(self, stamp_px: int, noise: float) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Return the arrays for a bundle, and fields of its `BundleInfo` that describe them.

        `noise` is the least RMS per pixel, over the flux, that they are for.
        """
        return {name: np.asarray(array) for name, array in self.stored_arrays().items()}, {}

    @classmethod
    def shapes(cls, info: BundleInfo) -> Mapping[str, tuple[int, ...] | None]:
        """Return the arrays that a bundle must have, with their shapes; None: any."""
        return dict.fromkeys(cls.stored())

    @classmethod
    def unpack(cls, arrays: Mapping[str, np.ndarray], info: BundleInfo) -> Self:
        """Return a fit from a bundle."""
        return cls.restored(arrays, info.config["train"], info.reference or "realisation")
