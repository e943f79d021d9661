"""Choice of the stars of an image that are good enough to learn the PSF from.

Everything works on stamps (n, s, s) somewhat wider than those of the network. The
star of a stamp lies near index (s//2, s//2).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from enum import StrEnum
from itertools import accumulate, repeat
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from psfdae.bright_stars import DEFECT, BrightStars
from psfdae.errors import Error
from psfdae.image.interpolation import interpolated_stamps
from psfdae.image.observation import Observation, central_pixel
from psfdae.image.stamps import Stamps, StarFlag, cut, peaks, sky_around, softened
from psfdae.moments import FWHM_OF_SIGMA, robust_scatter, shift_stamps, windowed_centres

if TYPE_CHECKING:
    from psfdae.settings import CalibrationStars, Stamp

ROWS = 2048  # stars that are measured at a time
REGISTRATION_ROUNDS, FARTHEST_PX = 10, 1.5  # of the centroid; from the brightest pixel, per axis
COMPANIONS = 12  # nearest stars with which a star is compared
CORE_PX = 8  # or half of the stamp, if that is more: no place for a faint neighbour
LOCAL = 1.2  # the worst pixels of good stars scatter more than their stamps as a whole
MOST_MISSING = 0.2  # of a star's light, in bad pixels, with which it is still learnt from
# Stars are saturated if at least so many have brightest pixels that agree to this part, which is
# less of their light, by this factor, than in stars at least so bright.
PILE, PILE_WIDTH, PILE_SHARPNESS, PILE_FROM = 3, 0.03, 0.9, 0.1


class CalibrationStarsError(Error, ValueError):
    """An image has too few stars to learn from, or its settings contradict each other."""


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
    """Measurements of all n stars of an observation, and the bright ones among them."""

    id: np.ndarray
    position: np.ndarray  # (n, 2), x, y, NaN where unknown
    snr: np.ndarray
    noise: np.ndarray  # RMS of the sky in counts per pixel
    sky: np.ndarray  # its level, likewise
    brightest: np.ndarray  # pixel of the star in counts, sky included; -inf off centre
    highest: np.ndarray  # pixel of the stamp, likewise; -inf if none can be used
    verdict: np.ndarray  # a `Verdict` for every star
    bright: BrightStars  # the good ones

    @classmethod
    def joined(cls, several: Sequence[Candidates]) -> Candidates:
        """Those of several observations, one after the other."""
        starts = accumulate((len(candidates.verdict) for candidates in several), initial=0)
        bright = [
            replace(candidates.bright, row=candidates.bright.row + start)
            for candidates, start in zip(several, starts, strict=False)
        ]
        names = [field.name for field in fields(cls) if field.name != "bright"]
        columns = {name: np.concatenate([getattr(f, name) for f in several]) for name in names}
        return cls(**columns, bright=BrightStars.joined(bright))

    def require(self, path: Path, least: int, remarks: Sequence[str] = ()) -> None:
        """Refuse an image with fewer good stars, by CalibrationStarsError.

        `remarks` are sentences on a mask or header values that were used or not, which may be why.
        """
        if len(self.bright) < least:
            problem = (
                f"{path}: {len(self.bright)} stars are good enough to learn from, "
                f"calibration_stars.stars_min = {least} are needed "
                f"(of {len(self.verdict)}: {self.count()}); --stars-min takes fewer, --snr-min "
                "fainter ones"
            )
            raise CalibrationStarsError("; ".join([problem, *remarks]))

    def count(self) -> str:
        """How many stars there are of every verdict, in words."""
        counts = Counter(self.verdict.tolist())
        return ", ".join(f"{counts[v]} {v}" for v in map(str, Verdict) if counts[v])

    def columns(self, held_out: np.ndarray) -> dict[str, np.ndarray]:
        """Columns of every star of the list, and which of the good ones are held out, (n,) each."""
        part = np.full(len(self.verdict), "", dtype="<U8")
        part[self.bright.row[held_out]] = "held out"
        part[self.bright.row[~held_out]] = "training"
        x, y = self.position.T
        return {
            "id": self.id,
            "x": x,
            "y": y,
            "snr": self.snr,
            "verdict": self.verdict,
            "part": part,
        }


def collect(
    observation: Observation,
    settings: CalibrationStars,
    framing: Stamp,
    isolation_px: float | None = None,
    by_core: bool = False,
) -> Candidates:
    """Measure all stars and choose those that are good enough to learn from.

    No neighbour is nearer than `isolation_px`, by default that of the settings. Its brightness is
    that of its stamp, or `by_core` that of 3 × 3 px: of a faint star beside a bright one, a whole
    stamp has the other's light.

    The observation has stamps with a margin (a cube: its own, larger ones), of which only
    those of bright stars are kept in memory. CalibrationStarsError says that there are
    fewer good ones than `calibration_stars.stars_min`.
    """
    observation.check_list()
    least = observation.least_noise
    measured = [
        _measure(chunk, settings, framing, least, observation.shape)
        for chunk in observation.chunks(ROWS)
    ]
    columns, kept_stamps = zip(*measured, strict=True)
    measured_columns = {key: np.concatenate([c[key] for c in columns]) for key in columns[0]}
    side, verdict, noise, snr = (
        framing.stamp_px,
        measured_columns["verdict"],
        measured_columns["noise"],
        measured_columns["snr"],
    )
    row = np.flatnonzero(verdict == Verdict.GOOD)
    if observation.saturate is None:
        flat = measured_columns["highest"] >= piled_up(
            measured_columns["brightest"], measured_columns["sky"], snr * noise
        )
        verdict[flat & (verdict == Verdict.GOOD)] = Verdict.SATURATED
    isolation = settings.isolation_px if isolation_px is None else isolation_px
    # A star that is listed twice is no neighbour of itself.
    position = np.where(observation.listed_again()[:, None], np.nan, measured_columns["position"])
    core = measured_columns.pop("core")
    close = crowded(position, core if by_core else snr * noise, isolation, settings.neighbour_ratio)
    verdict[close & (verdict == Verdict.GOOD)] = Verdict.CROWDED
    verdict[observation.without_position()] = Verdict.NO_POSITION
    stamps, peak, listed, colour, bad = (
        np.concatenate([k[i] for k in kept_stamps]) for i in range(5)
    )
    flux = cut(stamps, side, peak).sum(axis=(1, 2))
    verdict[row[flux <= 0]] = Verdict.MISFIT
    good = verdict[row] == Verdict.GOOD
    stamps, peak, listed, colour, flux, row, bad = (
        a[good] for a in (stamps, peak, listed, colour, flux, row, bad)
    )
    centring = settings.centring_px or 0.0
    window = np.maximum(window_of(snr[row], flux, noise[row]), centring / FWHM_OF_SIGMA)
    centre = windowed_centres(stamps, peak, window, REGISTRATION_ROUNDS, FARTHEST_PX)
    bright = BrightStars(
        *(stamps, peak, centre, measured_columns["position"][row], flux, noise[row], snr[row], row),
        *(listed, colour, bad),
    )
    # Sources off the locus of the stars, whose noise-equivalent areas are about the same.
    narrow = sharper_than_stars(bright.area())
    verdict[bright.row[narrow]] = Verdict.SHARP
    bright = bright.of(~narrow)
    bright, missing = completed(bright, side, settings.search_px, centring)
    verdict[bright.row[missing > MOST_MISSING]] = Verdict.INCOMPLETE
    bright = bright.of(missing <= MOST_MISSING)
    large = wider_than_stars(bright.area(), bright.position)
    verdict[bright.row[large]] = Verdict.EXTENDED
    bright = bright.of(~large)
    row = bright.row
    score = misfit(cut(bright.aligned(), side), bright.position, bright.noise / bright.flux)
    verdict[row[score > settings.misfit]] = Verdict.MISFIT
    result = Candidates(**measured_columns, bright=bright.of(score <= settings.misfit))
    result.require(observation.path, settings.stars_min, observation.remarks)
    return result


def _measure(
    chunk: Stamps,
    settings: CalibrationStars,
    framing: Stamp,
    least_noise: float,
    shape: tuple[int, ...] | None,
) -> tuple[dict[str, np.ndarray], tuple[np.ndarray, ...]]:
    """Measure all stars of a chunk of an image of a shape; None is that of a cube of stamps.

    Returns columns of all, and of the good ones stamps, peak, listed centre, colour and bad pixels.
    """
    side = framing.stamp_px
    level, noise = sky_around(chunk.data, chunk.bad, side)
    noise = np.where(np.isfinite(chunk.noise), chunk.noise, np.maximum(noise, least_noise))
    stamps = np.where(chunk.bad, 0.0, chunk.data - level[:, None, None])
    # Far below the sky there is no light: dead pixels, and neighbours that were subtracted badly.
    # These also make the noise around a star seem large.
    depth = -DEFECT * np.minimum(noise, 3.0 * np.median(noise))[:, None, None]
    off = _off_image(chunk, stamps.shape[-1], shape)
    bad = (chunk.bad | (stamps < depth)) & ~off
    stamps = interpolated_stamps(np.maximum(stamps, depth), bad)
    reach = min(settings.search_px, (stamps.shape[-1] - 5) // 2)
    centring = settings.centring_px or 0.0
    peak, centred = brightest_pixels(stamps, reach, centring)
    needed = side + 2 * min(reach + framing.jitter_px + 1, (stamps.shape[-1] - side) // 2)
    snr = signal_to_noise(cut(stamps, side), noise)
    # A bad pixel that is saturated tells of a saturated star only in the star's core.
    saturated = chunk.saturated & ~bad
    core = cut(chunk.saturated, 5).any(axis=(1, 2)) | cut(saturated, side).any(axis=(1, 2))
    incomplete = cut(off, needed).any(axis=(1, 2)) | (cut(bad, needed).mean(axis=(1, 2)) > 0.5)
    verdict = np.full(len(chunk), Verdict.GOOD, dtype="<U16")

    def said(flag: StarFlag) -> np.ndarray:
        return (chunk.flags & np.uint16(flag)) > 0

    for reason, stars in (
        (Verdict.OFF_CENTRE, ~centred),
        (Verdict.FAINT, snr < settings.least_snr),
        (Verdict.BLENDED, said(StarFlag.BLENDED)),
        (Verdict.SATURATED, core | said(StarFlag.SATURATED)),
        (Verdict.INCOMPLETE, incomplete | said(StarFlag.TRUNCATED)),
    ):
        verdict[stars] = reason
    columns = {
        "id": chunk.id,
        "position": np.stack([chunk.x, chunk.y], axis=1),
        "snr": snr,
        "noise": noise,
        "sky": level,
        "brightest": level
        + np.where(
            centred, cut(stamps, side).max((1, 2)) if centring else _at(stamps, peak), -np.inf
        ),
        "core": cut(stamps, 3).sum(axis=(1, 2)),
        "highest": cut(np.where(chunk.bad, -np.inf, chunk.data), side).max(axis=(1, 2)),
        "verdict": verdict,
    }
    good = verdict == Verdict.GOOD
    return columns, (stamps[good], peak[good], chunk.listed[good], chunk.colour[good], bad[good])


def _off_image(stamps: Stamps, side: int, shape: tuple[int, ...] | None) -> np.ndarray:
    """Return the pixels of stamps (n, side, side) that are beyond the edges of their image."""
    if shape is None:
        return np.zeros(stamps.data.shape, dtype=bool)
    axis = np.arange(side) - side // 2
    rows, columns = (central_pixel(v)[:, None] + axis for v in (stamps.y, stamps.x))
    inside = ((rows >= 0) & (rows < shape[0]))[:, :, None]
    return np.asarray(~(inside & ((columns >= 0) & (columns < shape[1]))[:, None, :]))


def sharper_than_stars(area: np.ndarray) -> np.ndarray:
    """Return which sources (n,) have a far smaller noise-equivalent area than the median source.

    Less than half of it, and less by more than five times the scatter: that of stars changes with
    the place in the field, and with the phase on the pixel grid where stars are narrow.
    """
    if len(area) < 4:
        return np.zeros(len(area), dtype=bool)
    size = np.log(area)
    limit = max(np.log(2.0), 5.0 * float(robust_scatter(size)))
    return np.asarray(size < np.median(size) - limit)


def wider_than_stars(area: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Return which sources have a far larger noise-equivalent area than the stars around them.

    Stars have nearly one size, other sources any: of the logarithms of all areas, each less the
    lower quartile of those of its nearest sources, the stars are the shortest interval that has a
    quarter of them. Sources above it by a factor of 1.5, and by more than five times the scatter
    that the interval implies, are no stars; the interval is then searched again. Where the PSF
    changes over the field, so do the sources around.

    Parameters
    ----------
    area : ndarray, shape (n,)
    position : ndarray, shape (n, 2)
        In the image; all sources are near where one is not finite.
    """
    from scipy.spatial import cKDTree

    is_wide = np.zeros(len(area), dtype=bool)
    if len(area) < 8:
        return is_wide
    size = np.log(area)
    for _ in range(10):
        star = np.flatnonzero(~is_wide)
        if len(star) < 8:
            break
        # Size beside that of the nearest eight: usually one of these is a star.
        around = size[star] * np.ones((len(size), 1))
        if np.isfinite(position).all():
            around = size[star][cKDTree(position[star]).query(position, k=8)[1]]
        excess = size - np.percentile(around, 25, axis=1)
        # A quarter of a normal distribution about its middle has the width 0.637 σ.
        ordered, count = np.sort(excess[star]), -(-len(star) // 4)
        width = ordered[count:] - ordered[:-count]
        first = int(width.argmin())
        local_area, scatter = np.median(ordered[first : first + count + 1]), width[first] / 0.637
        is_wider = excess > local_area + max(np.log(1.5), 5.0 * float(scatter))
        if not (is_wider & ~is_wide).any():
            break
        is_wide |= is_wider
    return is_wide


def completed(
    stars: BrightStars, stamp_px: int, search_px: int, centring_px: float = 0.0
) -> tuple[BrightStars, np.ndarray]:
    """Fill the bad pixels of stars with the PSF of the nearest stars, scaled to the good pixels.

    Parameters
    ----------
    stars : BrightStars
        With interpolated bad pixels.
    stamp_px, search_px : int
        Side of the stamps, in which the scale is measured; distance of the brightest pixel from
        the middle, at most.
    centring_px : float
        FWHM of the Gaussian that smooths stars before their brightest pixel is searched.

    Returns
    -------
    stars : BrightStars
        With new pixels, peaks, centres, fluxes and S/N of the stars that have bad pixels.
    missing : ndarray, shape (n,)
        Part of the light in the stamp that is in bad pixels.
    """
    from scipy.spatial import cKDTree

    missing = np.zeros(len(stars))
    incomplete = np.flatnonzero(stars.bad.any(axis=(1, 2)))
    if not incomplete.size or len(stars) < 4:
        return stars, missing
    count = min(COMPANIONS + 1, len(stars))
    place = stars.position
    if not np.isfinite(place).all():  # all stars are as near then
        place = np.arange(len(stars))[:, None] * np.ones(2)
    nearest = cKDTree(place).query(place[incomplete], k=count)[1]
    core = cut(np.ones((1, *stars.wide.shape[1:])), stamp_px).shape[-1]
    middle = stars.wide.shape[-1] // 2 - core // 2
    stamp = np.s_[middle : middle + core, middle : middle + core]
    for _ in range(2):
        aligned, stamps = stars.aligned(), stars.wide.copy()
        for star, neighbours in zip(incomplete, nearest, strict=True):
            # Median of the neighbours, moved to the star's centre; its flux by least squares over
            # the good pixels of the stamp, F = Σ x p / Σ p².
            psf = np.median(aligned[neighbours[neighbours != star]], axis=0)
            psf = shift_stamps(psf[None], stars.centre[star][None])[0]
            bad = stars.bad[star]
            good = ~bad[stamp]
            square = float(np.square(psf[stamp][good]).sum())
            flux = float((stamps[star][stamp] * psf[stamp])[good].sum()) / square if square else 0.0
            stamps[star][bad] = flux * psf[bad]
            missing[star] = (psf * bad)[stamp].sum() / psf[stamp].sum()
        peak = brightest_pixels(stamps[incomplete], search_px, centring_px)[0]
        light = cut(stamps[incomplete], stamp_px, peak)
        flux, snr = light.sum(axis=(1, 2)), stars.snr.copy()
        snr[incomplete] = signal_to_noise(
            cut(stamps[incomplete], stamp_px), stars.noise[incomplete]
        )
        usable = (flux > 0) & (snr[incomplete] > 0)
        missing[incomplete[~usable]] = 1.0
        window = window_of(
            *(np.where(usable, v, 1.0) for v in (snr[incomplete], flux, stars.noise[incomplete]))
        )
        window = np.maximum(window, centring_px / FWHM_OF_SIGMA)
        centres = windowed_centres(
            stamps[incomplete], peak, window, REGISTRATION_ROUNDS, FARTHEST_PX
        )
        new = {"peak": peak, "centre": centres, "flux": flux, "snr": snr[incomplete]}
        columns = {name: getattr(stars, name).copy() for name in new}
        for name, values in new.items():
            columns[name][incomplete[usable]] = values[usable]
        stars = replace(stars, wide=stamps, **columns)
    return stars, missing


def _at(stamps: np.ndarray, peak: np.ndarray) -> np.ndarray:
    """Pixels of stamps (n, s, s) at (row, column) from index (s//2, s//2), shape (n,)."""
    row, column = (peak + stamps.shape[-1] // 2).T
    return np.asarray(stamps[np.arange(len(stamps)), row, column])


def piled_up(brightest: np.ndarray, sky: np.ndarray, brightness: np.ndarray) -> float:
    """Counts, of six digits, from which brightest pixels of stars pile up; infinite if none do.

    Stars of the same brightness have the same brightest pixels, too. Of those that are cut
    off, the brightest pixel is less of the star than in others.

    Parameters
    ----------
    brightest : ndarray, shape (n,)
        Pixel of every star, counts, sky included.
    sky, brightness : ndarray, shape (n,)
        Level in counts, and light of the star in any unit.
    """
    height = brightest - sky
    top = height.max(initial=0.0)
    piled = height >= (1.0 - PILE_WIDTH) * top
    fainter = (height >= PILE_FROM * top) & ~piled
    if top <= 0 or piled.sum() < PILE or not fainter.any():
        return np.inf
    sharpness = height / np.where(brightness > 0, brightness, 1.0)
    if np.median(sharpness[piled]) > PILE_SHARPNESS * np.median(sharpness[fainter]):
        return np.inf
    return _rounded_down(float(brightest[piled].min()))


def _rounded_down(value: float) -> float:
    """Six digits, so that a level that is printed is the one that is meant."""
    unit = 10.0 ** (np.floor(np.log10(value)) - 5) if value > 0 else 1.0
    return float(f"{np.floor(value / unit * (1 + 1e-12)) * unit:.6g}")


def signal_to_noise(stamps: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """S/N of a filter matched to the star itself, √(Σx²/σ² − P), shape (n,).

    For an image x = F p the expectation of Σx² is F²Σp² + Pσ², and F/(σ √A) with
    the noise-equivalent area A = 1/Σp² is what stays (King 1983, PASP 95, 163). No
    PSF has to be known. 0 where the noise is 0.

    Parameters
    ----------
    stamps : ndarray, shape (n, d, d)
        Sky-subtracted.
    noise : ndarray, shape (n,)
        RMS σ of a pixel.
    """
    power = np.square(stamps, dtype=np.float64).sum(axis=(1, 2))
    safe = np.where(noise > 0, noise, np.inf)
    return np.asarray(np.sqrt(np.maximum(power / safe**2 - stamps[0].size, 0.0)))


def crowded(
    position: np.ndarray, brightness: np.ndarray, distance_px: float, ratio: float
) -> np.ndarray:
    """Stars with a neighbour of at least `ratio` of their brightness nearby, bool, shape (n,).

    Parameters
    ----------
    position : ndarray, shape (n, 2)
        In pixels; a star at NaN has no neighbours.
    brightness : ndarray, shape (n,)
    distance_px, ratio : float
    """
    from scipy.spatial import cKDTree

    located = np.flatnonzero(np.isfinite(position).all(axis=1))
    out = np.zeros(len(position), dtype=bool)
    pairs = located[cKDTree(position[located]).query_pairs(distance_px, output_type="ndarray")]
    for first, second in ((pairs[:, 0], pairs[:, 1]), (pairs[:, 1], pairs[:, 0])):
        out[first[brightness[second] >= ratio * brightness[first]]] = True
    return out


def brightest_pixels(
    stamps: np.ndarray, search_px: int, centring_px: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Brightest pixel near the middle of every stamp.

    Parameters
    ----------
    stamps : ndarray, shape (n, s, s)
    search_px : int
        Searched within ± this of the middle.
    centring_px : float
        FWHM of the Gaussian that smooths the stamps before; 0: none.

    Returns
    -------
    peak : ndarray of int, shape (n, 2)
        (row, column) from index (s//2, s//2).
    inside : ndarray of bool, shape (n,)
        Whether no pixel just outside the search window is brighter.
    """
    middle, reach = stamps.shape[-1] // 2, search_px + 1
    window = slice(middle - reach, middle + reach + 1)
    peak = peaks(softened(stamps, centring_px)[:, window, window]) - reach
    return peak, np.abs(peak).max(axis=1, initial=0) <= search_px


def window_of(snr: np.ndarray, flux: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """σ in pixels of the Gaussian with the noise-equivalent area of a star, shape (n,).

    A = (F / (σ_noise · S/N))² = 4π σ²; at least 0.7 px.
    """
    area = (flux / (noise * snr)) ** 2
    return np.asarray(np.maximum(np.sqrt(area / (4.0 * np.pi)), 0.7))


def misfit(aligned: np.ndarray, position: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """How unlike its neighbours each star is, in what is usual in this image, shape (n,).

    A star is compared with the nearest `COMPANIONS` stars, pixel by pixel: its
    difference from their median in units of their robust scatter, root mean square
    over the stamp, or over the worst 3 × 3 pixels of its core: a close companion and a core that is
    flat or hollow are no more than that. Where the PSF varies, so do the neighbours; a
    companion or a cosmic ray lies where they agree. The median star has 1, in its worst
    pixels 1/`LOCAL`.

    Parameters
    ----------
    aligned : ndarray, shape (n, d, d)
        Of flux 1, moved to a common centre.
    position : ndarray, shape (n, 2)
        In the image; all stars are neighbours where a position is not finite.
    noise : ndarray, shape (n,)
        RMS of a pixel over the flux.
    """
    from scipy import ndimage
    from scipy.spatial import cKDTree

    count = len(aligned)
    if count < 4:
        return np.ones(count)
    local_medians: Iterable[tuple[np.ndarray, np.ndarray]]
    if np.isfinite(position).all() and count > COMPANIONS:
        neighbours = cKDTree(position).query(position, k=COMPANIONS + 1)[1]
        local_medians = (
            _usual(aligned[nearest[nearest != star]]) for star, nearest in enumerate(neighbours)
        )
    else:
        local_medians = repeat(_usual(aligned), count)
    score, side = np.empty((count, 2)), aligned.shape[-1]
    core = min(side, max(side // 2, CORE_PX))
    for star, (median, variance) in enumerate(local_medians):
        square = (aligned[star] - median) ** 2 / (variance + noise[star] ** 2)
        patches = ndimage.uniform_filter(square, 3)[None]
        score[star] = square.mean(), cut(patches, core).max()
    score = np.sqrt(score)
    return np.asarray((score / np.median(score, axis=0) / (1.0, LOCAL)).max(axis=1))


def _usual(stars: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Median and robust variance of every pixel of some stars."""
    scatter = robust_scatter(stars)
    # A dozen stars may agree in a pixel by chance.
    return np.median(stars, axis=0), scatter**2 + np.median(scatter) ** 2


# What an image says of settings that neither its header nor its user gives. Each function ends in
# a sentence with the advice and what it rests on, or in None where there is nothing to advise.

LIGHT = 0.985  # of a star, as far as it is seen, that a stamp should hold
SMALLEST_PX = 8  # stamps of a bundle
STEP_PX = 4  # stamps that are so much too wide or too narrow are worth a word
SKY_SIGMA = 3.0  # a sky of fewer σ was probably subtracted


def advice(found: Candidates, observation: Observation, stamp_px: int) -> list[str]:
    """Sentences on saturation, gain and the size of stamps, for a training on `found`."""
    said = [stamp_advice(found, stamp_px)]
    if observation.saturate is None:
        said.append(saturation_advice(found))
    if observation.gain is None:
        said.append(gain_advice(found))
    return [sentence for sentence in said if sentence]


def saturation_advice(candidates: Candidates) -> str:
    """Return advice on saturation, from where brightest pixels pile up."""
    level = piled_up(candidates.brightest, candidates.sky, candidates.snr * candidates.noise)
    if not np.isfinite(level):
        return f"saturation: none is seen up to {candidates.brightest.max():.6g} counts"
    piled, flagged = (
        int((pixel >= level).sum()) for pixel in (candidates.brightest, candidates.highest)
    )
    return (
        f"saturation: the brightest pixels of {piled} stars agree from {level:.6g} counts on, as "
        f"if cut off; {flagged} stamps have such pixels and are not learnt from, --saturate "
        f"{level:.6g} flags these, too"
    )


def gain_advice(candidates: Candidates) -> str:
    """Return advice on the gain by sky and noise, if photons make it: variance = level / gain."""
    sky, noise = float(np.median(candidates.sky)), float(np.median(candidates.noise))
    sky_text = f"gain: the sky is {sky:.4g} counts, its noise {noise:.3g}"
    if not sky > SKY_SIGMA * noise > 0:
        return f"{sky_text}; it was probably subtracted, and says nothing of the gain"
    return (
        f"{sky_text}; if photons make it and no bias or sky was subtracted or added, "
        f"--gain {sky / noise**2:.3g} is right"
    )


def stamp_advice(candidates: Candidates, stamp_px: int) -> str | None:
    """Return advice on the stamps: light of the median star in squares, and how many overlap."""
    typical = np.median(candidates.bright.aligned(), axis=0)[None]
    sides = np.arange(SMALLEST_PX, typical.shape[-1] + 1, 2)
    light = np.array([cut(typical, side).sum() for side in sides]) / typical.sum()
    needed = int(sides[np.argmax(light >= LIGHT)])
    if abs(needed - stamp_px) < STEP_PX:
        return None
    shared = ", ".join(
        f"{100 * overlapping(candidates.position, side):.0f} % of {side} px"
        for side in (stamp_px, needed)
    )
    return (
        f"stamp size: {100 * LIGHT:g} % of the median star's light are within {needed} px; "
        f"another star of the list stands in {shared}: framing.stamp_px={needed} is worth a trial"
    )


def overlapping(position: np.ndarray, side: int) -> float:
    """Part of the stars (n, 2) in whose stamps another one stands."""
    from scipy.spatial import cKDTree

    located = position[np.isfinite(position).all(axis=1)]
    if len(located) < 2:
        return 0.0
    distance, _ = cKDTree(located).query(located, k=2, p=np.inf)
    return float((distance[:, 1] < 0.5 * side).mean())
