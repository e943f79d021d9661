"""Method `field`: a model of the PSF over the field, and the posterior of stars given this model.

The distribution of the stars is in `psfdae.methods.field_law`, and the posterior of a star in
`psfdae.methods.field_posterior`; here the distribution is fitted to bright stars, stored, and
applied to stamps. Equations are numbered as on the page docs/field_model.md.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike

from psfdae.bright_stars import BrightStars
from psfdae.method import (
    Estimate,
    FitError,
    Look,
    Measured,
    Method,
    Needs,
    Packing,
    Storage,
    TrainingSet,
)
from psfdae.methods.field_fit import FieldFit
from psfdae.methods.field_law import (
    MARGIN_PX,
    FieldLaw,
    FieldSettings,
    node_step,
    phase_of,
    phases_of,
)
from psfdae.methods.field_posterior import FieldStamps, StarPosterior, star_posterior
from psfdae.methods.field_search import fit_field, refit_field
from psfdae.methods.field_spline import FieldModel
from psfdae.moments import measure_shapes, moving_matrices, robust_scatter
from psfdae.noise import NoiseModel
from psfdae.progress import steps
from psfdae.rng import stream

MAX_PACKED_BYTES = 3e6
"""Largest size of the modes of the residuals in a bundle, in bytes."""


@dataclass(frozen=True, eq=False)
class FieldMixture(FieldLaw, Method):
    """Fitted model of a field, with the residuals of its stars.

    Attributes
    ----------
    redrawn : sequence of FieldModel
        Fields that the training stars give with other noise; none of a fit that was stored.
    parted : sequence of FieldModel
        Fields as uncertain as they are without some of the stars after the others, likewise.
    unknown_light : float
        Scatter of the light in the stamps of stars that the field takes for sky, over the flux; 0
        of a fit that was stored.
    """

    redrawn: Sequence[FieldModel] = ()
    parted: Sequence[FieldModel] = ()
    unknown_light: float = 0.0

    look = Look("field", "#117733", "D")
    needs = Needs(level=True, position=True)
    storage = Storage(
        arrays={
            "coefficients": ("1", "splines of the field for each term of its polynomial"),
            "low": ("pixel", "least x, y; magnitude and colour if the PSF changes with them"),
            "high": ("pixel", "greatest, likewise"),
            "usual": ("1", "mean of the terms"),
            "spread": ("1", "their covariance"),
            "offset": ("1", "mean residual by phase"),
            "modes": ("1", "modes of the residuals by phase"),
            "diagonal": ("1", "variance of the residuals beyond their modes"),
            "listed": ("pixel", "mean and RMS of fitted less listed centres (row, column)"),
        },
        per_reference=True,
    )
    packing = Packing(together=4096, padded=False)
    knows_field = True
    groups: ClassVar = {"field": FieldSettings}

    @classmethod
    def fit(cls, data: TrainingSet, field: FieldSettings) -> Self:
        """Fit the field to the training stars, and the covariance of what it leaves of them.

        Parameters
        ----------
        data : TrainingSet
        field : FieldSettings

        Raises
        ------
        FitError
            If there are no bright stars of an image.
        """
        if data.bright is None:
            raise FitError("it learns from the bright stars of an image: psfdae from-stars")
        bright, side = data.bright.of(np.unique(data.star[data.train])), data.images.shape[-1]
        sizes, splines = (side + 2 * MARGIN_PX, side), (field.spacing_px, field.smoothness)
        rng = stream(data.seed, "noise", "field")
        fit = fit_field(bright, data.noise.background, *sizes, field.orders, *splines, rng)
        used = bright.of(fit.good)
        terms = fit.model.terms(used.place)
        # Nodes are closer together where the mean star is narrow.
        mean_star = fit.model.images(terms.mean(axis=0)[None], np.zeros((1, 2)), side)
        step = node_step(float(measure_shapes(mean_star).fwhm_px[0]), field.step_px)
        offset, modes, diagonal = _residuals(fit, used.noise / fit.flux[fit.good], field, step)
        return cls(
            coefficients=fit.model.coefficients.astype(np.float32),
            low=fit.model.low,
            high=fit.model.high,
            usual=terms.mean(axis=0),
            spread=np.cov(terms.T, bias=True).reshape(terms.shape[1], -1),
            offset=offset.astype(np.float32),
            modes=modes.astype(np.float32),
            diagonal=diagonal.astype(np.float32),
            listed=_list_error((fit.centre + bright.peak - bright.listed)[fit.good]),
            noise=data.noise,
            settings=field,
            redrawn=fit.redrawn,
            parted=fit.parted,
            unknown_light=fit.unknown_light,
        )

    def of_exposure(self, bright: BrightStars, background: float) -> Self:
        """Return this model for another exposure of the same field, refitted to its bright stars.

        The residuals of stars about the field stay those of the training, and so does the error of
        the star list if too few stars show that of the new one.

        Parameters
        ----------
        bright : BrightStars
        background : float
            Photons of the sky in a pixel.
        """
        sizes = (self.side + 2 * MARGIN_PX, self.side, self.settings.smoothness)
        fit = refit_field(self.model, bright, background, *sizes)
        listed = _list_error((fit.centre + bright.peak - bright.listed)[fit.good])
        return replace(
            self,
            coefficients=fit.model.coefficients.astype(np.float32),
            listed=listed if np.isfinite(listed).all() else self.listed,
        )

    @classmethod
    def restored(
        cls, arrays: Mapping[str, np.ndarray], config: Mapping[str, Any], reference: str
    ) -> Self:
        """Return the method of a bundle; noise and settings are those of the configuration.

        Settings that this release does not know are ignored: they affect the fit alone.
        """
        noise = NoiseModel(config["noise"]["kappa"], config["noise"]["background_photons"])
        named: dict[str, Any] = {**arrays, "modes": arrays["modes"].astype(np.float32)}
        supported = {k: v for k, v in config["field"].items() if k in FieldSettings.model_fields}
        settings = FieldSettings.model_validate(supported)
        return cls(**named, noise=noise, settings=settings)

    def pack(self, stamp_px: int, noise: float) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Return the arrays for a bundle, and fields of its `BundleInfo`.

        Large stamps have fewer modes, in half precision; the variance of the others joins the
        diagonal.
        """
        arrays, info_fields = super().pack(stamp_px, noise)
        phases, mode_count, pixels = self.modes.shape
        packed_count = min(mode_count, max(1, int(MAX_PACKED_BYTES // (2 * phases * pixels))))
        arrays["diagonal"] = self.diagonal + np.square(self.modes[:, packed_count:]).sum(axis=1)
        arrays["modes"] = self.modes[:, :packed_count].astype(np.float16)
        # Bundles hold finite numbers: without a star list, its error is left out.
        arrays["listed"] = self.listed if np.isfinite(self.listed).all() else np.empty((0, 2))
        return arrays, info_fields

    def conditions(self) -> Iterator[tuple[str, str, ArrayLike]]:
        """Yield the conditions that any fit fulfils: a mean star of sum 1, and smaller residuals.

        Each is the name of an array, what it must have, and whether it has it.
        """
        terms, spread = len(self.coefficients), self.spread
        mean_star = self.model.images(self.usual[None], np.zeros((1, 2)), self.side)
        yield "coefficients", "a mean star of the sum 1", abs(mean_star.sum() - 1) < 0.1
        has_shape = self.low.shape == self.high.shape and 2 <= len(self.low) <= 4
        yield "high", "at least low", has_shape and self.low <= self.high
        yield "usual", "terms from -1 to 1", self.usual.shape == (terms,) and abs(self.usual) <= 1
        eigenvalue = np.linalg.eigvalsh(spread)[0] if spread.shape == (terms, terms) else -1.0
        yield "spread", "a covariance", (spread == spread.T) & (eigenvalue > -1e-6)
        yield "modes", "squares below 1", np.square(self.modes, dtype=float).sum(axis=1) < 1
        yield "offset", "numbers from -1 to 1", abs(self.offset) <= 1
        yield "diagonal", "numbers from 0 to 1", (self.diagonal > 0) & (self.diagonal < 1)
        yield "listed", "an error above 0, if any", self.listed[1:] > 0

    def draw_stars(
        self, count: int, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Draw noise-free stars of flux 1 at random places of the field and of a pixel.

        Each is of one of the fields that the training stars give with other noise, with a residual
        of the law and light that the field takes for sky: what the fit leaves open is in it.

        Parameters
        ----------
        count : int
        rng : Generator

        Returns
        -------
        images : ndarray, shape (count, d, d)
        position : ndarray, shape (count, 2) to (count, 4)
        centre : ndarray, shape (count, 2)
            (row, column) from pixel (d//2, d//2), of a list.
        """
        fields = self.redrawn or (self.model,)
        position = rng.uniform(self.low, self.high, (count, len(self.low)))
        centre = rng.uniform(-0.5, 0.5, (count, 2))
        # The field's image at this place, of one field after the other.
        images = np.empty((count, self.side, self.side))
        for number, field in enumerate(fields):
            rows = slice(number, None, len(fields))
            images[rows] = field.images(field.terms(position[rows]), centre[rows], self.side)
        images /= images.sum(axis=(1, 2), keepdims=True)
        # The residual e ~ N(offset, C) at the phase of the centre: modes and diagonal.
        phases = phases_of(self.step_px)
        for number in range(count):
            phase, window = phase_of(centre[number], phases, self.side)
            modes, variance = self.modes[phase][:, window], self.diagonal[phase, window]
            residual = self.offset[phase, window] + rng.normal(size=len(modes)) @ modes
            residual = residual + rng.normal(size=len(window)) * np.sqrt(variance)
            images[number] += residual.reshape(self.side, self.side)
        # Light that looks like sky.
        images += self.unknown_light * rng.normal(size=(count, 1, 1)) / images[0].size
        images /= images.sum(axis=(1, 2), keepdims=True)
        return images, position, centre - self.list_offset

    def fitted_flux_error(self) -> tuple[float, tuple[float, ...]]:
        """Standard error, over the flux, of a fit of the PSF to a star on a known sky.

        Of a star m' of another field, the model m finds the flux Σ m m' / Σ m². The variance is the
        sum of two: by fields of other noise, and by fields of other stars, which has what
        neighbours do to their stars, too. Either alone is too small for bright stars
        (`tests/test_stated_errors.py`): no field has what the polynomial cannot follow.

        Returns
        -------
        error : float
            RMS over the field; 0 of a fit that was stored.
        growth : tuple of 6 floats, or of none
            How the variance grows with the place (`psfdae.model.error_model.ModelErrors`): towards
            the edge of the field, fewer stars say what the PSF is.
        """
        from scipy.optimize import nnls

        # 5 × 5 places over the field; magnitude and colour are in the middle of their range.
        axes = np.linspace(self.low[:2], self.high[:2], 5).T
        place = np.full((25, 4), np.nan)
        place[:, :2] = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)

        def psfs(model: FieldModel) -> np.ndarray:
            images = model.images(model.terms(place), np.zeros((1, 2)), self.side)
            return np.asarray(images / images.sum(axis=(1, 2), keepdims=True))

        psf = psfs(self.model)

        def variance(models: Sequence[FieldModel]) -> np.ndarray:
            """Return the mean squared error of the flux at each place, (25,)."""
            flux = [(psf * psfs(other)).sum(axis=(1, 2)) for other in models]
            ratio = flux / np.square(psf).sum(axis=(1, 2))
            return np.asarray(np.square(ratio - 1.0).mean(axis=0))

        variances = [variance(models) for models in (self.redrawn, self.parted) if models]
        if not variances:
            return 0.0, ()
        # The mean over the field by the trapezoidal rule: half of what is at an edge counts.
        total = np.sum(variances, axis=0)
        edge = np.array([0.5, 1.0, 1.0, 1.0, 0.5]) / 4.0
        mean = float(total @ np.outer(edge, edge).ravel())
        # v = a + b u² + c w² + d u² w² by least squares, none below 0: few fields scatter.
        middle = axes.mean(axis=1)
        u2, w2 = np.square(place[:, :2] - middle).T
        unit = np.maximum(np.square(axes[:, -1] - middle), 1e-6)  # of one place, no growth
        terms = np.stack([np.ones(25), u2 / unit[0], w2 / unit[1], u2 * w2 / unit.prod()], axis=1)
        if not mean > 0:
            return 0.0, ()
        growth = nnls(terms, total / mean)[0] / [1.0, *unit, unit.prod()]
        return float(np.sqrt(mean)), tuple(float(number) for number in [*middle, *growth])

    def free_flux(self) -> Self:
        """Return the form of this method that measures flux and sky."""
        return replace(self, measures_flux=True)

    def psf_at(self, position: np.ndarray, oversampling: int = 1) -> np.ndarray:
        """Return the field's PSFs at positions, as `FieldModel.images` draws them.

        The star lies at its sub-pixel phase in the middle pixel. Its flux is that for which a star
        in the middle of its pixel has the sum 1 in its stamp: a PSF keeps its flux where it moves
        with its star, as it does in photometry, though some light then crosses the stamp's edge.

        Parameters
        ----------
        position : ndarray, shape (n, 2) to (n, 4)
            x, y, magnitude and colour, as in the star list of the training; the PSF is the mean
            one with respect to what is NaN.
        oversampling : int

        Returns
        -------
        ndarray, shape (n, m, m)
        """
        terms = self.terms(position)[0]
        phase = (position - np.floor(position + 0.5))[:, 1::-1]
        images = self.model.images(terms, phase + self.list_offset, self.side, oversampling)
        centred = np.broadcast_to(self.list_offset, phase.shape)
        total = self.model.images(terms, centred, self.side).sum(axis=(1, 2), keepdims=True)
        return np.asarray(images / total)

    def is_out_of_range(self, position: np.ndarray) -> np.ndarray:
        """Return which stars are brighter, fainter, bluer or redder than all training stars, (n,).

        `position` has x, y, magnitude and colour (n, 4). Those count with which the PSF changes,
        and 2 % of the range beyond its ends are allowed: a training star may be measured there.
        """
        value, low, high = (a[..., self.model.of_star] for a in (position, self.low, self.high))
        slack = 0.02 * (high - low)
        return np.asarray(((value < low - slack) | (value > high + slack)).any(axis=1))

    def facts(self) -> dict[str, str]:
        """Return titles and sentences about the field: how the PSF changes, and with what."""
        order = self.order
        changes = f"changes over the image by a polynomial of order {order}"
        constant = "is the same everywhere (order 0: more is not supported by stars left out)"
        facts = {"Field": f"the PSF {changes if order else constant}"}
        names = {
            2: ("Brightness", "magnitude −2.5 log₁₀ (flux / counts)"),
            3: ("Colour", "colour of the star list"),
        }
        for coordinate in self.model.of_star.tolist():
            name, quantity = names[coordinate]
            low, high = self.low[coordinate], self.high[coordinate]
            facts[name] = (
                f"the PSF changes with the {quantity}, {low:.2f} to {high:.2f}; stars beyond this "
                "range have the PSF of its end"
            )
        return facts

    def predict(
        self, noisy: np.ndarray, level: float | np.ndarray, position: np.ndarray | None = None
    ) -> np.ndarray:
        """Return the PSFs of `estimate`, which has parameters and errors."""
        return self.estimate(noisy, level, position).psf

    def estimate(
        self, noisy: np.ndarray, level: float | np.ndarray, position: np.ndarray | None = None
    ) -> Estimate:
        """Return PSFs, their standard deviation, and the evidence of every image.

        The images have flux 1 and no sky, unless this is the form of `free_flux`, which measures
        both.

        Parameters
        ----------
        noisy : ndarray, shape (n, d, d)
        level : float or ndarray, shape (n,)
            Noise level λ.
        position : ndarray, shape (n, 2) to (n, 4), optional
            NaN where unknown.

        Raises
        ------
        ValueError
            If a pixel is not finite.
        """
        count, pixels = len(noisy), noisy[0].size
        # A star's photons count as if they were spread evenly over the stamp.
        even_star = np.full(count, 1.0 / pixels)
        noise = np.sqrt(self.noise.variance(even_star, np.asarray(level)))
        flux = None if self.measures_flux else np.ones(count)
        sky = None if self.measures_flux else np.zeros(count)
        return self.measure(noisy, noise, position, flux=flux, sky=sky)

    def measure(
        self,
        stamps: np.ndarray,
        noise: np.ndarray,
        position: np.ndarray | None = None,
        centre: np.ndarray | None = None,
        fixed: bool | np.ndarray = False,
        flux: np.ndarray | None = None,
        sky: np.ndarray | None = None,
        gain: np.ndarray | None = None,
    ) -> Estimate:
        """Return the posterior of PSF, flux, sky and centre of every star.

        Parameters
        ----------
        stamps : ndarray, shape (n, d, d)
            In any unit; the sky may be roughly subtracted.
        noise : ndarray, shape (n,)
            RMS of a pixel, all photons spread evenly.
        position : ndarray, shape (n, 2) to (n, 4), optional
            (x, y) in the field, magnitude and colour; NaN where unknown.
        centre : ndarray, shape (n, 2), optional
            (row, column) in a star list, from pixel (d//2, d//2); NaN where there is none.
        fixed : bool or ndarray of bool, shape (n,)
            The listed centres of these stars are exact.
        flux, sky : ndarray, shape (n,), optional
            Known values; NaN where they are to be measured.
        gain : ndarray, shape (n,), optional
            Electrons per unit of the stamps, by which the errors have the star's photons where they
            are; NaN where unknown.

        Raises
        ------
        ValueError
            If a pixel is not finite, or the stamps have another size.
        """
        count = len(stamps)
        images = np.asarray(stamps, np.float64).reshape(count, -1)
        if images.shape[1] != self.side**2:
            raise ValueError(f"stamps of {images.shape[1]} px, expected {self.side**2}")
        if not np.isfinite(images).all():
            raise ValueError("stamps must be finite")
        unknown = np.full(count, np.nan)
        flux, sky = (unknown if a is None else a for a in (flux, sky))
        # Centres of the list in the coordinates of the field's centres.
        listed = np.full((count, 2), np.nan) if centre is None else centre
        if len(self.listed) and np.isfinite(self.listed).all():
            listed = listed + self.listed[0]
        terms, position_known = self.terms(position, count)
        sky_level = np.nan_to_num(sky)
        stars = FieldStamps(
            images=images - sky_level[:, None],
            noise=np.broadcast_to(noise, count),
            terms=terms,
            position_known=True,
            log_prior=self.log_prior(listed),
            centre=None,
            flux=flux,
            sky_known=np.isfinite(sky),
            unit_per_electron=np.zeros(count) if gain is None else np.nan_to_num(1.0 / gain),
            cell_sigma_px=np.full(count, self.cell_sigma_px),
            unit=np.ones(count),
        )
        # Stars of known and unknown centre, and of known and unknown position, one after the other.
        centre_known = np.isfinite(listed).all(axis=1) & fixed
        posterior = StarPosterior.empty(count, images.shape[1])
        for has_centre, has_position in np.ndindex(2, 2):
            rows = np.flatnonzero((centre_known == has_centre) & (position_known == has_position))
            parts = -(-rows.size // self.limits.stars_at_once)
            for batch in np.array_split(rows, parts) if parts else []:
                selected = stars.select(batch)._replace(position_known=bool(has_position))
                if has_centre:
                    # One node, the nearest one, which is taken to be at exactly this centre.
                    known = listed[batch]
                    nearest = np.square(self.places - known[:, None]).sum(axis=-1).argmin(axis=1)
                    is_nearest = np.arange(len(self.places)) == nearest[:, None]
                    selected = selected._replace(
                        centre=known,
                        log_prior=np.where(is_nearest, 0.0, -np.inf),
                        cell_sigma_px=np.zeros(len(batch)),
                    )
                posterior.set(batch, star_posterior(self, selected))
        measured = Measured(
            flux=posterior.flux,
            background=posterior.sky + sky_level,
            centre=posterior.centre - self.list_offset,
            covariance=posterior.covariance,
        )
        return Estimate(
            psf=posterior.psf.reshape(stamps.shape).astype(np.float32),
            sigma=posterior.psf_sigma.reshape(stamps.shape).astype(np.float32),
            evidence=posterior.log_evidence,
            measured=measured,
            outlier_score=posterior.mahalanobis2,
        )


def _residuals(
    fit: FieldFit, noise: np.ndarray, settings: FieldSettings, step_px: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return mean, modes and diagonal of the residual covariance C at every phase of a pixel.

    Parameters
    ----------
    fit : FieldFit
    noise : ndarray, shape (n,)
        RMS of a pixel of each good star, over its flux.
    settings : FieldSettings
    step_px : float
        Distance of two nodes.

    Returns
    -------
    offset : ndarray, shape (f², w²)
        Mean residual at each of the f² phases, in frames of w² pixels.
    modes : ndarray, shape (f², r, w²)
    diagonal : ndarray, shape (f², w²)
    """
    residual, centre = fit.residual[fit.good], fit.centre[fit.good]
    side = residual.shape[-1]
    # Weight of a star: which part of its residual is not noise, signal / (signal + noise).
    core = residual[:, 1:-1, 1:-1]
    noise_square = noise**2 * core[0].size
    signal = np.median(np.maximum(np.square(core).sum(axis=(1, 2)) - noise_square, 0.0))
    weight = (signal + 1e-12) / (signal + 1e-12 + noise_square)
    weight /= weight.sum()
    # Splines that move an image average its noise: half of the variance is left, which is no part
    # of C.
    noise_variance = 0.5 * float(weight @ noise**2)
    # Matrices that move the star from its centre to each phase, along rows and columns.
    shifts = phases_of(step_px)[:, None, None] - centre
    rows, columns = (
        np.array([moving_matrices(side, row) for row in shifts[..., axis]]) for axis in (0, 1)
    )
    columns = columns.transpose(0, 1, 3, 2)
    covariances = []
    for row in steps("residuals", rows):
        shifted_rows = row @ residual
        for column in columns:
            shifted = (shifted_rows @ column).reshape(len(residual), -1)
            # Principal components of the residuals, their variances less that of noise.
            mean = weight @ shifted
            scatter = np.sqrt(weight)[:, None] * (shifted - mean)
            _, size, axes = np.linalg.svd(scatter, full_matrices=False)
            modes = np.sqrt(np.maximum(size**2 - noise_variance, 0.0))[:, None] * axes
            # The leading ones are modes, a part of their variance and all other components the
            # diagonal: of few stars, modes are not the directions of all stars.
            variance = np.square(modes).sum(axis=0)
            modes = np.sqrt(1.0 - settings.diagonal) * modes[: settings.modes]
            diagonal = variance - np.square(modes).sum(axis=0)
            # No pixel is much surer than the others: 1 % of their mean variance at least.
            covariances.append((mean, modes, np.maximum(diagonal, 0.01 * diagonal.mean())))
    offset, all_modes, diagonals = (np.stack(arrays) for arrays in zip(*covariances, strict=True))
    # An error of 1e-6 of the flux in any pixel keeps C invertible.
    return offset, all_modes, np.maximum(diagonals, 1e-6**2)


def _list_error(offset_px: np.ndarray) -> np.ndarray:
    """Return median and robust RMS of fitted less listed centres (n, 2), shape (2, 2).

    NaN if fewer than five stars have a listed centre. The RMS is at least 0.05 px.
    """
    offset_px = offset_px[np.isfinite(offset_px).all(axis=1)]
    if len(offset_px) < 5:
        return np.full((2, 2), np.nan)
    scatter = np.maximum(robust_scatter(offset_px), 0.05)
    return np.stack([np.median(offset_px, axis=0), scatter])
