"""Scenes as the benchmarks of the optics see them: wavefronts, and stamps that are exact."""

from copy import deepcopy
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from psfdae.base.rng import stream
from psfdae.optics.propagation import StampPropagator
from psfdae.optics.pupil import annular_pupil
from psfdae.optics.wavefronts import WavefrontSource
from psfdae.telescope.settings import Telescope
from psfdae_paper.configuration.consistency import SIMULATION
from psfdae_paper.configuration.schema import Framing, Optics
from psfdae_paper.stars.fields import assign_fields
from psfdae_paper.stars.framing import Propagation, normalise_flux
from psfdae_paper.stars.scenes import star_wavefronts, template_wavefronts

READS = (*SIMULATION, "noise", "benchmark")
BUDGET = 0.01  # numerical MSE of a stamp in units of the smallest noise variance it carries

# Pupil samples and extra points of the reference; the last is used, the others show convergence.
REFERENCES = ((512, 8), (768, 12), (1024, 16))

pupil_of = lru_cache(maxsize=32)(annular_pupil)  # a sweep asks for the same pupils again


@dataclass(frozen=True)
class Scene:
    """A scene; everything in it can be sent to another process.

    `templates` are the static wavefronts of the fields and `stars` those of the stars (the
    same object where these have no aberrations of their own), `search_px` the search
    distance of the stars' brightest pixels.
    """

    name: str
    telescope: Telescope
    optics: Optics
    framing: Framing
    templates: WavefrontSource
    stars: WavefrontSource
    search_px: int
    budget: float

    @classmethod
    def of(cls, config):
        """The scene of a configuration, with the wavefronts that its stages use."""
        templates = template_wavefronts(config)
        stars, search_px = templates, config.framing.search_px
        if config.stars.aberration_fraction > 0:
            rng = stream(config.seed, "field", config.stars.name)
            fields = assign_fields(config.stars.count, len(templates), rng)
            stars, search_px = star_wavefronts(config, fields), config.stars.search_px
        # Levels λ have an RMS of κλ a pixel.
        budget = BUDGET * (config.noise.kappa * min(config.noise.levels)) ** 2
        groups = (config.telescope, config.optics, config.framing)
        return cls(config.scene.name, *groups, templates, stars, search_px, budget)

    def propagation(self, source, search_px, **optics):
        """The scene's own way from wavefronts to stamps, with changed optics if named."""
        settings = self.optics.model_copy(update=optics)
        return Propagation(source, self.telescope, settings, self.framing, search_px)


class Selection:
    """Some wavefronts of a source as a source; `slopes` are those of all, if known."""

    def __init__(self, source, index, slopes=None):
        self.index = np.asarray(index)
        self._source = source
        self._slopes = (source.slopes() if slopes is None else slopes)[self.index]

    def __len__(self):
        return len(self.index)

    def slopes(self):
        """Extreme slopes in waves per pupil radius, shape (b, 2, 2)."""
        return self._slopes

    def opd(self, index, pupil, dtype):
        """OPD in waves of the selected wavefronts `index`, shape (n, M, M)."""
        return self._source.opd(self.index[index], pupil, dtype)


@dataclass(frozen=True)
class Case:
    """One wavefront with its exact stamp of sum 1, `truth`.

    `source` has length 1; `offset_px`, shape (1, 2), is its brightest pixel from the chief
    ray, where the stamp is centred; `samples` are those that the scene gives it; `pixel` is
    in λ/D.
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

    def batch(self, pupil, count, dtype):
        """The wavefront's OPD in waves, `count` times, shape (count, M, M)."""
        opd = self.source.opd(np.zeros(1, dtype=int), pupil, np.dtype(dtype))
        return np.repeat(opd, count, axis=0)


def simulate_stamps(scene, source, offset_px, samples, points, precision="complex128"):
    """Stamps of sum 1 of all wavefronts at one setting; SamplingError if it is too coarse."""
    pupil = pupil_of(samples, scene.telescope.obscuration)
    size = scene.framing.stamp_px
    kernel = StampPropagator(pupil, size, scene.telescope.pixel, points, precision)
    out = np.empty((len(source), size, size))
    step = max(1, scene.optics.batch // 4)
    for start in range(0, len(source), step):
        stars = np.arange(start, min(start + step, len(source)))
        out[stars] = kernel(source.opd(stars, pupil, kernel.real_dtype), offset_px[stars])
    return normalise_flux(out)[0]


def stamp_mse(stamps, truth):
    """Mean squared difference of stamps, shape (n,)."""
    return ((stamps - truth) ** 2).mean(axis=(1, 2))


def compare_to_peak(stamps, reference):
    """Largest difference of normalised stamps in units of each reference's peak."""
    stamps, reference = normalise_flux(stamps)[0], normalise_flux(reference)[0]
    return float((np.abs(stamps - reference).max((-2, -1)) / reference.max((-2, -1))).max())


def spread_evenly(total, count):
    """Return at most `count` indices from 0 to total − 1."""
    return np.unique(np.linspace(0, total - 1, min(total, count)).round().astype(int))


def build_cases(scene):
    """The least steep template as the mild and the steepest star as the strong case.

    Returns the cases, and rows with the MSE of the coarser references against the finest.
    """
    cases, rows = [], []
    for aberration, source, pick, search_px in (
        ("mild", scene.templates, np.argmin, scene.framing.search_px),
        ("strong", scene.stars, np.argmax, scene.search_px),
    ):
        slopes = source.slopes()
        selection = Selection(source, np.array([pick(np.abs(slopes).max(axis=(1, 2)))]), slopes)
        # A copy: sources keep images of every grid, and the case is sent to other processes.
        work = deepcopy(selection)
        propagation = scene.propagation(work, search_px)
        offset = propagation.brightest()
        stamps = [simulate_stamps(scene, work, offset, *reference) for reference in REFERENCES]
        geometry = (scene.framing.stamp_px, scene.telescope.pixel, scene.telescope.obscuration)
        samples, truth = int(propagation.samples[0]), stamps[-1][0]
        place = (selection, offset, samples, *geometry, scene.budget, truth)
        cases.append(Case(scene.name, aberration, *place))
        for (samples, points), stamp in zip(REFERENCES[:-1], stamps, strict=False):
            row = {"scene": scene.name, "aberration": aberration}
            row |= {"samples": samples, "points": points}
            row |= {"finest_samples": REFERENCES[-1][0], "finest_points": REFERENCES[-1][1]}
            rows.append({**row, "mse": stamp_mse(stamp, stamps[-1])[0], "budget": scene.budget})
    return cases, rows
