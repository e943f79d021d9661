"""Measurement of wavefronts: from stamps of stars and a telescope to coefficients and PSFs.

`wavefront` runs the search, the draws and the joint fit; `Wavefronts` holds the posteriors of the
stars and the state of the telescope, and computes coefficients, PSFs and tables from them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from pydantic import NonNegativeInt

from psfdae.base.arguments import check_arguments, real_numbers
from psfdae.base.types import Table
from psfdae.image.stamps import Stamps, central_pixel
from psfdae.optics.pupil import SamplingError, annular_pupil
from psfdae.sensing.joint import Joint, fit_telescope
from psfdae.sensing.stars import Photons, SensingError, StarModes, StarOptics, WavefrontSearch
from psfdae.sensing.summary import nearest_modes, summarise_modes
from psfdae.telescope.field import Terms, build_terms, model_telescope
from psfdae.telescope.settings import OwnTelescope, read_telescope


@check_arguments
def wavefront(
    stars: ArrayLike | Stamps,
    telescope: OwnTelescope | str | Path,
    *,
    field_deg: ArrayLike,
    noise: ArrayLike | None = None,
    gain: ArrayLike | None = None,
    joint: bool = False,
    seed: NonNegativeInt = 0,
) -> Wavefronts:
    """Measure the wavefronts of stars that a known telescope has imaged.

    Parameters
    ----------
    stars : array, shape (n, d, d), or Stamps
        Images in any unit, with sky, the star near index [d/2, d/2], with the pixel scale of the
        telescope. Pixels that are not finite are not used.
    telescope : OwnTelescope or path
        Telescope, or its YAML file as in `config/telescope`, with the prior of its aberrations.
    field_deg : array, shape (n, 2)
        Field angle (x, y) of each star in degrees, along columns and rows.
    noise, gain : float or array, shape (n,), optional
        RMS of the sky noise in a pixel (by default the scatter of the stamp's border) and electrons
        per unit (by default the photon noise of the star is neglected); only for arrays.
    joint : bool
        Fit the state of the telescope to all stars together.
    seed : int
        Seed of the candidates and of the draws.

    Raises
    ------
    SensingError
        If shapes do not agree, no star is usable, or the aberrations are too large for any grid.
    ConfigError, RayTracingError, MissingExtraError
        If the telescope cannot be used.

    Examples
    --------
    >>> psfdae.wavefront(stamps[:1], "telescope.yaml", field_deg=[[0.0, 0.0]], gain=1.0)
    Wavefronts('refractor', 1 stars)
    """
    # Files are read, and arrays converted to stamps.
    if not isinstance(telescope, OwnTelescope):
        telescope = read_telescope(Path(telescope))
    stamps = stars if isinstance(stars, Stamps) else build_stamps(stars, noise, gain)
    # A field angle for each star: aberrations change over the field.
    angle = real_numbers("field_deg", field_deg).astype(float)
    if angle.shape != (len(stamps), 2) or not np.isfinite(angle).all():
        raise SensingError(
            f"field_deg of shape {angle.shape}, expected ({len(stamps)}, 2) finite numbers"
        )
    # The posterior of each single star, then the telescope that explains all stars.
    try:
        terms = build_terms(telescope, angle)
        optics = StarOptics(telescope, terms, stamps.data.shape[-1])
        search = WavefrontSearch(optics, Photons.from_stamps(stamps), seed)
        modes = search.find_modes()
        state = fit_telescope(search, modes, model_telescope(telescope, angle)) if joint else None
    except SamplingError as error:
        raise SensingError(
            f"{telescope.name}: aberrations or seeing need a finer pupil grid ({error})"
        ) from error
    return Wavefronts(search, stamps, angle, modes, state)


def build_stamps(stars: ArrayLike, noise: ArrayLike | None, gain: ArrayLike | None) -> Stamps:
    """Return stamps from arrays, for which at most noise and gain are known.

    Raises
    ------
    SensingError
        If shapes do not agree, or noise or gain is not above 0.
    """
    # Square stamps in double precision, one or more.
    data = real_numbers("stars", stars).astype(float)
    if data.ndim != 3 or data.shape[1] != data.shape[2] or not len(data):
        raise SensingError(f"stars of shape {data.shape}, expected (n, d, d)")
    count = len(data)

    def per_star(name: str, value: ArrayLike | None) -> np.ndarray:
        # One number may be given for all stars; NaN stands for a number to be estimated.
        numbers = real_numbers(name, np.nan if value is None else value).astype(float)
        if numbers.shape not in ((), (count,)):
            raise SensingError(
                f"{name} of shape {numbers.shape}, expected one number or one for each of the "
                f"{count} stars"
            )
        if value is not None and not (numbers > 0).all():
            raise SensingError(f"{name}: expected numbers above 0")
        return np.broadcast_to(numbers, count).copy()

    # Pixels that are not finite are bad; flux, sky and position are unknown.
    is_finite, unknown = np.isfinite(data), np.full(count, np.nan)
    return Stamps(
        data=np.where(is_finite, data, 0.0),
        bad=~is_finite,
        saturated=np.zeros(data.shape, bool),
        flags=np.zeros(count, np.uint16),
        id=np.arange(count),
        noise=per_star("noise", noise),
        noise_correlation=np.ones(count),
        gain=per_star("gain", gain),
        listed=np.full((count, 2), np.nan),
        **dict.fromkeys(
            ("x", "y", "flux", "background", "sky_level", "magnitude", "colour"), unknown
        ),
    )


def flat_modes(terms: Terms, obscuration: float, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the modes of the pupil without piston and tilts, and the light on its samples.

    A sum of modes without planes has no plane either.

    Parameters
    ----------
    terms : Terms
        Terms of the wavefronts, with J modes.
    obscuration : float
        Linear central obscuration of the pupil.
    samples : int
        Samples across the pupil; the grid is M = samples + 2 wide.

    Returns
    -------
    images : ndarray, shape (J, M²)
        OPD in waves of a unit of each mode.
    weight : ndarray, shape (M²,)
        Transmission of the samples, of sum 1.
    """
    pupil = annular_pupil(samples, obscuration)
    weight = pupil.amplitude.ravel() / pupil.amplitude.sum()
    # Least-squares planes a + b x + c y of the modes over the pupil.
    x, y = np.meshgrid(pupil.axis, pupil.axis)
    planes = np.stack([np.ones(x.size), x.ravel(), y.ravel()])
    images = terms.modes(pupil.axis[None, :], pupil.axis[:, None])
    images = images.reshape(len(images), -1)
    fit = np.linalg.solve((planes * weight) @ planes.T, (planes * weight) @ images.T)
    return images - fit.T @ planes, weight


@dataclass(frozen=True, eq=False)
class Wavefronts:
    """Wavefronts of stars, and the state of their telescope.

    Arrays have n rows for all stars, with NaN where a star has no usable pixels, or m rows for
    the stars `star` with usable pixels. K is the number of coefficients.

    Attributes
    ----------
    search : WavefrontSearch
        Search of the modes, with the optics and the counts of the stars.
    stamps : Stamps
        Stamps of n stars.
    field_deg : ndarray, shape (n, 2)
        Field angle (x, y) of each star.
    modes : StarModes
        Modes of the posteriors.
    joint : Joint or None
        State of the telescope, if it was fitted.

    Examples
    --------
    >>> angle = [[0.0, 0.0]]
    >>> wavefronts = psfdae.wavefront(stamps[:1], "telescope.yaml", field_deg=angle, gain=1.0)
    >>> wavefronts.explained
    array([ True])
    >>> wavefronts.psf().shape
    (1, 16, 16)
    >>> wavefronts.table.colnames[8:12]
    ['z4', 'z4_error', 'z5', 'z5_error']
    """

    search: WavefrontSearch
    stamps: Stamps
    field_deg: np.ndarray
    modes: StarModes
    joint: Joint | None = None

    def __repr__(self) -> str:
        """Return the name of the telescope and the number of stars."""
        return f"Wavefronts({self.telescope.name!r}, {len(self.stamps)} stars)"

    @property
    def telescope(self) -> OwnTelescope:
        """The telescope with the prior of its aberrations."""
        return self.search.optics.telescope

    @property
    def terms(self) -> Terms:
        """Names, modes and prior of the coefficients."""
        return self.search.optics.terms

    @property
    def wavelength_nm(self) -> float:
        """Wavelength of the telescope in nanometres, the OPD of one wave."""
        return self.telescope.wavelength_m / 1e-9

    @property
    def star(self) -> np.ndarray:
        """Stars with usable pixels, (m,)."""
        return self.modes.best_modes.star

    @cached_property
    def draws(self) -> np.ndarray:
        """Draws from the posteriors, (m, s, K + 4), as `StarModes.parameters`."""
        return self.search.draw_parameters(self.modes)

    @cached_property
    def coefficients(self) -> np.ndarray:
        """Draws of the coefficients in waves, (m, s, K)."""
        k = len(self.terms.names)
        return self.search.optics.coefficients(self.star[:, None], self.draws[..., :k])

    @cached_property
    def mode_of_draw(self) -> np.ndarray:
        """Mode that is nearest to every draw, (m, s), by the Mahalanobis distance."""
        return nearest_modes(self.draws, self.modes)

    @cached_property
    def summary(self) -> dict[str, np.ndarray]:
        """Table of posterior modes, by star and the most probable first.

        `star` (M,) and `probability` (M,); `mean` (M, K) and `covariance` (M, K, K) in waves.
        """
        return summarise_modes(self.coefficients, self.mode_of_draw, self.modes, self.terms.sd)

    def interval(self, probability: float = 0.6827) -> np.ndarray:
        """Return central intervals of the coefficients over all modes of each star.

        Parameters
        ----------
        probability : float
            Probability of the intervals, 0 … 1; by default as for ± σ of a normal distribution.

        Returns
        -------
        ndarray, shape (n, K, 2)
            Lower and upper ends in waves; NaN for stars without usable pixels.
        """
        # Quantiles of the draws at (1 ± probability)/2 leave out equal parts on both sides. Draws
        # come from all modes by their probabilities, so that an interval includes twins.
        half = 0.5 * probability
        ends = np.quantile(self.coefficients, [0.5 - half, 0.5 + half], axis=1)
        return self._spread_over_stars(np.moveaxis(ends, 0, -1))

    @cached_property
    def rms(self) -> tuple[np.ndarray, np.ndarray]:
        """RMS of the wavefront over the lit pupil in waves, without tilts, and its error, (n,)."""
        images, weight = flat_modes(self.terms, self.telescope.obscuration, 128)
        # Mean square of Σ c_j M_j over the pupil: cᵀ G c with the Gram matrix G of the modes.
        gram = (images * weight) @ images.T
        modes = np.einsum("msk,mkj->msj", self.coefficients, self.terms.to_modes[self.star])
        # Rounding can make the square of a perfect wavefront negative.
        rms = np.sqrt(np.maximum(np.einsum("msi,ij,msj->ms", modes, gram, modes), 0.0))
        return self._spread_over_stars(rms.mean(axis=1)), self._spread_over_stars(rms.std(axis=1))

    def psf(self, oversampling: int = 1, side: int | None = None) -> np.ndarray:
        """Return posterior mean PSFs, with the chief ray in the middle.

        Parameters
        ----------
        oversampling : int
            Values per pixel along each axis.
        side : int, optional
            Side in pixels, by default the side of the stamps.

        Returns
        -------
        ndarray, shape (n, s, s)
            PSFs, s = oversampling × side. Values are light per pixel: over the whole image they
            sum to oversampling². NaN for stars without usable pixels.
        """
        return self.psf_and_error(oversampling, side)[0]

    def psf_and_error(
        self, oversampling: int = 1, side: int | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return `psf`, and the standard deviation of its pixels over the star's wavefronts.

        For parameters and shapes see `psf`.
        """
        optics = self.search.optics
        side = (side or optics.stamp_px) * oversampling
        operator = optics.propagation(side, oversampling)
        # The star is in the middle: its position is not part of the PSF.
        centre_px = np.zeros((self.draws.shape[1], 2))
        # Mean and scatter over the PSFs of all draws, star by star, because the images of all stars
        # would not fit into the memory.
        mean, error = np.full((2, len(self.stamps), side, side), np.nan)
        for row, star in enumerate(self.star):
            # Smaller pixels hold less light: values are scaled to whole pixels.
            images = operator.stamps(self._pupil_modes(row, centre_px)) * oversampling**2
            mean[star], error[star] = images.mean(axis=0), images.std(axis=0)
        return mean, error

    @cached_property
    def model(self) -> np.ndarray:
        """Posterior mean images of the stars without sky, in the unit of the stamps, (n, d, d)."""
        # A draw has coefficients, then position (x, y), flux and sky.
        k = len(self.terms.names)
        model = np.full(self.stamps.data.shape, np.nan)
        for row, star in enumerate(self.star):
            position, flux = self.draws[row, :, k : k + 2], self.draws[row, :, k + 2]
            images = self.search.optics.operator.stamps(self._pupil_modes(row, position))
            # Fluxes of the draws, from units of the search to electrons to the stamps' unit.
            light = self.search.flux[star] * flux / self.search.photons.gain[star]
            model[star] = (light[:, None, None] * images).mean(axis=0)
        return model

    @property
    def residual(self) -> np.ndarray:
        """Stamps minus sky and model, in their unit, (n, d, d); NaN in pixels that are not used."""
        sky = self.measured()["sky"][:, None, None]
        is_unused = self.stamps.bad | self.stamps.saturated
        return np.where(is_unused, np.nan, self.stamps.data - sky - self.model)

    def _pupil_modes(self, row: int, position_px: np.ndarray) -> np.ndarray:
        """Return mode coefficients (s, J + 2) of the draws of `star[row]` at positions (s, 2)."""
        stars = np.full(len(position_px), self.star[row])
        return self.search.optics.mode_coefficients(stars, self.coefficients[row], position_px)

    @property
    def snr(self) -> np.ndarray:
        """S/N of a matched filter, (n,): √Σ model² over the noise of the sky in a pixel."""
        # The filter m, the image of the star, has the signal Σ m² and the variance σ² Σ m².
        power = np.sqrt((self.model**2).sum(axis=(1, 2)))
        return np.asarray(power / self.search.photons.sky_noise)

    @property
    def explained(self) -> np.ndarray:
        """True for stars that are explained by a mode, (n,)."""
        # Stars without usable pixels have no mode and count as unexplained.
        is_explained = np.zeros(len(self.stamps), bool)
        is_explained[self.star] = self.search.is_explained(self.modes.best_modes)
        return is_explained

    @property
    def chi2(self) -> np.ndarray:
        """Deviance of the best mode over the number of pixels, (n,); about 1 for a good fit."""
        pixels = self.search.photons.pixels[self.star]
        return self._spread_over_stars(self.modes.best_modes.deviance / pixels)

    def measured(self) -> dict[str, np.ndarray]:
        """Return position, flux and sky of every star with errors.

        Returns
        -------
        dict of ndarray, shape (n,)
            `x` and `y`, the position of the chief ray in 0-based pixels of the image from which
            stamps were cut, or else of the stamp; `flux`, the total light, and `sky`, in the unit
            of the stamps. Each has an error, `x_error` and so on. Values and errors are means and
            standard deviations over all modes. NaN for stars without usable pixels.
        """
        star, photons, side = self.star, self.search.photons, self.stamps.data.shape[-1]

        def middle(position: np.ndarray) -> np.ndarray:
            # First pixel of the stamp about a position; 0 where the position is unknown.
            corner = np.where(np.isfinite(position), central_pixel(position) - side // 2, 0)
            return np.asarray(corner[star] + 0.5 * (side - 1))

        # Zero and unit of each parameter. Positions are relative to the middle of the stamp, flux
        # and sky are in electrons, the sky in units of the root of its counts.
        gain = photons.gain[star]
        unit_px = np.ones(len(star))
        columns: dict[str, np.ndarray] = {}
        scales = {
            "x": (middle(self.stamps.x), unit_px),
            "y": (middle(self.stamps.y), unit_px),
            "flux": (np.zeros(len(star)), self.search.flux[star] / gain),
            "sky": (photons.sky_level[star], np.sqrt(photons.sky_counts[star]) / gain),
        }
        for index, (name, (zero, unit)) in enumerate(scales.items(), len(self.terms.names)):
            # Mean and standard deviation of the draws of all modes, in the unit of the column.
            draws = self.draws[..., index]
            columns[name] = self._spread_over_stars(zero + unit * draws.mean(axis=1))
            columns[f"{name}_error"] = self._spread_over_stars(unit * draws.std(axis=1))
        return columns

    def _spread_over_stars(self, values: np.ndarray) -> np.ndarray:
        """Return values (m, ...) of the usable stars as (n, ...), NaN for the others."""
        spread = np.full((len(self.stamps), *values.shape[1:]), np.nan)
        spread[self.star] = values
        return spread

    @property
    def table(self) -> Table:
        """Table with a row for every star and mode, the most probable mode of a star first.

        A star without usable pixels has a row of NaN. Columns are

        - `id` of the star, index `mode` and its `probability`;
        - `explained`, `chi2` and `snr` of the star, and its field angle `x_deg`, `y_deg`;
        - each coefficient and its error in waves, the standard deviation inside the mode;
        - `rms` of the wavefront over all modes and `rms_error`, in nanometres;
        - position, flux and sky with errors, as in `measured`.
        """
        from astropy.table import Column, Table

        # Rows of the summary and one row for each star without usable pixels, sorted by star.
        summary, stamps = self.summary, self.stamps
        star = np.append(summary["star"], np.setdiff1d(np.arange(len(stamps)), self.star))
        unusable = np.full(star.size - summary["star"].size, np.nan)
        order = np.argsort(star, kind="stable")
        star = star[order]

        def complete(values: np.ndarray) -> np.ndarray:
            # Values of the summary, and NaN for stars without usable pixels.
            return np.append(values, unusable)[order]

        columns: list[tuple[str, np.ndarray, str | None]] = [
            ("id", stamps.id[star], None),
            # Index of the mode: rows since the first row of the star.
            ("mode", np.arange(star.size) - np.searchsorted(star, star), None),
            ("probability", complete(summary["probability"]), None),
            ("explained", self.explained[star], None),
            ("chi2", self.chi2[star], None),
            ("snr", self.snr[star], None),
            ("x_deg", self.field_deg[star, 0], "deg"),
            ("y_deg", self.field_deg[star, 1], "deg"),
        ]
        for k, name in enumerate(self.terms.names):
            # Coefficients with their standard deviation in the mode.
            error = np.sqrt(summary["covariance"][:, k, k])
            columns.append((name, complete(summary["mean"][:, k]), "wave"))
            columns.append((f"{name}_error", complete(error), "wave"))
        # The RMS belongs to the whole posterior and is the same for all modes of a star.
        for name, waves in zip(("rms", "rms_error"), self.rms, strict=True):
            columns.append((name, self.wavelength_nm * waves[star], "nm"))
        for name, values in self.measured().items():
            columns.append((name, values[star], "pix" if name[0] in "xy" else None))
        table = Table()
        for name, values, unit in columns:
            # The FITS standard has no unit wave: it is in the description.
            fits_unit = None if unit == "wave" else unit
            table[name] = Column(values, unit=fits_unit, description=unit)
        return table
