"""Framing: from wavefronts to stamps around their brightest pixels.

A scene makes a source of wavefronts; these become stamps, each with its brightest pixel in the
middle up to a centring error, and normalised to flux 1. `Propagation` has the propagation and the
search for the brightest pixel, which all stages share.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from psfdae.base.errors import Error
from psfdae.base.files import Product
from psfdae.optics.propagation import EXTRA_POINTS, Precision, StampPropagator, run_grids
from psfdae.optics.pupil import Pupil, SamplingError, annular_pupil, choose_samples, count_samples
from psfdae.optics.seeing import BlurredPropagator
from psfdae.optics.wavefronts import WavefrontSource
from psfdae.telescope.settings import OwnTelescope, Telescope
from psfdae_paper.configuration.schema import Framing, Optics

Propagator = StampPropagator | BlurredPropagator
"""Functions of OPDs and stamp centres that give stamps, without or with seeing."""


class FramingError(Error, ValueError):
    """The brightest pixel of a star cannot be trusted to be in the search window."""


def brightest_pixel(image: np.ndarray, tie: float) -> tuple[int, int]:
    """First pixel in (row, column) order that is within `tie` of the maximum.

    Mirror-symmetric images have two or four equal maxima, and rounding would
    choose between them; the tolerance makes the choice reproducible.

    Parameters
    ----------
    image : ndarray, shape (h, w)
        Light on each pixel.
    tie : float
        Relative tolerance below the maximum.

    Returns
    -------
    tuple of int
        (row, column).
    """
    # argmax of a boolean array is the index of its first True.
    first_index = int(np.argmax(image >= (1.0 - tie) * image.max()))
    row, column = np.unravel_index(first_index, image.shape)
    return int(row), int(column)


def find_contested(images: np.ndarray, tie: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the pixels that compete for the maximum of search images in single precision.

    Parameters
    ----------
    images : ndarray, shape (B, h, h)
        Search images.
    tie : float
        Relative tolerance below the maximum, as for `brightest_pixel`.

    Returns
    -------
    image, row, column : ndarray of int, shape (K,)
        Pixels of images that have more than one candidate; a single candidate needs no check.
    """
    # A search image has an error of at most 8e-5 of its maximum (256 stars each of scene 1 at 10
    # and 50 %, and of scene 2): a pixel that is 1e-3 below a tie with the maximum may still be the
    # brightest.
    threshold = (1.0 - tie) * (1.0 - 1e-3)
    is_candidate = images >= threshold * images.max(axis=(1, 2), keepdims=True)
    is_contested = is_candidate.sum(axis=(1, 2)) > 1
    image, row, column = np.nonzero(is_candidate & is_contested[:, None, None])
    return image, row, column


def crop_jittered(frames: np.ndarray, jitter: np.ndarray, margin: int) -> np.ndarray:
    """Cut stamps out of images that were framed without jitter and with a margin.

    Parameters
    ----------
    frames : ndarray, shape (B, d + 2·margin, d + 2·margin)
        Brightest pixel at index d/2 + margin.
    jitter : ndarray of int, shape (B, 2) or (2,)
        (row, column) by which the brightest pixel moves in the stamp, |jitter| ≤ margin.
    margin : int
        Pixels around the stamp on each side.

    Returns
    -------
    ndarray, shape (B, d, d)
    """
    # The first pixel of the stamp is at margin − jitter: a brightest pixel that moves by +1 in
    # the stamp needs a cut that begins one pixel earlier.
    pixels = np.arange(frames.shape[-1] - 2 * margin)
    index = np.broadcast_to(margin - np.asarray(jitter), (len(frames), 2))[:, :, None] + pixels
    stars = np.arange(len(frames))[:, None, None]
    return np.asarray(frames[stars, index[:, 0, :, None], index[:, 1, None, :]])


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


def search_windows(
    slopes: np.ndarray, pixel: float, search_px: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the window in which the brightest pixel of each wavefront is searched first.

    Parameters
    ----------
    slopes : ndarray, shape (n, 2, 2)
        Extreme slopes [wavefront, axis (x, y), (min, max)] in waves per pupil radius.
    pixel : float
        Width of a pixel in λ/D.
    search_px : int
        Largest distance of a window's edge from its centre.

    Returns
    -------
    centre : ndarray of int, shape (n, 2)
        (row, column) of the window's centre from the chief ray.
    reach : ndarray of int, shape (n,)
        The window covers ± this many pixels.
    """
    # Rays land at twice the slope, in λ/D; here (row, column) and (min, max) in pixels.
    rays = 2.0 * slopes[:, ::-1] / pixel
    # Diffraction moves the brightest pixel by less than 3 px beyond the outermost ray. Sizes
    # are multiples of 8 px, so that many wavefronts share a search image's kernel.
    half_width = 0.5 * np.ptp(rays, axis=2).max(axis=1) + 3.0
    centre = np.rint(rays.mean(axis=2)).astype(np.int64)
    reach = (8 * np.ceil(half_width / 8)).astype(np.int64)
    # A window that leaves the permitted area is replaced by ± search_px around the chief ray.
    is_too_large = reach + np.abs(centre).max(axis=1) > 2 * search_px
    is_too_large |= reach > search_px
    centre[is_too_large], reach[is_too_large] = 0, search_px
    return centre, reach


@dataclass(eq=False)
class Propagation:
    """Stamps and brightest pixels of the wavefronts of one source.

    Each wavefront uses the smallest grid size that its slopes allow. Batches
    run in `optics.threads` threads; results do not depend on their number, and on the
    batch by rounding only. The caller limits the linear algebra to one thread.

    Parameters
    ----------
    source : WavefrontSource
        Wavefronts of all stars.
    telescope : Telescope
        Obscuration, pixel scale, and seeing if it has one.
    optics : Optics
        Pupil samples, precision, batch size and threads.
    framing : Framing
        Size of the stamps, largest centring error and tolerance of equal maxima.
    search_px : int
        The brightest pixel is searched within ± this distance of the chief ray.

    Raises
    ------
    SamplingError
        If a wavefront needs more samples than the largest grid has.
    """

    source: WavefrontSource
    telescope: Telescope
    optics: Optics
    framing: Framing
    search_px: int

    def __post_init__(self) -> None:
        telescope, optics, framing = self.telescope, self.optics, self.framing
        pixel = telescope.pixel  # width in λ/D
        # Farthest point of the focal plane that any stamp can contain, in λ/D: a peak at the
        # border of the largest search window, half a stamp, and the centring errors.
        reach_px = 2 * self.search_px + 0.5 * framing.stamp_px + framing.jitter_px
        edge = (reach_px + 0.5 * framing.subpixel) * pixel
        # Seeing carries light into the stamp from as far as its profile reaches.
        seeing = telescope.seeing if isinstance(telescope, OwnTelescope) else None
        self._blur = telescope.blur if isinstance(telescope, OwnTelescope) else None
        if seeing is not None and self._blur is not None:
            edge += self._blur.reach
            if edge > optics.pupil_samples[-1]:
                raise SamplingError(
                    f"telescope.seeing.fwhm_arcsec = {seeing.fwhm_arcsec:g}: its wings "
                    f"around the stamps need N ≥ {edge:.0f} pupil samples; "
                    f"optics.pupil_samples = {optics.pupil_samples}"
                )
        # The smallest pupil grid without aliasing within ± edge, from the wavefront's slopes.
        slopes = self.source.slopes()
        min_samples = count_samples(slopes, np.broadcast_to([-edge, edge], (2, 2)))
        self.samples = choose_samples(min_samples, tuple(optics.pupil_samples))
        self._centre, self._reach = search_windows(slopes, pixel, self.search_px)
        self._pupils: dict[int, Pupil] = {}

    def stamps(
        self, stamp_px: int, offset_px: np.ndarray, stars: np.ndarray | None = None
    ) -> np.ndarray:
        """Propagate wavefronts to pixel-integrated stamps at given positions in the focal plane.

        Parameters
        ----------
        stamp_px : int
            Side of a stamp.
        offset_px : ndarray, shape (B, 2)
            (row, column) from the chief ray to the centre of each stamp.
        stars : ndarray of int, shape (B,), optional
            The wavefronts; all of the source by default.

        Returns
        -------
        ndarray, shape (B, stamp_px, stamp_px), float64
            Fraction of the light through the pupil on each pixel.
        """
        stars = np.arange(len(self.source)) if stars is None else stars
        stamps = np.empty((len(stars), stamp_px, stamp_px))

        def prepare(samples: int) -> Callable[[np.ndarray], None]:
            pupil = self._pupil(samples)
            propagator = self._propagator(pupil, stamp_px, self.optics.precision)

            def propagate(batch: np.ndarray) -> None:
                opd = self.source.opd(stars[batch], pupil, propagator.real_dtype)
                stamps[batch] = propagator(opd, offset_px[batch])

            return propagate

        self._run(stars, prepare)
        return stamps

    def frame(
        self,
        side: int,
        jitter: np.ndarray | int = 0,
        stars: np.ndarray | None = None,
        phase_px: np.ndarray | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return stamps that have their brightest pixel in the middle, up to a centring error.

        Pixel j of the focal plane spans j … j + 1 pixels from the chief ray. The
        brightest one is placed at the 0-based index (side/2, side/2) + `jitter` (`side` even),
        so the centre of the stamp is `peak` − `jitter` from the chief ray.

        Parameters
        ----------
        side : int
            Side of a stamp in pixels.
        jitter : ndarray of int, shape (B, 2)
            Centring error (row, column) in pixels.
        stars : ndarray of int, shape (B,), optional
            The wavefronts; all of the source by default.
        phase_px : ndarray, shape (B, 2), optional
            Displacement of the pixel grid (row, column), as for `brightest`.

        Returns
        -------
        stamps : ndarray, shape (B, side, side), float64
            Fraction of the light through the pupil on each pixel.
        peak : ndarray of int, shape (B, 2)
            The brightest pixels.
        """
        peak = self.brightest(stars, phase_px)
        offset = peak - jitter
        return self.stamps(side, offset if phase_px is None else offset + phase_px, stars), peak

    def brightest(
        self, stars: np.ndarray | None = None, phase_px: np.ndarray | None = None
    ) -> np.ndarray:
        """Find the brightest pixel (row, column) of every wavefront, counted from the chief ray.

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
            (row, column) by which the pixel grid of every wavefront is displaced from the one
            that has the chief ray on a corner; 0 by default.

        Returns
        -------
        ndarray of int, shape (B, 2)

        Raises
        ------
        FramingError
            If the brightest pixel lies on the border of the last window, too.
        """
        stars = np.arange(len(self.source)) if stars is None else stars
        phase_px = np.zeros((len(stars), 2)) if phase_px is None else phase_px
        centre, reach = self._centre[stars], self._reach[stars]
        peaks = np.empty((len(stars), 2), dtype=np.int64)
        pending = np.arange(len(stars))
        while pending.size:
            # Wavefronts with windows of one size share a search image's kernel.
            for distance in np.unique(reach[pending]):
                members = pending[reach[pending] == distance]
                offset = phase_px[members] + centre[members]
                peaks[members] = centre[members] + self._search(
                    stars[members], offset, int(distance)
                )
            # Pixel indices of a window run from −reach to reach − 1. A peak on its border may be
            # the flank of a brighter one outside.
            peak_in_window, limit = peaks[pending] - centre[pending], reach[pending][:, None]
            on_border = (peak_in_window == -limit) | (peak_in_window == limit - 1)
            pending = pending[on_border.any(axis=1)]
            outside = pending[reach[pending] > self.search_px]
            if outside.size:
                raise FramingError(
                    f"search_px = {self.search_px}: the brightest pixel of {outside.size} of "
                    f"{len(peaks)} wavefronts lies {2 * self.search_px} px or more from the chief "
                    f"ray (the first is wavefront {stars[outside[0]]}); choose a larger search_px"
                )
            # Next: the window ± search_px around the chief ray; if that was it, twice the size.
            was_full_window = (reach[pending] == self.search_px) & ~centre[pending].any(axis=1)
            reach[pending] = np.where(was_full_window, 2, 1) * self.search_px
            centre[pending] = 0
        return peaks

    def _search(self, stars: np.ndarray, phase_px: np.ndarray, reach: int) -> np.ndarray:
        """Find brightest pixels within ± `reach` pixels of window centres.

        Parameters
        ----------
        stars : ndarray of int, shape (B,)
            Numbers of the wavefronts.
        phase_px : ndarray, shape (B, 2)
            (row, column) of the window's centre from the chief ray.
        reach : int
            Half the side of the windows, in pixels.

        Returns
        -------
        ndarray of int, shape (B, 2)
            (row, column) from the centre of the window.
        """
        peaks = np.empty((len(stars), 2), dtype=np.int64)
        tie = self.framing.tie

        def prepare(samples: int) -> Callable[[np.ndarray], None]:
            pupil = self._pupil(samples)
            search = self._propagator(pupil, 2 * reach, "complex64")
            exact = self._propagator(pupil, 1, "complex128", 2 * EXTRA_POINTS)

            def find(batch: np.ndarray) -> None:
                members, phase = stars[batch], phase_px[batch]
                opd = self.source.opd(members, pupil, search.real_dtype)
                image = search(opd, phase if phase.any() else None)
                # Pixels that compete for the maximum are computed exactly. The centre of pixel j
                # is at j + 1/2 pixels; a one-pixel stamp is centred there.
                star, row, column = find_contested(image, tie)
                offsets = np.stack([row, column], axis=1) - reach + 0.5 + phase[star]
                exact_values = np.empty(star.size)
                for start in range(0, star.size, self.optics.batch):
                    part = slice(start, start + self.optics.batch)
                    opd = self.source.opd(members[star[part]], pupil, exact.real_dtype)
                    exact_values[part] = exact(opd, offsets[part])[:, 0, 0]
                # Contested images keep nothing but these pixels.
                values = image.copy()
                values[np.unique(star)] = 0.0
                values[star, row, column] = exact_values
                peaks[batch] = [brightest_pixel(pixels, tie) for pixels in values]

            return find

        self._run(stars, prepare)
        return peaks - reach

    def _pupil(self, samples: int) -> Pupil:
        """Return the telescope's pupil with `samples` samples across; each size is made once."""
        if samples not in self._pupils:
            self._pupils[samples] = annular_pupil(samples, self.telescope.obscuration)
        return self._pupils[samples]

    def _run(
        self, stars: np.ndarray, prepare: Callable[[int], Callable[[np.ndarray], None]]
    ) -> None:
        """Process wavefronts in batches of one grid size, by the function from `prepare`."""
        # torch has threads of its own, inside every product.
        threads = 1 if self.optics.backend == "torch" else self.optics.threads
        run_grids(self.samples[stars], self.optics.batch, threads, prepare)

    def _propagator(
        self, pupil: Pupil, stamp_px: int, precision: Precision, extra: int = EXTRA_POINTS
    ) -> Propagator:
        """Return the propagation from a pupil to stamps, with the telescope's seeing if any."""
        geometry = (pupil, stamp_px, self.telescope.pixel)
        if self._blur is not None:
            return BlurredPropagator(*geometry, self._blur, precision)
        return StampPropagator(*geometry, extra, precision, self.optics.backend)


def cut_margin(templates: Product) -> np.ndarray:
    """Return static PSFs as they are in stamps without centring error, shape (F, d, d)."""
    # Templates have a margin on every side, from which a stamp is cut with any centring error.
    margin = templates.config["framing"]["jitter_px"]
    side = templates["psf"].shape[-1] - margin
    return templates["psf"][:, margin:side, margin:side]
