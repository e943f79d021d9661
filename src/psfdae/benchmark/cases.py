"""Wavefronts that every way of propagating has to cope with, and their exact stamps."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from psfdae.configuration.schema import Framing, Optics
from psfdae.configuration.telescope import Telescope
from psfdae.optics.propagation import StampPropagator
from psfdae.optics.pupil import Pupil, annular_pupil
from psfdae.optics.wavefronts import WavefrontSource
from psfdae.stars.framing import normalise_flux
from psfdae.stars.scene import Propagation

BUDGET = 0.01
"""Numerical MSE that a stamp may have, in units of the smallest noise variance it carries."""

REFERENCES = ((512, 5), (768, 6), (1024, 8))
"""Pupil samples and nodes of the reference; the last is used, the others show convergence."""

pupil_of = lru_cache(maxsize=32)(annular_pupil)
"""Pupils by (samples, obscuration): a sweep over settings asks for the same ones again."""


def error_budget(kappa: float, levels: list[float]) -> float:
    """Largest allowed numerical MSE of a flux-normalised stamp.

    Parameters
    ----------
    kappa : float
        Pixel RMS of the noise per unit of λ.
    levels : list of float
        Noise levels λ that the stamps will carry.
    """
    return BUDGET * (kappa * min(levels)) ** 2


@dataclass(frozen=True)
class Scene:
    """A scene as the benchmarks see it; everything in it can be sent to another process.

    Attributes
    ----------
    name : str
    telescope, optics, framing : config groups
    templates, stars : WavefrontSource
        Static wavefronts of the fields; those of the stars (the same object where
        stars have no aberrations of their own).
    search_px : int
        Search distance of the stars' brightest pixels.
    budget : float
        See `error_budget`.
    """

    name: str
    telescope: Telescope
    optics: Optics
    framing: Framing
    templates: WavefrontSource
    stars: WavefrontSource
    search_px: int
    budget: float

    def propagation(self, source: WavefrontSource, search_px: int, **optics: Any) -> Propagation:
        """The scene's own way from wavefronts to stamps, with changed optics if named."""
        settings = self.optics.model_copy(update=optics)
        return Propagation(source, self.telescope, settings, self.framing, search_px)


class Selection:
    """Some wavefronts of a source as a source of their own.

    Parameters
    ----------
    source : WavefrontSource
    index : ndarray of int, shape (b,)
    slopes : ndarray, shape (B, 2, 2), optional
        Slopes of all wavefronts of the source, if they have been measured.
    """

    def __init__(
        self, source: WavefrontSource, index: np.ndarray, slopes: np.ndarray | None = None
    ) -> None:
        self.index = np.asarray(index)
        self._source = source
        self._slopes = (source.slopes() if slopes is None else slopes)[self.index]

    def __len__(self) -> int:
        return len(self.index)

    def slopes(self) -> np.ndarray:
        """Extreme slopes in waves per pupil radius, shape (b, 2, 2)."""
        return self._slopes

    def opd(self, index: np.ndarray, pupil: Pupil, dtype: np.dtype) -> np.ndarray:
        """OPD in waves of the selected wavefronts `index`, shape (n, M, M)."""
        return self._source.opd(self.index[index], pupil, dtype)


@dataclass(frozen=True)
class Case:
    """One wavefront with its exact stamp.

    Attributes
    ----------
    scene, aberration : str
        For example "seidel", "strong".
    source : WavefrontSource of length 1
    offset_px : ndarray, shape (1, 2)
        Brightest pixel (row, column) from the chief ray: where the stamp is centred.
    samples : int
        Pupil samples that the scene's settings give this wavefront.
    stamp_px, pixel, obscuration
        Geometry; pixel width in λ/D.
    budget : float
    truth : ndarray, shape (d, d)
        Stamp of sum 1.
    """

    scene: str
    aberration: str
    source: WavefrontSource
    offset_px: np.ndarray
    samples: int
    stamp_px: int
    pixel: float
    obscuration: float
    budget: float
    truth: np.ndarray

    def batch(self, pupil: Pupil, count: int, dtype: np.dtype) -> np.ndarray:
        """The wavefront's OPD in waves, `count` times, shape (count, M, M)."""
        opd = self.source.opd(np.zeros(1, dtype=int), pupil, dtype)
        return np.repeat(opd, count, axis=0)


def stamps_at(
    scene: Scene,
    source: WavefrontSource,
    offset_px: np.ndarray,
    samples: int,
    nodes: int,
    precision: str = "complex128",
) -> np.ndarray:
    """Flux-normalised stamps of all wavefronts of a source at one setting, numpy.

    Raises
    ------
    SamplingError
        If the source refuses so coarse a grid.
    """
    pupil = pupil_of(samples, scene.telescope.obscuration)
    size, pixel = scene.framing.stamp_px, scene.telescope.pixel
    kernel = StampPropagator(pupil, size, pixel, nodes, precision)  # type: ignore[arg-type]
    out = np.empty((len(source), size, size))
    step = max(1, scene.optics.batch // 4)
    for start in range(0, len(source), step):
        stars = np.arange(start, min(start + step, len(source)))
        opd = source.opd(stars, pupil, kernel.real_dtype)
        out[stars] = kernel(opd, offset_px[stars])
    return normalise_flux(out)[0]


def errors(stamp: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """Largest difference of a pixel in units of the true peak, and the MSE.

    Parameters
    ----------
    stamp, truth : ndarray, shape (d, d)
        Stamps of sum 1.
    """
    difference = np.asarray(stamp, dtype=np.float64) - truth
    return float(np.abs(difference).max() / truth.max()), float((difference**2).mean())


def build_cases(scene: Scene) -> tuple[list[Case], list[dict[str, Any]]]:
    """The least steep template as the mild and the steepest star as the strong case.

    Returns
    -------
    cases : list of Case
    convergence : list of rows
        MSE of the coarser references against the finest, per case.
    """
    picks = (
        ("mild", scene.templates, np.argmin, scene.framing.search_px),
        ("strong", scene.stars, np.argmax, scene.search_px),
    )
    cases, rows = [], []
    for aberration, source, pick, search_px in picks:
        slopes = source.slopes()
        chosen = int(pick(np.abs(slopes).max(axis=(1, 2))))
        one = Selection(source, np.array([chosen]), slopes)
        case, convergence = _case(scene, aberration, one, search_px)
        cases.append(case)
        rows += convergence
    return cases, rows


def _case(
    scene: Scene, aberration: str, one: Selection, search_px: int
) -> tuple[Case, list[dict[str, Any]]]:
    # A copy: sources keep images of every grid, and the case will be sent to other processes.
    work = deepcopy(one)
    propagation = scene.propagation(work, search_px)
    offset = propagation.brightest()
    stamps = [stamps_at(scene, work, offset, n, q)[0] for n, q in REFERENCES]
    key = {"scene": scene.name, "aberration": aberration}
    convergence = [
        {
            **key,
            "samples": samples,
            "nodes": nodes,
            "finest_samples": REFERENCES[-1][0],
            "finest_nodes": REFERENCES[-1][1],
            "mse": errors(stamp, stamps[-1])[1],
            "budget": scene.budget,
        }
        for (samples, nodes), stamp in zip(REFERENCES[:-1], stamps, strict=False)
    ]
    case = Case(
        **key,
        source=one,
        offset_px=offset,
        samples=int(propagation.samples[0]),
        stamp_px=scene.framing.stamp_px,
        pixel=scene.telescope.pixel,
        obscuration=scene.telescope.obscuration,
        budget=scene.budget,
        truth=stamps[-1],
    )
    return case, convergence
