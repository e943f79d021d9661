"""`ImageStars`: bright stars of images, some for the training of a model, others for its test."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from html import escape
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from psfdae.base.files import Column, Product
from psfdae.base.rng import stream
from psfdae.base.settings import Noise
from psfdae.base.types import QTable
from psfdae.image.image import Image
from psfdae.image.image_input import ImageInput
from psfdae.image.observation import Observation
from psfdae.image.positions import list_offset
from psfdae.image.selection import Candidates
from psfdae.image.selection_advice import advice
from psfdae.image.tables import html_table, star_table
from psfdae.methods.interface import Estimate, Method, TrainingSet
from psfdae.stars.bright_stars import BrightStars
from psfdae.stars.splits import Split, held_out_fields
from psfdae.training.settings import Settings
from psfdae.training.star_sets import split_stars, training_set
from psfdae.training.training_images import stack_all, star_grid, training_columns


@dataclass(frozen=True, eq=False)
class ImageStars:
    """Bright stars of an image, and the images for the training and the test of methods.

    Stars of several exposures are one set; `exposures` has the stars of each.

    Attributes
    ----------
    source : ImageInput
        The image with its list and options; of several, the first one.
    observation : Observation
        The image with all of its stars; of several, the first one under a name for all.
    candidates : Candidates
        Measurements of each star of the list, and the bright stars among them.
    held_out : ndarray of bool, shape (n,)
        True for bright stars that are not used in any fit.
    settings : Settings
        Settings, with the noise levels that follow from the stars.
    notes : sequence of str
        Facts about the camera and the list, and advice on settings.
    exposures : sequence of ImageStars
        The stars of each image, if there are several.
    estimates : dict
        By noise level λ, the method of the model that was packed last, the noisy test images, and
        its estimate of them, which the report shows.

    Examples
    --------
    >>> stars = psfdae.Stars.from_image(image, catalogue=xy, **camera)
    >>> stars
    Stars('array', 36 stars (29 training stars, 7 held out) of 36)
    >>> [str(part) for part in stars.table["part"][:2]]
    ['training', 'held out']
    """

    source: ImageInput
    observation: Observation
    candidates: Candidates
    held_out: np.ndarray
    settings: Settings
    notes: Sequence[str]
    exposures: Sequence[ImageStars] = ()
    estimates: dict[float, tuple[Method, np.ndarray, Estimate]] = field(default_factory=dict)
    split_kind: ClassVar[str] = "held_out"
    """Kind of the split: all images of a star are in the training, or all are in the test."""
    reference: ClassVar[str] = "realisation"
    """Array of `product` with the truth: the noise-free image of the star itself."""

    @property
    def images(self) -> Sequence[ImageStars]:
        """Stars of each image."""
        return self.exposures or (self,)

    @cached_property
    def split(self) -> Split:
        """Numbers of the training, validation and test images in `product`."""
        return split_stars(self.product, self.split_kind, self.settings)

    def training_set(self, kind: type[Method], **fields: Any) -> TrainingSet:
        """Return what a method is fitted to; `fields` are further fields of `TrainingSet`."""
        return training_set(
            self.settings, kind, self.product, self.split_kind, self.reference, **fields
        )

    @cached_property
    def columns(self) -> dict[str, Column]:
        """Arrays of the product "stars"."""
        # Positions on a lattice over each image, by which stars are held out evenly over its field.
        settings, calibration = self.settings, self.settings.calibration_stars
        grid = np.concatenate([star_grid(s.candidates.bright.position) for s in self.images])
        return training_columns(
            self.candidates.bright,
            grid,
            self.held_out,
            calibration.bins,
            settings.framing,
            settings.parts,
            stream(settings.seed, "own stars"),
            calibration.centring_px or 0.0,
        )

    @property
    def _counts(self) -> str:
        """Words for the numbers of stars of the training and of the test."""
        held_out = int(self.held_out.sum())
        return f"{len(self) - held_out} training stars, {held_out} held out"

    def __repr__(self) -> str:
        path, count = str(self.observation.path), len(self.candidates.verdict)
        return f"Stars({path!r}, {len(self)} stars ({self._counts}) of {count})"

    def _repr_html_(self) -> str:
        """Return counts of the stars, for a notebook."""
        rows = [
            ["image", escape(self.observation.path.name)],
            ["stars", f"{len(self)}: {self._counts}"],
            [f"of {len(self.candidates.verdict)}", self.candidates.count()],
            ["stamps", f"{self.settings.framing.stamp_px} px"],
        ]
        rows += [["images", str(len(self.images))]] if self.exposures else []
        return html_table(["Stars", ""], rows)

    @property
    def name(self) -> str:
        """Default name of a model of these stars: the image's name, or "all" of several."""
        return "all" if self.exposures else self.source.name

    def replace_settings(self, settings: Settings) -> ImageStars:
        """Return these stars with other settings of methods."""
        # The images are drawn once for all methods.
        stars = replace(self, settings=settings)
        vars(stars)["columns"] = self.columns  # no setting of a method changes them
        return stars

    def __len__(self) -> int:
        return len(self.held_out)

    def summary(self) -> str:
        """Return the number of stars of every verdict, and of those held out, in two lines."""
        count = len(self.candidates.verdict)
        return f"{count} stars: {self.candidates.count()}\n{self._counts}"

    @property
    def table(self) -> QTable:
        """Every star: position, S/N, why it is not used, its part, and the columns of its list.

        `psfdae.image.tables.star_table` has the names and units of the columns.
        """
        from astropy.table import vstack

        # Measurements of all stars; of several images, with the file that each star is in.
        columns = self.candidates.columns(self.held_out)
        observations = [image.observation for image in self.images]
        if self.exposures:
            names = [observation.path.name for observation in observations]
            counts = [observation.count for observation in observations]
            columns = {"image": np.repeat(names, counts), **columns}
        # Columns of the lists, if every image has one.
        lists = [observation.list_columns for observation in observations]
        list_columns = [columns_of_list for columns_of_list in lists if columns_of_list is not None]
        joined_list = vstack(list_columns) if len(list_columns) == len(lists) else None
        return star_table(columns, self.observation.unit, joined_list)

    @cached_property
    def product(self) -> Product:
        """Training and test images with their stars, as a product "stars" in memory."""
        arrays = {name: column.values for name, column in self.columns.items()}
        return Product(self.observation.path, self.described(), arrays)

    @property
    def mean_psf(self) -> np.ndarray:
        """Stack of all training stars, (s, s), its centre at index (s//2, s//2)."""
        return stack_all(self.candidates.bright, self.held_out)

    def described(self) -> dict[str, Any]:
        """Return the description of the product "stars", as JSON holds it."""
        # Settings that determine the stars, then the images, then what is known of the camera.
        observation = self.observation
        parts = {"seed", "calibration_stars", "framing", "parts"}
        description: dict[str, Any] = {
            **self.settings.model_dump(include=parts),
            "source": "stars",
            "image": ", ".join(image.observation.path.name for image in self.images),
            "image_sha256": ", ".join(image.observation.sha256() for image in self.images),
        }
        if isinstance(observation, Image):
            description["image_px"] = [*reversed(observation.shape)]
        if frames := observation.detector_frames:
            description["detector"] = frames
        if observation.instrument:
            description["instrument"] = observation.instrument
        if observation.colour_column:
            description["colour_column"] = observation.colour_column
        description["telescope"] = {"pixel_scale_arcsec": observation.pixel_scale_arcsec}
        if observation.scale_assumed:
            description["telescope"]["assumed"] = True
        # Tuples become lists, as in the description of a product that was read from a file.
        plain: dict[str, Any] = json.loads(json.dumps(description))
        return plain


def select_stars(
    source: ImageInput, observation: Observation, candidates: Candidates, settings: Settings
) -> ImageStars:
    """Return the bright stars among the measured stars of an observation.

    Parameters
    ----------
    source : ImageInput
        Image and list from which the observation was opened.
    observation : Observation
        The opened image, with its stars.
    candidates : Candidates
        Measured stars of the observation.
    settings : Settings
        Settings by which the stars were chosen.

    Raises
    ------
    ObservationError
        If the stars are far off the positions of their list, unless that is accepted.
    """
    bright = candidates.bright
    # A single star stands twice: the model is trained on it and tested on it.
    if len(bright) == 1:
        bright = bright.select(np.array([0, 0]))
        candidates = replace(candidates, bright=bright)
    # Median offset (x, y) between stars and list; a large one is refused unless accepted.
    offset = (bright.centre - bright.listed)[:, ::-1]
    offset_note = list_offset(observation.catalogue, offset, source.accept_offset)
    notes = [observation.summary(), *filter(None, [offset_note])]
    # Advice on stamps and saturation needs enough stars for a median.
    if len(bright) >= settings.calibration_stars.stars_min:
        notes += advice(candidates, observation, settings.framing.stamp_px)
    # Noise levels follow from the noise-equivalent area of the bright stars.
    if len(bright):
        sky_photons = bright.sky_photons(observation.gain, settings.noise.background_photons)
        settings = degrade_levels(settings, bright, sky_photons)
    # Every fifth star is held out, evenly over the field.
    held_out = held_out_fields(star_grid(bright.position))
    return ImageStars(source, observation, candidates, held_out, settings, tuple(notes))


def join_stars(exposures: Sequence[ImageStars]) -> ImageStars:
    """Join the stars of several images of one camera, chosen with the same settings.

    A star is held out if it is in its own image.

    Parameters
    ----------
    exposures : sequence of ImageStars
        The stars of each image, two images or more.

    Raises
    ------
    CalibrationStarsError
        If all together are too few.
    """
    # The joined observation stands for all images, as large as the largest.
    first, observations = exposures[0], [image.observation for image in exposures]
    observation = replace(
        first.observation,
        path=Path(f"{first.observation.path} and {len(exposures) - 1} more"),
        shape=tuple(map(max, zip(*(image.shape for image in observations), strict=True))),
        header_cards=[card for image in observations for card in image.header_cards],
    )
    candidates = Candidates.concatenate([image.candidates for image in exposures])
    candidates.require(observation.path, first.settings.calibration_stars.stars_min)
    # The sky of a typical star: each image counts by its number of stars.
    sky_photons = np.repeat(
        [image.settings.noise.background_photons for image in exposures],
        [len(image) for image in exposures],
    )
    return ImageStars(
        first.source,
        observation,
        candidates,
        np.concatenate([image.held_out for image in exposures]),
        degrade_levels(first.settings, candidates.bright, float(np.median(sky_photons))),
        [note for image in exposures for note in image.notes],
        exposures=exposures,
    )


def degrade_levels(settings: Settings, bright: BrightStars, sky_photons: float) -> Settings:
    """Return settings with the noise levels λ of the given S/N, for noise-free stars of flux 1.

    S/N = 1 / (κ λ √A), with A the median noise-equivalent area of the bright stars.

    Parameters
    ----------
    settings : Settings
        Settings with `snr_levels`.
    bright : BrightStars
        Stars to be degraded.
    sky_photons : float
        Photons of the sky in a pixel.
    """
    area, kappa = float(np.median(bright.area())), settings.noise.kappa
    degraded_snr = settings.calibration_stars.list_degraded_snr()
    levels = [1.0 / (snr * np.sqrt(area) * kappa) for snr in degraded_snr]
    # Levels ascend where S/N descend; nine digits, so that a file has the same number.
    noise = Noise(
        name=settings.noise.name,
        levels=[float(f"{level:.9g}") for level in reversed(levels)],
        kappa=kappa,
        background_photons=sky_photons,
    )
    return settings.model_copy(update={"noise": noise})
