"""`StarModel`: a model of the PSF, with the call that denoises stars.

Inputs: stamps, or an image with its star list. Outputs: a `Prediction` with PSFs, their errors,
fluxes and flags. The steps are in `psfdae.denoise.denoiser`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from html import escape
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike
from pydantic import NonNegativeInt, PositiveInt

from psfdae.base.arguments import check_arguments
from psfdae.base.errors import call, keyword
from psfdae.base.progress import task
from psfdae.base.threads import available_cores, run_ordered, run_parallel, use_one_thread_each
from psfdae.denoise.bundle import Bundle, estimator, read_bundle, write_bundle
from psfdae.denoise.denoiser import make_denoiser
from psfdae.denoise.description import error_table, model_facts
from psfdae.denoise.error_model import ErrorModel
from psfdae.denoise.prediction import Prediction
from psfdae.denoise.stamp_arrays import make_stamps
from psfdae.image.detector_frame import find_offset
from psfdae.image.image import Image
from psfdae.image.observation import Observation
from psfdae.image.stamps import Stamps
from psfdae.image.tables import html_table
from psfdae.methods.bundle_info import BundleInfo
from psfdae.methods.field.prior import FieldPrior
from psfdae.methods.interface import Method
from psfdae.psf.interface import FieldPsfs, PredictionError
from psfdae.psf.wings import Wings

SCALE_TOLERANCE = 0.02
"""Relative difference of pixel scales up to which they are the same."""


class StarModel(FieldPsfs):
    """Fitted method with the flux model, error model and limits that denoising needs.

    Parameters
    ----------
    bundle : Bundle
        Contents of a model file; `load` reads them.
    method : Method, optional
        Fitted method of the bundle; by default it is built from the arrays of the bundle.
    """

    margin_px: ClassVar[int] = 2
    """Largest shift, in pixels, that moves a star of an image to the middle of its stamp."""

    max_stars_read: ClassVar[int] = 1024
    """Stars of an image that are read at a time; fewer if their stamps are large."""

    def __init__(self, bundle: Bundle, method: Method | None = None) -> None:
        self.bundle = bundle
        self.denoiser = make_denoiser(bundle, estimator(bundle) if method is None else method)
        self.name, self.stamp_px = bundle.info.name, bundle.info.stamp_px

    @classmethod
    def load(cls, path: str | Path | None = None) -> Self:
        """Read a model from its file, by default the one that comes with the package.

        Raises
        ------
        BundleError
            If the file is missing, damaged, of a newer format, or not a model.
        PredictionError
            If it describes a telescope.
        MissingExtraError
            If the model is a network and torch is not installed.
        """
        if path is not None and Path(path).suffix in (".yaml", ".yml"):
            wavefront = call("psfdae.wavefront", f"psfdae wavefront INPUT --telescope {path}")
            raise PredictionError(
                f"{path}: describes a telescope, not a model; {wavefront} measures the "
                "wavefronts of its stars, and gives their PSFs"
            )
        return cls(read_bundle(None if path is None else Path(path)))

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle and copy the bundle alone, from which everything else is built."""
        return type(self), (self.bundle,)

    def __repr__(self) -> str:
        info = self.info
        return (
            f"{type(self).__name__}({info.name!r}, {info.stamp_px}×{info.stamp_px} px of "
            f'{info.pixel_scale_arcsec:g}", S/N {info.snr_min:.3g} … {info.snr_max:.3g})'
        )

    def _repr_html_(self) -> str:
        """Return the facts on use and training in `psfdae describe` as HTML, for a notebook."""
        # Facts on the file and on conventions are left to the command.
        left_out = {"Name", "Written", "Licence", "SHA-256", "Framing", "Normalisation"}
        left_out |= {"Noise-equivalent area", "Flagged as unlike"}
        facts = model_facts(self.bundle).items()
        rows = [(name, escape(fact)) for name, fact in facts if name not in left_out]
        tables = [html_table([type(self).__name__, self.name], rows)]
        # Errors of the test stars, if there were any.
        if (errors := error_table(self.info)) is not None:
            tables.append(html_table(errors.colnames, [tuple(row) for row in errors]))
        return "".join(tables)

    def replace_errors(self, errors: ErrorModel) -> Self:
        """Return the same model with another error model."""
        return type(self)(replace(self.bundle, errors=errors), self.method)

    @property
    def info(self) -> BundleInfo:
        """Stamp size, pixel scale, range of S/N and the other metadata of the bundle."""
        return self.bundle.info

    @property
    def method(self) -> Method:
        """Fitted method that denoises the stars."""
        return self.denoiser.method

    @check_arguments
    def save(self, path: str | Path) -> None:
        """Write the model to a file, by convention NAME.psf.safetensors, for `load_model`."""
        write_bundle(self.bundle, Path(path))

    @check_arguments
    def predict(
        self,
        stamps: ArrayLike,
        *,
        flux: ArrayLike | None = None,
        background: ArrayLike | None = None,
        noise: ArrayLike | None = None,
        bad: ArrayLike | None = None,
        saturated: ArrayLike | None = None,
        gain: ArrayLike | None = None,
        position: ArrayLike | None = None,
        centre: ArrayLike | None = None,
        fixed: bool = False,
        margin: NonNegativeInt = 0,
        threads: PositiveInt | None = 1,
    ) -> Prediction:
        """Return the PSFs of stars, with uncertainties, photometry, shapes and flags.

        Stars do not influence each other. The number of threads does not change a result; how many
        stars are passed at once changes it at most at the level of rounding.

        Parameters
        ----------
        stamps : array, masked array, Quantity or NDData, shape (n, s, s) or (s, s)
            Stars in any unit, sky included, with the pixel scale `info.pixel_scale_arcsec` and
            s = `info.stamp_px` + 2 `margin`. The brightest pixel is near [s/2, s/2] (0-based).
            Masked pixels are bad. If `noise` is not given, it is the median of an NDData's σ in
            the stamp.
        flux, background, noise : float or array, shape (n,), optional
            Flux inside the stamp, sky level and RMS of the sky noise in a pixel, in
            the unit of the stamps. Values that are not given, or NaN, are estimated.
        bad, saturated : array of bool, shape of the stamps, optional
            Pixels that must not be used; pixels that are not finite are never used.
        gain : float or array, shape (n,), optional
            Electrons per unit of the stamps: adds the star's photon noise to `chi2`
            and `flux_error`.
        position : array, shape (n, 2) to (n, 4), optional
            (x, y) of the stars in the training image, 0-based pixel coordinates; NaN where
            unknown. The third column is the magnitude −2.5 log₁₀ (flux / counts), by default of
            the flux in the stamp, and the fourth the colour; they are used if the PSF of the
            training stars changes with their brightness and colour.
        centre : array, shape (n, 2), optional
            Listed centres (x, y) of the stars, in pixels from index s//2; NaN where unknown.
            Only models that measure centres (`psfdae.methods.field`) use `position` and `centre`.
        fixed : bool
            True if these centres are exact, and are not fitted.
        margin : int
            Additional pixels on each side of the stamps, by which a star may be moved to centre it.
        threads : int, optional
            Number of threads; None uses all cores.

        Returns
        -------
        Prediction
            One row per star, flagged stars included.

        Raises
        ------
        PredictionError
            If shapes or types do not fit.
        """
        # Check the arrays, and convert them to stamps.
        side = self.stamp_px + 2 * margin
        numbers = {"flux": flux, "background": background, "noise": noise, "gain": gain}
        masks = {"bad": bad, "saturated": saturated}
        stars, unit = make_stamps(stamps, side, self.name, numbers, masks, position, centre)
        # Blocks of stars are denoised in parallel; each star as if it were alone.
        blocks = stars.split(self.denoiser.block_size)
        threads = min(threads or available_cores(), len(blocks))
        with use_one_thread_each():
            parts = run_parallel(lambda block: self.denoiser.denoise(block, fixed), blocks, threads)
        return replace(Prediction.joined(parts), unit=unit)

    def stream(
        self, observation: Observation, threads: int | None = None, fixed: bool = False
    ) -> Iterator[tuple[Stamps, Prediction]]:
        """Yield chunks of the stars of an observation, in their order, with predictions.

        Only a few chunks are in memory at a time. Listed centres are exact if `fixed`. By default,
        all cores are used.
        """
        # Stamps are read in chunks; one thread denoises the blocks of a chunk.
        denoiser = self.to_image_frame(observation)[0].denoiser
        size = denoiser.block_size

        def predict_chunk(stamps: Stamps) -> Prediction:
            blocks = stamps.split(size)
            return Prediction.joined([denoiser.denoise(block, fixed) for block in blocks])

        chunks = observation.chunks(max(size, min(self.max_stars_read, 4 * size)))
        list_columns, start = observation.list_columns, 0
        with use_one_thread_each(), task("stars", observation.count) as advance:
            for stamps, prediction in run_ordered(
                predict_chunk, chunks, threads or available_cores()
            ):
                # Add the columns of the star list for the rows of these stars.
                rows = slice(start, start + len(prediction))
                start = rows.stop
                # Sky coordinates of the fitted centre if the model measures one, else of the list.
                x = np.where(np.isfinite(prediction.x_fit), prediction.x_fit, prediction.x)
                y = np.where(np.isfinite(prediction.y_fit), prediction.y_fit, prediction.y)
                prediction_on_sky = replace(
                    prediction,
                    columns=prediction.columns | observation.sky_columns(x, y),
                    list_columns=None if list_columns is None else list_columns[rows],
                    unit=observation.unit,
                )
                yield stamps, prediction_on_sky
                advance(len(prediction))

    @property
    def sha256(self) -> str:
        """SHA-256 of the bundle."""
        return self.bundle.sha256

    @property
    def order(self) -> int:
        """Order of the field's polynomial; raises as `psf_at`."""
        return self._field().order

    @property
    def wings(self) -> Wings | None:
        """Light of stars outside their stamps, if the bundle has it."""
        return self.denoiser.wings

    def flux_error(self, position: np.ndarray) -> np.ndarray:
        """Return the relative flux errors of stars at positions (n, 2), x and y, due to the PSF.

        They are standard errors over the flux, shape (n,), for stars whose sky comes from the sky
        map. In the middle of the field they are at least the RMS over the whole field: the sky map
        has errors there, too, which the model of the field does not include.
        """
        errors = self.bundle.errors.model_errors
        return np.asarray(errors.fitted_flux * np.maximum(errors.flux_factor(position), 1.0))

    @property
    def image_px(self) -> tuple[int, int] | None:
        """Columns and rows of the image of the training stars, if the bundle has it."""
        size = self.info.config.get("stars", {}).get("image_px")
        return None if size is None else (size[0], size[1])

    def field_range(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the minimum and maximum (x, y) of the training stars; raises as `psf_at`."""
        self._field()
        # The field's polynomial has its range in its arrays.
        low, high = (np.asarray(self.bundle.weights[name][:2]) for name in ("low", "high"))
        # Both limits are 0 for stars without positions, and equal for a single star.
        if not ((high > low) | ((high == low) & (low != 0))).all():
            raise PredictionError(f"the model {self.name!r} knows no positions of its stars")
        return low, high

    @property
    def magnitude_range(self) -> tuple[float, float] | None:
        """Minimum and maximum magnitude between which the PSF changes; None if it does not."""
        if not self.method.knows_field:
            return None
        low, high = (self.bundle.weights[name].tolist() for name in ("low", "high"))
        return (low[2], high[2]) if len(low) > 2 and high[2] > low[2] else None

    def _field(self) -> Method:
        """Return the method as one that knows the PSF at every position in the field."""
        field = self.method
        if not field.knows_field:
            training = call("psfdae.fit with method='field'", "psfdae train --method field")
            raise PredictionError(
                f"the model {self.name!r}: {field.look.title}: knows the PSF of a star alone, "
                f"not the PSF of a position; {training} makes one that does"
            )
        return field

    def residual_variance(self, side_px: int) -> float:
        """Return the mean variance of stars about the field model, in the middle of the stamp."""
        if not isinstance(self.method, FieldPrior):
            return np.nan
        # Covariance of the residuals of stars of flux 1 in the middle of their pixel (eq. 6): a
        # diagonal, and modes, whose squares are variances.
        _, modes, diagonal = self.method.residuals_at(np.zeros(2))
        variance = (np.square(modes).sum(axis=0) + diagonal).reshape(self.stamp_px, -1)
        begin = self.stamp_px // 2 - side_px // 2
        middle = slice(max(begin, 0), begin + side_px)
        return float(variance[middle, middle].mean())

    def draw_psfs(self, position: np.ndarray, oversampling: int) -> np.ndarray:
        """Return the PSFs of flux 1 at positions (n, 2 to 4), as `FieldPsfs` defines it."""
        return self._field().psf_at(position, oversampling)

    def to_image_frame(self, observation: Observation) -> tuple[Self, list[str]]:
        """Return the model in the pixel frame of an image, and warnings if the frames differ."""
        size = self.image_px
        if not self.method.knows_field or size is None or not isinstance(observation, Image):
            return self, []
        # Frames of both images; models of older releases do not have one.
        sizes = np.array(observation.shape[::-1]), np.array(size)
        frames = self.info.config["stars"].get("detector", {})
        try:
            offset = find_offset(frames, sizes[1], observation.detector_frames, sizes[0])
        except ValueError as error:
            raise PredictionError(f"{observation.path}: {error} as {self.name!r} has") from None
        is_moved = offset is not None and np.abs(offset).max() > 1e-3
        if not is_moved and (sizes[0] == sizes[1]).all():
            return self, []
        sizes_text = "{}×{} pixels, {}×{} in the training".format(*sizes[0], *sizes[1])
        if offset is None:
            advice = "headers do not show which part it is: positions are used as in the training"
            return self, [f"{observation.path}: {sizes_text}; {advice}"]
        # Shift all positions in the model: the range of its field (`low`, `high`), and the middle
        # from which its errors grow.
        bundle, weights = self.bundle, dict(self.bundle.weights)
        for name in ("low", "high"):
            weights[name] = weights[name] - np.pad(offset, (0, len(weights[name]) - 2))
        model_errors = bundle.errors.model_errors
        moved_errors = model_errors._replace(middle=model_errors.middle - offset)
        errors = replace(bundle.errors, model_errors=moved_errors)
        shifted_bundle = replace(bundle, weights=weights, errors=errors)
        # Results name the file of the model.
        vars(shifted_bundle)["sha256"] = bundle.sha256
        frame = "by the headers, its first pixel is x {:g}, y {:g} there".format(*offset)
        return type(self)(shifted_bundle), [f"{observation.path}: {sizes_text}; {frame}"]

    def check_scale(self, pixel_scale_arcsec: float | None, source: str) -> None:
        """Raise an error if the pixels of stars differ in scale from the training stars.

        Parameters
        ----------
        pixel_scale_arcsec : float or None
            Pixel scale of the stars; None if it is unknown.
        source : str
            Name of the file, for the message.

        Raises
        ------
        PredictionError
            If the scale is unknown, or its relative difference exceeds `SCALE_TOLERANCE`.
        """
        model_scale = self.info.pixel_scale_arcsec
        advice = f"; {call('psfdae.fit', 'psfdae train')} trains a model on your image"
        if pixel_scale_arcsec is None:
            raise PredictionError(
                f"{source}: neither a WCS nor the header gives the pixel scale; "
                f"set it with {keyword('pixel_scale_arcsec')} (the model's is {model_scale:.6g} "
                f"arcsec){advice}"
            )
        if not abs(pixel_scale_arcsec / model_scale - 1.0) <= SCALE_TOLERANCE:
            scale_note = ", assumed" if self.info.scale_assumed else ""
            raise PredictionError(
                f"{source}: pixels of {pixel_scale_arcsec:.6g} arcsec, but the model "
                f"{self.info.name!r} was trained on {model_scale:.6g} arcsec{scale_note} "
                f"(tolerance {100 * SCALE_TOLERANCE:g} %){advice}"
            )
