"""`StarModel`: a model of the PSF, with the call that denoises stars.

A stamp, or an image with its star list, goes in; a `Prediction` with PSFs, their errors, fluxes and
flags comes out. The steps are in `psfdae.denoise.denoiser`.
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
    """Fitted method with all that it takes to denoise stars: photometry, errors and limits.

    Parameters
    ----------
    bundle : Bundle
        `load` reads one from a file.
    method : Method, optional
        The method of its arrays; by default it is unpacked from them.
    """

    margin_px: ClassVar[int] = 2
    """Pixels by which a star of an image may be moved to the middle of its stamp."""

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
        """Pickle and copy the bundle alone, from which all else is made."""
        return type(self), (self.bundle,)

    def __repr__(self) -> str:
        info = self.info
        return (
            f"{type(self).__name__}({info.name!r}, {info.stamp_px}×{info.stamp_px} px of "
            f'{info.pixel_scale_arcsec:g}", S/N {info.snr_min:.3g} … {info.snr_max:.3g})'
        )

    def _repr_html_(self) -> str:
        """Return what `psfdae describe` says of use and training, for a notebook."""
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
        """Return the same model with other errors."""
        return type(self)(replace(self.bundle, errors=errors), self.method)

    @property
    def info(self) -> BundleInfo:
        """Stamp size, pixel scale, range of S/N and all else that the bundle says."""
        return self.bundle.info

    @property
    def method(self) -> Method:
        """Fitted method that denoises the stars."""
        return self.denoiser.method

    @check_arguments
    def save(self, path: str | Path) -> None:
        """Write the model to a file, by custom NAME.psf.safetensors, for `load_model`."""
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
            Masked pixels are bad; an NDData's σ, its median in a stamp, is the noise that is not
            given. s = `info.stamp_px` + 2 `margin`; in any unit, sky included, the star's
            brightest pixel about [s/2, s/2] (0-based), pixels of the scale
            `info.pixel_scale_arcsec`.
        flux, background, noise : float or array, shape (n,), optional
            Flux inside the stamp, sky level and RMS of the sky noise in a pixel, in
            the unit of the stamps. What is not given, or is NaN, is estimated.
        bad, saturated : array of bool, shape of the stamps, optional
            Pixels that must not be used; those that are not finite never are.
        gain : float or array, shape (n,), optional
            Electrons per unit of the stamps: adds the star's photon noise to `chi2`
            and `flux_error`.
        position : array, shape (n, 2) to (n, 4), optional
            (x, y) of the stars in the image of the training, 0-based; NaN where unknown. The third
            number is the magnitude −2.5 log₁₀ (flux / counts), by default of the flux in the
            stamp, the fourth the colour; they count where the PSF of the training stars changes
            with their brightness and colour.
        centre : array, shape (n, 2), optional
            (x, y) of the stars' centres that a list says, from index s//2; NaN where unknown.
            Like the position, for models that measure centres (`psfdae.methods.field`).
        fixed : bool
            These centres are exact.
        margin : int
            Pixels around each stamp, by which a star may be moved to centre it.
        threads : int, optional
            None takes all cores.

        Returns
        -------
        Prediction
            One row per star, also of those that are flagged.

        Raises
        ------
        PredictionError
            If shapes or types do not fit.
        """
        # Check the arrays, and make them to stamps.
        side = self.stamp_px + 2 * margin
        numbers = {"flux": flux, "background": background, "noise": noise, "gain": gain}
        masks = {"bad": bad, "saturated": saturated}
        stars, unit = make_stamps(stamps, side, self.name, numbers, masks, position, centre)
        # Blocks of stars, side by side; each is denoised as if it were alone.
        blocks = stars.split(self.denoiser.block_size)
        threads = min(threads or available_cores(), len(blocks))
        with use_one_thread_each():
            parts = run_parallel(lambda block: self.denoiser.denoise(block, fixed), blocks, threads)
        return replace(Prediction.joined(parts), unit=unit)

    def stream(
        self, observation: Observation, threads: int | None = None, fixed: bool = False
    ) -> Iterator[tuple[Stamps, Prediction]]:
        """Yield the stars of an observation in their order, some at a time, with predictions.

        Few of them are in memory. Listed centres are exact if `fixed`; by default all cores are
        taken.
        """
        # Stamps are read in chunks, each of which is denoised in blocks by a thread of its own.
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
                # Columns of the star list go along with the stars' rows.
                rows = slice(start, start + len(prediction))
                start = rows.stop
                # The star on the sky, by its own centre where the model measures one.
                x = np.where(np.isfinite(prediction.x_fit), prediction.x_fit, prediction.x)
                y = np.where(np.isfinite(prediction.y_fit), prediction.y_fit, prediction.y)
                on_sky = replace(
                    prediction,
                    columns=prediction.columns | observation.sky_columns(x, y),
                    list_columns=None if list_columns is None else list_columns[rows],
                    unit=observation.unit,
                )
                yield stamps, on_sky
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
        """Light of stars beyond their stamps, if the bundle says any."""
        return self.denoiser.wings

    def flux_error(self, position: np.ndarray) -> np.ndarray:
        """Return the relative flux errors of stars at positions (n, 2), x and y, due to the PSF.

        Standard errors over the flux (n,) of stars on a sky that is a map of the image. In the
        middle of the field, they are not below the RMS over the whole field: a map of the sky has
        errors there as well, which no field knows.
        """
        errors = self.bundle.errors.model_errors
        return np.asarray(errors.fitted_flux * np.maximum(errors.flux_factor(position), 1.0))

    @property
    def image_px(self) -> tuple[int, int] | None:
        """Columns and rows of the image of the training stars, if the bundle says it."""
        size = self.info.config.get("stars", {}).get("image_px")
        return None if size is None else (size[0], size[1])

    def field_range(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the least and greatest position (x, y) of training stars; raises as `psf_at`."""
        self._field()
        # The field's polynomial has its range in its arrays.
        low, high = (np.asarray(self.bundle.weights[name][:2]) for name in ("low", "high"))
        # Stars without positions leave zeros; a star alone is at one position.
        if not ((high > low) | ((high == low) & (low != 0))).all():
            raise PredictionError(f"the model {self.name!r} knows no positions of its stars")
        return low, high

    @property
    def magnitude_range(self) -> tuple[float, float] | None:
        """Lowest and highest magnitude with which the PSF changes; None if it does not."""
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
        """Return the mean variance of stars about the field, in the middle of a PSF of flux 1."""
        if not isinstance(self.method, FieldPrior):
            return np.nan
        # Residuals of stars in the middle of their pixel (eq. 6): squares of modes, and diagonal.
        _, modes, diagonal = self.method.residuals_at(np.zeros(2))
        variance = (np.square(modes).sum(axis=0) + diagonal).reshape(self.stamp_px, -1)
        begin = self.stamp_px // 2 - side_px // 2
        middle = slice(max(begin, 0), begin + side_px)
        return float(variance[middle, middle].mean())

    def draw_psfs(self, position: np.ndarray, oversampling: int) -> np.ndarray:
        """Return the PSFs of flux 1 at positions (n, 2 to 4), as `FieldPsfs` defines it."""
        return self._field().psf_at(position, oversampling)

    def to_image_frame(self, observation: Observation) -> tuple[Self, list[str]]:
        """Return the model in the pixel frame of an image, and notes on how frames differ."""
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
        words = "{}×{} pixels, {}×{} in the training".format(*sizes[0], *sizes[1])
        if offset is None:
            advice = "headers do not show which part it is: positions are used as in the training"
            return self, [f"{observation.path}: {words}; {advice}"]
        # Positions of a model are the range of its field, and the middle from which errors grow.
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
        return type(self)(shifted_bundle), [f"{observation.path}: {words}; {frame}"]

    def check_scale(self, pixel_scale_arcsec: float | None, source: str) -> None:
        """Raise an error if the pixels of stars differ in scale from the training stars.

        Parameters
        ----------
        pixel_scale_arcsec : float or None
            None if nobody knows it.
        source : str
            Name of the file, for the message.

        Raises
        ------
        PredictionError
            If the scale is unknown, or off by more than `SCALE_TOLERANCE`.
        """
        model_scale = self.info.pixel_scale_arcsec
        advice = f"; {call('psfdae.fit', 'psfdae train')} trains one on an image of yours"
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
