"""One block of stars through centring, photometry, network, uncertainty and shapes."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

import numpy as np

from psfdae.bundle import Bundle, at_noise, mahalanobis, network
from psfdae.prediction.border import border_median
from psfdae.prediction.centring import displacement, recut
from psfdae.prediction.flags import StarFlag, raise_flag
from psfdae.prediction.photometry import Known, Photometer
from psfdae.prediction.results import Prediction, Stars
from psfdae.prediction.shapes import measure_shapes

BLOCK = 256
"""Stars that are computed together, always so many: other numbers would round otherwise."""

BLOCK_PX = BLOCK * 32**2
"""Pixels of a block at most; larger stamps come in smaller blocks."""

BLOCK_VALUES = 64 * BLOCK_PX
"""Numbers between two layers of the network at most: 64 channels of a block."""

SNR_TOLERANCE = 1.25
"""Factor beyond the trained S/N that raises no flag: a faint star's S/N is no better known."""


class Engine:
    """What a bundle needs to be ready: the network and the photometry's matrices.

    Safe to use from several threads.
    """

    def __init__(self, bundle: Bundle) -> None:
        self.bundle = bundle
        self.network = network(bundle)
        pixels = bundle.info.stamp_px**2
        self.size = min(BLOCK, max(1, BLOCK_PX // pixels))
        widest = max(bundle.info.dae.widths)
        self._images = min(self.size, max(1, BLOCK_VALUES // (widest * pixels)))
        self._photometer = Photometer(bundle.flux_model, bundle.info.components)

    def blocks(self, stars: Stars) -> list[Stars]:
        """Stars in parts of `size`."""
        return [stars.part(slice(a, a + self.size)) for a in range(0, len(stars), self.size)]

    def block(self, stars: Stars) -> Prediction:
        """PSFs of at most `size` stars; computed as if there were just so many."""
        count = len(stars)
        if count < self.size:
            stars = _filled(stars, self.bundle.flux_model.mean, self.size)
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            return self._compute(stars).first(count)

    def _compute(self, stars: Stars) -> Prediction:
        from psfdae.models.dae import predict

        bundle, info = self.bundle, self.bundle.info
        stamps, bad, shift, flags = self._centred(stars)
        sky = border_median(stamps, bad)
        found = self._photometer.measure(stamps, bad, sky, stars.known)
        lost = (found.flags & StarFlag.NO_FLUX) > 0
        if lost.all():  # such as the stars of a catalogue that reaches far beyond the image
            psf = np.empty_like(found.images)
        else:
            psf = predict(self.network, found.images, info.image_scale, self._images)
        psf[lost] = np.nan
        shapes = measure_shapes(psf)
        noise = found.noise / np.where(lost, np.nan, found.flux)
        snr = 1.0 / (noise * info.noise_equivalent_px**0.5)
        distance = mahalanobis(found.images, noise, bundle.flux_model, info.components)
        flux = found.flux.astype(np.float32)[:, None, None]
        uncertainty = at_noise(noise, bundle.noise_nodes, bundle.error68)
        psf *= flux
        uncertainty *= flux
        residual = (stamps - found.background[:, None, None]).astype(np.float32) - psf
        residual[~found.used] = np.nan
        flags |= found.flags
        for flag, where in (
            (StarFlag.SNR_LOW, snr < info.snr_min / SNR_TOLERANCE),
            (StarFlag.SNR_HIGH, snr > info.snr_max * SNR_TOLERANCE),
            (StarFlag.UNLIKE_TRAINING, distance > bundle.distance_limit),
        ):
            raise_flag(flags, flag, where)
        photons = np.nan_to_num(np.maximum(found.flux, 0.0) / stars.gain)
        return Prediction(
            psf=psf,
            residual=residual,
            uncertainty=uncertainty,
            flux=found.flux,
            flux_error=np.sqrt(found.flux_error**2 + photons),
            background=found.background,
            noise=found.noise,
            snr=snr,
            chi2=_chi2(residual, psf, found.noise, stars.gain),
            distance=distance,
            fwhm_px=shapes.fwhm_px,
            ellipticity=shapes.ellipticity,
            position_angle_deg=shapes.position_angle_deg,
            shift_x=shift[:, 1],
            shift_y=shift[:, 0],
            flags=flags,
        )

    def _centred(self, stars: Stars) -> tuple[np.ndarray, ...]:
        """Stamps (n, d, d), their bad pixels, their shift (row, column), and flags so far."""
        info = self.bundle.info
        margin = (stars.data.shape[-1] - info.stamp_px) // 2
        # Saturated pixels show where the star is; the others would mislead.
        data, hidden = stars.data, stars.bad & ~stars.saturated
        if hidden.any():
            data = np.where(hidden, border_median(data, hidden)[:, None, None], data)
        shift = displacement(data, info.jitter_px)
        too_far = np.abs(shift).max(axis=1) > margin
        shift[too_far] = 0
        stamps, bad, saturated = (
            recut(wide, shift, info.stamp_px) for wide in (data, stars.bad, stars.saturated)
        )
        flags = np.zeros(len(stamps), dtype=np.uint16)
        for flag, where in (
            (StarFlag.MASKED, bad.any(axis=(1, 2))),
            (StarFlag.SATURATED, saturated.any(axis=(1, 2))),
            (StarFlag.TRUNCATED, stars.truncated),
            (StarFlag.OFF_CENTRE, too_far),
        ):
            raise_flag(flags, flag, where)
        return stamps, bad | saturated, shift, flags


def _chi2(residual: np.ndarray, psf: np.ndarray, noise: np.ndarray, gain: np.ndarray) -> np.ndarray:
    """Mean of the squared residuals in units of their σ over the pixels that are not NaN."""
    variance = (noise**2).astype(np.float32)[:, None, None]
    if np.isfinite(gain).any():
        per_electron = np.where(gain > 0, 1.0 / gain, 0.0).astype(np.float32)[:, None, None]
        variance = variance + np.maximum(psf, 0.0) * per_electron
    squares = (residual**2 / variance).reshape(len(residual), -1)
    used = np.isfinite(squares)
    if not used.all():
        squares = np.where(used, squares, 0.0)
    count = used.sum(axis=1)
    total = squares.sum(axis=1, dtype=np.float64)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def _filled(stars: Stars, mean: np.ndarray, size: int) -> Stars:
    """Stars up to `size`, the last ones being mean PSFs."""
    missing, side, stamp_px = size - len(stars), stars.data.shape[-1], round(mean.size**0.5)
    margin = (side - stamp_px) // 2
    filler = np.zeros((missing, side, side), stars.data.dtype)
    filler[:, margin : margin + stamp_px, margin : margin + stamp_px] = mean.reshape(
        stamp_px, stamp_px
    )

    def fill(array: np.ndarray, value: Any) -> np.ndarray:
        more = np.full((missing, *array.shape[1:]), value, dtype=array.dtype)
        return np.concatenate([array, more])

    return Stars(
        data=np.concatenate([stars.data, filler]),
        bad=fill(stars.bad, False),
        saturated=fill(stars.saturated, False),
        truncated=fill(stars.truncated, False),
        known=Known(*(fill(value, np.nan) for value in vars(stars.known).values())),
        gain=fill(stars.gain, np.nan),
    )


@contextmanager
def one_thread_each() -> Iterator[None]:
    """Linear algebra and network on one thread per calling thread, and as before afterwards."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with _libraries().limit(limits=1, user_api="blas"):
            yield
    finally:
        torch.set_num_threads(before)


@cache
def _libraries() -> Any:
    """Looking for the loaded libraries takes milliseconds, hence once."""
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()
