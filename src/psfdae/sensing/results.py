"""`wavefront`: stamps of stars and a telescope in; coefficients, PSFs and its state out."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from psfdae.image.observation import central_pixel
from psfdae.image.stamps import Stamps
from psfdae.optics.pupil import SamplingError, annular_pupil
from psfdae.sensing.joint import Joint, joint_fit
from psfdae.sensing.stars import (
    Modes,
    Photons,
    Search,
    SensingError,
    StarOptics,
    expected_deviance,
)
from psfdae.telescope.field import Terms, field_model, terms_of
from psfdae.telescope.settings import OwnTelescope, read_telescope

if TYPE_CHECKING:
    from astropy.table import Table

NANOMETRE = 1e-9

RMS_SAMPLES = 128
"""Pupil samples on which the RMS of a wavefront is taken."""


def wavefront(
    stars: ArrayLike | Stamps,
    telescope: OwnTelescope | str | Path,
    *,
    field_deg: ArrayLike,
    noise: ArrayLike | None = None,
    gain: ArrayLike | None = None,
    joint: bool = False,
    seed: int = 0,
) -> Wavefronts:
    """Wavefronts of stars that a known telescope has imaged.

    Parameters
    ----------
    stars : array, shape (n, d, d), or Stamps
        In any unit, sky included, the star about index [d/2, d/2], pixels of the telescope's
        scale. Those that are not finite are not used.
    telescope : OwnTelescope or path
        A YAML file as in `config/telescope`, with the prior of its aberrations.
    field_deg : array, shape (n, 2)
        Field angle (x, y) of each star in degrees, along columns and rows.
    noise, gain : float or array, shape (n,), optional
        RMS of the sky in a pixel (by default the scatter of the stamp's border) and electrons
        per unit (by default the star's own photon noise is neglected); of arrays only.
    joint : bool
        Fit the state of the telescope to all stars together.
    seed : int
        Of the candidates and of the draws.

    Raises
    ------
    SensingError
        If shapes do not fit, no star is usable, or the aberrations are too large for any grid.
    ConfigError, RayTracingError, MissingExtraError
        If the telescope cannot be used.

    Examples
    --------
    >>> psfdae.wavefront(stamps[:1], "telescope.yaml", field_deg=[[0.0, 0.0]], gain=1.0)
    Wavefronts('refractor', 1 stars)
    """
    if not isinstance(telescope, OwnTelescope):
        telescope = read_telescope(Path(telescope))
    stamps = stars if isinstance(stars, Stamps) else _stamps(stars, noise, gain)
    angle = np.asarray(field_deg, float)
    if angle.shape != (len(stamps), 2) or not np.isfinite(angle).all():
        raise SensingError(
            f"field_deg of shape {angle.shape}, expected ({len(stamps)}, 2) finite numbers"
        )
    photons = Photons.of(stamps)
    try:
        terms = terms_of(telescope, angle)
        search = Search(StarOptics(telescope, terms, stamps.data.shape[-1]), photons, seed)
        modes = search.modes()
        state = joint_fit(search, modes, field_model(telescope, angle)) if joint else None
        found = Wavefronts(search, stamps, angle, modes, state)
    except SamplingError as error:
        largest = search.optics.operator.sizes[-1]
        raise SensingError(
            f"{telescope.name}: aberrations or seeing need more than {largest} samples across the "
            f"pupil ({error})"
        ) from error
    return found


def _stamps(stars: ArrayLike, noise: ArrayLike | None, gain: ArrayLike | None) -> Stamps:
    data = np.asarray(stars, float)
    if data.ndim != 3 or data.shape[1] != data.shape[2] or not len(data):
        raise SensingError(f"stars of shape {data.shape}, expected (n, d, d)")
    count = len(data)
    unknown = np.full(count, np.nan)

    def each(name: str, value: ArrayLike | None) -> np.ndarray:
        numbers = np.asarray(np.nan if value is None else value, float)
        if numbers.shape not in ((), (count,)):
            raise SensingError(f"{name} of shape {numbers.shape}, expected one for {count} stars")
        if value is not None and not (numbers > 0).all():
            raise SensingError(f"{name}: expected numbers above 0")
        return np.broadcast_to(numbers, count).copy()

    finite = np.isfinite(data)
    return Stamps(
        np.where(finite, data, 0.0),
        ~finite,
        np.zeros(data.shape, bool),
        np.zeros(count, np.uint16),
        np.arange(count),
        x=unknown,
        y=unknown,
        flux=unknown,
        background=unknown,
        noise=each("noise", noise),
        gain=each("gain", gain),
        magnitude=unknown,
        colour=unknown,
        listed=np.full((count, 2), np.nan),
    )


@dataclass(frozen=True, eq=False)
class Wavefronts:
    """Wavefronts of stars and the state of their telescope.

    Attributes
    ----------
    search : Search
    stamps : Stamps
        Of n stars.
    field_deg : ndarray, shape (n, 2)
    modes : Modes
        Of the posteriors.
    joint : Joint or None
        State of the telescope.

    Examples
    --------
    >>> found = psfdae.wavefront(stamps[:1], "telescope.yaml", field_deg=[[0.0, 0.0]], gain=1.0)
    >>> found.explained
    array([ True])
    >>> found.psf().shape
    (1, 16, 16)
    >>> found.table.colnames[8:12]
    ['z4', 'z4_error', 'z5', 'z5_error']
    """

    search: Search
    stamps: Stamps
    field_deg: np.ndarray
    modes: Modes
    joint: Joint | None = None

    def __repr__(self) -> str:
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
    def star(self) -> np.ndarray:
        """Stars with usable pixels, (m,)."""
        return np.asarray(self.modes.star[self.modes.first])

    @cached_property
    def draws(self) -> np.ndarray:
        """Draws from their posteriors, (m, s, K + 4), as `Modes.numbers`; made on first use."""
        return self.search.sampled(self.modes)

    @cached_property
    def coefficients(self) -> np.ndarray:
        """Draws of the coefficients in waves, (m, s, K)."""
        k = len(self.terms.names)
        return np.asarray(
            self.terms.mean[self.star, None]
            + self.terms.sd[self.star, None] * (self.draws[..., :k])
        )

    @cached_property
    def mode_of_draw(self) -> np.ndarray:
        """Mode that every draw (m, s) is nearest to."""
        out = np.empty(self.draws.shape[:2], int)
        for row, star in enumerate(self.star):
            own = np.flatnonzero(self.modes.star == star)
            gap = self.draws[row][None] - self.modes.numbers[own][:, None]
            scale = np.linalg.inv(self.modes.covariance[own])
            out[row] = own[np.einsum("mni,mij,mnj->mn", gap, scale, gap).argmin(axis=0)]
        return out

    @cached_property
    def summary(self) -> dict[str, np.ndarray]:
        """Table of posterior modes per star, most probable first.

        `star` (M,) and `probability` (M,); `mean` (M, K) and `covariance` (M, K, K) in waves.
        """
        columns: dict[str, list[Any]] = {
            name: [] for name in ("star", "probability", "mean", "covariance")
        }
        for row, star in enumerate(self.star):
            own, count = np.unique(self.mode_of_draw[row], return_counts=True)
            for mode in own[np.argsort(-count, kind="stable")]:
                draws = self.coefficients[row, self.mode_of_draw[row] == mode]
                laplace = self._laplace(mode)
                # A mode of few draws has the covariance of its peak.
                few = len(draws) <= 2 * draws.shape[1]
                columns["star"].append(star)
                columns["probability"].append(len(draws) / self.draws.shape[1])
                columns["mean"].append(draws.mean(axis=0))
                columns["covariance"].append(
                    laplace if few else np.atleast_2d(np.cov(draws, rowvar=False))
                )
        return {name: np.array(values) for name, values in columns.items()}

    def _laplace(self, mode: int) -> np.ndarray:
        k, sd = len(self.terms.names), self.terms.sd[self.modes.star[mode]]
        return np.asarray(self.modes.covariance[mode, :k, :k] * sd * sd[:, None])

    def interval(self, probability: float = 0.6827) -> np.ndarray:
        """Central intervals of the coefficients over all modes, (n, K, 2) in waves."""
        half = 0.5 * probability
        ends = np.quantile(self.coefficients, [0.5 - half, 0.5 + half], axis=1)
        return self._spread(np.moveaxis(ends, 0, -1))

    @cached_property
    def rms(self) -> tuple[np.ndarray, np.ndarray]:
        """RMS of the wavefront over the lit pupil in waves, without tilts, and its error, (n,)."""
        pupil = annular_pupil(RMS_SAMPLES, self.telescope.obscuration)
        weight = pupil.amplitude.ravel() / pupil.amplitude.sum()
        x, y = np.meshgrid(pupil.axis, pupil.axis)
        planes = np.stack([np.ones(x.size), x.ravel(), y.ravel()])
        images = self.terms.modes(pupil.axis[None, :], pupil.axis[:, None])
        images = images.reshape(len(images), -1)
        fit = np.linalg.solve((planes * weight) @ planes.T, (planes * weight) @ images.T)
        images = images - fit.T @ planes
        gram = (images * weight) @ images.T
        modes = np.einsum("msk,mkj->msj", self.coefficients, self.terms.to_modes[self.star])
        rms = np.sqrt(np.maximum(np.einsum("msi,ij,msj->ms", modes, gram, modes), 0.0))
        return self._spread(rms.mean(axis=1)), self._spread(rms.std(axis=1))

    def psf(self, oversampling: int = 1, side: int | None = None) -> np.ndarray:
        """Posterior mean PSFs, (n, s, s), s = oversampling × side, the chief ray in the middle.

        The whole light is 1 per oversampling²; `side` in pixels is that of the stamps by default.
        NaN for stars without usable pixels.
        """
        return self.psf_and_error(oversampling, side)[0]

    def psf_and_error(
        self, oversampling: int = 1, side: int | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return `psf`, and the standard deviation of its pixels over the star's wavefronts."""
        optics = self.search.optics
        side = (side or optics.stamp_px) * oversampling
        operator = optics.propagation(side, oversampling)
        k, count = len(self.terms.names), self.draws.shape[1]
        mean, error = np.full((2, len(self.stamps), side, side), np.nan)
        for row, star in enumerate(self.star):
            modes = optics.modes(np.full(count, star), self.draws[row, :, :k], np.zeros((count, 2)))
            each = operator.stamps(modes) * oversampling**2
            mean[star], error[star] = each.mean(axis=0), each.std(axis=0)
        return mean, error

    @cached_property
    def model(self) -> np.ndarray:
        """Posterior mean images of the stars without sky, in the unit of the stamps, (n, d, d)."""
        optics, k = self.search.optics, len(self.terms.names)
        found = np.full(self.stamps.data.shape, np.nan)
        for row, star in enumerate(self.star):
            numbers = self.draws[row]
            modes = optics.modes(np.full(len(numbers), star), numbers[:, :k], numbers[:, k : k + 2])
            light = self.search.flux[star] * numbers[:, k + 2] / self.search.photons.gain[star]
            found[star] = (light[:, None, None] * optics.operator.stamps(modes)).mean(axis=0)
        return found

    @property
    def snr(self) -> np.ndarray:
        """S/N of a matched filter, (n,)."""
        power = np.sqrt((self.model**2).sum(axis=(1, 2)))
        return np.asarray(power / self.search.photons.noise)

    @property
    def explained(self) -> np.ndarray:
        """Whether a mode explains the star, (n,)."""
        first = self.modes.take(self.modes.first)
        found = np.zeros(len(self.stamps), bool)
        found[first.star] = self.search.explained(first)
        return found

    @property
    def chi2(self) -> np.ndarray:
        """Deviance of the best mode over the number of pixels, (n,)."""
        first = self.modes.take(self.modes.first)
        found = np.full(len(self.stamps), np.nan)
        found[first.star] = first.deviance / expected_deviance(self.search.photons, first.star)[0]
        return found

    def measured(self) -> dict[str, np.ndarray]:
        """Place, flux and sky of every star with errors, (n,) each.

        The place of the chief ray is a 0-based pixel of the image, where stamps were cut from one,
        else of the stamp; flux is the whole light.
        """
        photons, k = self.search.photons, len(self.terms.names)
        side = self.stamps.data.shape[-1]
        corners = [
            np.where(np.isfinite(at), central_pixel(at) - side // 2, 0)[self.star]
            for at in (self.stamps.x, self.stamps.y)
        ]
        own = self.draws[..., k:]
        gain, star = photons.gain, self.star
        scale = [np.ones(len(star))] * 2
        scale += [self.search.flux[star] / gain[star], np.sqrt(photons.sky[star]) / gain[star]]
        zero = [corner + 0.5 * (side - 1) for corner in corners]
        zero += [np.zeros(len(star)), photons.level[star]]
        columns: dict[str, np.ndarray] = {}
        for i, name in enumerate(("x", "y", "flux", "sky")):
            columns[name] = self._spread(zero[i] + scale[i] * own[..., i].mean(axis=1))
            columns[f"{name}_error"] = self._spread(scale[i] * own[..., i].std(axis=1))
        return columns

    def _spread(self, values: np.ndarray) -> np.ndarray:
        """Values of the usable stars (m, ...) for all, NaN for the others, (n, ...)."""
        out = np.full((len(self.stamps), *values.shape[1:]), np.nan)
        out[self.star] = values
        return out

    @property
    def table(self) -> Table:
        """A row for every star and mode, the likeliest mode of a star first.

        Coefficients and errors are in waves. `rms` and `rms_error` are in nanometres.
        """
        from astropy.table import Table

        found, stamps = self.summary, self.stamps
        star = np.append(found["star"], np.setdiff1d(np.arange(len(stamps)), self.star))
        lost = star.size - found["star"].size
        order = np.argsort(star, kind="stable")
        first = np.diff(star[order], prepend=-1) > 0
        mode = np.arange(star.size) - np.maximum.accumulate(
            np.where(first, np.arange(star.size), 0)
        )

        def filled(values: np.ndarray) -> np.ndarray:
            return np.append(values, np.full(lost, np.nan))[order]

        star = star[order]
        wave = self.telescope.wavelength_m / NANOMETRE
        columns: dict[str, Any] = {
            "id": stamps.id[star],
            "mode": mode,
            "probability": filled(found["probability"]),
            "explained": self.explained[star],
            "chi2": self.chi2[star],
            "snr": self.snr[star],
            "x_deg": self.field_deg[star, 0],
            "y_deg": self.field_deg[star, 1],
        }
        for k, name in enumerate(self.terms.names):
            columns[name] = filled(found["mean"][:, k])
            columns[f"{name}_error"] = filled(np.sqrt(found["covariance"][:, k, k]))
        columns |= {"rms": wave * self.rms[0][star], "rms_error": wave * self.rms[1][star]}
        columns |= {name: values[star] for name, values in self.measured().items()}
        units = {name: "wave" for term in self.terms.names for name in (term, f"{term}_error")}
        units |= {"x_deg": "deg", "y_deg": "deg", "rms": "nm", "rms_error": "nm"}
        units |= dict.fromkeys(("x", "y", "x_error", "y_error"), "pix")
        table = Table(columns)
        for name, unit in units.items():
            # A wave is no unit of the FITS standard.
            table[name].unit = None if unit == "wave" else unit
            table[name].description = unit
        return table
