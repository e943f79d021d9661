"""Sets of stars, products of the kind "stars": split, noise, and what is made from them.

Inputs: a product and a configuration. Outputs: the `TrainingSet` of a method, the `HeldOutStars`
that test it, and the `ModelStars` from which a model is built of a fit.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from psfdae.base.files import Product, ProductError, read_product
from psfdae.base.rng import stream
from psfdae.base.settings import Config, OfFit, WithNoise
from psfdae.methods.fit_files import get_training_reference
from psfdae.methods.interface import Method, TrainingSet
from psfdae.stars.bright_stars import BrightStars, psf_coordinates
from psfdae.stars.noise import NoiseModel, OwnNoise, build_noise, noise_equivalent_px
from psfdae.stars.splits import Split, held_out_split, random_split


def read_stars(path: Path, *references: str) -> Product:
    """Read stars with their noise-free images, fields and the given references."""
    # The realisation, the noise-free image, is the first of the references.
    names = dict.fromkeys(("realisation", *references, "field_index", "grid"))
    return read_product(path, "stars", tuple(names))


def are_real(stars: Product) -> bool:
    """Return True if the stars come from an image, not from a simulation."""
    return stars.config.get("source") == "stars"


def field_positions(stars: Product) -> np.ndarray:
    """Return the field position of each image of a star.

    Returns
    -------
    ndarray, shape (n, 2) or (n, 4)
        Simulated stars: steps of the field's grid. Stars of an image: pixels, magnitude and colour
        of the bright star, which its noisy images share; NaN where the list lacks them.
    """
    # Rows of fields, or of bright stars; each has several images.
    position = stars["grid"]
    if are_real(stars):
        position = psf_coordinates(stars["position"], stars["flux"], stars["colour"])
    return np.asarray(position[stars["field_index"]])


def star_area(stars: Product, train: np.ndarray) -> float:
    """Return the noise-equivalent area A of a typical star, in pixels.

    Parameters
    ----------
    stars : product "stars"
        Images of stars with their noise-free truth.
    train : ndarray of int
        Numbers of the training images, whose mean gives the area of simulated stars.
    """
    # Bright stars of an image have a measured S/N = F / (σ √A), with σ / F as their noise.
    if are_real(stars):
        return float(np.median((stars["noise"] * stars["snr"]) ** -2.0))
    return noise_equivalent_px(stars["realisation"][train])


def split_stars(stars: Product, kind: str, config: OfFit) -> Split:
    """Split stars into training, validation and test.

    Parameters
    ----------
    stars : product "stars"
        Images of stars with their noise-free truth.
    kind : str
        "held_out" for whole field positions, else at random.
    config : settings with the groups `parts` and `seed`
        Numbers of stars of each part, and the seed of the draw.

    Raises
    ------
    ProductError
        If the file holds fewer stars than the config's parts need.
    """
    parts, field_index = config.parts, stars["field_index"]
    count, validation = len(field_index), parts.validation_fraction
    if kind == "held_out":
        return held_out_split(field_index, stars["grid"], validation, config.seed)
    # Training and test share no image; validation stars are a part of the training.
    if parts.train_stars + parts.test_stars > count:
        raise ProductError(
            f"{stars.path}: holds {count} stars, but parts.train_stars + parts.test_stars = "
            f"{parts.train_stars + parts.test_stars}"
        )
    return random_split(count, parts.train_stars, parts.test_stars, validation, config.seed)


def noise_model(config: WithNoise) -> NoiseModel:
    """Return the noise model of a configuration, by its noise law."""
    return build_noise(config.noise.model_dump())


def noisy_test_images(config: OfFit, stars: Product, test: np.ndarray, level: float) -> np.ndarray:
    """Return noisy images (n, d, d) of test stars at one noise level λ.

    The noise of a star depends on seed, set of stars, λ and star only. Datasets differ in set or λ,
    so that their columns are independent; methods, references, bounds and splits share it, so that
    they are compared on the same images.

    Parameters
    ----------
    config : settings with the groups `noise` and `seed`
        Noise model, and the seed of the draw.
    stars : product "stars"
        Images of stars with their noise-free truth.
    test : ndarray of int, shape (n,)
        Numbers of the images in the product.
    level : float
        λ > 0, the noise level in units of the training (`psfdae.base.settings.Noise`).
    """
    set_name = stars.config.get("stars", {}).get("name", "own")
    # Six digits of λ: the same level from two files may differ in the last bit.
    rng = stream(config.seed, "noise", "test", set_name, f"{level:.6g}")
    return np.asarray(noise_model(config).draw(stars["realisation"], level, rng)[test])


def own_noise(
    stars: Product, images: np.ndarray, background: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the noise of bright stars themselves, in images of flux 1; 0 for simulated stars.

    Parameters
    ----------
    stars : product "stars"
        Product to which the images belong.
    images : ndarray, shape (n, d, d)
        Images of flux 1.
    background : float
        Photons B of the sky in a pixel.

    Returns
    -------
    flux_error : ndarray, shape (n,)
        Standard error of the sum of the pixels, which is set to 1, above a sky that is the median
        of the pixels around the star.
    sigma : ndarray, shape (n, d, d)
        Standard error of each pixel, from the noise of the sky and the photons of the star.
    """
    if not are_real(stars):
        return np.zeros(len(images)), np.broadcast_to(np.float32(0.0), images.shape)
    # A star of F = √B / σ photons has the variance σ² + x / F = σ² + x σ / √B in a pixel x.
    noise = stars["noise"][stars["field_index"]]
    sigma = noise[:, None, None]
    variance = sigma**2 + np.maximum(images, 0.0) * sigma / np.sqrt(background)
    # P pixels have the noise √P σ; the median of n pixels around them errs by √(π/2n) σ in each.
    pixels = images[0].size
    sky_pixels = max(stars["wide"][0].size - pixels, 1)
    return noise * np.sqrt(pixels + np.pi / 2 * pixels**2 / sky_pixels), np.sqrt(variance)


@dataclass(frozen=True)
class HeldOutStars:
    """Noise-free stars of flux 1 that no training has seen.

    Bright stars of an image stand for noise-free ones, but have noise themselves.

    Attributes
    ----------
    min_images : int
        Noisy images per noise node, at least; of fewer stars, each is seen several times.
    images : ndarray, shape (n, d, d)
        Noise-free stars, to which noise is added.
    references : ndarray, shape (n, d, d)
        What is to be restored of them.
    noise : NoiseModel
    position : ndarray, shape (n, 2) or (n, 4)
        Positions; with magnitudes and colours for stars of an image.
    flux_error : ndarray, shape (n,)
        Error of the flux, which is taken to be 1, due to noise in the image.
    own_noise : ndarray, shape (n, d, d)
        Standard deviation of the noise that is in the pixels already.
    star : ndarray of int, shape (n,), or None
        Star of each image, if stars of an image have several; they come in turn.
    """

    images: np.ndarray
    references: np.ndarray
    noise: NoiseModel
    position: np.ndarray
    flux_error: np.ndarray
    own_noise: np.ndarray
    star: np.ndarray | None = None

    min_images: ClassVar[int] = 250

    @classmethod
    def select(
        cls, stars: Product, reference: str, noise: NoiseModel, test: np.ndarray
    ) -> HeldOutStars:
        """Return some stars of a product "stars", by their indices."""
        truth = stars[reference]
        flux_error, pixel_noise = own_noise(stars, truth, noise.background)
        # All stars of the product, of which the test stars are taken.
        arrays = (stars["realisation"], truth, field_positions(stars), flux_error, pixel_noise)
        images, references, position, flux_error, pixel_noise = (array[test] for array in arrays)
        star = stars["field_index"][test] if are_real(stars) else None
        return cls(images, references, noise, position, flux_error, pixel_noise, star)

    def count_stars(self) -> int:
        """Return the number of different stars."""
        return len(self.images) if self.star is None else len(np.unique(self.star))

    def draw(self, noise: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Return at least `min_images` noisy images (n, d, d) of flux 1, and their stars (n,)."""
        # Few stars are repeated, each time with other noise. λ is the noise over the flux and κ.
        star = np.resize(np.arange(len(self.images)), max(len(self.images), self.min_images))
        return self.noise.draw(self.images[star], noise / self.noise.kappa, rng), star

    def errors(
        self,
        psf: np.ndarray,
        star: np.ndarray | slice = slice(None),
        unit: np.ndarray | None = None,
    ) -> np.ndarray:
        """Return moduli of the errors of PSFs of some stars, less the stars' own noise.

        Parameters
        ----------
        psf : ndarray, shape (n, d, d)
            Denoised PSFs of flux 1.
        star : ndarray of int, shape (n,), or slice
            Star of every PSF.
        unit : ndarray, shape (n, d, d), optional
            Unit of the errors, such as the method's σ; by default the flux.

        Returns
        -------
        ndarray, shape (n, d, d)
            At least 0. Quantiles above the own noise are as for errors to noise-free stars; means
            are larger.
        """
        # The own noise s of a pixel is independent of the error e: the difference from the
        # reference has the mean square e² + s².
        square = np.square(psf - self.references[star]) - np.square(self.own_noise[star])
        error = np.sqrt(np.maximum(square, 0.0))
        # Equal stars leave a method no doubt: its σ may be 0.
        return np.asarray(error if unit is None else error / np.maximum(unit, 1e-12))


@dataclass(frozen=True)
class ModelStars:
    """Stars to which a model was fitted, and those that test it: all that a bundle is made from.

    Attributes
    ----------
    product : product "stars"
    images, references : ndarray, shape (n, d, d)
        Training images of flux 1, and what is to be restored of them.
    stars : ndarray of int, shape (m,)
        Numbers of the training stars; a star of an image has several images.
    held_out : HeldOutStars
        Test stars.
    test : ndarray of int
        Their numbers in the product.
    noise_equivalent_px : float
        Noise-equivalent area of a typical star.
    """

    product: Product
    images: np.ndarray
    references: np.ndarray
    stars: np.ndarray
    held_out: HeldOutStars
    test: np.ndarray
    noise_equivalent_px: float

    @classmethod
    def select(cls, stars: Product, split_kind: str, reference: str, config: OfFit) -> ModelStars:
        """Return the parts of a product "stars", as `training_set` and `HeldOutStars` do."""
        parts = split_stars(stars, split_kind, config)
        numbers = np.unique(stars["field_index"][parts.train]) if are_real(stars) else parts.train
        return cls(
            stars,
            stars["realisation"][parts.train],
            stars[reference][parts.train],
            numbers,
            HeldOutStars.select(stars, reference, noise_model(config), parts.test),
            parts.test,
            star_area(stars, parts.train),
        )

    @property
    def bright(self) -> BrightStars | None:
        """The training stars of an image with the pixels around them; None if simulated."""
        return BrightStars.read(self.product).select(self.stars) if are_real(self.product) else None


def training_set(
    config: OfFit, kind: type[Method], stars: Product, split: str, reference: str, **fields: Any
) -> TrainingSet:
    """Return the training part of a split, with the noise of a configuration.

    Parameters
    ----------
    config : settings with the groups `noise`, `parts` and `seed`
        Noise levels, numbers of stars of each part, and seed.
    kind : type of Method
        Method to be fitted.
    stars : product "stars"
        Images of stars with their noise-free truth.
    split : str
        Kind of the split, as of `split_stars`.
    reference : str
        Array of the product that is the truth.
    **fields
        Further fields of `TrainingSet`.
    """

    def star_noise(images: np.ndarray, mean: np.ndarray) -> np.ndarray:
        """Return the noise of bright stars; its arrays are read if a method asks for it."""
        star, background = stars["field_index"], config.noise.background_photons
        return OwnNoise(stars["noise"][star], background, stars["phase"], star)(images, mean)

    # Stars of an image have noise themselves, and some methods measure them in the image; simulated
    # stars have a description of their simulation.
    parts, positions = split_stars(stars, split, config), field_positions(stars)
    if are_real(stars):
        fields["own_noise"] = star_noise
        if kind.knows_field:
            fields |= {"bright": BrightStars.read(stars), "star": stars["field_index"]}
    else:
        fields["simulation"] = stars.config
    return TrainingSet(
        images=stars["realisation"],
        references=stars[get_training_reference(kind, reference)],
        fit=parts.fit,
        validation=parts.validation,
        levels=np.asarray(config.noise.levels),
        noise=noise_model(config),
        seed=config.seed,
        reference=reference,
        positions=positions,
        **fields,
    )


def fit_apart(kind: type[Method], data: TrainingSet, star: np.ndarray, config: Config) -> Method:
    """Fit a method without the validation stars, for methods that otherwise train on them.

    Parameters
    ----------
    kind : type of Method
        Class of the method.
    data : TrainingSet
        Images with their training and validation parts.
    star : ndarray of int, shape (n,)
        Number of the star of each image.
    config : settings of the method
        Groups of settings that `Method.fit` takes.
    """
    # A tenth of the stars of the fit choose its settings in place of the validation stars.
    is_judge = np.isin(star[data.fit], np.unique(star[data.fit])[::10])
    data = replace(data, fit=data.fit[~is_judge], validation=data.fit[is_judge])
    return kind.fit(data, **kind.settings(config))
