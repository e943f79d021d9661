"""`Stars`: the bright stars of images, some for the training of a model, others for its test."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from psfdae.base.files import Column, Product
from psfdae.base.rng import stream
from psfdae.base.settings import Noise
from psfdae.image.containers import as_images
from psfdae.image.errors import ObservationError
from psfdae.image.image_input import ImageInput, ImageStatements
from psfdae.image.observation import Observation
from psfdae.image.positions import list_offset
from psfdae.image.selection import Candidates, Verdict
from psfdae.image.selection_advice import advice
from psfdae.image.tables import html_table, star_table
from psfdae.image.training_images import single_psf, star_grid, training_columns
from psfdae.stars.bright_stars import BrightStars
from psfdae.stars.splits import Split, held_out_fields
from psfdae.training.settings import Settings, settings_model, with_keywords
from psfdae.training.star_choice import (
    ENOUGH_STARS,
    MIN_STARS_WITH_ERROR,
    choose_bright_stars,
    few_stars_notes,
    require_one_camera,
    require_unique_names,
)
from psfdae.training.star_residuals import reject_misfits
from psfdae.training.star_sets import split_stars, training_set

if TYPE_CHECKING:
    from astropy.table import QTable

    from psfdae.image.catalogue import StarList
    from psfdae.image.containers import Image
    from psfdae.methods.interface import Method, TrainingSet


@dataclass(frozen=True, eq=False)
class Stars:
    """Bright stars of an image, and the images for the training and the test of methods.

    Stars of several exposures are one set; `exposures` has those of each.

    Attributes
    ----------
    source : ImageInput
        The image, and what was stated about it; of several, the first one.
    observation : Observation
        The image with all of its stars; of several, the first one under a name for all.
    candidates : Candidates
        Measurements of each star of the list, and the bright stars among them.
    held_out : ndarray of bool, shape (n,)
        True for bright stars that no fit learns from.
    settings : Settings
        Settings, with the noise levels that follow from the stars.
    notes : sequence of str
        Facts about the camera and the list, and advice on settings.
    exposures : sequence of Stars
        The stars of each image, if there are several.

    Examples
    --------
    >>> stars = psfdae.Stars.from_image(image, catalogue=xy, **camera)
    >>> stars
    Stars('array', 36 stars (29 to learn from, 7 held out) of 36)
    >>> [str(part) for part in stars.table["part"][:2]]
    ['training', 'held out']
    """

    source: ImageInput
    observation: Observation
    candidates: Candidates
    held_out: np.ndarray
    settings: Settings
    notes: Sequence[str]
    exposures: Sequence[Stars] = ()
    split_kind: ClassVar[str] = "held_out"
    """Kind of the split: all images of a star are in the training, or all are in the test."""
    reference: ClassVar[str] = "realisation"
    """Array of `product` with the truth: the noise-free image of the star itself."""

    @classmethod
    def from_image(
        cls, image: Image | Sequence[Image], catalogue: StarList | None = None, **statements: Any
    ) -> Stars:
        """Choose the bright stars of an image and make training data of them.

        Parameters
        ----------
        image : path-like, array of shape (h, w) or (n, s, s), NDData, HDU, or several of these
            FITS image, or cube of stamps; or images that are exposures of one camera, of which all
            that follows is stated alike. Mask, uncertainty, unit, WCS and meta of CCDData and
            NDData are used, and the mask of a masked array; an HDUList is read as a file is.
        catalogue : path-like, table, SkyCoord, array of shape (n, 2), or n pairs, optional
            Star list: a file, a table with its columns, or positions (x, y), 0-based; of several
            images, one with sky coordinates.
        **statements
            Statements on the image, named and explained in
            `psfdae.image.image_input.ImageStatements`, such as `gain=1.5`: `detect` (True, or the
            threshold in σ), `threshold`, `on_image`, `extension`, `origin`, `mask`, `bad_bits`,
            `weight`, `variance`, `error`, `pixel_scale_arcsec`, `gain`, `read_noise`, `saturate`,
            `colour_column`, `accept_offset`. All others are settings, keys of `CalibrationStars`,
            `Stamp` and `Parts`, or `seed`; such as `snr_min=50` or `stamp_px=24`.

        Raises
        ------
        Error
            If the image or the list cannot be used, or too few stars are bright enough.
        """
        images = as_images(image)
        if not images:
            raise ObservationError("image", "no image, expected at least one")
        # Keywords are statements on the image, or else settings.
        names = {field.name for field in fields(ImageStatements)}
        settings = {name: value for name, value in statements.items() if name not in names}
        stated = {name: value for name, value in statements.items() if name in names}
        # All images are opened with the same statements.
        source = ImageInput(images[0], catalogue=catalogue, **stated)
        settings_of_all = with_keywords(settings_model()(), Settings.image_groups, settings)
        return cls.of(source.of_each(images), settings_of_all)

    @classmethod
    def of(cls, sources: Sequence[ImageInput], settings: Settings) -> Stars:
        """Choose the bright stars of images with their options; errors are those of `from_image`.

        A single image must have enough stars itself; of several, all together must.
        """
        require_unique_names(sources)
        calibration = settings.calibration_stars
        opened: Sequence[Observation] = [
            source.open(settings.framing.stamp_px, calibration.margin_px).assuming()
            for source in sources
        ]
        for observation in opened:
            observation.check_planes()
        require_one_camera(opened)
        opened, candidates, relaxed, notes = choose_bright_stars(opened, settings)
        # Bright stars of each image; those of a crowded image again without their neighbours.
        exposures = []
        for source, observation, measured in zip(sources, opened, candidates, strict=True):
            image_candidates = reject_misfits(measured, relaxed, observation.gain)
            # Of several images, one may have few stars or none.
            if len(sources) == 1:
                min_stars = relaxed.calibration_stars.stars_min
                image_candidates.require(observation.path, min_stars, observation.remarks)
            stars = stars_of_candidates(source, observation, image_candidates, relaxed)
            if is_crowded(stars):
                from psfdae.training.neighbours import without_neighbours

                stars = without_neighbours(stars, calibration.neighbour_ratio)
            exposures.append(stars)
        stars = exposures[0] if len(exposures) == 1 else joined_stars(exposures)
        few_notes = few_stars_notes(stars.candidates.bright.row, stars.held_out)
        return replace(stars, notes=(*stars.notes, *notes, *few_notes))

    @property
    def images(self) -> Sequence[Stars]:
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
        return f"{len(self) - held_out} to learn from, {held_out} held out"

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
        """Default name of a model of these stars: that of the image, or "all" of several."""
        return "all" if self.exposures else self.source.name

    def with_settings(self, settings: Settings) -> Stars:
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
        listed = [columns_of_list for columns_of_list in lists if columns_of_list is not None]
        joined_list = vstack(listed) if len(listed) == len(lists) else None
        return star_table(columns, self.observation.unit, joined_list)

    @cached_property
    def product(self) -> Product:
        """Training and test images with their stars, as a product "stars" in memory."""
        arrays = {name: column.values for name, column in self.columns.items()}
        return Product(self.observation.path, self.described(), arrays)

    @property
    def mean_psf(self) -> np.ndarray:
        """Stack of all training stars, (s, s), its centre at index (s//2, s//2)."""
        return single_psf(self.candidates.bright, self.held_out)

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
        if observation.shape:
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


def stars_of_candidates(
    source: ImageInput, observation: Observation, candidates: Candidates, settings: Settings
) -> Stars:
    """Return the bright stars among the measured stars of an observation.

    Parameters
    ----------
    source : ImageInput
    observation : Observation
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
        bright = bright.of(np.array([0, 0]))
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
        settings = with_degraded_levels(settings, bright, sky_photons)
    # Every fifth star is held out, evenly over the field.
    held_out = held_out_fields(star_grid(bright.position))
    return Stars(source, observation, candidates, held_out, settings, tuple(notes))


def is_crowded(stars: Stars) -> bool:
    """Return True if so many bright stars have neighbours that it pays to subtract these.

    Parameters
    ----------
    stars : Stars
        Stars of one image.
    """
    # Neighbours can only be fitted in an image with known positions, not in a cube of stamps.
    has_image = stars.observation.shape is not None
    if not has_image or not np.isfinite(stars.candidates.bright.position).all():
        return False
    # With fewer than 5 stars, there is no field to fit neighbours with; with fewer stars that have
    # neighbours than stars without, those without are enough.
    crowded = np.count_nonzero(stars.candidates.verdict == Verdict.CROWDED)
    enough = max(len(stars), ENOUGH_STARS)
    return len(stars) >= MIN_STARS_WITH_ERROR and bool(crowded >= enough)


def joined_stars(exposures: Sequence[Stars]) -> Stars:
    """Join the stars of several images of one camera, chosen with the same settings.

    A star is held out if it is in its own image.

    Parameters
    ----------
    exposures : sequence of Stars
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
        shape=tuple(map(max, zip(*(image.shape or () for image in observations), strict=True))),
        header_cards=[card for image in observations for card in image.header_cards],
    )
    candidates = Candidates.joined([image.candidates for image in exposures])
    candidates.require(observation.path, first.settings.calibration_stars.stars_min)
    # The sky of a typical star: each image counts by its number of stars.
    sky_photons = np.repeat(
        [image.settings.noise.background_photons for image in exposures],
        [len(image) for image in exposures],
    )
    return Stars(
        first.source,
        observation,
        candidates,
        np.concatenate([image.held_out for image in exposures]),
        with_degraded_levels(first.settings, candidates.bright, float(np.median(sky_photons))),
        [note for image in exposures for note in image.notes],
        exposures=exposures,
    )


def with_degraded_levels(settings: Settings, bright: BrightStars, sky_photons: float) -> Settings:
    """Return settings with the noise levels λ of the stated S/N, for noise-free stars of flux 1.

    S/N = 1 / (κ λ √A), with A the median noise-equivalent area of the bright stars.

    Parameters
    ----------
    settings : Settings
    bright : BrightStars
    sky_photons : float
        Photons of the sky in a pixel.
    """
    area, kappa = float(np.median(bright.area())), settings.noise.kappa
    degraded_snr = settings.calibration_stars.degraded()
    levels = [1.0 / (snr * np.sqrt(area) * kappa) for snr in degraded_snr]
    # Levels ascend where S/N descend; nine digits, so that a file has the same number.
    noise = Noise(
        name=settings.noise.name,
        levels=[float(f"{level:.9g}") for level in reversed(levels)],
        kappa=kappa,
        background_photons=sky_photons,
    )
    return settings.model_copy(update={"noise": noise})
