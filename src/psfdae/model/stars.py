"""`Stars`: the bright stars of an image, some to learn from, the others to test a model."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from psfdae.bright_stars import BrightStars
from psfdae.files import Column, Product
from psfdae.image.observation import Observation, Source, list_offset
from psfdae.image.selection import Candidates, Verdict, advice, collect
from psfdae.image.training_images import single_psf, star_grid, training_columns
from psfdae.model.settings import IMAGE_GROUPS, Settings, settings_model, with_keywords
from psfdae.rng import stream
from psfdae.settings import Noise
from psfdae.splits import held_out_fields

if TYPE_CHECKING:
    from astropy.table import Table

    from psfdae.image.catalogue import StarList
    from psfdae.model.wings import Wings

SPLIT, REFERENCE = "held_out", "realisation"
"""Whole stars are held out, and a star itself is what is to be restored."""

MANY_CROWDED = 1.0
"""Bright stars with neighbours over those without, from which the neighbours are subtracted."""

DETECTED_SIGMA = 5.0
"""σ above the sky from which stars are searched by default."""


@dataclass(frozen=True, eq=False)
class Stars:
    """The bright stars of an image, and the images that methods learn from and are tested on.

    Attributes
    ----------
    source : Source
        The image, and what was stated about it.
    observation : Observation
        All of its stars.
    candidates : Candidates
        What was measured of each, and the bright ones.
    held_out : ndarray of bool
        Which of the bright ones no fit learns from.
    columns : dict of str to Column
        Arrays of the product "stars".
    settings : Settings
        With the noise levels that follow from the stars.
    notes : tuple of str
        What is known of the camera and the list, and advice on settings.
    wings : Wings or None
        Light of stars beyond their stamps, if all stars were fitted together to find it.

    Examples
    --------
    >>> stars = psfdae.Stars.from_image(image, catalogue=xy, **camera)
    >>> print(stars.summary())
    36 stars: 36 good
    29 to learn from, 7 held out
    >>> [str(part) for part in stars.table["part"][:2]]
    ['training', 'held out']
    """

    source: Source
    observation: Observation
    candidates: Candidates
    held_out: np.ndarray
    columns: dict[str, Column]
    settings: Settings
    notes: Sequence[str]
    wings: Wings | None = None

    @classmethod
    def from_image(
        cls,
        image: str | Path | np.ndarray,
        catalogue: StarList | None = None,
        *,
        detect: bool | float = False,
        extension: str | int | None = None,
        origin: int | None = None,
        mask: str | int | Path | np.ndarray | None = None,
        bad_bits: int | None = None,
        weight: str | int | Path | np.ndarray | None = None,
        variance: str | int | Path | np.ndarray | None = None,
        pixel_scale_arcsec: float | None = None,
        gain: float | None = None,
        read_noise: float | None = None,
        saturate: float | None = None,
        accept_offset: bool = False,
        **settings: object,
    ) -> Stars:
        """Choose the bright stars of an image and make training data of them.

        Parameters
        ----------
        image : path-like, or array of shape (h, w) or (n, s, s)
            FITS image, or cube of stamps.
        catalogue : path-like, table, or array of shape (n, 2), optional
            Star list: a file, a table with its columns, or positions (x, y), 0-based.
        detect : bool or float
            Search for stars instead, this many σ above the sky (True: 5).
        extension : str or int, optional
            With the stars, if the file has several.
        origin : 0 or 1, optional
            Index of the first pixel's centre in the list, where its columns do not say it.
        mask, weight, variance : extension, path or array as large as the image, optional
            Bad pixels are other than 0, or those with one of `bad_bits`; 1/σ² but for a factor;
            σ² of the pixels.
        bad_bits : int, optional
        pixel_scale_arcsec, gain, read_noise, saturate : float, optional
            Arcseconds per pixel, electrons per count, electrons, counts; instead of the header's.
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
        source = Source(
            image if isinstance(image, np.ndarray) else Path(image),
            catalogue,
            threshold,
            extension,
            origin=origin,
            mask=mask,
            bad_bits=bad_bits,
            weight=weight,
            variance=variance,
            pixel_scale_arcsec=pixel_scale_arcsec,
            gain=gain,
            read_noise=read_noise,
            saturate=saturate,
            accept_offset=accept_offset,
        )
        return cls.of(source, with_keywords(settings_model()(), IMAGE_GROUPS, settings))

    @classmethod
    def of(cls, source: Source, settings: Settings) -> Stars:
        """As `from_image`, of an image with what is stated about it, and settings."""
        margin = settings.calibration_stars.margin_px
        observation = source.open(settings.framing.stamp_px, margin).assuming()
        stars = cls.chosen(source, observation, settings)
        if not stars.many_crowded:
            return stars
        from psfdae.model.neighbours import without_neighbours

        return without_neighbours(stars)

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
        framing, wanted = settings.framing, settings.calibration_stars
        found = collect(observation, wanted, framing, isolation_px)
        bright = found.bright
        off = list_offset(
            observation.catalogue, (bright.centre - bright.listed)[:, ::-1], source.accept_offset
        )
        notes = [observation.said(), *filter(None, [off])]
        notes += advice(found, observation, framing.stamp_px)
        grid = star_grid(bright.position)
        held_out = held_out_fields(grid)
        rng = stream(settings.seed, "own stars")
        columns = training_columns(
            bright, grid, held_out, wanted.bins, framing, settings.parts, rng
        )
        sky = bright.sky_photons(observation.gain, settings.noise.background_photons)
        settings = settings.model_copy(update={"noise": _noise(settings, bright, sky)})
        return cls(source, observation, found, held_out, columns, settings, tuple(notes))

    @property
    def many_crowded(self) -> bool:
        """So many bright stars of an image have neighbours that it pays to subtract these."""
        if self.observation.shape is None or not np.isfinite(self.candidates.bright.position).all():
            return False
        crowded = np.count_nonzero(self.candidates.verdict == Verdict.CROWDED)
        return bool(crowded >= MANY_CROWDED * len(self))

    def __repr__(self) -> str:
        return f"Stars({str(self.observation.path)!r}, {self.summary()})"

    @property
    def name(self) -> str:
        """What a model of these stars is called by default."""
        return self.observation.path.name.split(".")[0] or "model"

    def with_settings(self, settings: Settings) -> Stars:
        """These stars with other settings of methods."""
        return replace(self, settings=settings)

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
    def table(self) -> Table:
        """Every star of the image: place, S/N, why it is not used, and its part."""
        return self.candidates.table(self.held_out)

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
        """What the product "stars" says of its stars."""
        observation = self.observation
        kept = self.settings.model_dump(include={"seed", "calibration_stars", "framing", "parts"})
        scale = {"pixel_scale_arcsec": observation.pixel_scale_arcsec}
        size = {"image_px": [*reversed(observation.shape)]} if observation.shape else {}
        taken_with = {"instrument": observation.instrument} if observation.instrument else {}
        assumed = {"assumed": True} if observation.scale_assumed else {}
        said = {
            **kept,
            "source": "stars",
            "image": observation.path.name,
            "image_sha256": observation.sha256(),
            **size,
            **taken_with,
            "telescope": {**scale, **assumed},
        }
        plain: dict[str, Any] = json.loads(json.dumps(said))
        return plain


def _noise(settings: Settings, bright: BrightStars, background: float) -> Noise:
    """Settings of the noise, with the levels of the S/N asked for, of noise-free stars."""
    area, kappa = float(np.median(bright.area())), settings.noise.kappa
    degraded = settings.calibration_stars.degraded()
    levels = [1.0 / (snr * np.sqrt(area) * kappa) for snr in degraded]
    return Noise(
        name=settings.noise.name,
        levels=[float(f"{level:.9g}") for level in reversed(levels)],
        kappa=kappa,
        background_photons=background,
    )
