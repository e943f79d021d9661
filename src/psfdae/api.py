"""What `import psfdae` gives: models, stars, and the calls that take a whole image.

Each call opens its image (`ImageInput`) and leaves the work to a function of another module.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, Unpack

from pydantic import PositiveInt

from psfdae.base.arguments import check_arguments
from psfdae.base.types import CCDData, GriddedPSFModel, QTable
from psfdae.denoise.image_prediction import predict_stars
from psfdae.denoise.prediction import Prediction
from psfdae.denoise.star_model import StarModel
from psfdae.image.containers import as_images
from psfdae.image.errors import ObservationError
from psfdae.image.image_input import ImageInput, ImageKeywords, ImageOptions
from psfdae.photometry.image_photometry import measure_all_stars
from psfdae.psf.interface import NodeCount, Oversampling
from psfdae.psf.photutils_grid import make_photutils_grid
from psfdae.training.exposures import exposure
from psfdae.training.fitting import fit_model
from psfdae.training.from_image import collect_stars
from psfdae.training.settings import Settings, apply_keywords, settings_model
from psfdae.training.stars import ImageStars

if TYPE_CHECKING:
    from psfdae.image.catalogue import StarList
    from psfdae.image.containers import ImageLike


class StarKeywords(ImageKeywords, total=False):
    """Keywords of `Stars.from_image`: options of the image, and settings of stars and stamps.

    The settings are explained in `psfdae.base.settings`: `CalibrationStars`, `Stamp` and `Parts`.
    `seed` is the seed of all random numbers.
    """

    snr_min: float | None
    isolation_px: float
    neighbour_ratio: float
    misfit: float
    search_px: int
    margin_px: int
    stars_min: int
    light_min: float
    centring_px: float | None
    bins: int
    snr_levels: list[float]
    stamp_px: int
    jitter_px: int
    subpixel: bool
    train_stars: int
    test_stars: int
    validation_fraction: float
    seed: int


class PredictKeywords(ImageKeywords, total=False):
    """Keywords of `PsfModel.predict_image`: options of the image, and columns of its list."""

    flux_column: str | None
    background_column: str | None


class Stars(ImageStars):
    """Bright stars of an image, and the images for the training and the test of methods.

    `from_image` chooses them. `psfdae.training.stars.ImageStars` has their attributes.

    Examples
    --------
    >>> stars = psfdae.Stars.from_image(image, catalogue=xy, **camera)
    >>> stars
    Stars('array', 36 stars (29 training stars, 7 held out) of 36)
    >>> [str(part) for part in stars.table["part"][:2]]
    ['training', 'held out']
    """

    @classmethod
    @check_arguments
    def from_image(
        cls,
        image: ImageLike | Sequence[ImageLike],
        catalogue: StarList | None = None,
        **options: Unpack[StarKeywords],
    ) -> Self:
        """Choose the bright stars of an image and make training data of them.

        Parameters
        ----------
        image : path-like, array of shape (h, w) or (n, s, s), NDData, HDU, or several of these
            FITS image, or cube of stamps; or images that are exposures of one camera, with the
            same options for all. Mask, uncertainty, unit, WCS and meta of CCDData and
            NDData are used, and the mask of a masked array; an HDUList is read as a file is.
        catalogue : path-like, table, SkyCoord, array of shape (n, 2), or n pairs, optional
            Star list: a file, a table with its columns, or positions (x, y), 0-based; of several
            images, one with sky coordinates.
        **options
            Options of the image (`psfdae.image.image_input.ImageOptions`), such as `gain=1.5` or
            `detect=True`, which may be the threshold in σ; or settings of stars and stamps
            (`StarKeywords`), such as `snr_min=50` or `stamp_px=24`.

        Returns
        -------
        Stars
            All stars of the list with their verdicts, and the images of the good ones.

        Raises
        ------
        Error
            If the image or the list cannot be used, or too few stars are bright enough.
        """
        images = as_images(image)
        if not images:
            raise ObservationError("image", "no image, expected at least one")
        # Keywords are options of the image, or else settings. All images are opened alike.
        names = {option.name for option in fields(ImageOptions)}
        image_options: dict[str, Any] = {n: v for n, v in options.items() if n in names}
        settings = {name: value for name, value in options.items() if name not in names}
        source = ImageInput(images[0], catalogue=catalogue, **image_options)
        all_settings = apply_keywords(settings_model()(), Settings.image_groups, settings)
        stars = collect_stars(source.repeat_for(images), all_settings)
        return cls(*(getattr(stars, field.name) for field in fields(stars)))


class PsfModel(StarModel):
    """Fitted method with all that it takes to denoise stars: photometry, errors and limits.

    Examples
    --------
    >>> prediction = model.predict(stamps, position=xy)
    >>> prediction.psf.shape
    (36, 16, 16)
    >>> model.psf_at(150.0, 150.0, oversampling=1).shape
    (16, 16)
    >>> model.save("image.psf.safetensors")
    >>> psfdae.load_model("image.psf.safetensors").info.training_stars
    29
    """

    @check_arguments
    def predict_image(
        self,
        image: ImageLike,
        catalogue: StarList | None = None,
        *,
        fixed: bool = False,
        threads: PositiveInt | None = None,
        **options: Unpack[PredictKeywords],
    ) -> Prediction:
        """Return the PSFs of the stars of an image, as the command `psfdae predict` does.

        Parameters
        ----------
        image : path-like, array, NDData, HDU or HDUList
            FITS image, or cube of stamps.
        catalogue : path-like, table, SkyCoord, array of shape (n, 2), or n pairs, optional
            Star list, as `Stars.from_image` takes it.
        fixed : bool
            Hold the centres of the list fixed, for models that measure centres (field).
        threads : int, optional
            By default, all cores.
        **options
            Options of the image (`psfdae.image.image_input.ImageOptions`), such as `detect=True` in
            place of a list. Also `flux_column` and `background_column` of the list.

        Returns
        -------
        Prediction
            One row per star; `notes` has sentences on the image and its list.

        Raises
        ------
        Error
            If the image or its list cannot be used, or its pixel scale is not the model's.
        """
        source = ImageInput.build(image, {**options, "catalogue": catalogue})
        return predict_stars(self, source, threads, fixed)

    @check_arguments
    def adapt(
        self,
        image: ImageLike,
        catalogue: StarList | None = None,
        *,
        name: str | None = None,
        **options: Unpack[ImageKeywords],
    ) -> Self:
        """Return this model adapted to another exposure, as `psfdae adapt` does.

        The stars of the exposure show how its PSF differs from the model's; ten may be enough.

        Parameters
        ----------
        image : path-like, array, NDData, HDU or HDUList
            FITS image of the other exposure.
        catalogue : path-like, table, SkyCoord, array of shape (n, 2), or n pairs, optional
            Star list, as `Stars.from_image` takes it.
        **options
            Options of the image (`psfdae.image.image_input.ImageOptions`), such as `gain=1.5` or
            `detect=True`.
        name : str, optional
            Name of the new model, by default the image's.

        Returns
        -------
        PsfModel
            Model of the exposure; this one is unchanged.

        Raises
        ------
        Error
            If this is not a model of a field, or the image has too few bright stars.
        """
        source = ImageInput.build(image, {**options, "catalogue": catalogue})
        return exposure(self, source, name or source.name)[0]

    @check_arguments
    def photometry(
        self,
        image: ImageLike,
        catalogue: StarList | None = None,
        *,
        zero_point: float | None = None,
        reference: StarList | None = None,
        magnitude_column: str = "mag",
        **options: Unpack[ImageKeywords],
    ) -> QTable:
        """Measure the fluxes of all stars of an image, overlapping ones together.

        It is the table that the command `psfdae photometry` writes.

        Parameters
        ----------
        image : path-like, array, NDData, HDU or HDUList
            The image that the model was trained on, or another one with the same PSF.
        catalogue : path-like, table, SkyCoord, array of shape (n, 2), or n pairs, optional
            Star list; no other stars are searched for.
        zero_point : float, optional
            Magnitude of a flux of 1.
        reference : as `catalogue`, optional
            Star list with magnitudes, which give the zero point.
        magnitude_column : str
            Column of the reference with the magnitudes.
        **options
            Options of the image (`psfdae.image.image_input.ImageOptions`), such as `detect=True` in
            place of a list.

        Returns
        -------
        QTable
            A row for each star, with units.

        Raises
        ------
        Error
            If the image or a list cannot be used, or the model does not know the PSF at a position.
        """
        source = ImageInput.build(image, {**options, "catalogue": catalogue})
        return measure_all_stars(self, source, zero_point, reference, magnitude_column).table

    @check_arguments
    def residual(
        self, image: ImageLike, catalogue: StarList | None = None, **options: Unpack[ImageKeywords]
    ) -> CCDData:
        """Return an image without its sky and stars, which are measured as by `photometry`.

        `psfdae.photometry.image_photometry.measure_all_stars` gives table and residual of one
        measurement.

        Parameters
        ----------
        image : path-like, array, NDData, HDU or HDUList
            FITS image with the PSF of the model.
        catalogue : path-like, table, SkyCoord, array of shape (n, 2), or n pairs, optional
            Star list; no other stars are searched for.
        **options
            Options of the image (`psfdae.image.image_input.ImageOptions`), such as `gain=1.5` or
            `detect=True`.

        Returns
        -------
        CCDData
            Image in its own unit, with its WCS.

        Raises
        ------
        Error
            As `photometry`.
        """
        source = ImageInput.build(image, {**options, "catalogue": catalogue})
        return measure_all_stars(self, source).residual

    @check_arguments
    def to_photutils(self, nodes: NodeCount = 9, oversampling: Oversampling = 4) -> GriddedPSFModel:
        """Return the field as photutils' `GriddedPSFModel`, such as `PSFPhotometry` takes.

        Its PSFs have an odd number of values along an axis.

        Parameters
        ----------
        nodes : int
            Positions along either axis, over the field of the training stars.
        oversampling : int
            Values per pixel and axis.

        Raises
        ------
        PredictionError
            As `psf_at`.
        """
        return make_photutils_grid(self, nodes, oversampling)


@check_arguments
def load_model(path: str | Path | None = None) -> PsfModel:
    """Return a trained model, ready to predict the PSFs of stars.

    Parameters
    ----------
    path : path-like, optional
        Model bundle (`.psf.safetensors`); by default the one that comes with the package.

    Raises
    ------
    BundleError
        If the file is missing, damaged, of a newer format, or not a model bundle.
    PredictionError
        If it describes a telescope.
    MissingExtraError
        If the model is a network and torch is not installed.

    Examples
    --------
    >>> psfdae.load_model()
    PsfModel('wfsat', 16×16 px of 0.1", S/N 3.3 … 1.1e+03)
    """
    return PsfModel.load(path)


@check_arguments
def fit(
    stars: Stars,
    method: str | None = None,
    *,
    name: str | None = None,
    licence: str = "not stated",
    **settings: object,
) -> PsfModel:
    """Train a model on the bright stars of images, without those that are held out.

    Parameters
    ----------
    stars : ImageStars
        Bright stars of one or several images (`Stars.from_image`).
    method : str, optional
        "gmm", "field" or "dae"; by default, of the methods in the settings, the one with the
        smallest error on validation stars, or "field" where stars are few.
    name : str, optional
        Name of the model; by default the image's.
    licence : str
        Licence of the model.
    **settings
        Keys of the method's settings, such as `orders=[0, 1, 2]` for "field".

    Returns
    -------
    PsfModel
        `save` writes it to a file.

    Raises
    ------
    Error
        If the method's fits cannot be saved as a model, a package is missing, or a setting is
        wrong.

    Examples
    --------
    >>> psfdae.fit(stars, method="gmm", components=[4], shrinkage=[10.0], name="mine")
    PsfModel('mine', 16×16 px of 1", S/N 5 … 50)
    """
    model = fit_model(stars, method, name=name, licence=licence, **settings)
    return PsfModel(model.bundle, model.method)
