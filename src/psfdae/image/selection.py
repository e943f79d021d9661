"""Choice of the stars of an image that are good enough to train a PSF model on.

Input: an observation (`observation`), with stamps somewhat wider than the method's. Output:
`Candidates`, with a verdict on each star and the stamps of the good ones.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from enum import StrEnum
from itertools import accumulate
from pathlib import Path

import numpy as np

from psfdae.base.errors import Error, keyword
from psfdae.base.progress import task
from psfdae.base.settings import CalibrationStars, Stamp
from psfdae.image.image import Image
from psfdae.image.interpolation import fill_bad_stamps
from psfdae.image.observation import Observation
from psfdae.image.sky import sky_around
from psfdae.image.stamps import Stamps, StarFlag, cut, cut_image
from psfdae.image.star_criteria import (
    brightest_pixels,
    find_crowded,
    find_pile_up,
    misfit,
    sharper_than_stars,
    stamp_snr,
    wider_than_stars,
)
from psfdae.stars.bright_stars import BrightStars
from psfdae.stars.moments import FWHM_OF_SIGMA, find_centroids, shift_stamps


class CalibrationStarsError(Error, ValueError):
    """An image has too few training stars, or its settings contradict each other."""


class Verdict(StrEnum):
    """Why a star is not used; the first reason that applies."""

    GOOD = "good"
    NO_POSITION = "no position"
    INCOMPLETE = "incomplete"  # pixels off the image, or over a fifth of the light in bad pixels
    SATURATED = "saturated"
    BLENDED = "blended"  # by the star list
    FAINT = "faint"
    OFF_CENTRE = "off centre"
    CROWDED = "crowded"
    SHARP = "sharp"  # far narrower than the other stars: a cosmic ray, a hot pixel
    EXTENDED = "extended"  # far wider than the stars around it: a galaxy, a blend
    MISFIT = "misfit"  # unlike its neighbours: a blend, a galaxy, a cosmic ray


@dataclass(frozen=True)
class Candidates:
    """Measurements of all n stars of an observation, and the bright ones among them.

    Attributes
    ----------
    id : ndarray, shape (n,)
        Identifiers of the stars.
    position : ndarray, shape (n, 2)
        (x, y) in the image, NaN where unknown.
    snr : ndarray, shape (n,)
        S/N by a filter matched to the star.
    noise, sky : ndarray, shape (n,)
        RMS and level of the sky in counts per pixel.
    brightest : ndarray, shape (n,)
        Brightest pixel of the star in counts, sky included; -inf for a star off the centre.
    highest : ndarray, shape (n,)
        Highest pixel of the stamp in counts; -inf if none can be used.
    verdict : ndarray of str, shape (n,)
        A `Verdict` for every star.
    bright : BrightStars
        The stars whose verdict is good.
    """

    id: np.ndarray
    position: np.ndarray
    snr: np.ndarray
    noise: np.ndarray
    sky: np.ndarray
    brightest: np.ndarray
    highest: np.ndarray
    verdict: np.ndarray
    bright: BrightStars

    def __repr__(self) -> str:
        return f"Candidates({self.count()})"

    @classmethod
    def concatenate(cls, several: Sequence[Candidates]) -> Candidates:
        """Join the candidates of several observations, one after the other.

        Rows of bright stars are shifted to rows of the joined list.
        """
        # Rows of bright stars are rows of the joined list.
        starts = accumulate((len(candidates.verdict) for candidates in several), initial=0)
        bright = [stars.bright for stars in several]
        bright = [replace(b, row=b.row + n) for b, n in zip(bright, starts, strict=False)]
        names = [field.name for field in fields(cls) if field.name != "bright"]
        columns = {name: np.concatenate([getattr(c, name) for c in several]) for name in names}
        return cls(**columns, bright=BrightStars.join(bright))

    def require(self, path: Path, stars_min: int, remarks: Sequence[str] = ()) -> None:
        """Raise CalibrationStarsError if the image has fewer good stars.

        `remarks` are warnings about the mask or the header, which may give the reason.
        """
        if len(self.bright) < stars_min:
            problem = (
                f"{path}: {len(self.bright)} stars are good enough for training, "
                f"{stars_min} are needed (of {len(self.verdict)}: {self.count()}); "
                f"{keyword('stars_min')} takes fewer, {keyword('snr_min')} fainter ones"
            )
            raise CalibrationStarsError("; ".join([problem, *remarks]))

    def count(self) -> str:
        """Return the number of stars of every verdict, in words."""
        counts = Counter(self.verdict.tolist())
        return ", ".join(f"{counts[name]} {name}" for name in map(str, Verdict) if counts[name])

    def columns(self, held_out: np.ndarray) -> dict[str, np.ndarray]:
        """Return columns of all stars of the list, with the part of the good ones, (n,) each.

        Parameters
        ----------
        held_out : ndarray of bool, shape (k,)
            True for bright stars that are kept out of all fits.
        """
        # Stars that are not good are in no part.
        part = np.full(len(self.verdict), "", dtype="<U8")
        part[self.bright.row[held_out]] = "held out"
        part[self.bright.row[~held_out]] = "training"
        x, y = self.position.T
        measurements = {"id": self.id, "x": x, "y": y, "snr": self.snr}
        return measurements | {"verdict": self.verdict, "part": part}


def collect(
    observation: Observation,
    settings: CalibrationStars,
    framing: Stamp,
    isolation_px: float | None = None,
    by_core: bool = False,
) -> Candidates:
    """Measure all stars and choose those that are good enough for training.

    Parameters
    ----------
    observation : Observation
        The stars; stamps need a margin, and only stamps of bright stars are kept in memory.
    settings : CalibrationStars
        Limits of the criteria.
    framing : Stamp
        Side and jitter of the stamps of the method.
    isolation_px : float, optional
        Minimum distance of neighbours in px, by default from the settings.
    by_core : bool
        Measure the brightness of neighbours in 3 × 3 px instead of their stamps: the whole
        stamp of a faint star includes light of a bright neighbour.

    Raises
    ------
    CalibrationStarsError
        If there are fewer good stars than `calibration_stars.stars_min`.
    """
    if isinstance(observation, Image):
        observation.check_list()
    # Measure 2048 stars at a time; stamps of the good ones are kept.
    parts = []
    with task("stars of the image", observation.count) as advance:
        for stamps in observation.chunks(2048):
            parts.append(measure_stamps(stamps, settings, framing, observation))
            advance(len(stamps.data))
    star_columns = {name: np.concatenate([part[name] for part, _ in parts]) for name in parts[0][0]}
    bright = BrightStars.join([stars for _, stars in parts])
    # Stars that meet all criteria of single stars, with their rows in the list.
    verdict, position = star_columns["verdict"], star_columns["position"]
    bright = replace(bright, row=np.flatnonzero(verdict == Verdict.GOOD))
    # Saturation that the pixels show.
    light, core = star_columns["snr"] * star_columns["noise"], star_columns.pop("core")
    if observation.saturate is None:
        full = find_pile_up(star_columns["brightest"], star_columns["sky"], light)
        verdict[(star_columns["highest"] >= full) & (verdict == Verdict.GOOD)] = Verdict.SATURATED
    # Neighbours; a star that is listed twice is not a neighbour of itself.
    is_repeated = observation.find_repeated_stars()[:, None]
    xy = np.where(is_repeated, np.nan, position)
    isolation_px = settings.isolation_px if isolation_px is None else isolation_px
    is_crowded = find_crowded(
        xy, core if by_core else light, isolation_px, settings.neighbour_ratio
    )
    verdict[is_crowded & (verdict == Verdict.GOOD)] = Verdict.CROWDED
    # A missing position overrides all other reasons; a source without light is a misfit.
    verdict[observation.lacks_position()] = Verdict.NO_POSITION
    verdict[bright.row[bright.flux <= 0]] = Verdict.MISFIT
    centring = settings.centring_px or 0.0
    bright = _measure_centres(bright.select(verdict[bright.row] == Verdict.GOOD), centring)

    def reject(stars: BrightStars, is_rejected: np.ndarray, reason: Verdict) -> BrightStars:
        """Return the accepted stars, and record the reason for the others."""
        verdict[stars.row[is_rejected]] = reason
        return stars.select(~is_rejected)

    # Sources off the locus of the stars, whose noise-equivalent areas are about the same.
    bright = reject(bright, sharper_than_stars(bright.area()), Verdict.SHARP)
    # Bad pixels of the others get the values of stars nearby, before sizes are compared again.
    bright, missing = fill_bad_pixels(bright, framing.stamp_px, settings.search_px, centring)
    # A star with more than a fifth of its light in bad pixels is not used for training.
    bright = reject(bright, missing > 0.2, Verdict.INCOMPLETE)
    # Galaxies and blends, which are wider than the stars around them. The error of ln A, with
    # A = (F/(σ S/N))², is 2 σ √P/F by the noise of the P pixels of a stamp.
    size_error = 2.0 * framing.stamp_px * bright.noise / bright.flux
    is_extended = wider_than_stars(bright.area(), bright.position, size_error)
    bright = reject(bright, is_extended, Verdict.EXTENDED)
    # Stars that are unlike their neighbours.
    aligned_stamps = cut(bright.align(), framing.stamp_px)
    score = misfit(aligned_stamps, bright.position, bright.noise / bright.flux)
    bright = reject(bright, ~(score <= settings.misfit), Verdict.MISFIT)
    candidates = Candidates(**star_columns, bright=bright)
    candidates.require(observation.path, settings.stars_min, observation.remarks)
    return candidates


def measure_stamps(
    stamps: Stamps, settings: CalibrationStars, framing: Stamp, observation: Observation
) -> tuple[dict[str, np.ndarray], BrightStars]:
    """Return columns of `Candidates` and the good stars, without centres and rows.

    Parameters
    ----------
    stamps : Stamps
        Some stars of an image, or of a cube of stamps.
    settings : CalibrationStars
        Limits of the criteria.
    framing : Stamp
        Side and jitter of the stamps of the method.
    observation : Observation
        Image or cube of the stamps.
    """
    # Sky around each star, unless it was measured when the stamps were cut, and the star above it.
    # The noise is from the noise map if the observation has one.
    side, level, noise = framing.stamp_px, stamps.sky_level, np.zeros(len(stamps))
    if not np.isfinite(level).all():
        level, noise = sky_around(stamps.data, stamps.bad, side)
    noise = np.maximum(noise, observation.least_noise)
    noise = np.where(np.isfinite(stamps.noise), stamps.noise, noise)
    light = np.where(stamps.bad, 0.0, stamps.data - level[:, None, None])
    wide_px = light.shape[-1]
    # Pixels outside the image; stamps of a cube lie within it.
    off_image = np.zeros(light.shape, dtype=bool)
    if isinstance(observation, Image):
        nothing = np.broadcast_to(False, observation.shape)
        off_image = ~cut_image(nothing, nothing.shape, stamps.x, stamps.y, wide_px, margin=0)[1]
    # Pixels far below the sky are dead, or of neighbours that were subtracted badly; these also
    # increase the noise that is measured around a star.
    depth = -BrightStars.defect_sigma * np.minimum(noise, 3.0 * np.median(noise))[:, None, None]
    bad = (stamps.bad | (light < depth)) & ~off_image
    light = fill_bad_stamps(np.maximum(light, depth), bad)
    # Brightest pixel, flux and S/N.
    reach_px = min(settings.search_px, (wide_px - 5) // 2)
    centring = settings.centring_px or 0.0
    peak, is_centred = brightest_pixels(light, reach_px, centring)
    flux = cut(light, side, peak).sum(axis=(1, 2))
    snr = stamp_snr(cut(light, side), noise)
    # A star that is smoothed to be centred has its brightest pixel anywhere.
    highest_light = (cut(light, side) if centring else cut(light, 1, peak)).max(axis=(1, 2))
    # A saturated bad pixel indicates a saturated star only in the star's core.
    is_saturated = cut(stamps.saturated & ~bad, side).any(axis=(1, 2))
    is_saturated |= cut(stamps.saturated, 5).any(axis=(1, 2))
    # Pixels that a stamp may need when the star is moved.
    needed_px = side + 2 * min(reach_px + framing.jitter_px + 1, (wide_px - side) // 2)
    incomplete = cut(off_image, needed_px).any(axis=(1, 2))
    incomplete |= cut(bad, needed_px).mean(axis=(1, 2)) > 0.5

    def is_flagged(flag: StarFlag) -> np.ndarray:
        return (stamps.flags & np.uint16(flag)) > 0

    # The last reason that applies overrides the others.
    verdict = np.full(len(stamps), Verdict.GOOD, dtype="<U16")
    for reason, stars in (
        (Verdict.OFF_CENTRE, ~is_centred),
        (Verdict.FAINT, snr < settings.effective_snr_min),
        (Verdict.BLENDED, is_flagged(StarFlag.BLENDED)),
        (Verdict.SATURATED, is_saturated | is_flagged(StarFlag.SATURATED)),
        (Verdict.INCOMPLETE, incomplete | is_flagged(StarFlag.TRUNCATED)),
    ):
        verdict[stars] = reason
    # Columns for all stars, in counts with the sky where pixels are compared with saturation.
    position = np.stack([stamps.x, stamps.y], axis=1)
    columns = {
        "id": stamps.id,
        "position": position,
        "snr": snr,
        "noise": noise,
        "sky": level,
        "brightest": level + np.where(is_centred, highest_light, -np.inf),
        "core": cut(light, 3).sum(axis=(1, 2)),
        "highest": cut(np.where(stamps.bad, -np.inf, stamps.data), side).max(axis=(1, 2)),
        "verdict": verdict,
    }
    # Only good stars keep their stamps; centres are measured later, for fewer stars.
    is_good = verdict == Verdict.GOOD
    return columns, BrightStars(
        stamps=light[is_good],
        peak=peak[is_good],
        centre=np.full((is_good.sum(), 2), np.nan),
        position=position[is_good],
        flux=flux[is_good],
        noise=noise[is_good],
        snr=snr[is_good],
        row=np.flatnonzero(is_good),
        listed=stamps.listed[is_good],
        colour=stamps.colour[is_good],
        bad=bad[is_good],
    )


def _measure_centres(stars: BrightStars, centring_px: float) -> BrightStars:
    """Return stars with their centroids, within 1.5 px of their brightest pixels per axis.

    The window is a Gaussian with the noise-equivalent area of the star, A = 4π σ², but at least as
    wide as 0.7 px and as the Gaussian of FWHM `centring_px`.
    """
    # σ of the window from the area of each star.
    sigma = np.maximum(np.sqrt(stars.area() / (4.0 * np.pi)), 0.7)
    window_px = np.maximum(sigma, centring_px / FWHM_OF_SIGMA)
    centre = find_centroids(stars.stamps, stars.peak, window_px, rounds=10, reach_px=1.5)
    return replace(stars, centre=centre)


def fill_bad_pixels(
    stars: BrightStars, stamp_px: int, search_px: int, centring_px: float = 0.0
) -> tuple[BrightStars, np.ndarray]:
    """Fill the bad pixels of stars with the PSF of the 12 nearest ones, scaled to the good pixels.

    Parameters
    ----------
    stars : BrightStars
        Stars whose bad pixels are interpolated.
    stamp_px, search_px : int
        Side of the stamps, in which the scale is measured; maximum distance of the brightest
        pixel from the middle.
    centring_px : float
        FWHM of the Gaussian that smooths stars before their brightest pixel is searched.

    Returns
    -------
    stars : BrightStars
        The stars, with new pixels, peaks, centres, fluxes and S/N where they have bad pixels.
    missing : ndarray, shape (n,)
        Fraction of the light in the stamp that is in bad pixels.
    """
    from scipy.spatial import cKDTree

    # Only stars with bad pixels change; a median needs more than three stars.
    missing = np.zeros(len(stars))
    incomplete = np.flatnonzero(stars.bad.any(axis=(1, 2)))
    if not incomplete.size or len(stars) < 4:
        return stars, missing
    # The nearest stars, and the star itself, which is left out below.
    position = stars.position
    if not np.isfinite(position).all():  # all distances are equal then
        position = np.arange(len(stars))[:, None] * np.ones(2)
    nearest = cKDTree(position).query(position[incomplete], k=min(13, len(stars)))[1]
    # The stamp within its margins, where the scale is measured.
    start = stars.stamps.shape[-1] // 2 - stamp_px // 2
    stamp = np.s_[start : start + stamp_px, start : start + stamp_px]
    # In the second pass, the bad pixels of neighbours are filled, too.
    for _ in range(2):
        aligned_stamps, images = stars.align(), stars.stamps.copy()
        # Median of the neighbours, moved to the star's centre; its flux by least squares over the
        # good pixels of the stamp, F = Σ x p / Σ p².
        medians = np.stack(
            [
                np.median(aligned_stamps[neighbours[neighbours != star]], axis=0)
                for star, neighbours in zip(incomplete, nearest, strict=True)
            ]
        )
        psfs = shift_stamps(medians, stars.centre[incomplete])
        for star, psf in zip(incomplete, psfs, strict=True):
            bad = stars.bad[star]
            is_good = ~bad[stamp]
            square = float(np.square(psf[stamp][is_good]).sum())
            flux = (
                float((images[star][stamp] * psf[stamp])[is_good].sum()) / square if square else 0.0
            )
            images[star][bad] = flux * psf[bad]
            missing[star] = (psf * bad)[stamp].sum() / psf[stamp].sum()
        # Measure these stars again; a star without light keeps its measurements.
        light = images[incomplete]
        peak = brightest_pixels(light, search_px, centring_px)[0]
        flux = cut(light, stamp_px, peak).sum(axis=(1, 2))
        snr = stamp_snr(cut(light, stamp_px), stars.noise[incomplete])
        usable = (flux > 0) & (snr > 0)
        missing[incomplete[~usable]] = 1.0
        new = replace(stars.select(incomplete), stamps=light, peak=peak, flux=flux, snr=snr)
        new = _measure_centres(new.select(usable), centring_px)
        columns = {name: getattr(stars, name).copy() for name in ("peak", "flux", "snr", "centre")}
        for name, column in columns.items():
            column[incomplete[usable]] = getattr(new, name)
        stars = replace(stars, stamps=images, **columns)
    return stars, missing
