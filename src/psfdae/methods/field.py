"""A mixture over sub-pixel centres about a model of the field, for stars of an image.

The law of the stars is in `psfdae.field_law`; here it is fitted to bright stars, stored, and
applied to stamps.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike

from psfdae.bright_stars import BrightStars
from psfdae.field_law import (
    MARGIN_PX,
    FieldLaw,
    FieldSettings,
    FieldStamps,
    StarPosterior,
    batches_of,
    node_step,
    phase_of,
    phases_of,
)
from psfdae.field_psf import FieldFit, FieldModel, fit_field, refit_field
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
from psfdae.moments import measure_shapes, moving_matrices, robust_scatter
from psfdae.noise import NoiseModel
from psfdae.progress import steps
from psfdae.rng import stream

OWN_NOISE = 0.5
"""Part of the variance of bright stars' own noise that is left when splines have moved them."""

LEAST_LIST_ERROR_PX = 0.05
"""Least RMS that listed centres are taken to have."""

LEAST_DIAGONAL, LEAST_ERROR = 0.01, 1e-6
"""Least diagonal of C over its mean, and least error of any pixel over the flux."""

LEAST_LISTED = 5
"""Stars with listed centres that are needed to measure the error of a list."""

RANGE_SLACK = 0.02
"""Part of the range of magnitudes or colours by which a star of the training may seem beyond it."""

PACKED_BYTES = 3e6
"""Largest size of the residuals in a bundle."""


@dataclass(frozen=True, eq=False)
class FieldMixture(FieldLaw, Method):
    """A fitted field with the residuals of its stars.

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
    groups: ClassVar = {"field": FieldSettings}

    @classmethod
    def fit(cls, data: TrainingSet, field: FieldSettings) -> Self:
        """The field of the training stars, and what it leaves of them.

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
        usual = fit.model.images(terms.mean(axis=0)[None], np.zeros((1, 2)), side)
        step = node_step(float(measure_shapes(usual).fwhm_px[0]), field.step_px)
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
        """This model for another exposure of the same field, by its few bright stars.

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
        """Estimator of a bundle; noise and settings are those of the configuration.

        Settings that this release does not know change no number of a fit that is done.
        """
        noise = NoiseModel(config["noise"]["kappa"], config["noise"]["background_photons"])
        named: dict[str, Any] = {**arrays, "modes": arrays["modes"].astype(np.float32)}
        known = {k: v for k, v in config["field"].items() if k in FieldSettings.model_fields}
        settings = FieldSettings.model_validate(known)
        return cls(**named, noise=noise, settings=settings)

    def pack(self, stamp_px: int, noise: float) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Arrays for a bundle: of large stamps fewer modes, the others join the diagonal."""
        arrays, said = super().pack(stamp_px, noise)
        phases, most, pixels = self.modes.shape
        kept = min(most, max(1, int(PACKED_BYTES // (2 * phases * pixels))))
        arrays["diagonal"] = self.diagonal + np.square(self.modes[:, kept:]).sum(axis=1)
        arrays["modes"] = self.modes[:, :kept].astype(np.float16)
        # What no list said is left out: bundles hold numbers.
        arrays["listed"] = self.listed if np.isfinite(self.listed).all() else np.empty((0, 2))
        return arrays, said

    def conditions(self) -> Iterator[tuple[str, str, ArrayLike]]:
        """Conditions that any fit fulfils: a mean star of the sum 1, residuals smaller than it."""
        terms, spread = len(self.coefficients), self.spread
        usual = self.model.images(self.usual[None], np.zeros((1, 2)), self.side)
        yield "coefficients", "a mean star of the sum 1", abs(usual.sum() - 1) < 0.1
        alike = self.low.shape == self.high.shape and 2 <= len(self.low) <= 4
        yield "high", "at least low", alike and self.low <= self.high
        yield "usual", "terms from -1 to 1", self.usual.shape == (terms,) and abs(self.usual) <= 1
        least = np.linalg.eigvalsh(spread)[0] if spread.shape == (terms, terms) else -1.0
        yield "spread", "a covariance", (spread == spread.T) & (least > -1e-6)
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
        return images, position, centre - self._list_offset

    def fitted_flux_error(self) -> float:
        """Standard error, over the flux, of a fit of the PSF to a star on a known sky.

        Of a star m' of another field, the model m finds the flux Σ m m' / Σ m². The error is the
        larger one of two: by fields of other noise, and by fields of other stars, which has what
        neighbours do to their stars, too. 0 of a fit that was stored.
        """
        # 5 × 5 places over the field; magnitude and colour are in the middle of their range.
        axes = np.linspace(self.low[:2], self.high[:2], 5).T
        place = np.full((25, 4), np.nan)
        place[:, :2] = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)

        def psfs(model: FieldModel) -> np.ndarray:
            images = model.images(model.terms(place), np.zeros((1, 2)), self.side)
            return np.asarray(images / images.sum(axis=(1, 2), keepdims=True))

        psf = psfs(self.model)

        def error(models: Sequence[FieldModel]) -> float:
            flux = [(psf * psfs(other)).sum(axis=(1, 2)) for other in models]
            return float(np.sqrt(np.square(flux / np.square(psf).sum(axis=(1, 2)) - 1.0).mean()))

        return max((error(models) for models in (self.redrawn, self.parted) if models), default=0.0)

    def free_flux(self) -> Self:
        """The form that finds flux and sky."""
        return replace(self, measures_flux=True)

    def psf_at(self, position: np.ndarray, oversampling: int = 1) -> np.ndarray:
        """The field's PSFs (n, m, m) at positions, as `FieldModel.images` draws them.

        Positions, which may have magnitudes and colours (n, 4), are meant as those of the list of
        the training, and what is not known of them as usual. Stars lie in their sub-pixel phase
        beside the middle, which is the pixel of their position. Their flux is that for which a
        star in the middle of its pixel has the sum 1 in its stamp: a PSF keeps it where it moves
        with its star, as it does in photometry, though some light then crosses the stamp's edge.
        """
        terms = self._terms(position)[0]
        phase = (position - np.floor(position + 0.5))[:, 1::-1]
        images = self.model.images(terms, phase + self._list_offset, self.side, oversampling)
        whole = self.model.images(terms, np.broadcast_to(self._list_offset, phase.shape), self.side)
        return np.asarray(images / whole.sum(axis=(1, 2), keepdims=True))

    def beyond(self, position: np.ndarray) -> np.ndarray:
        """Whether magnitude or colour of stars (n, 4) are beyond the training's, if they count."""
        value, low, high = (a[..., self.model.of_star] for a in (position, self.low, self.high))
        slack = RANGE_SLACK * (high - low)
        return np.asarray(((value < low - slack) | (value > high + slack)).any(axis=1))

    def facts(self) -> dict[str, str]:
        """The polynomial of the field."""
        order = self.order
        changes = f"changes over the image by a polynomial of order {order}"
        same = "is the same everywhere (order 0: more is not supported by stars left out)"
        facts = {"Field": f"the PSF {changes if order else same}"}
        names = {
            2: ("Brightness", "magnitude −2.5 log₁₀ (flux / counts)"),
            3: ("Colour", "colour of the star list"),
        }
        for coordinate in self.model.of_star.tolist():
            name, what = names[coordinate]
            low, high = self.low[coordinate], self.high[coordinate]
            facts[name] = (
                f"the PSF changes with the {what}, {low:.2f} to {high:.2f}; stars beyond this "
                "range have the PSF of its end"
            )
        return facts

    def predict(
        self, noisy: np.ndarray, level: float | np.ndarray, position: np.ndarray | None = None
    ) -> np.ndarray:
        """PSFs; raises as `estimate`."""
        return self.estimate(noisy, level, position).psf

    def estimate(
        self, noisy: np.ndarray, level: float | np.ndarray, position: np.ndarray | None = None
    ) -> Estimate:
        """PSFs, their standard deviation, and the evidence of every image.

        Flux and sky are known unless `free_flux` says otherwise. Positions that are NaN are
        not known.

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
        """PSF, flux, sky and centre of every star.

        Parameters
        ----------
        stamps : ndarray, shape (n, d, d)
            In any unit; the sky may be roughly subtracted.
        noise : ndarray, shape (n,)
            RMS of a pixel, all photons spread evenly.
        position : ndarray, shape (n, 2) to (n, 4), optional
            (x, y) in the field, magnitude and colour; NaN where unknown.
        centre : ndarray, shape (n, 2), optional
            (row, column) that a list says, from pixel (d//2, d//2); NaN where none does.
        fixed : bool or ndarray of bool, shape (n,)
            These are taken as they are, where there are any.
        flux, sky : ndarray, shape (n,), optional
            Those that are known; NaN where they are to be found.
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
        terms, position_known = self._terms(position, count)
        sky_level = np.nan_to_num(sky)
        stars = FieldStamps(
            images=images - sky_level[:, None],
            noise=np.broadcast_to(noise, count),
            terms=terms,
            position_known=True,
            log_prior=self._prior(listed),
            centre=None,
            flux=flux,
            sky_known=np.isfinite(sky),
            unit_per_electron=np.zeros(count) if gain is None else np.nan_to_num(1.0 / gain),
            cell_sigma_px=np.full(count, self.cell_sigma_px),
        )
        # Stars of known and unknown centre, and of known and unknown position, one after the other.
        centre_known = np.isfinite(listed).all(axis=1) & fixed
        posterior = StarPosterior.empty(count, images.shape[1])
        for has_centre, has_position in np.ndindex(2, 2):
            rows = np.flatnonzero((centre_known == has_centre) & (position_known == has_position))
            for batch in batches_of(rows):
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
                posterior.set(batch, self._posterior(selected))
        measured = Measured(
            flux=posterior.measurement[:, 0],
            background=posterior.measurement[:, 1] + sky_level,
            centre=posterior.measurement[:, 2:] - self._list_offset,
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
    """Mean, modes and remaining variance of the residuals in every phase of a pixel.

    Splines move them there. A star counts by how much of its residual is no `noise` (n,),
    which is the RMS of a pixel of flux 1, and what noise adds to their scatter is taken off.
    """
    residual, centre = fit.residual[fit.good], fit.centre[fit.good]
    side = residual.shape[-1]
    inner = residual[:, 1:-1, 1:-1]
    own = noise**2 * inner[0].size
    signal = np.median(np.maximum(np.square(inner).sum(axis=(1, 2)) - own, 0.0))
    weight = (signal + 1e-12) / (signal + 1e-12 + own)
    weight /= weight.sum()
    left = OWN_NOISE * float(weight @ noise**2)
    shifts = phases_of(step_px)[:, None, None] - centre
    rows, columns = (
        np.array([moving_matrices(side, row) for row in shifts[..., axis]]) for axis in (0, 1)
    )
    columns = columns.transpose(0, 1, 3, 2)
    found = []
    for row in steps("residuals", rows):
        half = row @ residual
        for column in columns:
            moved = (half @ column).reshape(len(residual), -1)
            mean = weight @ moved
            scatter = np.sqrt(weight)[:, None] * (moved - mean)
            _, size, axes = np.linalg.svd(scatter, full_matrices=False)
            modes = np.sqrt(np.maximum(size**2 - left, 0.0))[:, None] * axes
            variance = np.square(modes).sum(axis=0)
            modes = np.sqrt(1.0 - settings.diagonal) * modes[: settings.modes]
            diagonal = variance - np.square(modes).sum(axis=0)
            found.append((mean, modes, np.maximum(diagonal, LEAST_DIAGONAL * diagonal.mean())))
    offset, all_modes, diagonals = (np.stack(arrays) for arrays in zip(*found, strict=True))
    return offset, all_modes, np.maximum(diagonals, LEAST_ERROR**2)


def _list_error(off: np.ndarray) -> np.ndarray:
    """Median and robust RMS of distances (n, 2) from a list; NaN if there was none."""
    known = off[np.isfinite(off).all(axis=1)]
    if len(known) < LEAST_LISTED:
        return np.full((2, 2), np.nan)
    scatter = np.maximum(robust_scatter(known), LEAST_LIST_ERROR_PX)
    return np.stack([np.median(known, axis=0), scatter])
