"""`BrightStars`: stars of an image that are bright enough to train a PSF model on.

Inputs: stamps and measurements of stars (`image.selection`), or a product "stars". Outputs: the
same stars aligned or cut to frames, and the coordinates on which the PSF may depend.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from psfdae.base.files import Product
from psfdae.base.rows import Rows
from psfdae.stars.moments import shift_stamps


def magnitude(flux: np.ndarray) -> np.ndarray:
    """Return instrumental magnitudes of fluxes in counts, which are taken to be positive."""
    # m = −2.5 lg F; a flux of 0 gets a large, finite magnitude.
    return np.asarray(-2.5 * np.log10(np.maximum(flux, 1e-300)))


def psf_coordinates(position: np.ndarray, flux: np.ndarray, colour: np.ndarray) -> np.ndarray:
    """Return the coordinates on which the PSF may depend: x, y, magnitude and colour, (n, 4)."""
    # Coordinates of one star in a row.
    return np.column_stack([position, magnitude(flux), colour])


@dataclass(frozen=True)
class BrightStars(Rows):
    """Bright stars with the pixels around them.

    Attributes
    ----------
    stamps : ndarray, shape (n, s, s)
        Sky-subtracted stamps with a margin, in the unit of `flux`.
    peak : ndarray of int, shape (n, 2)
        Brightest pixel (row, column) from index (s//2, s//2).
    centre, listed : ndarray, shape (n, 2)
        Centroid, and centre in the star list, from the same index; NaN where unknown.
    position : ndarray, shape (n, 2)
        (x, y) in the image, NaN where unknown.
    flux, noise : ndarray, shape (n,)
        Flux inside the stamp, and RMS of the sky noise in a pixel, in counts.
    snr : ndarray, shape (n,)
        S/N of a filter matched to the star.
    row : ndarray of int, shape (n,)
        Row of the star list.
    colour : ndarray, shape (n,)
        Colour in the star list, NaN where there is none.
    bad : ndarray of bool, shape (n, s, s)
        Pixels of `stamps` that were not measured, filled by values of nearby stars; by default
        none.
    defect_sigma : float
        Largest depth of a defect below the sky in σ of the sky; deeper pixels are raised to it.
    min_sky, max_sky : float
        Limits of the sky B in photons per pixel. The deepest pixel, B − `defect_sigma` √B, must not
        be negative; compared with the largest sky, photons of stars are negligible.
    """

    defect_sigma: ClassVar[float] = 6.0
    min_sky: ClassVar[float] = 2.0 * defect_sigma**2
    max_sky: ClassVar[float] = 1e12

    stamps: np.ndarray
    peak: np.ndarray
    centre: np.ndarray
    position: np.ndarray
    flux: np.ndarray
    noise: np.ndarray
    snr: np.ndarray
    row: np.ndarray
    listed: np.ndarray
    colour: np.ndarray
    bad: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=bool))

    def __post_init__(self) -> None:
        """Replace a missing mask by one of measured pixels."""
        # Without a mask, all pixels were measured.
        if self.bad.shape != self.stamps.shape:
            object.__setattr__(self, "bad", np.zeros(self.stamps.shape, dtype=bool))

    @classmethod
    def read(cls, stars: Product) -> BrightStars:
        """Return the bright stars of a product "stars" of an image, without centroids."""
        names = ("peak", "position", "snr", "row", "listed", "flux", "colour", "bad")
        arrays = {name: stars[name] for name in names}
        # The product has stamps and noise of stars of flux 1.
        flux = arrays["flux"]
        arrays["stamps"] = stars["wide"] * flux[:, None, None]
        arrays["noise"] = stars["noise"] * flux
        return cls(**arrays, centre=np.full(arrays["position"].shape, np.nan))

    def __len__(self) -> int:
        """Return the number of stars."""
        return len(self.stamps)

    @property
    def coordinates(self) -> np.ndarray:
        """x, y, magnitude and colour, (n, 4); an unknown colour is the median of the others."""
        # The median of the known colours takes the place of an unknown one.
        has_colour = np.isfinite(self.colour)
        median = np.median(self.colour[has_colour]) if has_colour.any() else np.nan
        return psf_coordinates(self.position, self.flux, np.where(has_colour, self.colour, median))

    def area(self) -> np.ndarray:
        """Return the noise-equivalent area A = (F / (σ S/N))² of each star in pixels, (n,)."""
        # The S/N of a matched filter is F / (σ √A).
        return np.asarray((self.flux / (self.noise * self.snr)) ** 2)

    def align(self) -> np.ndarray:
        """Return the stars with flux 1, shifted to the common centre (s//2, s//2), (n, s, s)."""
        # By splines, so that the shift need not be a whole number of pixels.
        return np.asarray(shift_stamps(self.stamps, -self.centre) / self.flux[:, None, None])

    def sky_photons(self, gain: float | None, otherwise: float) -> float:
        """Return the photons per pixel whose Poisson noise equals sky and read noise together.

        Parameters
        ----------
        gain : float or None
            Electrons per count, > 0; None where unknown.
        otherwise : float
            Result where the gain is unknown.

        Returns
        -------
        float
            Between `min_sky` and `max_sky` for a known gain.
        """
        # Variance in electrons², N = (σ gain)²: a Poisson variable of mean N has it.
        if gain is None:
            return otherwise
        limits = self.min_sky**0.5, self.max_sky**0.5
        return float(np.clip(np.median(self.noise) * gain, *limits) ** 2)

    def cut_frames(self, side: int) -> tuple[np.ndarray, np.ndarray]:
        """Return frames (n, side, side) with the brightest pixel at index (side//2, side//2).

        The second array is True for measured pixels. Pixels outside of the stamps are 0.
        """
        # Rows and columns of each frame in padded stamps. The margin is as wide as a frame; in it
        # images are NaN and no pixel is bad.
        margin = ((0, 0), (side, side), (side, side))
        start = side + self.stamps.shape[-1] // 2 - side // 2
        rows, columns = (self.peak[:, i, None] + start + np.arange(side) for i in (0, 1))
        frame = np.arange(len(self))[:, None, None], rows[:, :, None], columns[:, None, :]
        images = np.pad(self.stamps, margin, constant_values=np.nan)[frame]
        # Pixels outside of the stamps were not measured.
        is_inside = np.isfinite(images)
        bad = np.pad(self.bad, margin)[frame]
        return np.where(is_inside, images, 0.0).astype(np.float64), is_inside & ~bad
