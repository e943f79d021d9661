"""`PsfModel`: a model bundle applied to stamps in memory."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from psfdae.bundle import Bundle, BundleInfo, read_bundle
from psfdae.prediction.engine import Engine, one_thread_each
from psfdae.prediction.photometry import Known
from psfdae.prediction.results import Prediction, Stars
from psfdae.threads import side_by_side

SCALE_TOLERANCE = 0.02
"""Relative difference of the pixel scale from that of the training that is accepted."""


class PredictionError(ValueError):
    """Stars that a model cannot be applied to; one line with what it takes instead."""


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
    """
    return PsfModel(read_bundle(None if path is None else Path(path)))


class PsfModel:
    """A trained network with all that it takes to apply it to stars.

    Parameters
    ----------
    bundle : Bundle
        `load_model` reads one from a file.
    """

    def __init__(self, bundle: Bundle) -> None:
        self.bundle = bundle
        self.engine = Engine(bundle)

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
        margin: int = 0,
        threads: int | None = 1,
    ) -> Prediction:
        """PSFs of stars, with uncertainties, photometry, shapes and flags.

        Stars do not influence each other; the result does not depend on the number
        of threads, and on how many stars are passed at once in its rounding at most.

        Parameters
        ----------
        stamps : array, shape (n, s, s) or (s, s)
            s = `info.stamp_px` + 2 `margin`; in any unit, sky included, the star's
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
        given = {"flux": flux, "background": background, "noise": noise, "gain": gain}
        masks = {"bad": bad, "saturated": saturated}
        return self.predict_stars(self._stars(stamps, given, masks, margin), threads)

    def predict_stars(self, stars: Stars, threads: int | None = 1) -> Prediction:
        """As `predict`, of stars that are known to fit."""
        blocks = self.engine.blocks(stars)
        with one_thread_each():
            threads = min(threads or available_cores(), max(len(blocks), 1))
            parts = side_by_side(self.engine.block, blocks or [stars], threads)
        return Prediction.joined(parts)

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
        if pixel_scale_arcsec is None:
            raise PredictionError(
                f"{what}: neither a WCS nor the header gives the pixel scale; "
                f"state it with --pixel-scale (the model's is {trained:.6g} arcsec)"
            )
        if not abs(pixel_scale_arcsec / trained - 1.0) <= SCALE_TOLERANCE:
            raise PredictionError(
                f"{what}: pixels of {pixel_scale_arcsec:.6g} arcsec, but the model "
                f"{self.info.name!r} was trained on {trained:.6g} arcsec "
                f"(tolerance {100 * SCALE_TOLERANCE:g} %)"
            )

    def _stars(
        self,
        stamps: ArrayLike,
        given: dict[str, ArrayLike | None],
        masks: dict[str, ArrayLike | None],
        margin: int,
    ) -> Stars:
        """Stars from what a caller gives, checked."""
        data = _numbers("stamps", stamps)
        single = data.ndim == 2
        data = data[None] if single else data
        self._check_shape(data, margin)
        finite = np.isfinite(data)
        values = {name: _per_star(name, value, len(data)) for name, value in given.items()}
        hidden = {name: _mask(name, mask, data, single) for name, mask in masks.items()}
        return Stars(
            data=data if finite.all() else np.where(finite, data, 0),
            bad=hidden["bad"] | ~finite,
            saturated=hidden["saturated"],
            truncated=np.zeros(len(data), dtype=bool),
            gain=values.pop("gain"),
            known=Known(**values),
        )

    def _check_shape(self, data: np.ndarray, margin: int) -> None:
        side = self.info.stamp_px + 2 * margin
        if margin < 0 or data.ndim != 3 or data.shape[1:] != (side, side):
            size = "×".join(str(n) for n in data.shape)
            raise PredictionError(
                f"stamps of shape {size}, but the model {self.info.name!r} takes n×{side}×{side}"
            )


def available_cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _numbers(name: str, values: ArrayLike) -> np.ndarray:
    """An array of float32 or float64 in the machine's byte order."""
    array = np.asarray(values)
    if array.dtype.kind not in "fiub":
        raise PredictionError(f"{name} of type {array.dtype}, expected real numbers")
    narrow = array.dtype.kind == "f" and array.dtype.itemsize <= 4
    return array.astype(np.float32 if narrow else np.float64, copy=False)


def _mask(name: str, mask: ArrayLike | None, data: np.ndarray, single: bool) -> np.ndarray:
    if mask is None:
        return np.zeros(data.shape, dtype=bool)
    array = np.asarray(mask, dtype=bool)
    array = array[None] if single else array
    if array.shape != data.shape:
        raise PredictionError(f"{name} of shape {array.shape}, but stamps of shape {data.shape}")
    return array


def _per_star(name: str, value: ArrayLike | None, count: int) -> np.ndarray:
    """One number per star, NaN where it is not known."""
    numbers = _numbers(name, np.nan if value is None else value).astype(np.float64)
    if numbers.ndim > 1 or (numbers.ndim == 1 and len(numbers) != count):
        raise PredictionError(f"{name} of shape {numbers.shape}, expected one for {count} stamps")
    return np.broadcast_to(numbers, (count,))
