"""`Stars`: the bright stars of images, some to learn from, the others to test a model."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from psfdae.bright_stars import BrightStars
from psfdae.files import Column, Product
from psfdae.image.containers import as_images
from psfdae.image.errors import ObservationError
from psfdae.image.observation import (
    ASSUMED_SCALE,
    Observation,
    Source,
    list_offset,
    other_instruments,
)
from psfdae.image.selection import Candidates, Verdict, advice, collect
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
    from astropy.units import Quantity

    from psfdae.image.catalogue import StarList
    from psfdae.image.containers import Image
    from psfdae.model.wings import Wings

SPLIT, REFERENCE = "held_out", "realisation"
"""Whole stars are held out, and a star itself is what is to be restored."""

MANY_CROWDED = 1.0
"""Bright stars with neighbours over those without, from which the neighbours are subtracted."""

ALL = "all"
"""Name of a model of several exposures by default."""

ENOUGH_STARS, FEW_STARS, FAINT_SNR = 20, 5, 20.0
"""Stars for which S/N 100 is asked; fewest of which an error is stated; least S/N if there are
some."""

DETECTED_SIGMA = 5.0
"""σ above the sky from which stars are searched by default."""


@dataclass(frozen=True, eq=False)
class Stars:
    """The bright stars of an image, and the images that methods learn from and are tested on.

    Those of several exposures are one set; each exposure keeps its own in `exposures`.

    Attributes
    ----------
    source : Source
        The image, and what was stated about it; of several, the first one.
    observation : Observation
        All of its stars; of several images that of the first, under a name for all.
    candidates : Candidates
        What was measured of each, and the bright ones.
    held_out : ndarray of bool
        Which of the bright ones no fit learns from.
    settings : Settings
        With the noise levels that follow from the stars.
    notes : tuple of str
        What is known of the camera and the list, and advice on settings.
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

    source: Source
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
        *,
        detect: bool | float = False,
        extension: str | int | None = None,
        origin: int | None = None,
        mask: str | int | Path | np.ndarray | None = None,
        bad_bits: int | None = None,
        weight: str | int | Path | np.ndarray | None = None,
        variance: str | int | Path | np.ndarray | None = None,
        error: str | int | Path | np.ndarray | None = None,
        pixel_scale_arcsec: float | Quantity | None = None,
        gain: float | Quantity | None = None,
        read_noise: float | Quantity | None = None,
        saturate: float | Quantity | None = None,
        colour_column: str | None = None,
        accept_offset: bool = False,
        **settings: object,
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
        detect : bool or float
            Search for stars instead, this many σ above the sky (True: 5).
        extension : str or int, optional
            With the stars, if the file has several.
        origin : 0 or 1, optional
            Index of the first pixel's centre in the list, where its columns do not say it.
        mask, weight, variance, error : extension, path or array as large as the image, optional
            Bad pixels are other than 0, or those with one of `bad_bits`; 1/σ² but for a factor;
            σ² of the pixels; σ. Of a file with extensions DQ and ERR, these by default; "none"
            takes neither.
        bad_bits : int, optional
        pixel_scale_arcsec, gain, read_noise, saturate : float or Quantity, optional
            Arcseconds per pixel, electrons per count, electrons, counts; instead of the header's.
        colour_column : str, optional
            Of the star list, such as g − r; the PSF may change with it.
        accept_offset : bool
            Take a star list that is off by more than a pixel.
        **settings
            Keys of `CalibrationStars`, `Stamp`, `Parts`, or `seed`; such as `snr_min=50` or
            `stamp_px=24`.

        Raises
        ------
        Error
            If the image or the list cannot be used, or too few stars are bright enough.
        """
        threshold = DETECTED_SIGMA if detect is True else detect or None
        images = as_images(image)
        if not images:
            raise ObservationError("image", "no image, expected at least one")
        source = Source(
            images[0],
            catalogue,
            threshold,
            extension,
            origin=origin,
            mask=mask,
            bad_bits=bad_bits,
            weight=weight,
            variance=variance,
            error=error,
            pixel_scale_arcsec=pixel_scale_arcsec,
            gain=gain,
            read_noise=read_noise,
            saturate=saturate,
            colour_column=colour_column,
            accept_offset=accept_offset,
        )
        settings_of_all = with_keywords(settings_model()(), IMAGE_GROUPS, settings)
        return cls.of(source.of_each(images), settings_of_all)

    @classmethod
    def of(cls, sources: Sequence[Source], settings: Settings) -> Stars:
        """Choose the stars of images with their options; errors are those of `from_image`."""
        _require_own_names(sources)
        margin = settings.calibration_stars.margin_px
        opened = [source.open(settings.framing.stamp_px, margin).assuming() for source in sources]
        _require_one_camera(opened)
        # The stars, first in stamps of the size of the settings, then in wider ones if these hold
        # too little of their light.
        chosen, candidates = enough_stars(opened, settings)
        notes = []
        if (sized := fitting_stamps(opened, candidates, settings)) is not None:
            settings, note = sized
            notes.append(note)
            size, margin = settings.framing.stamp_px, settings.calibration_stars.margin_px
            opened = [replace(one, stamp_px=size, margin=margin) for one in opened]
            chosen, candidates = enough_stars(opened, settings)
        if chosen.calibration_stars.least_snr < settings.calibration_stars.least_snr:
            notes.append(
                f"few stars: those of S/N {chosen.calibration_stars.least_snr:g} and above are "
                "learnt from, as fewer than 20 have S/N "
                f"{settings.calibration_stars.least_snr:g}; --snr-min takes others"
            )
        exposures = []
        for source, observation, found in zip(sources, opened, candidates, strict=True):
            if len(sources) == 1:
                least = chosen.calibration_stars.stars_min
                found.require(observation.path, least, observation.remarks)
            stars = cls.of_candidates(source, observation, found, chosen)
            if stars.many_crowded:
                from psfdae.model.neighbours import without_neighbours

                asked = settings.calibration_stars.neighbour_ratio
                stars = without_neighbours(stars, asked)
            exposures.append(stars)
        found_stars = exposures[0] if len(exposures) == 1 else cls.joined(exposures)
        notes += few_stars(found_stars)
        return replace(found_stars, notes=(*found_stars.notes, *notes))

    @classmethod
    def joined(cls, exposures: Sequence[Stars]) -> Stars:
        """The stars of several images of one camera, chosen with the same settings, as one set.

        Each is held out or not as in its own image. CalibrationStarsError: all are too few.
        """
        first = exposures[0]
        seen = [part.observation for part in exposures]
        observation = replace(
            seen[0],
            path=Path(f"{seen[0].path} and {len(seen) - 1} more"),
            shape=tuple(map(max, zip(*(one.shape or () for one in seen), strict=True))),
            header_cards=[card for one in seen for card in one.header_cards],
        )
        found = Candidates.joined([part.candidates for part in exposures])
        found.require(observation.path, first.settings.calibration_stars.stars_min)
        sky = np.repeat(
            [part.settings.noise.background_photons for part in exposures],
            [len(part) for part in exposures],
        )
        return cls(
            first.source,
            observation,
            found,
            np.concatenate([part.held_out for part in exposures]),
            _with_noise(first.settings, found.bright, float(np.median(sky))),
            [note for part in exposures for note in part.notes],
            exposures=exposures,
        )

    @classmethod
    def chosen(
        cls,
        source: Source,
        observation: Observation,
        settings: Settings,
        isolation_px: float | None = None,
    ) -> Stars:
        """The bright stars of an observation; no neighbour is nearer than `isolation_px`.

        By default, the settings say how near one may be.
        """
        wanted = settings.calibration_stars
        found = collect(observation, wanted, settings.framing, isolation_px)
        return cls.of_candidates(source, observation, found, settings)

    @classmethod
    def of_candidates(
        cls, source: Source, observation: Observation, found: Candidates, settings: Settings
    ) -> Stars:
        """The bright stars among those of an observation that were measured."""
        bright = found.bright
        # A star that is alone stands twice: the model is learnt from it and tested on it.
        if len(bright) == 1:
            bright = bright.of(np.array([0, 0]))
            found = replace(found, bright=bright)
        off = list_offset(
            observation.catalogue, (bright.centre - bright.listed)[:, ::-1], source.accept_offset
        )
        notes = [observation.said(), *filter(None, [off])]
        if len(bright) >= settings.calibration_stars.stars_min:
            notes += advice(found, observation, settings.framing.stamp_px)
        if len(bright):
            sky = bright.sky_photons(observation.gain, settings.noise.background_photons)
            settings = _with_noise(settings, bright, sky)
        held_out = held_out_fields(star_grid(bright.position))
        return cls(source, observation, found, held_out, settings, tuple(notes))

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
        settings, bright = self.settings, self.candidates.bright
        grid = np.concatenate([star_grid(s.candidates.bright.position) for s in self.images])
        rest = settings.calibration_stars.bins, settings.framing, settings.parts
        rng = stream(settings.seed, "own stars")
        centring = settings.calibration_stars.centring_px or 0.0
        return training_columns(bright, grid, self.held_out, *rest, rng, centring)

    @property
    def many_crowded(self) -> bool:
        """So many bright stars of an image have neighbours that it pays to subtract these."""
        if self.observation.shape is None or not np.isfinite(self.candidates.bright.position).all():
            return False
        if len(self) < FEW_STARS:
            return False
        crowded = np.count_nonzero(self.candidates.verdict == Verdict.CROWDED)
        return bool(crowded >= MANY_CROWDED * max(len(self), ENOUGH_STARS))

    def __repr__(self) -> str:
        held_count = int(self.held_out.sum())
        return (
            f"Stars({str(self.observation.path)!r}, {len(self)} stars "
            f"({len(self) - held_count} to learn from, {held_count} held out) "
            f"of {len(self.candidates.verdict)})"
        )

    def _repr_html_(self) -> str:
        """Counts of the stars, for a notebook."""
        held_count, images = int(self.held_out.sum()), len(self.images)
        learnt_count = len(self) - held_count
        rows = [
            ["image", escape(self.observation.path.name)],
            ["stars", f"{len(self)}: {learnt_count} to learn from, {held_count} held out"],
            [f"of {len(self.candidates.verdict)}", self.candidates.count()],
            ["stamps", f"{self.settings.framing.stamp_px} px"],
        ]
        rows += [["images", str(images)]] if images > 1 else []
        return html_table(["Stars", ""], rows)

    @property
    def name(self) -> str:
        """Default name of a model of these stars."""
        return ALL if self.exposures else self.source.name

    def with_settings(self, settings: Settings) -> Stars:
        """These stars with other settings of methods."""
        stars = replace(self, settings=settings)
        vars(stars)["columns"] = self.columns  # no setting of a method changes them
        return stars

    def __len__(self) -> int:
        return len(self.held_out)

    def summary(self) -> str:
        """How many stars there are of every verdict, and how many are held out."""
        held = int(self.held_out.sum())
        return (
            f"{len(self.candidates.verdict)} stars: {self.candidates.count()}\n"
            f"{len(self) - held} to learn from, {held} held out"
        )

    @property
    def table(self) -> QTable:
        """Every star: place, S/N, why it is not used, its part, and further columns of its list.

        `psfdae.image.tables.star_table` says which names and units the columns have.
        """
        from astropy.table import vstack

        columns = self.candidates.columns(self.held_out)
        if self.exposures:
            counts = [one.observation.count for one in self.images]
            names = [one.observation.path.name for one in self.images]
            columns = {"image": np.repeat(names, counts), **columns}
        of_lists = [one.observation.list_columns for one in self.images]
        known = [of_list for of_list in of_lists if of_list is not None]
        of_list = vstack(known) if len(known) == len(of_lists) else None
        return star_table(columns, self.observation.unit, of_list)

    @cached_property
    def product(self) -> Product:
        """The images, and what is known of their stars, as a product "stars" in memory."""
        arrays = {name: column.values for name, column in self.columns.items()}
        return Product(self.observation.path, self.described(), arrays)

    @property
    def mean_psf(self) -> np.ndarray:
        """The stack of all training stars, (s, s), its centre at index (s//2, s//2)."""
        return single_psf(self.candidates.bright, self.held_out)

    def described(self) -> dict[str, Any]:
        """Return the description of the product "stars"."""
        observation = self.observation
        kept = self.settings.model_dump(include={"seed", "calibration_stars", "framing", "parts"})
        scale = {"pixel_scale_arcsec": observation.pixel_scale_arcsec}
        size = {"image_px": [*reversed(observation.shape)]} if observation.shape else {}
        taken_with = {"instrument": observation.instrument} if observation.instrument else {}
        colours = {"colour_column": observation.colour_column} if observation.colour_column else {}
        assumed = {"assumed": True} if observation.scale_assumed else {}
        said = {
            **kept,
            "source": "stars",
            "image": ", ".join(part.observation.path.name for part in self.images),
            "image_sha256": ", ".join(part.observation.sha256() for part in self.images),
            **size,
            **taken_with,
            **colours,
            "telescope": {**scale, **assumed},
        }
        plain: dict[str, Any] = json.loads(json.dumps(said))
        return plain


def enough_stars(
    opened: Sequence[Observation], settings: Settings
) -> tuple[Settings, list[Candidates]]:
    """Choose stars from the brightest down, until there are enough.

    Where S/N 100 gives fewer than `ENOUGH_STARS`, the least S/N is lowered until there are three
    times as many, or to 20; and to 10 if even that gives too few. Where these are still too few
    because bright stars have neighbours, brighter and brighter neighbours are accepted, whose light
    is subtracted later.

    Returns
    -------
    settings : Settings
        With the least S/N, and the brightness of neighbours.
    candidates : list of Candidates
        Of each observation.
    """
    asked = settings.calibration_stars

    def with_limits(by_core: bool = False, **limits: float) -> tuple[Settings, list[Candidates]]:
        stars = asked.model_copy(update=limits)
        # Only the stars of all images together must be enough, which is required later.
        of_each = stars.model_copy(update={"stars_min": 0})
        found = [collect(one, of_each, settings.framing, by_core=by_core) for one in opened]
        return settings.model_copy(update={"calibration_stars": stars}), found

    best = with_limits(snr_min=asked.least_snr)
    count = sum(len(one.bright) for one in best[1])
    if count >= ENOUGH_STARS:
        return best
    for snr in asked.lower_snr():
        chosen, found = with_limits(snr_min=snr)
        if (more := sum(len(one.bright) for one in found)) > count:
            best, count = (chosen, found), more
        if count >= (ENOUGH_STARS if snr <= FAINT_SNR else 3 * ENOUGH_STARS):
            break
    crowded = sum(np.count_nonzero(one.verdict == Verdict.CROWDED) for one in best[1])
    if count >= ENOUGH_STARS or crowded < ENOUGH_STARS:
        return best
    for ratio in (0.05, 0.1, 0.2, 0.4):
        # The median of stars with neighbours here and there has little of their light.
        chosen, found = with_limits(True, snr_min=asked.least_snr, neighbour_ratio=ratio)
        if (more := sum(len(one.bright) for one in found)) > count:
            best, count = (chosen, found), more
        if count >= ENOUGH_STARS:
            break
    return best


def fitting_stamps(
    opened: Sequence[Observation], candidates: Sequence[Candidates], settings: Settings
) -> tuple[Settings, str] | None:
    """Settings for stars that are too large, or too hollow, for those that there are.

    Margin, search distance, isolation and the sub-pixel steps follow the side of the stamps; a note
    says so. None if the stamps hold the light of the stars, and these have their brightest pixels
    in their middle.
    """
    asked, framing = settings.calibration_stars, settings.framing
    if not asked.light_min and asked.centring_px is not None:
        return None
    sizes = [_size(*both) for both in zip(opened, candidates, strict=True)]
    known = [size for size in sizes if size is not None]
    if not known:
        return None
    largest = max(known, key=lambda size: size.fwhm_px)
    side = framing.stamp_px
    if asked.light_min:
        side = max(side, largest.side(asked.light_min))
    wide = side > framing.stamp_px
    if not (wide or largest.hollow):
        return None
    # Lengths of the choice of stars grow with their stamps.
    scale, centring = side / framing.stamp_px, asked.centring_px
    if centring is None:
        centring = largest.fwhm_px if largest.hollow or largest.fwhm_px > 5.0 else 0.0
    stars = {
        "centring_px": float(f"{centring:.3g}"),
        "margin_px": min(round(asked.margin_px * scale), 64),
        "search_px": min(round(asked.search_px * scale), 16),
        "isolation_px": asked.isolation_px * scale,
    }
    changed: dict[str, Any] = {
        "calibration_stars": asked.model_copy(update=stars),
        "framing": framing.model_copy(update={"stamp_px": side}),
    }
    if wide and (field := getattr(settings, "field", None)) is not None:
        # Steps of smooth stars are as much wider as their finest structure, in powers of 2; that
        # of stars of a FWHM of 2.8 px, for which the settings are made, is 1.5 px.
        wider = 2.0 ** max(np.floor(np.log2(largest.sharpness_px / 1.5)), 0.0)
        steps = (
            ("spacing_px", min(2.0, field.spacing_px * wider)),
            ("step_px", min(1.0, field.step_px * wider)),
        )
        changed["field"] = field.model_copy(update=dict(steps))
    note = f"stars: half of the light is within a diameter of {largest.fwhm_px:.3g} px"
    if wide:
        now, then = (100 * largest.light_within(s) for s in (framing.stamp_px, side))
        note += (
            f"; stamps of {side} px, which hold {then:.1f} % of it, are used instead of "
            f"{framing.stamp_px} px ({now:.0f} %); --stamp-px takes others"
        )
    if largest.hollow:
        note += "; the brightest pixel is off the middle: stars are centred on their smoothed light"
    return settings.model_copy(update=changed), note


def _size(observation: Observation, found: Candidates) -> SourceSize | None:
    """Size of the stars of an image; None of a cube of stamps, or if no star is seen."""
    if observation.shape is None or observation.positions is None:
        return None
    sky, good = observation.sky(), found.bright.position
    # Stars that are good in small stamps are not saturated; without some, all count.
    place = good if len(good) >= FEW_STARS else observation.positions
    return measure_size(sky.flat, sky.bad, place)


def few_stars(stars: Stars) -> list[str]:
    """Return notes on a model of few stars."""
    count, held = len(stars), int(stars.held_out.sum())
    if count >= ENOUGH_STARS:
        return []
    if len(np.unique(stars.candidates.bright.row)) == 1:
        return ["one star: the PSF is this star, tested on itself; its error is not known"]
    if count < FEW_STARS:
        return [
            f"few stars: the PSF is the mean of {count - held} stars, tested on {held}; its error "
            "is not known"
        ]
    return [
        f"few stars: {count - held} are learnt from, {held} test the model; its errors are rough"
    ]


def _require_own_names(sources: Sequence[Source]) -> None:
    """Refuse images whose models would have the same name."""
    known: dict[str, Path] = {}
    for source in sources:
        if source.name in known:
            problem = f"its model would have the name of that of {known[source.name]}"
            raise ObservationError(source.path, f"{problem}, {source.name!r}")
        known[source.name] = source.path


def _require_one_camera(opened: Sequence[Observation]) -> None:
    """Refuse several images with pixels of several sizes, or several cameras or filters."""
    first = opened[0]
    for other in opened if len(opened) > 1 else ():
        if other.shape is None:
            raise ObservationError(other.path, "a cube of stamps; expected an image")
        scales = [o.pixel_scale_arcsec or ASSUMED_SCALE for o in (first, other)]
        unlike = []
        if abs(scales[1] / scales[0] - 1.0) > SCALE_TOLERANCE:
            unlike = [("the pixel scale", *(f"{scale:.6g} arcsec" for scale in scales))]
        unlike += [
            (key, repr(known), repr(seen))
            for key, known, seen in other_instruments(first.instrument, other.instrument)
        ]
        if unlike:
            what, one, two = unlike[0]
            problem = f"{what} is {two}, but that of {first.path} is {one}; a model is of one"
            raise ObservationError(other.path, problem)


def _with_noise(settings: Settings, bright: BrightStars, background: float) -> Settings:
    """Settings with the noise levels of the S/N asked for, of noise-free stars."""
    area, kappa = float(np.median(bright.area())), settings.noise.kappa
    degraded = settings.calibration_stars.degraded()
    levels = [1.0 / (snr * np.sqrt(area) * kappa) for snr in degraded]
    noise = Noise(
        name=settings.noise.name,
        levels=[float(f"{level:.9g}") for level in reversed(levels)],
        kappa=kappa,
        background_photons=background,
    )
    return settings.model_copy(update={"noise": noise})
