"""Base class of methods, which estimate the PSF of a star from its noisy image.

Each method is in a module of its own in `psfdae.methods` or `psfdae_paper.methods`, with its
settings; `config/config.yaml` has their values for the reproduction, and a list `methods` of the
names of its methods. Rules, tables, figures, sweeps, runs of MLflow, bundles and `train` get all
information from the classes: label and colour, inputs, files of a fit, and form in a bundle.

A method has at least `look`, `fit` and `predict`; the base class has defaults for the rest. A
method with a product lists its arrays in `storage`. All methods are called by `estimate`; a method
that computes more than the PSF, such as uncertainties, overrides it and has no `predict`. Two class
attributes mark capabilities of some methods, `knows_field` and `finds_flux`.

Modules of methods must not load torch or scipy when they are imported, because commands derive
their options from them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike

from psfdae.base.errors import Error
from psfdae.base.files import Column, read_product, write_product
from psfdae.base.rows import Rows
from psfdae.base.settings import Config, Evaluation, Group
from psfdae.methods.bundle_info import BundleInfo
from psfdae.stars.bright_stars import BrightStars
from psfdae.stars.noise import NoiseModel, draw_levels

CONFIG, HISTORY = "config.yaml", "history.csv"
"""Resolved configuration and course of a training, in the folder of a network."""


class FitError(Error, RuntimeError):
    """A method cannot be fitted; the message gives the reason and a remedy."""


@dataclass(frozen=True)
class TrainingSet:
    """Stars and other inputs for the training of a method.

    Attributes
    ----------
    images : ndarray, shape (n, d, d), float32
        Noise-free stars of sum 1, the reference "realisation".
    references : ndarray, shape (n, d, d), float32
        Targets of the training: the product's array `reference`, but templates for a
        method with one fit for both references.
    fit, validation : ndarray of int
        Indices of the stars of these parts.
    levels : ndarray, shape (L,)
        Noise levels λ of the training, with equal probability.
    noise : NoiseModel
        Noise of the images at a level.
    seed : int
        Seed of the method's random streams.
    reference : str
        "realisation" or "template".
    positions : ndarray, shape (n, 2) or (n, 4)
        Positions of the stars in the field, in any unit, and for stars of an image also magnitudes
        and colours; empty where unknown.
    own_noise : callable or None
        Noise of images that are not noise-free: a function of star indices (m,) and their mean
        image (P,) that returns the contribution of noise to their scatter about it, (P, P).
    bright : BrightStars or None
        The bright stars of an image from which the images were made, in counts.
    star : ndarray of int, shape (n,)
        Bright star of every image; empty if there are none.
    simulation : mapping
        Configuration of the simulation of the stars; empty for stars of an image.
    start : Method or None
        Fit of the method to the realisations of the same stars, at which the fit to their templates
        begins.
    checkpoint : Path or None
        File for the state of a long fit; the caller removes it after the fit.
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
        level = draw_levels(self.levels, stars.size, rng)
        return self.noise.draw(self.images[stars], level, rng), level

    def drop_validation(self) -> TrainingSet:
        """Return this set without its validation stars."""
        return replace(self, validation=self.validation[:0])


@dataclass(frozen=True)
class Measurements(Rows):
    """Photometry and astrometry of stars by a method, in the unit of their stamps.

    Attributes
    ----------
    flux, background : ndarray, shape (n,)
        Flux inside the stamp, and sky per pixel.
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
class Estimate(Rows):
    """PSFs that a method has restored, with their uncertainty and other measurements.

    Attributes
    ----------
    psf : ndarray, shape (n, d, d)
        Restored PSFs.
    sigma : ndarray, shape (n, d, d), or None
        Standard deviation of each pixel of the PSF; for a method that measures stars, the standard
        deviation of the star over its flux, with the error of the flux.
    evidence : ndarray, shape (n,), or None
        Logarithm of the probability density of each noisy image.
    flux : ndarray, shape (n,), or None
        Flux of the star over the flux by which its image was divided, if the method measures it;
        the sum of the PSF is this ratio.
    measurements : Measurements or None
        Measurements of a method that measures stars itself; its PSFs have the sum 1.
    outlier_score : ndarray, shape (n,), or None
        See `Method.outlier_score`, if the method computes it together with the PSFs.
    is_explained : ndarray of bool, shape (n,), or None
        True if the method's own model explains the star; otherwise another method gave its PSF.
    """

    psf: np.ndarray
    sigma: np.ndarray | None = None
    evidence: np.ndarray | None = None
    flux: np.ndarray | None = None
    measurements: Measurements | None = None
    outlier_score: np.ndarray | None = None
    is_explained: np.ndarray | None = None


# The parts of a method's class.


@dataclass(frozen=True)
class Look:
    """Label, colour and marker of a method in tables and figures.

    Attributes
    ----------
    label, color, marker : str
        Additional inputs of the method (`Needs`) are appended to the label.
    paper : (str, str) or None
        Name of its row in the paper's tables, in the data and as printed.
    is_drawn : bool
        True if the figures of restored stars show it.
    restores : bool
        False for the noisy image itself, which is drawn on its own scale.
    title : str
        Name in messages and reports on stars of an image, without abbreviations; by default the
        label.
    """

    label: str
    color: str
    marker: str = "o"
    paper: tuple[str, str] | None = None
    is_drawn: bool = True
    restores: bool = True
    title: str = ""


@dataclass(frozen=True)
class Needs:
    """Inputs of a method in addition to the image, and resources of a fit.

    Attributes
    ----------
    level : bool
        `predict` also gets the noise level λ of all images, or of each, shape (n,).
    position : bool
        `predict` also gets the positions in the field, shape (n, 2); for an image with magnitudes
        and colours (n, 4), NaN where unknown.
    validation : bool
        The fit uses the validation stars only to choose the best state, or not at all.
    memory_mb, minutes : int
        Upper limits of the memory and the time of a fit.
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
        Names of the arrays of the HDF5 product, with their units and meanings.
    files : tuple of str
        Files in the folder of a fit that is not a product.
    diagnostics : tuple of str
        Tables (CSV) beside them, of which a fitted method has the rows in `diagnosed`.
    per_reference : bool
        True for a fit to each reference, False for one fit for both.
    rule : str
        Name of its rule; by default it is derived from the method's name.
    """

    arrays: Mapping[str, tuple[str, str]] = field(default_factory=dict)
    files: tuple[str, ...] = ()
    diagnostics: tuple[str, ...] = ()
    per_reference: bool = False
    rule: str = ""


@dataclass(frozen=True)
class Packing:
    """Form of a fit in a model bundle.

    Attributes
    ----------
    suffix : str or None
        End of the names of its bundles; by default "-" and the method's name.
    batch_size : int
        Number of small images that `psfdae predict` restores at once.
    is_padded : bool
        True if smaller batches are padded to this size, because rounding depends on the size.
    """

    suffix: str | None = None
    batch_size: int = 256
    is_padded: bool = True


class Method:
    """Base class of all methods; the name of a method is the name of its module.

    Attributes
    ----------
    look : Look
        Label, colour and marker.
    needs : Needs
        Inputs in addition to the image, and resources of a fit.
    storage : Storage or None
        Files of a fit; None if the fit takes no time and is repeated where it is applied.
    packing : Packing or None
        Form in a bundle; None if bundles cannot contain it.
    groups : mapping
        Groups of the configuration with its settings; `fit` gets them by name.
    knows_field : bool
        True if it has a model of the PSF at every position in the field, with which it measures
        flux, sky and centre of a star together with its PSF. It has `measure`, `psf_at`, `order`,
        `draw_stars`, `estimate_flux_error` and `is_outside_range`, and is trained on
        `TrainingSet.bright`.
    assumes_independent_pixels : bool
        True if its likelihood is a product over pixels. With the noise of interpolated pixels its
        PSFs are not the best possible, and its standard deviations do not hold.
    finds_flux : bool
        True if its form `free_flux` measures the flux of an image for which only an estimate is
        known. It has `flux`.
    """

    name: ClassVar[str] = ""
    look: ClassVar[Look]
    needs: ClassVar[Needs] = Needs()
    storage: ClassVar[Storage | None] = Storage()
    packing: ClassVar[Packing | None] = Packing()
    groups: ClassVar[Mapping[str, type[Group]]] = {}
    knows_field: ClassVar[bool] = False
    finds_flux: ClassVar[bool] = False
    assumes_independent_pixels: ClassVar[bool] = False

    def __repr__(self) -> str:
        """Return the class with the title of the method."""
        return f"{type(self).__name__}({self.look.title or self.look.label})"

    diagnostic_rows: Mapping[str, list[dict[str, Any]]]

    if TYPE_CHECKING:
        # Class method: from a `TrainingSet` and the groups of settings to a fitted method.
        fit: Callable[..., Self]
        # PSFs of flux-normalised noisy images, both of shape (n, d, d); see `estimate`.
        predict: Callable[..., np.ndarray]
        # `finds_flux`: fluxes of images over the fluxes by which they were divided, (n,), and the
        # clusters near an image, (n, K), to which `estimate` and `outlier_score` are limited.
        flux: Callable[..., tuple[np.ndarray, np.ndarray]]
        # `knows_field`, explained in `psfdae.methods.field.FieldMixture`: PSFs at positions (n, 2),
        # or with magnitudes and colours (n, 4); the posterior of stars on stamps in any unit;
        # images, positions and centres of stars drawn from their prior; the error of a flux on a
        # known sky; and stars with a magnitude or colour outside of the training range.
        psf_at: Callable[..., np.ndarray]
        measure: Callable[..., Estimate]
        draw_stars: Callable[..., tuple[np.ndarray, np.ndarray, np.ndarray]]
        estimate_flux_error: Callable[..., tuple[float, np.ndarray, np.ndarray]]
        is_outside_range: Callable[..., np.ndarray]

        @property
        def order(self) -> int:
            """Order of the polynomial of the PSF over the field."""

    def __init_subclass__(cls) -> None:
        """Set the name of a method, and complete its label and title."""
        cls.name = cls.__module__.rpartition(".")[2]
        if "look" in vars(cls):
            label, title = cls.look.label, cls.look.title or cls.look.label
            cls.look = replace(cls.look, label=f"{label}{cls.needs}", title=title)

    @classmethod
    def settings(cls, config: Config) -> dict[str, Group]:
        """Return its groups of a configuration, the keyword arguments of `fit`."""
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

    # Results of a fitted method in addition to the PSF of a star; most methods have none.

    def free_flux(self) -> Self:
        """Return the form for images of sum 1 whose flux and sky are only estimates."""
        return self

    def facts(self) -> Mapping[str, str]:
        """Return facts for the user by their titles, without full stops at the end."""
        return {}

    def conditions(self) -> Iterable[tuple[str, str, ArrayLike]]:
        """Return conditions that the arrays of any fit fulfil, to detect damaged files.

        Each has the name of an array, the condition in words, and whether it is fulfilled.
        """
        return ()

    def estimate(
        self,
        noisy: np.ndarray,
        level: float | np.ndarray,
        position: np.ndarray | None = None,
        with_sigma: bool = True,
    ) -> Estimate:
        """Return the PSFs of noisy images (n, d, d), with other results of the method.

        By default it calls `predict` with the inputs that the method needs.

        Parameters
        ----------
        noisy : ndarray, shape (n, d, d)
            Images of flux 1 without sky; estimates of both for the form `free_flux`.
        level : float or ndarray, shape (n,)
            Noise level λ.
        position : ndarray, shape (n, 2) or (n, 4), optional
            See `Needs.position`.
        with_sigma : bool
            False if standard deviations are not needed; some methods are faster without them.
        """
        inputs = (level,) * self.needs.level + (position,) * self.needs.position
        return Estimate(self.predict(noisy, *inputs))

    def outlier_score(
        self, noisy: np.ndarray, level: np.ndarray, near_clusters: np.ndarray | None = None
    ) -> np.ndarray | None:
        """Return the dissimilarity of images (n, d, d) from all training stars, shape (n,).

        It is −2 ln of the probability density; for a normal distribution the squared Mahalanobis
        distance. The result is None if the method does not know the distribution of the training
        stars, or has the score in its `estimate`. `near_clusters` is the second result of `flux`
        for these images.
        """
        return None

    # A fit as files, and as part of a bundle.

    def save(self, place: Path, config: Mapping[str, Any]) -> None:
        """Write the fit with its resolved configuration."""
        # The unit and the meaning of each array are part of the product.
        arrays, facts = self.to_arrays(), self.list_arrays()
        columns = {name: Column(array, *facts[name]) for name, array in arrays.items()}
        write_product(place, self.name, columns, config)

    @classmethod
    def load(
        cls, place: Path, reference: str = "realisation", evaluation: Evaluation | None = None
    ) -> Self:
        """Read a fit, ready to restore a reference.

        Parameters
        ----------
        place : Path
            File or folder of the fit.
        reference : str
            "realisation" or "template"; used by methods with one fit for both.
        evaluation : config group
            Number of threads; by default it is not changed.

        Raises
        ------
        ProductError
            If a file is missing or damaged.
        """
        product = read_product(place, cls.name, tuple(cls.list_arrays()))
        return cls.from_arrays(product.arrays, product.config, reference)

    @classmethod
    def list_arrays(cls) -> Mapping[str, tuple[str, str]]:
        """Return unit and meaning of each array of a fit; empty if the method has no files."""
        return cls.storage.arrays if cls.storage else {}

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return the arrays of a fit by their names in files; by default names of attributes."""
        return {name: getattr(self, name) for name in self.list_arrays()}

    @classmethod
    def read_config(cls, place: Path) -> dict[str, Any]:
        """Return the resolved configuration of a fit."""
        return read_product(place, cls.name, ()).config

    @classmethod
    def from_arrays(
        cls, arrays: Mapping[str, np.ndarray], config: Mapping[str, Any], reference: str
    ) -> Self:
        """Return a fit from its arrays and the configuration that was saved with them."""
        return cls(**arrays)

    def export(self, stamp_px: int, noise: float) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Return the arrays for a bundle, and fields of its `BundleInfo` that describe them.

        `noise` is the minimum RMS per pixel, over the flux, for which they are used.
        """
        return {name: np.asarray(array) for name, array in self.to_arrays().items()}, {}

    @classmethod
    def shapes(cls, info: BundleInfo) -> Mapping[str, tuple[int, ...] | None]:
        """Return the arrays that a bundle must have, with their shapes; None for any shape."""
        return dict.fromkeys(cls.list_arrays())

    @classmethod
    def from_bundle(cls, arrays: Mapping[str, np.ndarray], info: BundleInfo) -> Self:
        """Return a fit from a bundle."""
        return cls.from_arrays(arrays, info.config["train"], info.reference or "realisation")
