"""`Stars`: the bright stars of images, some for the training of a model, others for its test."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from psfdae.bright_stars import BrightStars
from psfdae.files import Column, Product
from psfdae.image.camera import other_instruments
from psfdae.image.containers import as_images
from psfdae.image.errors import ObservationError
from psfdae.image.image_input import ImageInput, ImageStatements
from psfdae.image.observation import ASSUMED_SCALE_ARCSEC, Observation
from psfdae.image.positions import list_offset
from psfdae.image.selection import Candidates, Verdict, collect
from psfdae.image.selection_advice import advice
from psfdae.image.source_size import SourceSize, measure_size
from psfdae.image.tables import html_table, star_table
from psfdae.image.training_images import single_psf, star_grid, training_columns
from psfdae.model.psf_model import SCALE_TOLERANCE
from psfdae.model.settings import IMAGE_GROUPS, Settings, settings_model, with_keywords
from psfdae.model.star_sets import split_stars
from psfdae.rng import stream
from psfdae.settings import Noise
from psfdae.splits import Split, held_out_fields

if TYPE_CHECKING:
    from astropy.table import QTable

    from psfdae.image.catalogue import StarList
    from psfdae.image.containers import Image
    from psfdae.model.wings import Wings

SPLIT = "held_out"
"""Kind of the split: all images of a star are in the training, or all are in the test."""

REFERENCE = "realisation"
"""Kind of the truth: the noise-free image of the star itself."""

ALL = "all"
"""Default name of a model of several exposures."""

ENOUGH_STARS = 20
"""Number of bright stars below which the limits on S/N and neighbours are relaxed."""

MIN_STARS_WITH_ERROR = 5
"""Number of bright stars below which no error of the model is stated."""

MIN_CROWDED_RATIO = 1.0
"""Ratio of bright stars with neighbours to those without from which neighbours are subtracted."""


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
    wings : Wings or None
        Light of stars beyond their stamps, if all stars were fitted together to find it.
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
    wings: Wings | None = None
    exposures: Sequence[Stars] = ()

    @classmethod
    def from_image(
        cls,
        image: Image | Sequence[Image],
        catalogue: StarList | None = None,
        **statements: Any,
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
        names = {field.name for field in fields(ImageStatements)}
        settings = {name: value for name, value in statements.items() if name not in names}
        stated = {name: value for name, value in statements.items() if name in names}
        # All images are opened with the same statements.
        source = ImageInput(images[0], catalogue=catalogue, **stated)
        settings_of_all = with_keywords(settings_model()(), IMAGE_GROUPS, settings)
        return cls.of(source.of_each(images), settings_of_all)

    @classmethod
    def of(cls, sources: Sequence[ImageInput], settings: Settings) -> Stars:
        """Choose the bright stars of images with their options; errors are those of `from_image`.

        A single image must have enough stars itself; of several, all together must.
        """
        _require_unique_names(sources)
        calibration = settings.calibration_stars
        opened = [
            source.open(settings.framing.stamp_px, calibration.margin_px).assuming()
            for source in sources
        ]
        _require_one_camera(opened)
        # Choose stars in stamps of the stated size, then in larger ones if these hold too little
        # of their light.
        relaxed, candidates = collect_enough(opened, settings)
        notes = []
        if (enlarged := enlarge_stamps(opened, candidates, settings)) is not None:
            settings, note = enlarged
            notes.append(note)
            size, calibration = settings.framing.stamp_px, settings.calibration_stars
            opened = [
                replace(observation, stamp_px=size, margin=calibration.margin_px)
                for observation in opened
            ]
            relaxed, candidates = collect_enough(opened, settings)
        # The user learns that stars below the stated S/N take part.
        if relaxed.calibration_stars.least_snr < calibration.least_snr:
            notes.append(
                f"few stars: those of S/N {relaxed.calibration_stars.least_snr:g} and above are "
                f"used, because fewer than 20 have S/N {calibration.least_snr:g}; --snr-min sets "
                "another limit"
            )
        # Bright stars of each image; those of a crowded image again without their neighbours.
        exposures = []
        for source, observation, measured in zip(sources, opened, candidates, strict=True):
            # Of several images, one may have few stars or none.
            if len(sources) == 1:
                min_stars = relaxed.calibration_stars.stars_min
                measured.require(observation.path, min_stars, observation.remarks)
            stars = cls.of_candidates(source, observation, measured, relaxed)
            if stars.is_crowded:
                from psfdae.model.neighbours import without_neighbours

                stars = without_neighbours(stars, calibration.neighbour_ratio)
            exposures.append(stars)
        stars = exposures[0] if len(exposures) == 1 else cls.joined(exposures)
        return replace(stars, notes=(*stars.notes, *notes, *few_stars_notes(stars)))

    @classmethod
    def joined(cls, exposures: Sequence[Stars]) -> Stars:
        """Join the stars of several images of one camera, chosen with the same settings.

        A star is held out if it is in its own image.

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
        return cls(
            first.source,
            observation,
            candidates,
            np.concatenate([image.held_out for image in exposures]),
            _with_noise(first.settings, candidates.bright, float(np.median(sky_photons))),
            [note for image in exposures for note in image.notes],
            exposures=exposures,
        )

    @classmethod
    def of_candidates(
        cls,
        source: ImageInput,
        observation: Observation,
        candidates: Candidates,
        settings: Settings,
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
        """
        bright = candidates.bright
        # A single star stands twice: the model is trained on it and tested on it.
        if len(bright) == 1:
            bright = bright.of(np.array([0, 0]))
            candidates = replace(candidates, bright=bright)
        # Median offset (x, y) between stars and list; a large one is refused unless accepted.
        offset_note = list_offset(
            observation.catalogue, (bright.centre - bright.listed)[:, ::-1], source.accept_offset
        )
        notes = [observation.summary(), *filter(None, [offset_note])]
        # Advice on stamps and saturation needs enough stars for a median.
        if len(bright) >= settings.calibration_stars.stars_min:
            notes += advice(candidates, observation, settings.framing.stamp_px)
        # Noise levels follow from the noise-equivalent area of the bright stars.
        if len(bright):
            sky = bright.sky_photons(observation.gain, settings.noise.background_photons)
            settings = _with_noise(settings, bright, sky)
        held_out = held_out_fields(star_grid(bright.position))
        return cls(source, observation, candidates, held_out, settings, tuple(notes))

    @property
    def images(self) -> Sequence[Stars]:
        """Stars of each image."""
        return self.exposures or (self,)

    @cached_property
    def split(self) -> Split:
        """Numbers of the training, validation and test images in `product`."""
        return split_stars(self.product, SPLIT, self.settings)

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
    def is_crowded(self) -> bool:
        """True if so many bright stars have neighbours that it pays to subtract these."""
        # Neighbours can only be fitted in an image with known positions, not in a cube of stamps.
        has_image = self.observation.shape is not None
        if not has_image or not np.isfinite(self.candidates.bright.position).all():
            return False
        crowded = np.count_nonzero(self.candidates.verdict == Verdict.CROWDED)
        # With fewer stars, there is no field to fit neighbours with.
        return len(self) >= MIN_STARS_WITH_ERROR and bool(
            crowded >= MIN_CROWDED_RATIO * max(len(self), ENOUGH_STARS)
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
        """Default name of a model of these stars."""
        return ALL if self.exposures else self.source.name

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


def collect_enough(
    opened: Sequence[Observation], settings: Settings
) -> tuple[Settings, list[Candidates]]:
    """Choose stars from the brightest down, until there are enough.

    Where S/N 100 gives fewer than `ENOUGH_STARS`, the least S/N is lowered until there are three
    times as many, or to 20; and to 10 if even that gives too few. Where these are still too few
    because bright stars have neighbours, brighter and brighter neighbours are accepted, whose light
    is subtracted later.

    Parameters
    ----------
    opened : sequence of Observation
        Images of one camera; their stars count together.
    settings : Settings

    Returns
    -------
    settings : Settings
        Settings with the least S/N, and the brightness of accepted neighbours.
    candidates : list of Candidates
        Measured stars of each observation.
    """
    calibration = settings.calibration_stars

    def collect_all(by_core: bool = False, **limits: float) -> tuple[Settings, list[Candidates]]:
        """Choose stars with other limits."""
        relaxed = calibration.model_copy(update=limits)
        # Only the stars of all images together must be enough, which is required later.
        image_limits = relaxed.model_copy(update={"stars_min": 0})
        return settings.model_copy(update={"calibration_stars": relaxed}), [
            collect(observation, image_limits, settings.framing, by_core=by_core)
            for observation in opened
        ]

    def bright_count(selection: tuple[Settings, list[Candidates]]) -> int:
        """Return the number of bright stars of a selection."""
        return sum(len(candidates.bright) for candidates in selection[1])

    selection = collect_all(snr_min=calibration.least_snr)
    if bright_count(selection) >= ENOUGH_STARS:
        return selection
    # Fainter stars: three times as many as needed while their S/N is above 20. Of two selections
    # with as many stars, the first one stays.
    for snr in calibration.lower_snr():
        selection = max(selection, collect_all(snr_min=snr), key=bright_count)
        if bright_count(selection) >= (ENOUGH_STARS if snr <= 20.0 else 3 * ENOUGH_STARS):
            return selection
    crowded = sum(np.count_nonzero(c.verdict == Verdict.CROWDED) for c in selection[1])
    # Brighter neighbours; their brightness is that of their cores, since the stamp of a faint star
    # has the light of a bright neighbour. The mean PSF is a median: of neighbours on all sides it
    # has little light.
    for ratio in (0.05, 0.1, 0.2, 0.4) if crowded >= ENOUGH_STARS else ():
        if bright_count(selection) < ENOUGH_STARS:
            limits = {"snr_min": calibration.least_snr, "neighbour_ratio": ratio}
            selection = max(selection, collect_all(True, **limits), key=bright_count)
    return selection


def enlarge_stamps(
    opened: Sequence[Observation], candidates: Sequence[Candidates], settings: Settings
) -> tuple[Settings, str] | None:
    """Adapt the settings to stars that are too large for their stamps, or hollow.

    Margin, search distance, isolation and the sub-pixel steps follow the side of the stamps.

    Parameters
    ----------
    opened : sequence of Observation
    candidates : sequence of Candidates
        Measured stars of each observation.
    settings : Settings

    Returns
    -------
    settings : Settings
    note : str
        Size of the stars and of the stamps.
        None in place of both, if the stamps hold the light of the stars and these have their
        brightest pixels in their middle.
    """
    calibration, framing = settings.calibration_stars, settings.framing
    # A stated size of stamps and a stated centring leave nothing to adapt.
    if not calibration.light_min and calibration.centring_px is not None:
        return None
    largest = _largest_size(opened, candidates)
    if largest is None:
        return None
    # The side of stamps that hold the stated part of the light, at least that of the settings.
    side = framing.stamp_px
    if calibration.light_min:
        side = max(side, largest.side(calibration.light_min))
    is_larger = side > framing.stamp_px
    if not (is_larger or largest.hollow):
        return None
    # Lengths of the choice of stars grow with their stamps, up to what the settings allow. Stars
    # without a sharp peak are centred on their light smoothed by their own width.
    scale, centring = side / framing.stamp_px, calibration.centring_px
    if centring is None:
        centring = largest.fwhm_px if largest.hollow or largest.fwhm_px > 5.0 else 0.0
    lengths = {
        "centring_px": float(f"{centring:.3g}"),
        "margin_px": min(round(calibration.margin_px * scale), 64),
        "search_px": min(round(calibration.search_px * scale), 16),
        "isolation_px": calibration.isolation_px * scale,
    }
    groups: dict[str, Any] = {
        "calibration_stars": calibration.model_copy(update=lengths),
        "framing": framing.model_copy(update={"stamp_px": side}),
    }
    if is_larger and (field := getattr(settings, "field", None)) is not None:
        # Steps of the field's splines grow with the finest structure of the stars, in powers of 2.
        # The settings are made for stars of a FWHM of 2.8 px, whose finest structure is 1.5 px.
        factor = 2.0 ** max(np.floor(np.log2(largest.sharpness_px / 1.5)), 0.0)
        steps_px = {
            "spacing_px": min(2.0, field.spacing_px * factor),
            "step_px": min(1.0, field.step_px * factor),
        }
        groups["field"] = field.model_copy(update=steps_px)
    note = f"stars: half of the light is within a diameter of {largest.fwhm_px:.3g} px"
    if is_larger:
        old_part, new_part = (100 * largest.light_within(s) for s in (framing.stamp_px, side))
        note += (
            f"; stamps of {side} px, which hold {new_part:.1f} % of it, are used instead of "
            f"{framing.stamp_px} px ({old_part:.0f} %); --stamp-px sets another size"
        )
    if largest.hollow:
        note += "; the brightest pixel is off the middle: stars are centred on their smoothed light"
    return settings.model_copy(update=groups), note


def _largest_size(
    opened: Sequence[Observation], candidates: Sequence[Candidates]
) -> SourceSize | None:
    """Return the size of stars in the image where it is largest.

    Parameters
    ----------
    opened : sequence of Observation
    candidates : sequence of Candidates
        Measured stars of each observation.

    Returns
    -------
    SourceSize or None
        None for cubes of stamps, or if no star is detected.
    """
    sizes = []
    for observation, measured in zip(opened, candidates, strict=True):
        if observation.shape is not None and observation.positions is not None:
            # Stars that are good in small stamps are not saturated; without such stars, all count.
            sky, position = observation.sky(), measured.bright.position
            if len(position) < MIN_STARS_WITH_ERROR:
                position = observation.positions
            sizes.append(measure_size(sky.flat, sky.bad, position))
    return max(filter(None, sizes), key=lambda size: size.fwhm_px, default=None)


def few_stars_notes(stars: Stars) -> list[str]:
    """Return notes on a model of few stars: none, or one line.

    Errors of a model rest on the stars held out, a fifth of all: with fewer than 20 stars they are
    rough, with fewer than 5 not stated.
    """
    count, held_out = len(stars), int(stars.held_out.sum())
    if count >= ENOUGH_STARS:
        return []
    if len(np.unique(stars.candidates.bright.row)) == 1:
        return ["one star: the PSF is this star, tested on itself; its error is not known"]
    training = count - held_out
    if count >= MIN_STARS_WITH_ERROR:
        sentence = f"{training} train the model, {held_out} test it; its errors are rough"
    else:
        sentence = f"the PSF is the mean of {training} stars, tested on {held_out}; its error is "
        sentence += "not known"
    return [f"few stars: {sentence}"]


def _require_unique_names(sources: Sequence[ImageInput]) -> None:
    """Refuse images whose models would have the same name.

    Raises
    ------
    ObservationError
        If two files have the same name without suffix.
    """
    paths: dict[str, Path] = {}
    for source in sources:
        if source.name in paths:
            problem = f"its model would have the name of that of {paths[source.name]}"
            raise ObservationError(source.path, f"{problem}, {source.name!r}")
        paths[source.name] = source.path


def _require_one_camera(opened: Sequence[Observation]) -> None:
    """Refuse several images with pixels of several sizes, or several cameras or filters.

    Parameters
    ----------
    opened : sequence of Observation
        A single one is accepted, a cube of stamps as well.

    Raises
    ------
    ObservationError
        Names the first difference from the first image.
    """
    first = opened[0]
    for observation in opened if len(opened) > 1 else ():
        if observation.shape is None:
            raise ObservationError(observation.path, "a cube of stamps; expected an image")
        # Telescope, camera and filter of the headers, then the pixel scale, which is named first.
        differences = [
            (key, repr(first_value), repr(value))
            for key, first_value, value in other_instruments(
                first.instrument, observation.instrument
            )
        ]
        scales = [o.pixel_scale_arcsec or ASSUMED_SCALE_ARCSEC for o in (first, observation)]
        if abs(scales[1] / scales[0] - 1.0) > SCALE_TOLERANCE:
            first_text, text = (f"{scale:.6g} arcsec" for scale in scales)
            differences.insert(0, ("the pixel scale", first_text, text))
        if differences:
            name, first_text, text = differences[0]
            problem = f"{name} is {text}, but that of {first.path} is {first_text}"
            raise ObservationError(observation.path, f"{problem}; a model is of one")


def _with_noise(settings: Settings, bright: BrightStars, sky_photons: float) -> Settings:
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
    noise = Noise(
        name=settings.noise.name,
        levels=[float(f"{level:.9g}") for level in reversed(levels)],
        kappa=kappa,
        background_photons=sky_photons,
    )
    return settings.model_copy(update={"noise": noise})
