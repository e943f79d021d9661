"""`FieldPsfs`: the PSF at every position of an image, from psfdae or from another program."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from contextlib import suppress
from typing import Annotated, Protocol, Self, TypeAlias

import numpy as np
from pydantic import Field

from psfdae.base.arguments import ArgumentError, check_arguments, real_numbers
from psfdae.base.errors import Error
from psfdae.image.observation import Observation
from psfdae.psf.wings import Wings, outer_shares
from psfdae.stars.moments import measure_shapes


class _Array(Protocol):
    """Object that numpy can make an array of."""

    def __array__(self) -> np.ndarray: ...


Numbers: TypeAlias = float | Sequence[float] | _Array
"""Number, or several; `ArrayLike` would include texts."""


NodeCount: TypeAlias = Annotated[int, Field(ge=1, le=1000)]
"""Number of positions along an axis."""

Oversampling: TypeAlias = Annotated[int, Field(ge=1, le=32)]
"""Values per pixel; memory grows as the square, and no PSF has structure at a 32nd of a pixel."""


class PredictionError(Error, ValueError):
    """A model cannot be applied to these stars or positions; one line with the valid input.

    Examples
    --------
    >>> try:
    ...     model.predict(np.ones((1, 9, 9)))
    ... except psfdae.PredictionError as error:
    ...     print(error)
    stamps of shape 1×9×9, but the model 'array' takes n×16×16
    """


class FieldPsfs(ABC):
    """PSF at every position of an image, and quantities that follow from it.

    Attributes
    ----------
    name : str
        Name of the model.
    stamp_px : int
        Even side d, in pixels, of the stamps in which PSFs have the sum 1.
    """

    name: str
    stamp_px: int

    @property
    @abstractmethod
    def sha256(self) -> str:
        """Checksum of the model."""

    @property
    @abstractmethod
    def order(self) -> int:
        """Order of the polynomial of the PSF over the field; raises as `psf_at`."""

    @property
    @abstractmethod
    def image_px(self) -> tuple[int, int] | None:
        """Columns and rows of the image that the model was trained on, if known."""

    def flux_error(self, position: np.ndarray) -> np.ndarray:
        """Return the relative flux errors of stars on a known sky that are due to the model.

        Parameters
        ----------
        position : ndarray, shape (n, 2)
            x and y of the stars, 0-based pixel coordinates.

        Returns
        -------
        ndarray, shape (n,)
            0 if the errors of the model are not known.
        """
        return np.zeros(len(position))

    @property
    def wings(self) -> Wings | None:
        """Light of stars outside their stamps, if it was measured."""
        return None

    @abstractmethod
    def field_range(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the minimum and maximum (x, y) of the training stars; raises as `psf_at`."""

    @property
    def magnitude_range(self) -> tuple[float, float] | None:
        """Minimum and maximum magnitude between which the PSF changes; None if it does not."""
        return None

    @abstractmethod
    def check_scale(self, pixel_scale_arcsec: float | None, source: str) -> None:
        """Raise PredictionError if the pixel scale differs from the model's.

        `source` names the image in the message.
        """

    def to_image_frame(self, observation: Observation) -> tuple[Self, list[str]]:
        """Return the model in the pixel coordinates of an image of a part of the detector.

        Returns
        -------
        model : FieldPsfs
            The same model where the headers do not give the position of the image on the detector
            (`psfdae.image.detector_frame`).
        notes : list of str
            A warning if the image differs from the training image in size or position.

        Raises
        ------
        PredictionError
            If the headers show another binning, or a mirrored image.
        """
        return self, []

    def residual_variance(self, side_px: int) -> float:
        """Return the mean variance of pixels of training stars about their PSF, over the flux².

        Parameters
        ----------
        side_px : int
            Odd side, in pixels, of the square around a star over which the mean is taken.

        Returns
        -------
        float
            NaN if the variance is not known.
        """
        return np.nan

    @abstractmethod
    def draw_psfs(self, position: np.ndarray, oversampling: int) -> np.ndarray:
        """Return PSFs (n, m, m) as `psf_at`, at checked positions (n, 2) to (n, 4).

        Columns are x, y, magnitude and colour; NaN stands for an average over the training stars.
        """

    @check_arguments
    def psf_at(
        self,
        x: Numbers,
        y: Numbers,
        oversampling: Oversampling = 4,
        *,
        mag: Numbers | None = None,
        colour: Numbers | None = None,
    ) -> np.ndarray:
        """Return PSFs at any positions in the training image.

        Parameters
        ----------
        x, y : float or array, shape (n,)
            0-based pixel coordinates. The PSF has their sub-pixel phase.
        oversampling : int
            Values per pixel and axis; each is the light in a whole pixel around its point.
        mag, colour : float or array, shape (n,), optional
            Instrumental magnitude −2.5 log₁₀ (flux / counts), and colour as in the star list; by
            default the PSF is the average over the training stars. Outside their range, it is
            the PSF of the nearest end. It depends on either only if this dependence reduces the
            error of held-out stars.

        Returns
        -------
        ndarray, shape (m, m) or (n, m, m), float64
            m is the stamp's side d for an oversampling o of 1, else o d + 1. Index m//2 is the
            middle of the pixel of the position. The flux is that for which a star in the middle
            of its pixel has the sum 1 in the d × d pixels of its stamp.

        Raises
        ------
        PredictionError
            If the model's method knows no PSF between the stars, a number is not usable, or the
            model's PSF at a position does not have a finite flux above 0.
        """
        # Columns up to the last given one; NaN for a missing column before it.
        columns = {"x": x, "y": y, "mag": mag, "colour": colour}
        is_given = [value is not None for value in columns.values()]
        count = 4 if is_given[3] else 3 if is_given[2] else 2
        numbers = [
            real_numbers(name, np.nan if value is None else value, PredictionError)
            for name, value in columns.items()
        ]
        # NaN stands for arrays of different lengths, which have no common shape.
        position = np.full((1, count), np.nan)
        with suppress(ValueError):
            position = np.stack(np.broadcast_arrays(*numbers[:count]), axis=-1)
        if position.ndim > 2 or not np.isfinite(position[..., is_given[:count]]).all():
            raise PredictionError(
                "x, y, mag and colour must be finite: numbers, or one-dimensional arrays of the "
                "same length"
            )
        # Polynomials may overflow far outside the image; such PSFs raise an error below.
        with np.errstate(all="ignore"):
            psfs = self.draw_psfs(position.reshape(-1, count), oversampling)
        # The flux of a PSF is about 1. Far outside the image, or in a damaged file, polynomials may
        # give anything.
        flux = psfs.sum(axis=(1, 2))
        is_usable = np.isfinite(flux) & (flux > 0)
        if not is_usable.all():
            x0, y0 = position.reshape(-1, count)[np.argmin(is_usable)][:2]
            raise PredictionError(
                f"the model {self.name!r}: damaged, or far outside its image: no PSF of a "
                f"finite flux above 0 at x {x0:.6g}, y {y0:.6g}"
            )
        return psfs if position.ndim == 2 else psfs[0]

    def draw_on_pixels(self, position: np.ndarray) -> np.ndarray:
        """Return PSFs (n, d, d) in the pixels of the image, at positions (n, 2) or (n, 3).

        A third column has the magnitudes; see `psf_at`.
        """
        x, y, *mag = position.T
        return self.psf_at(x, y, 1, mag=mag[0] if mag else None)

    @check_arguments
    def aperture_correction(self, x: float, y: float, radius_px: float) -> float:
        """Return the total flux of a star over its flux in an aperture.

        The total flux is the light within `wings.radius_px[-1]`, or in the stamp if there are no
        wings.

        Parameters
        ----------
        x, y : float
            Centre of star and aperture, 0-based pixel coordinates.
        radius_px : float
            Radius of the aperture in pixels.

        Raises
        ------
        ValueError
            If the radius is not above 0, or exceeds `wings.radius_px[-1]`, or half the stamp if
            there are no wings.
        PredictionError
            As `psf_at`.
        """
        return aperture_correction(self, self.wings, x, y, radius_px)

    @check_arguments
    def grid(self, columns: NodeCount, rows: NodeCount) -> np.ndarray:
        """Return positions (n, 2), x and y, of a grid over the field; raises as `field_range`."""
        # Rows of the grid follow each other: x changes fastest.
        low, high = self.field_range()
        x, y = (np.linspace(low[i], high[i], count) for i, count in ((0, columns), (1, rows)))
        return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)

    def fwhm_px(self) -> float:
        """Return the FWHM of the PSF in the middle of the field; raises as `psf_at`."""
        # In the middle of a pixel, so that the FWHM does not depend on the sub-pixel phase.
        x, y = np.rint(np.mean(self.field_range(), axis=0))[:, None]
        return float(measure_shapes(self.psf_at(x, y, 1)).fwhm_px[0])


def aperture_correction(
    model: FieldPsfs, wings: Wings | None, x: float, y: float, radius_px: float
) -> float:
    """Return the total flux of a star at (x, y) over its flux in an aperture around it.

    See `FieldPsfs.aperture_correction`. A pixel at the edge of the aperture is weighted by the
    fraction of its area inside.

    Raises
    ------
    ValueError
        If the radius is not above 0, or exceeds the last radius of the wings, or half the stamp if
        there are no wings.
    """
    from photutils.aperture import CircularAperture

    radius_max = model.stamp_px / 2 if wings is None else float(wings.radius_px[-1])
    if not 0 < radius_px <= radius_max:
        raise ArgumentError(f"radius_px {radius_px} px, expected above 0 up to {radius_max:g}")
    # Light of the PSF in the aperture, centred on the star's position in the stamp.
    psf = model.psf_at(x, y, 1)
    middle = np.array([x, y]) - np.floor(np.array([x, y]) + 0.5) + psf.shape[0] // 2
    inside = float(CircularAperture(middle, radius_px).do_photometry(psf)[0][0])
    if wings is None:
        return 1.0 / inside
    # Total light over the light in the aperture, both with the wings of this PSF.
    scale = float(wings.scale(outer_shares(model.draw_on_pixels, np.array([[x, y]])))[0])
    all_wings, inner_wings = (scale * wings.light(r)[0] for r in (np.inf, radius_px))
    return (1.0 + all_wings) / (inside + inner_wings)
