"""`PsfModel`: a model bundle applied to stamps: centring, photometry, network, uncertainty."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields, replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from psfdae.bright_stars import magnitude
from psfdae.bundle_info import BundleInfo
from psfdae.image.containers import parts_of_array, sigma_of
from psfdae.image.observation import Observation, other_instruments
from psfdae.image.stamps import (
    Stamps,
    StarFlag,
    border_median,
    border_scatter,
    cut,
    displacement,
    raise_flag,
)
from psfdae.method import (
    FindsFlux,
    KnowsField,
    MeasuresStars,
    Method,
    Packing,
    ScoresOutliers,
    with_free_flux,
)
from psfdae.model.bundle import (
    Bundle,
    at_noise,
    brightest,
    estimator,
    mahalanobis,
    read_bundle,
    write_bundle,
)
from psfdae.model.field_psfs import FieldPsfs, PredictionError, real_numbers
from psfdae.model.photometry import FAINT_SNR, KEPT, NOISE_FLOOR, Photometer, Photometry
from psfdae.model.prediction import Prediction, measured_of, unmeasured
from psfdae.model.wings import Wings, outer_light
from psfdae.moments import measure_shapes
from psfdae.progress import task
from psfdae.threads import available_cores, in_order, side_by_side

if TYPE_CHECKING:
    from threadpoolctl import ThreadpoolController

COLOURS = "the column of colours"
SCALE_TOLERANCE = 0.02  # relative difference of the pixel scale from that of the training
SNR_TOLERANCE = 1.25  # beyond the trained S/N without a flag: a faint star's is no better known
LEAST_LEFT = 0.01  # of the noise in a pixel, by a PSF that follows the star there
MOST_CHI2 = 10.0  # of a star without a flag
SKY_SIGMA = 5.0  # scatter of the border by which its median may differ from a sky that is given
FLUX_FACTOR = (0.5, 2.0)  # by which a method may correct the flux of a star
BLOCK = 256  # stars that a network computes together, always so many: other numbers round otherwise
SEEN = 2048  # stars that are measured and described together
ROWS = 4 * BLOCK  # stars that are read at a time, fewer if their stamps are large
MARGIN_PX = 2  # by which a star of an image may be moved to centre it
WHOLE_PX = 32  # larger stamps come in smaller blocks


def load_model(path: str | Path | None = None) -> PsfModel:
    """A trained model, ready to predict the PSFs of stars.

    Parameters
    ----------
    path : path-like, optional
        Model bundle (`.psf.safetensors`); by default the one that comes with the package.

    Raises
    ------
    BundleError
        If the file is missing, damaged, of a newer format, or no model bundle.
    PredictionError
        If it describes a telescope.
    MissingExtraError
        If the model is a network and torch is not installed.

    Examples
    --------
    >>> psfdae.load_model()
    PsfModel('wfsat', 16×16 px of 0.1", S/N 3.3 … 1.1e+03)
    """
    if path is not None and Path(path).suffix in (".yaml", ".yml"):
        raise PredictionError(
            f"{path}: describes a telescope, and is no model; psfdae wavefront INPUT --telescope "
            f"{path} measures the wavefronts of its stars and writes their PSFs"
        )
    return PsfModel(read_bundle(None if path is None else Path(path)))


class PsfModel(FieldPsfs):
    """A trained network with all that it takes to apply it to stars.

    Parameters
    ----------
    bundle : Bundle
        `load_model` reads one from a file.
    fitted : Method, optional
        The method of its arrays; by default it is unpacked from them.

    Examples
    --------
    >>> found = model.predict(stamps, position=xy)
    >>> found.psf.shape
    (36, 16, 16)
    >>> model.psf_at(150.0, 150.0, oversampling=1).shape
    (16, 16)
    >>> model.save("image.psf.safetensors")
    >>> psfdae.load_model("image.psf.safetensors").info.training_stars
    29
    """

    def __init__(self, bundle: Bundle, fitted: Method | None = None) -> None:
        self.bundle = bundle
        self.engine = Engine(bundle, estimator(bundle) if fitted is None else fitted)
        self.name, self.stamp_px = bundle.info.name, bundle.info.stamp_px

    def __repr__(self) -> str:
        info = self.info
        return (
            f"PsfModel({info.name!r}, {info.stamp_px}×{info.stamp_px} px of "
            f'{info.pixel_scale_arcsec:g}", S/N {info.snr_min:.3g} … {info.snr_max:.3g})'
        )

    @property
    def info(self) -> BundleInfo:
        """Stamp size, pixel scale, range of S/N and all else that the bundle says."""
        return self.bundle.info

    def save(self, path: str | Path) -> None:
        """Write the model to a file, by custom NAME.psf.safetensors, for `load_model`."""
        write_bundle(self.bundle, Path(path))

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
        margin: int = 0,
        threads: int | None = 1,
    ) -> Prediction:
        """PSFs of stars, with uncertainties, photometry, shapes and flags.

        Stars do not influence each other; the result does not depend on the number
        of threads, and on how many stars are passed at once in its rounding at most.

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
            number is the magnitude −2.5 log₁₀ (flux / counts), by default that of the flux in the
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
        values, masked, sigma, unit = _unpacked(stamps)
        if noise is None and sigma is not None:
            noise = np.nanmedian(sigma, axis=(-2, -1))
        given = {"flux": flux, "background": background, "noise": noise, "gain": gain}
        given = {name: _without_unit(name, value, unit) for name, value in given.items()}
        if masked is not None:
            bad = masked if bad is None else masked | np.asarray(bad, dtype=bool)
        masks = {"bad": bad, "saturated": saturated}
        stars = self._stamps(values, margin, given, masks, position, centre)
        blocks = self.engine.blocks(stars)
        with one_thread_each():
            threads = min(threads or available_cores(), max(len(blocks), 1))
            work = (lambda block: self.engine.block(block, fixed), blocks or [stars], threads)
            parts = side_by_side(*work)
        return replace(Prediction.joined(parts), unit=unit)

    def _stamps(
        self,
        stamps: ArrayLike,
        margin: int,
        given: Mapping[str, ArrayLike | None],
        masks: Mapping[str, ArrayLike | None],
        position: ArrayLike | None,
        centre: ArrayLike | None,
    ) -> Stamps:
        """Check the arguments of `predict`."""
        data = real_numbers("stamps", stamps)
        single = data.ndim == 2
        data = data[None] if single else data
        side = self.info.stamp_px + 2 * margin
        if margin < 0 or data.ndim != 3 or data.shape[1:] != (side, side):
            size = "×".join(str(n) for n in data.shape)
            raise PredictionError(
                f"stamps of shape {size}, but the model {self.info.name!r} takes n×{side}×{side}"
            )
        finite = np.isfinite(data)
        x, y, mag, colour = _numbers("position", position, len(data), 4).T
        return Stamps(
            data=data if finite.all() else np.where(finite, data, 0),
            bad=_mask("bad", masks["bad"], data, single) | ~finite,
            saturated=_mask("saturated", masks["saturated"], data, single),
            flags=np.zeros(len(data), dtype=np.uint16),
            id=np.arange(len(data)),
            x=x,
            y=y,
            magnitude=mag,
            colour=colour,
            listed=_numbers("centre", centre, len(data), 2)[:, ::-1],
            **{name: _per_star(name, value, len(data)) for name, value in given.items()},
        )

    def stream(
        self, observation: Observation, threads: int | None = None, fixed: bool = False
    ) -> Iterator[tuple[Stamps, Prediction]]:
        """The stars of an observation in their order, some at a time, with their predictions.

        Few of them are in memory. Listed centres are exact if `fixed`; by default all cores are
        taken.
        """
        size = self.engine.size

        def predicted(stamps: Stamps) -> Prediction:
            blocks = self.engine.blocks(stamps)
            return Prediction.joined([self.engine.block(block, fixed) for block in blocks])

        chunks = observation.chunks(max(size, min(ROWS, 4 * size)))
        list_columns, start = observation.list_columns, 0
        with one_thread_each(), task("stars", observation.count) as advance:
            for stamps, prediction in in_order(predicted, chunks, threads or available_cores()):
                rows = slice(start, start + len(prediction))
                start = rows.stop
                # The star on the sky, by its own centre where the model measures one.
                x = np.where(np.isfinite(prediction.x_fit), prediction.x_fit, prediction.x)
                y = np.where(np.isfinite(prediction.y_fit), prediction.y_fit, prediction.y)
                sky = observation.on_sky(x, y)
                ra, dec = (None, None) if sky is None else sky
                list_rows = None if list_columns is None else list_columns[rows]
                unit = observation.unit
                yield (
                    stamps,
                    replace(prediction, ra=ra, dec=dec, list_columns=list_rows, unit=unit),
                )
                advance(len(prediction))

    @property
    def sha256(self) -> str:
        """Checksum of the bundle."""
        return self.bundle.sha256

    @property
    def order(self) -> int:
        """Order of the field's polynomial; raises as `psf_at`."""
        return self._field().order

    @property
    def wings(self) -> Wings | None:
        """Light of stars beyond their stamps, if the bundle says any."""
        return self.engine.wings

    @property
    def flux_error(self) -> float:
        """Standard error over the flux that model and wings make of every star on a known sky."""
        light, error = (0.0, 0.0) if self.wings is None else self.wings.light()
        return float(np.hypot(self.bundle.model_errors.fitted_flux, error / (1.0 + light)))

    @property
    def image_px(self) -> tuple[int, int] | None:
        """Columns and rows of the image of the training stars, if the bundle says it."""
        size = self.info.config.get("stars", {}).get("image_px")
        return None if size is None else (size[0], size[1])

    def other_instrument(
        self, instrument: Mapping[str, str], colour_column: str | None = None
    ) -> str:
        """Describe how an image's telescope, camera or filter differs from the training image.

        Parameters
        ----------
        instrument : mapping
            By the key of the header, as `Observation.instrument`.
        colour_column : str, optional
            Of the star list, if its colours are used.

        Returns
        -------
        said : str
            Empty if all that both headers and lists name is the same.
        """
        stars = self.info.config.get("stars")
        stars = stars if isinstance(stars, Mapping) else {}
        known = stars.get("instrument")
        known = dict(known) if isinstance(known, Mapping) else {}
        if colour_column and "colour_column" in stars:
            known[COLOURS] = stars["colour_column"]
            instrument = {**instrument, COLOURS: colour_column}
        return "; ".join(
            f"{key} is {seen!r}, the model {self.name!r} was trained on {value!r}"
            for key, value, seen in other_instruments(known, instrument)
        )

    def field_range(self) -> tuple[np.ndarray, np.ndarray]:
        """Least and greatest position (x, y) of the training stars; raises as `psf_at`."""
        self._field()
        low, high = (np.asarray(self.bundle.weights[name][:2]) for name in ("low", "high"))
        # Stars without places leave zeros; a star alone is at one place.
        if not ((high > low) | ((high == low) & (low > 0))).all():
            raise PredictionError(f"the model {self.name!r} knows no places of its stars")
        return low, high

    def _field(self) -> KnowsField:
        field = self.engine.estimator
        if not isinstance(field, KnowsField):
            raise PredictionError(
                f"the model {self.name!r}: {field.look.label}: knows the PSF of a star alone, "
                "not that of a place; psfdae from-stars --method field makes one that does"
            )
        return field

    def _psfs(self, place: np.ndarray, oversampling: int) -> np.ndarray:
        return self._field().psf_at(place, oversampling)

    def check_scale(self, pixel_scale_arcsec: float | None, what: str) -> None:
        """Refuse stars whose pixels are not those of the training.

        Parameters
        ----------
        pixel_scale_arcsec : float or None
            None if nobody knows it.
        what : str
            Name of the file, for the message.

        Raises
        ------
        PredictionError
            If the scale is unknown, or off by more than `SCALE_TOLERANCE`.
        """
        trained = self.info.pixel_scale_arcsec
        other = "; psfdae from-stars trains one on an image of yours"
        if pixel_scale_arcsec is None:
            raise PredictionError(
                f"{what}: neither a WCS nor the header gives the pixel scale; "
                f"state it with --pixel-scale (the model's is {trained:.6g} arcsec){other}"
            )
        if not abs(pixel_scale_arcsec / trained - 1.0) <= SCALE_TOLERANCE:
            assumed = ", assumed" if self.info.scale_assumed else ""
            raise PredictionError(
                f"{what}: pixels of {pixel_scale_arcsec:.6g} arcsec, but the model "
                f"{self.info.name!r} was trained on {trained:.6g} arcsec{assumed} "
                f"(tolerance {100 * SCALE_TOLERANCE:g} %){other}"
            )


def _unpacked(
    stamps: Any,
) -> tuple[np.ndarray, np.ndarray | None, np.ndarray | None, str]:
    """Numbers, mask, σ and unit of stamps in any container; None, None and "" without them."""
    if hasattr(stamps, "uncertainty") and hasattr(stamps, "mask"):  # an NDData
        mask = stamps.mask if stamps.mask is None else np.asarray(stamps.mask, dtype=bool)
        unit = "" if stamps.unit is None else str(stamps.unit)
        return np.asarray(stamps.data), mask, sigma_of(stamps), unit
    if hasattr(stamps, "fileinfo"):  # an HDU, or a list of them
        raise PredictionError(
            f"{type(stamps).__name__} in place of stamps: its array is its attribute data; "
            "psfdae.Stars.from_image takes images in FITS files"
        )
    values, mask, unit = parts_of_array(stamps)
    return values, mask, None, unit


def _without_unit(name: str, value: Any, unit: str) -> Any:
    """A quantity as numbers of the unit of the stamps, of electrons per that of a gain."""
    if not hasattr(value, "to_value"):
        return value
    wanted = unit or "ct"
    if name == "gain":
        wanted = f"electron / ({wanted})"
    try:
        return value.to_value(wanted)
    except (ValueError, TypeError):
        raise PredictionError(
            f"{name} in {value.unit}, but that of the stamps is {wanted or 'none'}"
        ) from None


def _mask(name: str, mask: ArrayLike | None, data: np.ndarray, single: bool) -> np.ndarray:
    if mask is None:
        return np.zeros(data.shape, dtype=bool)
    array = np.asarray(mask, dtype=bool)
    array = array[None] if single else array
    if array.shape != data.shape:
        raise PredictionError(f"{name} of shape {array.shape}, but stamps of shape {data.shape}")
    return array


def _numbers(name: str, values: ArrayLike | None, count: int, most: int) -> np.ndarray:
    """Two numbers per star, or as many as `most`, (n, most); NaN where they are not known."""
    numbers = real_numbers(name, np.full((count, 2), np.nan) if values is None else values)
    if numbers.shape not in [(count, columns) for columns in range(2, most + 1)]:
        raise PredictionError(
            f"{name} of shape {numbers.shape}, expected ({count}, 2)"
            + f" to ({count}, {most})" * (most > 2)
        )
    missing = np.full((count, most - numbers.shape[1]), np.nan)
    return np.hstack([numbers, missing], dtype=np.float64)


def _per_star(name: str, value: ArrayLike | None, count: int) -> np.ndarray:
    """One number per star, NaN where it is not known."""
    numbers = real_numbers(name, np.nan if value is None else value).astype(np.float64)
    if numbers.ndim > 1 or (numbers.ndim == 1 and len(numbers) != count):
        raise PredictionError(f"{name} of shape {numbers.shape}, expected one for {count} stamps")
    return np.broadcast_to(numbers, (count,))


class Seen(NamedTuple):
    """Stars as they are before they are restored.

    Attributes
    ----------
    stars : Stamps
    exact : ndarray of bool, shape (n,)
        Whether their listed centres are.
    stamps, bad : ndarray, shape (n, d, d)
        Centred, with pixels that are not used.
    shift : ndarray of int, shape (n, 2)
        By which they were moved, (row, column).
    flags : ndarray of uint16, shape (n,)
    start : ndarray, shape (n,)
        A rough sky.
    found : Photometry
    """

    stars: Stamps
    exact: np.ndarray
    stamps: np.ndarray
    bad: np.ndarray
    shift: np.ndarray
    flags: np.ndarray
    start: np.ndarray
    found: Photometry


class Restored(NamedTuple):
    """PSFs of stars.

    Attributes
    ----------
    psf : ndarray, shape (n, d, d)
        Of flux 1; NaN where there is no flux.
    sigma : ndarray, shape (n, d, d), or None
        Its standard deviation.
    found : Photometry
    lost : ndarray of bool, shape (n,)
        Stars without flux.
    score : ndarray, shape (n,)
        How unlike all training stars; NaN where nothing says so.
    of_star : dict of ndarray
        What a method measured that measures stars.
    """

    psf: np.ndarray
    sigma: np.ndarray | None
    found: Photometry
    lost: np.ndarray
    score: np.ndarray
    of_star: dict[str, np.ndarray]


class Engine:
    """A bundle that is ready to use: the method and the photometry's matrices.

    Safe to use from several threads.
    """

    def __init__(self, bundle: Bundle, fitted: Method) -> None:
        self.bundle, self.estimator = bundle, fitted
        self.free_flux = with_free_flux(self.estimator)
        packing = self.estimator.packing or Packing()
        together, self._padded = packing.together, packing.padded
        self.size = min(together, max(1, together * WHOLE_PX**2 // bundle.info.stamp_px**2))
        self._photometer = Photometer(bundle.flux_model, bundle.info.components)
        self.wings = bundle.wings
        stars = bundle.info.config.get("stars", {}).get("calibration_stars", {})
        self._centring_px = float(stars.get("centring_px") or 0.0)

    def blocks(self, stars: Stamps) -> list[Stamps]:
        """Stars in parts of `size`."""
        return [stars.part(slice(a, a + self.size)) for a in range(0, len(stars), self.size)]

    def block(self, stars: Stamps, fixed: bool = False) -> Prediction:
        """PSFs of at most `size` stars, whose listed centres are exact if `fixed`."""
        count = len(stars)
        size = self.size if self._padded else 1
        if count < size:
            stars = _filled(stars, self.bundle, size)
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            return self._compute(stars, fixed).of(slice(count))

    def _compute(self, stars: Stamps, fixed: bool) -> Prediction:
        parts = [stars.part(slice(a, a + SEEN)) for a in range(0, len(stars), SEEN)]
        seen = [self._seen(part, fixed) for part in parts]
        if isinstance(self.estimator, MeasuresStars):
            restored = [self._measured(one, self.estimator) for one in seen]
        else:
            restored = self._estimated(seen)
        return Prediction.joined([*map(self._predicted, seen, restored)])

    def _seen(self, stars: Stamps, fixed: bool) -> Seen:
        exact = fixed & np.isfinite(stars.listed).all(axis=1)
        stamps, bad, shift, flags = self._centred(stars, exact)
        start = border_median(stamps, bad)
        if np.isfinite(stars.background).any():
            unlike_sky = np.abs(start - stars.background) > SKY_SIGMA * border_scatter(stamps)
            raise_flag(flags, StarFlag.SKY_OFF, unlike_sky)
        found = self._photometer.measure(stamps, bad, start, stars)
        return Seen(stars, exact, stamps, bad, shift, flags, start, found)

    def _predicted(self, seen: Seen, restored: Restored) -> Prediction:
        bundle, info = self.bundle, self.bundle.info
        stars, stamps, flags = seen.stars, seen.stamps, seen.flags
        psf, sigma, found, lost = restored.psf, restored.sigma, restored.found, restored.lost
        noise = found.noise / np.where(lost, np.nan, found.flux)
        shapes = measure_shapes(psf)
        snr = np.sqrt(np.square(psf, dtype=np.float64).sum(axis=(1, 2))) / noise
        doubt = None if sigma is None else sigma * found.flux[:, None, None]
        distance = mahalanobis(found.images, noise, bundle.flux_model, info.components)
        flux = found.flux.astype(np.float32)[:, None, None]
        width, ratios, of_flux = self._doubts(psf, sigma, noise, stars)
        uncertainty = flux * width
        psf *= flux
        residual = (stamps - found.background[:, None, None]).astype(np.float32) - psf
        residual[~found.used] = np.nan
        flags |= found.flags
        raise_flag(flags, StarFlag.SNR_LOW, snr < info.snr_min / SNR_TOLERANCE)
        # What measures stars knows their noise, and comes ever nearer to the star itself.
        limited = not restored.of_star
        raise_flag(flags, StarFlag.SNR_HIGH, limited & (snr > info.snr_max * SNR_TOLERANCE))
        unlike = distance > bundle.distance_limit
        if bundle.strange_limit is not None:
            unlike |= restored.score > np.interp(noise, bundle.noise_nodes, bundle.strange_limit)
        raise_flag(flags, StarFlag.UNLIKE_TRAINING, unlike)
        chi2 = _chi2(residual, psf, doubt, found.noise, stars.gain)
        raise_flag(flags, StarFlag.POOR_FIT, chi2 > MOST_CHI2)
        photons = np.nan_to_num(np.maximum(found.flux, 0.0) / stars.gain)
        if restored.of_star:  # whose errors have the photons
            photons[:] = 0.0
        flux_error = np.sqrt((of_flux * found.flux_error) ** 2 + photons)
        fluxes: dict[str, Any] = self._with_wings(stars, found, flux_error)
        centres: dict[str, Any] = restored.of_star or unmeasured(len(stars))
        return Prediction(
            id=stars.id,
            x=stars.x,
            y=stars.y,
            psf=psf,
            residual=residual,
            uncertainty=uncertainty,
            ratio95=ratios[:, 0],
            ratio95_bright=ratios[:, 1],
            flux=found.flux,
            flux_error=flux_error,
            **fluxes,
            noise=found.noise,
            snr=snr,
            chi2=chi2,
            distance=distance,
            outlier_score=restored.score,
            fwhm_px=shapes.fwhm_px,
            ellipticity=shapes.ellipticity,
            position_angle_deg=shapes.position_angle_deg,
            shift_x=seen.shift[:, 1],
            shift_y=seen.shift[:, 0],
            flags=flags,
            **centres,
        )

    def _with_wings(
        self, stars: Stamps, found: Photometry, error: np.ndarray
    ) -> dict[str, np.ndarray]:
        """Columns of fluxes with the light beyond the stamps, and of the sky without that in them.

        `error` (n,) is that of the fluxes.
        """
        flux, sky = found.flux, found.background
        if self.wings is None or not isinstance(self.estimator, KnowsField):
            unknown = np.full(len(flux), np.nan)
            return {"flux_total": unknown, "flux_total_error": unknown, "background": sky}
        place = np.stack([stars.x, stars.y], axis=1)
        outer = outer_light(self.estimator.psf_at, place)
        total, doubt = self.wings.total(outer)
        # An error of a flux that was given is not known.
        own = np.hypot(error * total, flux * doubt)
        # Light that is even in the stamp is in the sky of a star whose sky is not known.
        scale = self.wings.scale(outer)
        even = np.nan_to_num(np.maximum(flux, 0.0) * scale * self.wings.profile[0])
        sky = np.where(np.isnan(stars.background), sky - even, sky)
        return {"flux_total": flux * total, "flux_total_error": own, "background": sky}

    def _doubts(
        self, psf: np.ndarray, sigma: np.ndarray | None, noise: np.ndarray, stars: Stamps
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Half-widths of 68 % of PSFs of flux 1 (n, d, d), and what widens them to 95 % (n, 2).

        The latter are of faint and of bright pixels. The last array (n,) has factors of the
        error of the flux. All depend on which of noise, flux and sky were estimated.
        """
        bundle, count = self.bundle, len(noise)
        width = at_noise(noise, bundle.noise_nodes, bundle.error68)
        if sigma is not None:
            width = width * sigma
        ratio = np.interp(noise, bundle.noise_nodes, bundle.ratio95)
        ratios, of_flux = np.stack([ratio, ratio], axis=1), np.ones(count)
        if (scales := bundle.scales(noise)) is None:
            return width, ratios, of_flux
        noise_too, flux_too, sky_too = (
            np.isnan(known) for known in (stars.noise, stars.flux, stars.background)
        )
        case = np.where(sky_too, 2, flux_too.astype(int))
        wider, widest = (
            table[np.arange(count), noise_too.astype(int), case] for table in scales[:2]
        )
        faint, bright = wider.T.astype(np.float32)[:, :, None, None]
        width = width * np.where(brightest(psf), bright, faint)
        return width, ratios * widest / wider, np.where(flux_too & sky_too, scales[2], of_flux)

    def _measured(self, seen: Seen, method: MeasuresStars) -> Restored:
        """Restore stars with the fluxes that the method measures in place of the photometry.

        That repairs bad pixels and tells the noise.
        """
        stars, stamps, bad, shift = seen.stars, seen.stamps, seen.bad, seen.shift
        start, exact, found = seen.start, seen.exact, seen.found
        pixels = stamps[0].size
        given, unseen = np.isfinite(stars.flux), (found.flags & StarFlag.NO_FLUX) > 0
        level = start[:, None, None]
        repaired = found.images * found.flux[:, None, None] + found.background[:, None, None]
        repaired = np.where(unseen[:, None, None], np.where(bad, level, stamps), repaired)
        data = np.where(found.used & ~bad, stamps, repaired).astype(np.float64) - level
        size = np.abs(data).max(axis=(1, 2))
        nothing = ~((bad.mean(axis=(1, 2)) <= 1 - KEPT) & (size > 0) & np.isfinite(size))
        nothing |= (np.ptp(data, axis=(1, 2)) <= 0) | ~np.isfinite(found.noise)
        data = np.where(nothing[:, None, None], 0.0, data)
        noise = np.where(found.noise > NOISE_FLOOR * size, found.noise, NOISE_FLOOR * size)
        photons = np.nan_to_num(np.maximum(found.flux, 0.0) / stars.gain / pixels)
        noise = np.where(nothing, 1.0, np.sqrt(noise**2 + photons))
        flux = np.where(given, stars.flux, found.flux)
        mag = np.where(np.isnan(stars.magnitude), magnitude(flux), stars.magnitude)
        place = np.stack([stars.x, stars.y, mag, stars.colour], axis=1)
        estimate = method.measure(
            data,
            noise,
            place,
            stars.listed - shift,
            exact,
            flux=stars.flux,
            sky=stars.background - start,
            gain=stars.gain,
        )
        own = estimate.measured
        assert own is not None and estimate.sigma is not None
        own = replace(own, covariance=self._with_model_errors(own.covariance, own.flux))
        error = np.sqrt(own.covariance[:, 0, 0])
        flux = np.where(given, stars.flux, own.flux)
        lost = nothing | np.where(given, unseen, ~(flux > error))
        flags = found.flags & np.uint16(StarFlag.MASKED | StarFlag.OUTLIER)
        raise_flag(flags, StarFlag.NO_FLUX, lost)
        raise_flag(flags, StarFlag.FAINT, ~given & ~lost & (flux < FAINT_SNR * error))
        raise_flag(flags, StarFlag.BEYOND, method.is_out_of_range(place) & ~lost)
        sky = start + own.background
        unit = np.where(lost, 1.0, flux)[:, None, None]
        images = (data - own.background[:, None, None]) / unit
        better = replace(
            found,
            flux=np.where(nothing, np.nan, flux),
            flux_error=np.where(given | nothing, np.nan, error),
            background=np.where(nothing, found.background, sky),
            images=np.where(lost[:, None, None], 0.0, images).astype(np.float32),
            flags=flags,
        )
        # The pixel at the middle of the stamp as it was given, in the image if that is known.
        middle = np.stack([stars.y, stars.x], axis=1) - stars.listed
        middle = np.where(np.isfinite(middle), middle, stars.data.shape[-1] // 2)
        measured = measured_of(middle + shift + own.centre, own.covariance)
        estimate.psf[lost] = estimate.sigma[lost] = np.nan
        score = np.full(len(lost), np.nan)
        if self.bundle.strange_limit is not None and estimate.outlier_score is not None:
            score[~lost] = estimate.outlier_score[~lost]
        of_star = {k: np.where(lost, np.nan, v) for k, v in measured.items()}
        return Restored(estimate.psf, estimate.sigma, better, lost, score, of_star)

    def _with_model_errors(self, covariance: np.ndarray, flux: np.ndarray) -> np.ndarray:
        """Covariances (n, 4, 4) of flux, sky, row and column with the errors of the model itself.

        A number that is known, whose variance is almost 0, stays so.
        """
        errors = self.bundle.model_errors
        unit = np.maximum(flux, 0.0)[:, None]
        more = np.concatenate(
            [unit * [errors.flux, errors.sky], np.full((len(flux), 2), errors.centre)], axis=1
        )
        variance = np.maximum(np.einsum("nii->ni", covariance), 0.0)
        least = np.concatenate([unit * 1e-5, unit * 1e-12, np.full((len(flux), 2), 1e-9)], axis=1)
        more[np.sqrt(variance) < least] = 0.0
        return np.asarray(covariance + more[:, :, None] ** 2 * np.eye(4))

    def _estimated(self, seen: Sequence[Seen]) -> list[Restored]:
        """Restore stars of unknown flux: estimate flux and sky first, if the method can.

        It takes the noise for larger then: what it does not know of a bright star would pass for
        flux. Parts are restored together, in which some stars have about the same noise.
        """
        info = self.bundle.info
        near: dict[str, Any] = {}
        found = Photometry.joined([one.found for one in seen])
        parts = np.cumsum([0, *(len(one.stars) for one in seen)])
        lost = (found.flags & StarFlag.NO_FLUX) > 0
        psf, sigma = np.full_like(found.images, np.nan), None
        score = np.full(len(lost), np.nan)
        mean = self.bundle.flux_model.mean.reshape(found.images.shape[1:])

        def current() -> tuple[np.ndarray, np.ndarray]:
            images = found.images
            if lost.any():
                images = np.where(lost[:, None, None], mean, images).astype(images.dtype)
            noise = found.noise / np.where(lost, np.nan, found.flux)
            return images, np.where(lost, info.noise_max, noise)

        unknown = [np.isnan(one.stars.flux) & np.isnan(one.stars.background) for one in seen]
        free = np.concatenate(unknown) & ~lost
        if free.any() and isinstance(self.free_flux, FindsFlux):
            images, noise = current()
            wider = np.hypot(noise, info.misfit) / info.kappa
            flux, near["near_clusters"] = self.free_flux.flux(images, wider)
            free &= np.isfinite(flux)  # a damaged model may find none
            found = found.with_flux(np.where(free, np.clip(flux, *FLUX_FACTOR), 1.0))
        if not lost.all():  # such as the stars of a catalogue that reaches far beyond the image
            images, noise = current()
            estimate = self.estimator.estimate(images, noise / info.kappa, **near)
            psf, sigma = estimate.psf.astype(np.float32, copy=False), estimate.sigma
            for array in (psf, sigma):
                if array is not None:
                    array[lost] = np.nan
            if self.bundle.strange_limit is not None:
                some = {name: values[~lost] for name, values in near.items()}
                level = noise[~lost] / info.kappa
                assert isinstance(self.free_flux, ScoresOutliers)
                score[~lost] = self.free_flux.outlier_score(images[~lost], level, **some)
        rows = [slice(*ends) for ends in pairwise(parts)]
        return [
            Restored(
                psf[part],
                None if sigma is None else sigma[part],
                found.part(part),
                lost[part],
                score[part],
                {},
            )
            for part in rows
        ]

    def _centred(self, stars: Stamps, exact: np.ndarray) -> tuple[np.ndarray, ...]:
        """Stamps (n, d, d), their bad pixels, their shift (row, column), and flags so far.

        Stars (n,) whose place is `exact` are not moved.
        """
        side = self.bundle.info.stamp_px
        margin = (stars.data.shape[-1] - side) // 2
        # Saturated pixels show where the star is; the others would mislead.
        data, hidden = stars.data, stars.bad & ~stars.saturated
        if hidden.any():
            data = np.where(hidden, border_median(data, hidden)[:, None, None], data)
        shift = displacement(data, self.bundle.info.jitter_px, self._centring_px)
        shift[exact] = 0
        too_far = np.abs(shift).max(axis=1) > margin
        shift[too_far] = 0
        stamps, bad, saturated = (
            cut(wide, side, shift) for wide in (data, stars.bad, stars.saturated)
        )
        flags = stars.flags.copy()
        raise_flag(flags, StarFlag.MASKED, bad.any(axis=(1, 2)))
        raise_flag(flags, StarFlag.SATURATED, saturated.any(axis=(1, 2)))
        raise_flag(flags, StarFlag.OFF_CENTRE, too_far)
        return stamps, bad | saturated, shift, flags


def _chi2(
    residual: np.ndarray,
    psf: np.ndarray,
    doubt: np.ndarray | None,
    noise: np.ndarray,
    gain: np.ndarray,
) -> np.ndarray:
    """Σ residual²/v over what is expected of it, of the pixels that are not NaN; v is noise.

    A restored star follows its own noise where it is bright. If the method has a `doubt` u (n, d,
    d) of its pixels in a noise of the mean variance s, it leaves the part k = 1 − u²/s, at
    least `LEAST_LEFT`, of what noise does to each, and Σ (s k + k² (v − s))/v is expected; else
    the number of pixels is.
    """
    variance = np.broadcast_to((noise**2)[:, None, None], residual.shape)
    if np.isfinite(gain).any():
        per_electron = np.where(gain > 0, 1.0 / gain, 0.0)[:, None, None]
        variance = variance + np.maximum(psf, 0.0) * per_electron
    used = np.isfinite(residual) & np.isfinite(variance)
    expected = np.ones(residual.shape)
    if doubt is not None:
        even = variance.mean(axis=(1, 2), keepdims=True)
        left = np.clip(1.0 - doubt.astype(np.float64) ** 2 / even, LEAST_LEFT, 1.0)
        expected = left * (even + left * (variance - even)) / variance
    found, wanted = (
        np.where(used, values, 0.0).sum(axis=(1, 2), dtype=np.float64)
        for values in (residual**2 / variance, expected)
    )
    return np.where(used.any(axis=(1, 2)), found / np.where(wanted > 0, wanted, np.inf), np.nan)


def _filled(stars: Stamps, bundle: Bundle, size: int) -> Stamps:
    """Stars up to `size`, the last ones being mean PSFs of which nothing is known."""
    count, side = len(stars), bundle.info.stamp_px
    filled = {}
    for field in fields(stars):
        values = getattr(stars, field.name)
        blank = np.nan if values.dtype.kind == "f" else 0
        more = np.full((size - count, *values.shape[1:]), blank, values.dtype)
        filled[field.name] = np.concatenate([values, more])
    margin = (stars.data.shape[-1] - side) // 2
    inner = slice(margin, margin + side)
    filled["data"][count:] = 0.0
    filled["data"][count:, inner, inner] = bundle.flux_model.mean.reshape(side, side)
    return Stamps(**filled)


@contextmanager
def one_thread_each() -> Iterator[None]:
    """Linear algebra and network on one thread per calling thread, and as before afterwards."""
    with _libraries().limit(limits=1, user_api="blas"), _networks_on_one_thread():
        yield


@contextmanager
def _networks_on_one_thread() -> Iterator[None]:
    """Limit torch to one thread meanwhile, if a network has loaded it already."""
    torch = sys.modules.get("torch")
    if torch is None:
        yield
        return
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@cache
def _libraries() -> ThreadpoolController:
    """Looking for the loaded libraries takes milliseconds, hence once."""
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()
