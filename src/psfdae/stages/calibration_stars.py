"""Bright stars of an observation, and the product "stars" that is made of them."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from psfdae.files import Column, write_product, write_text
from psfdae.observations import Observation, Stamps
from psfdae.rng import stream
from psfdae.safe_text import no_formula
from psfdae.stars.calibration_stars import (
    CalibrationStarsError,
    Verdict,
    brightest_pixels,
    crowded,
    misfit,
    signal_to_noise,
    sky_around,
    star_centres,
    window_of,
)
from psfdae.stars.from_observation import (
    BrightStars,
    aligned_stars,
    cut,
    make_images,
    star_of_images,
    templates_of,
)

ROWS = 2048
"""Stars that are measured at a time."""

DEFECT = 6.0
"""Pixels this many σ below the sky are defects; they are raised to that."""

LEAST_SKY = 2.0 * DEFECT**2
"""Photons per pixel of the new noise, at least: a rate of photons cannot be negative.

The deepest pixel of a star that is made fainter has B − DEFECT √B photons at most.
"""


@dataclass(frozen=True)
class Candidates:
    """What is known of all n stars of an observation, and the bright ones among them.

    Attributes
    ----------
    id : ndarray, shape (n,)
    position : ndarray, shape (n, 2)
        (x, y), NaN where unknown.
    snr, noise : ndarray, shape (n,)
        Signal to noise; RMS of the sky in counts per pixel.
    verdict : ndarray of str, shape (n,)
        A `Verdict` for every star.
    bright : BrightStars
        The good ones.
    """

    id: np.ndarray
    position: np.ndarray
    snr: np.ndarray
    noise: np.ndarray
    verdict: np.ndarray
    bright: BrightStars

    def count(self) -> str:
        """How many stars there are of every verdict, in words."""
        found = Counter(self.verdict.tolist())
        return ", ".join(f"{found[v]} {v}" for v in map(str, Verdict) if found[v])


def collect(observation: Observation, config: Any) -> Candidates:
    """Measure all stars and choose those that are good enough to learn from.

    Only stamps of bright stars are kept in memory.

    Parameters
    ----------
    observation : Observation
        Opened with `stamp_px` (a cube: its own, larger one) and the margin.
    config : config with `calibration_stars` and `framing`

    Raises
    ------
    CalibrationStarsError
        If there are fewer good stars than `calibration_stars.stars_min`.
    """
    measured = [_measure(chunk, config) for chunk in observation.chunks(ROWS)]
    columns, kept = zip(*measured, strict=True)
    found = {key: np.concatenate([c[key] for c in columns]) for key in columns[0]}
    settings, side = config.calibration_stars, config.framing.stamp_px
    verdict = found["verdict"]
    close = crowded(
        found["position"],
        found["snr"] * found["noise"],
        settings.isolation_px,
        settings.neighbour_ratio,
    )
    verdict[close & (verdict == Verdict.GOOD)] = Verdict.CROWDED
    row = np.flatnonzero(found["kept"])
    wide, peak = (np.concatenate([k[i] for k in kept]) for i in (0, 1))
    wide = np.maximum(wide, -DEFECT * found["noise"][row, None, None])
    flux = cut(wide, peak, side).sum(axis=(1, 2))
    verdict[row[flux <= 0]] = Verdict.MISFIT
    good = verdict[row] == Verdict.GOOD
    wide, peak, flux, row = wide[good], peak[good], flux[good], row[good]
    noise, snr = found["noise"][row], found["snr"][row]
    centre = star_centres(wide, peak, window_of(snr, flux, noise))
    bright = BrightStars(wide, peak, centre, found["position"][row], flux, noise, snr, row)
    score = _misfits(bright, side)
    verdict[row[score > settings.misfit]] = Verdict.MISFIT
    result = Candidates(
        **{key: found[key] for key in ("id", "position", "snr", "noise", "verdict")},
        bright=bright.of(score <= settings.misfit),
    )
    _check_number(result, observation.path, settings)
    return result


def _measure(chunk: Stamps, config: Any) -> tuple[dict[str, np.ndarray], tuple[np.ndarray, ...]]:
    """Columns for all stars of a chunk; stamps and peaks of the bright ones."""
    settings, side = config.calibration_stars, config.framing.stamp_px
    sky = sky_around(chunk.data, chunk.bad, side)
    wide = np.where(chunk.bad, 0.0, chunk.data - sky.level[:, None, None])
    middle = np.zeros((len(chunk), 2), dtype=np.int64)
    reach = min(settings.search_px, (wide.shape[-1] - 5) // 2)
    peak, centred = brightest_pixels(wide, reach)
    needed = side + 2 * min(reach + config.framing.jitter_px + 1, (wide.shape[-1] - side) // 2)
    snr = signal_to_noise(cut(wide, middle, side), sky.noise)
    verdict = np.full(len(chunk), Verdict.GOOD, dtype="<U16")
    for reason, stars in (
        (Verdict.OFF_CENTRE, ~centred),
        (Verdict.FAINT, snr < settings.snr_min),
        (Verdict.SATURATED, cut(chunk.saturated, middle, side).any(axis=(1, 2))),
        (Verdict.INCOMPLETE, cut(chunk.bad, middle, needed).any(axis=(1, 2))),
    ):
        verdict[stars] = reason
    kept = verdict == Verdict.GOOD
    columns = {
        "id": chunk.id,
        "position": np.stack([chunk.x, chunk.y], axis=1),
        "snr": snr,
        "noise": sky.noise,
        "verdict": verdict,
        "kept": kept,
    }
    return columns, (wide[kept], peak[kept])


def _misfits(stars: BrightStars, side: int) -> np.ndarray:
    middle = np.zeros((len(stars), 2), dtype=np.int64)
    stamps = cut(aligned_stars(stars), middle, side)
    return misfit(stamps, stars.position, stars.noise / stars.flux)


def _check_number(found: Candidates, path: Path, settings: Any) -> None:
    if len(found.bright) < settings.stars_min:
        raise CalibrationStarsError(
            f"{path}: {len(found.bright)} stars are good enough to learn from, "
            f"calibration_stars.stars_min = {settings.stars_min} are needed "
            f"(of {len(found.verdict)}: {found.count()})"
        )


def write_selection(found: Candidates, held_out: np.ndarray, path: Path) -> None:
    """CSV with every star of the catalogue: id, x, y, snr, verdict, part."""
    import pandas as pd

    part = np.full(len(found.verdict), "", dtype="<U8")
    part[found.bright.row] = np.where(held_out, "held out", "training")
    table = pd.DataFrame(
        {
            "id": found.id if found.id.dtype.kind == "i" else [no_formula(n) for n in found.id],
            "x": found.position[:, 0],
            "y": found.position[:, 1],
            "snr": found.snr,
            "verdict": found.verdict,
            "part": part,
        }
    )
    write_text(path, table.to_csv(index=False, float_format="%.6g"))


def sky_photons(bright: BrightStars, gain: float | None, otherwise: float) -> float:
    """Photons per pixel whose Poisson noise is the sky's, read noise included.

    Parameters
    ----------
    bright : BrightStars
    gain : electrons per count, None if unknown
    otherwise : for an unknown gain
    """
    if gain is None:
        return otherwise
    return max(float(np.median(bright.noise) * gain) ** 2, LEAST_SKY)


def write_stars(
    bright: BrightStars,
    grid: np.ndarray,
    held_out: np.ndarray,
    config: Any,
    described: dict[str, Any],
    out: Path,
) -> dict[str, np.ndarray]:
    """Make the images and write the product "stars".

    Parameters
    ----------
    bright : BrightStars
    grid : ndarray, shape (n, 2)
        Place of every star (`star_grid`).
    held_out : ndarray of bool, shape (n,)
    config : config with seed, calibration_stars, framing and parts
    described : goes into the product as its configuration
    out : path of the HDF5 product

    Returns
    -------
    dict of ndarray
        The columns.
    """
    framing, parts = config.framing, config.parts
    star = star_of_images(held_out, parts.train_stars, parts.test_stars)
    template = templates_of(bright, held_out, config.calibration_stars.bins)
    images = make_images(
        bright,
        template,
        star,
        framing.stamp_px,
        framing.jitter_px,
        ~held_out[star] & framing.subpixel,
        stream(config.seed, "own stars"),
    )
    columns = {
        "template": Column(images.template, "1", "stack of the star's part of the field, sum 1"),
        "realisation": Column(images.realisation, "1", "the star itself, sum 1"),
        "field_index": Column(images.star, "1", "star that the image shows"),
        "grid": Column(grid, "1", "place (ix, iy) of every star in the order of x and y"),
        "jitter": Column(images.jitter, "pixel", "centring error (row, column)"),
        "position": Column(bright.position, "pixel", "(x, y) of every star, 0-based"),
        "snr": Column(bright.snr, "1", "signal to noise of every star"),
        "noise": Column(bright.noise / bright.flux, "1", "pixel RMS over flux of every star"),
        "row": Column(bright.row, "1", "row of every star in the catalogue"),
    }
    write_product(out, "stars", columns, described)
    return {name: column.values for name, column in columns.items()}
