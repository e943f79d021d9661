"""Framing: from wavefronts to stamps around their brightest pixels.

A scene is a source of wavefronts; `Propagation` turns them into stamps, so that the
search for the brightest pixel and the propagation are written once.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from psfdae.errors import Error
from psfdae.optics.propagation import EXTRA_POINTS, Precision, StampPropagator, in_batches
from psfdae.optics.pupil import (
    Pupil,
    SamplingError,
    annular_pupil,
    choose_samples,
    required_samples,
)
from psfdae.optics.seeing import BlurredPropagator
from psfdae.optics.wavefronts import WavefrontSource
from psfdae.telescope.settings import OwnTelescope, Telescope
from psfdae_paper.configuration.schema import Framing, Optics

Propagator = StampPropagator | BlurredPropagator


class FramingError(Error, ValueError):
    """The brightest pixel of a star cannot be trusted to be in the search window."""


def brightest_pixel(image: np.ndarray, tie: float) -> tuple[int, int]:
    """First pixel in (row, column) order that is within `tie` of the maximum.

    Mirror-symmetric images have two or four equal maxima, and rounding would
    choose between them; the tolerance makes the choice reproducible.

    Parameters
    ----------
    image : ndarray, shape (h, w)
    tie : float
        Relative tolerance below the maximum.
    """
    flat = int(np.argmax(image >= (1.0 - tie) * image.max()))
    row, column = np.unravel_index(flat, image.shape)
    return int(row), int(column)


def crop_jittered(framed: np.ndarray, jitter: np.ndarray, margin: int) -> np.ndarray:
    """Cut stamps out of images that were framed without jitter and with a margin.

    Parameters
    ----------
    framed : ndarray, shape (B, d + 2·margin, d + 2·margin)
        Brightest pixel at index d/2 + margin.
    jitter : ndarray of int, shape (B, 2) or (2,)
        (row, column) by which the brightest pixel moves in the stamp, |jitter| ≤ margin.

    Returns
    -------
    ndarray, shape (B, d, d)
    """
    pixels = np.arange(framed.shape[-1] - 2 * margin)
    start = np.broadcast_to(margin - np.asarray(jitter), (len(framed), 2))[:, :, None] + pixels
    stars = np.arange(len(framed))[:, None, None]
    cut: np.ndarray = framed[stars, start[:, 0, :, None], start[:, 1, None, :]]
    return cut


def normalise_flux(stamps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Divide stamps by their own flux (eq. 8 of the paper).

    Returns
    -------
    normalised : ndarray, shape (..., d, d)
        Stamps that sum to 1.
    flux : ndarray, shape (...)
        The sum inside each stamp.
    """
    flux = stamps.sum(axis=(-2, -1))
    return stamps / flux[..., None, None], flux


RAY_MARGIN, RUNG = 3.0, 8
"""Pixels beyond the outermost ray in which the brightest pixel is looked for, and steps of the
sizes of search images."""

SEARCH_ERROR = 1e-3
"""Search-image pixels this far below a tie with the maximum may still be the brightest.

The search image errs by 8e-5 of its maximum at most (256 stars each of scene 1 at 10 and
50 %, and of scene 2). A pixel that is alone on the shortlist settles a star; only the
others are computed exactly.
"""


class Propagation:
    """Stamps and brightest pixels of the wavefronts of one source.

    Each wavefront uses the smallest grid size that its slopes allow. Batches
    run in `optics.threads` threads; results do not depend on their number, and on the
    batch by rounding only. The caller limits the linear algebra to one thread.

    Parameters
    ----------
    source : WavefrontSource
    telescope, optics, framing : config groups
    search_px : int
        The brightest pixel is searched within ± this distance of the chief ray.

    Raises
    ------
    SamplingError
        If the largest grid size is below what a wavefront needs.
    """

    def __init__(
        self,
        source: WavefrontSource,
        telescope: Telescope,
        optics: Optics,
        framing: Framing,
        search_px: int,
    ) -> None:
        self.search_px = search_px
        self.source = source
        self.telescope = telescope
        self.optics = optics
        self.framing = framing
        pixel = telescope.pixel
        reach = 2 * search_px + 0.5 * framing.stamp_px + framing.jitter_px + 0.5 * framing.subpixel
        edge = reach * pixel
        own = telescope if isinstance(telescope, OwnTelescope) else None
        seeing, self._blur = (own.seeing, own.blur) if own else (None, None)
        if seeing is not None and self._blur is not None:
            edge += self._blur.reach
            if edge > optics.pupil_samples[-1]:
                raise SamplingError(
                    f"telescope.seeing.fwhm_arcsec = {seeing.fwhm_arcsec:g}: its wings "
                    f"around the stamps need N ≥ {edge:.0f} pupil samples; "
                    f"optics.pupil_samples = {optics.pupil_samples}"
                )
        slopes = source.slopes()
        needed = required_samples(slopes, np.broadcast_to([-edge, edge], (2, 2)))
        self.samples = choose_samples(needed, tuple(optics.pupil_samples))
        # Rays land at twice the slope, in λ/D; here (row, column) and (min, max) in pixels.
        rays = 2.0 * slopes[:, ::-1] / pixel
        half = 0.5 * np.ptp(rays, axis=2).max(axis=1) + RAY_MARGIN
        self._centre = np.rint(rays.mean(axis=2)).astype(np.int64)
        self._reach = (RUNG * np.ceil(half / RUNG)).astype(np.int64)
        far = self._reach + np.abs(self._centre).max(axis=1) > 2 * search_px
        far |= self._reach > search_px
        self._centre[far], self._reach[far] = 0, search_px
        self._pupils: dict[int, Pupil] = {}

    def stamps(
        self, stamp_px: int, offset_px: np.ndarray, stars: np.ndarray | None = None
    ) -> np.ndarray:
        """Pixel-integrated stamps centred `offset_px` (row, column), (B, 2), from the chief ray.

        `stars` are the B wavefronts; all of the source by default.

        Returns
        -------
        ndarray, shape (B, stamp_px, stamp_px), float64
            Fraction of the light through the pupil on each pixel.
        """
        stars = np.arange(len(self.source)) if stars is None else stars
        out = np.empty((len(stars), stamp_px, stamp_px))

        def prepare(samples: int) -> Callable[[np.ndarray], None]:
            pupil = self._pupil(samples)
            kernel = self._kernel(pupil, stamp_px, self.optics.precision)

            def propagate(batch: np.ndarray) -> None:
                opd = self.source.opd(stars[batch], pupil, kernel.real_dtype)
                out[batch] = kernel(opd, offset_px[batch])

            return propagate

        self._run(stars, prepare)
        return out

    def framed(
        self,
        side: int,
        jitter: np.ndarray | int = 0,
        stars: np.ndarray | None = None,
        phase_px: np.ndarray | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Stamps that have their brightest pixel in the middle, up to a centring error.

        Pixel j of the focal plane spans j … j + 1 pixels from the chief ray. The
        brightest one goes to the 0-based index (side/2, side/2) + `jitter` (`side` even),
        so the centre of the stamp is `peak` − `jitter` from the chief ray.

        Parameters
        ----------
        side : int
        jitter : ndarray of int, shape (B, 2)
            (row, column).
        stars, phase_px : as for `brightest`

        Returns
        -------
        stamps : ndarray, shape (B, side, side), float64
        peak : ndarray of int, shape (B, 2)
            The brightest pixels.
        """
        peak = self.brightest(stars, phase_px)
        offset = peak - jitter
        return self.stamps(side, offset if phase_px is None else offset + phase_px, stars), peak

    def brightest(
        self, stars: np.ndarray | None = None, phase_px: np.ndarray | None = None
    ) -> np.ndarray:
        """Brightest pixel (row, column) of every wavefront, in pixels from the chief ray.

        A single-precision search image shortlists pixels; those are then computed
        in complex128, and the first in (row, column) order within the tie
        tolerance is taken. The image shows where the wavefront's rays land, or the
        whole window. Wavefronts whose peak touches its border are searched again in the
        whole window, and then in one of twice the size.

        Parameters
        ----------
        stars : ndarray of int, shape (B,), optional
            The wavefronts; all of the source by default.
        phase_px : ndarray, shape (B, 2), optional
            (row, column) by which the pixel grid of every wavefront lies beside the one
            that has the chief ray on a corner; 0 by default.

        Raises
        ------
        FramingError
            If the brightest pixel lies on the border of that window, too.
        """
        stars = np.arange(len(self.source)) if stars is None else stars
        phase_px = np.zeros((len(stars), 2)) if phase_px is None else phase_px
        centre, reach = self._centre[stars], self._reach[stars]
        peaks = np.empty((len(stars), 2), dtype=np.int64)
        border = np.arange(len(stars))
        while border.size:
            for distance in np.unique(reach[border]):
                own = border[reach[border] == distance]
                offset = phase_px[own] + centre[own]
                peaks[own] = centre[own] + self._search(stars[own], offset, int(distance))
            border = border[_touches(peaks[border] - centre[border], reach[border])]
            outside = border[reach[border] > self.search_px]
            if outside.size:
                raise FramingError(
                    f"search_px = {self.search_px}: the brightest pixel of {outside.size} of "
                    f"{len(peaks)} wavefronts lies {2 * self.search_px} px or more from the chief "
                    f"ray (the first is wavefront {stars[outside[0]]}); a larger value would do"
                )
            whole = (reach[border] == self.search_px) & ~centre[border].any(axis=1)
            reach[border], centre[border] = np.where(whole, 2, 1) * self.search_px, 0
        return peaks

    def _search(self, stars: np.ndarray, phase_px: np.ndarray, reach: int) -> np.ndarray:
        peaks = np.empty((len(stars), 2), dtype=np.int64)

        def prepare(samples: int) -> Callable[[np.ndarray], None]:
            pupil = self._pupil(samples)
            search = self._kernel(pupil, 2 * reach, "complex64")
            exact = self._kernel(pupil, 1, "complex128", 2 * EXTRA_POINTS)

            def find(batch: np.ndarray) -> None:
                members, phase = stars[batch], phase_px[batch]
                opd = self.source.opd(members, pupil, search.real_dtype)
                image = search(opd, phase if phase.any() else None)
                peaks[batch] = self._refine(members, phase, pupil, image, exact) - reach

            return find

        self._run(stars, prepare)
        return peaks

    def _refine(
        self,
        batch: np.ndarray,
        phase_px: np.ndarray,
        pupil: Pupil,
        image: np.ndarray,
        exact: Propagator,
    ) -> np.ndarray:
        """Brightest pixel of every search image; exact values where several compete."""
        half = image.shape[-1] // 2
        least = (1.0 - self.framing.tie) * (1.0 - SEARCH_ERROR)
        bright = image >= least * image.max(axis=(1, 2), keepdims=True)
        contested = bright.sum(axis=(1, 2)) > 1
        star, row, column = np.nonzero(bright & contested[:, None, None])
        values = np.where(contested[:, None, None], 0.0, image)
        # The centre of pixel j is at j + 1/2 pixels; a one-pixel stamp is centred there.
        offsets = np.stack([row, column], axis=1) - half + 0.5 + phase_px[star]
        for start in range(0, star.size, self.optics.batch):
            part = slice(start, start + self.optics.batch)
            opd = self.source.opd(batch[star[part]], pupil, exact.real_dtype)
            values[star[part], row[part], column[part]] = exact(opd, offsets[part])[:, 0, 0]
        return np.array([brightest_pixel(image, self.framing.tie) for image in values])

    def _pupil(self, samples: int) -> Pupil:
        if samples not in self._pupils:
            self._pupils[samples] = annular_pupil(samples, self.telescope.obscuration)
        return self._pupils[samples]

    def _run(
        self, stars: np.ndarray, prepare: Callable[[int], Callable[[np.ndarray], None]]
    ) -> None:
        # torch has threads of its own, inside every product.
        threads = 1 if self.optics.backend == "torch" else self.optics.threads
        in_batches(self.samples[stars], self.optics.batch, threads, prepare)

    def _kernel(
        self, pupil: Pupil, stamp_px: int, precision: Precision, extra: int = EXTRA_POINTS
    ) -> Propagator:
        common = (pupil, stamp_px, self.telescope.pixel)
        if self._blur is not None:
            return BlurredPropagator(*common, self._blur, precision)
        return StampPropagator(*common, extra, precision, self.optics.backend)


def _touches(peaks: np.ndarray, reach: np.ndarray) -> np.ndarray:
    """Which brightest pixels (n, 2) lie on the border of a window of ± `reach` pixels, (n,)."""
    reach = reach[:, None]
    touches: np.ndarray = ((peaks == -reach) | (peaks == reach - 1)).any(axis=1)
    return touches
