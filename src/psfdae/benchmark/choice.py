"""Which (pupil samples, nodes, precision) a scene should use: the cheapest within its budget."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from psfdae.benchmark.cases import Scene, Selection, stamps_at
from psfdae.benchmark.propagation import PRECISIONS, candidate_nodes, candidate_samples, yes
from psfdae.configuration.schema import Optics
from psfdae.optics.sampling import SamplingError, choose_samples, required_nodes
from psfdae.stars.framing import normalise_flux

if TYPE_CHECKING:
    import pandas as pd

REFERENCE = (768, 6)
"""Pupil samples and nodes of the exact stamps; `build_cases` shows that they are exact enough."""

SCREENED = 32
"""Stars that are screened for large errors where not all are."""

SAME_TIME = 0.02
"""Relative difference of two times that says nothing: repeats spread by more."""

EVERY_GRID = range(16, 2049)
"""A ladder without gaps, to ask the sampling guard what it needs."""


@dataclass(frozen=True)
class Sample:
    """Stars of a scene with their errors at every candidate setting.

    Attributes
    ----------
    needed : ndarray of int, shape (n,)
        Pupil samples that the sampling guard asks for each star.
    population : ndarray of int, shape (B,)
        The same for all stars of the scene.
    stamps : mapping of (samples, nodes, precision) to ndarray, shape (n, d, d)
        Stamps of sum 1 where the grid does not alias the wavefront's own spectrum.
    truth : ndarray, shape (n, d, d)
    even : ndarray of bool, shape (n,)
        Stars that are spread evenly; the others were taken for their large errors.
    """

    needed: np.ndarray
    population: np.ndarray
    stamps: Mapping[tuple[int, int, str], np.ndarray]
    truth: np.ndarray
    even: np.ndarray

    def mse(self, samples: np.ndarray, nodes: int, precision: str) -> np.ndarray:
        """Numerical MSE of every star on a grid of its own, shape (n,)."""
        return stamp_mse(self.at(samples, nodes, precision), self.truth)

    def at(self, samples: np.ndarray, nodes: int, precision: str) -> np.ndarray:
        """Stamps with each star on a grid of its own, shape (n, d, d)."""
        return np.stack([self.stamps[int(n), nodes, precision][i] for i, n in enumerate(samples)])

    def grids(self) -> tuple[int, ...]:
        """Candidate grid sizes, ascending."""
        return tuple(sorted({samples for samples, _, _ in self.stamps}))


def stamp_mse(stamps: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Mean squared difference of stamps, shape (n,)."""
    return ((stamps - truth) ** 2).mean(axis=(1, 2))


def guard_samples(scene: Scene) -> np.ndarray:
    """Pupil samples N that the sampling guard asks for every star of a scene, shape (B,)."""
    every = scene.propagation(scene.stars, scene.search_px, pupil_samples=list(EVERY_GRID))
    return every.samples


def spread(needed: np.ndarray, ladder: Sequence[int], per_rung: int) -> np.ndarray:
    """Stars spread evenly over what they need, within every rung that they use.

    The least and the most demanding star of a rung are always among them.

    Returns
    -------
    ndarray of int
        At most `per_rung` indices per rung, ascending.
    """
    rungs = choose_samples(needed, tuple(ladder))
    picks = []
    for rung in np.unique(rungs):
        members = np.flatnonzero(rungs == rung)
        members = members[np.argsort(needed[members], kind="stable")]
        places = np.linspace(0, members.size - 1, min(per_rung, members.size)).round().astype(int)
        picks.append(members[places])
    return np.sort(np.concatenate(picks))


def take_sample(scene: Scene, stars: int, thorough: bool) -> Sample:
    """Errors of a sample of a scene's stars at all candidate settings.

    The sample is spread over the rungs, and holds the stars whose errors are the
    largest of all (see `screen`), because the worst star of a set decides.

    Parameters
    ----------
    scene : Scene
    stars : int
        Stars of each rung.
    thorough : bool
        All candidates, or only those next to the configured setting.
    """
    population = guard_samples(scene)
    even = spread(population, scene.optics.pupil_samples, stars)
    worst = screen(scene, population, max(1, stars // 8), thorough)
    index = np.union1d(even, worst)
    source = Selection(scene.stars, index)
    offset = scene.propagation(source, scene.search_px).brightest()
    stamps = {}
    least = required_nodes(scene.telescope.pixel)
    allowed = [q for q in candidate_nodes(scene.optics, thorough) if q >= least]
    for samples in candidate_samples(scene.optics, thorough):
        for nodes, precision in product(allowed, PRECISIONS):
            try:
                found = stamps_at(scene, source, offset, samples, nodes, precision)
            except SamplingError:
                break
            stamps[samples, nodes, precision] = found
    truth = stamps_at(scene, source, offset, *REFERENCE)
    return Sample(population[index], population, stamps, truth, np.isin(index, even))


def screen(scene: Scene, needed: np.ndarray, kept: int, thorough: bool) -> np.ndarray:
    """Stars whose stamps change most on coarser grids or with fewer nodes.

    Parameters
    ----------
    needed : ndarray of int, shape (B,)
        Pupil samples that the sampling guard asks for every star of the scene.
    kept : int
        Stars kept per grid size, and for the nodes.
    thorough : bool
        All stars and candidates, or `SCREENED` stars and few candidates.

    Returns
    -------
    ndarray of int
        Their indices, ascending.
    """
    count = needed.size if thorough else min(SCREENED, needed.size)
    looked_at = np.linspace(0, needed.size - 1, count).round().astype(int)
    slopes, optics = scene.stars.slopes(), scene.optics
    offset = scene.propagation(
        Selection(scene.stars, looked_at, slopes), scene.search_px
    ).brightest()

    def stamps(members: np.ndarray, samples: int, nodes: int) -> np.ndarray:
        some = Selection(scene.stars, looked_at[members], slopes)
        settings = {"pupil_samples": [samples], "nodes": nodes}
        propagation = scene.propagation(some, scene.search_px, **settings)
        return normalise_flux(propagation.stamps(scene.framing.stamp_px, offset[members]))[0]

    everyone = np.arange(count)
    finest = int(choose_samples(needed[looked_at].max(keepdims=True), optics.pupil_samples)[0])
    exact = stamps(everyone, finest, optics.nodes)
    integrated = stamps(everyone, finest, optics.nodes + 2)
    changes = [(everyone, stamp_mse(exact, integrated))]
    # The stars that fewer nodes spoil most are others.
    for nodes in range(required_nodes(scene.telescope.pixel), optics.nodes):
        changes.append((everyone, stamp_mse(stamps(everyone, finest, nodes), integrated)))
    for samples in candidate_samples(optics, thorough):
        members = np.flatnonzero(needed[looked_at] <= samples)
        if members.size and samples <= optics.pupil_samples[0]:
            coarse = stamps(members, samples, optics.nodes)
            changes.append((members, stamp_mse(coarse, exact[members])))
    worst = [members[np.argsort(change)[-kept:]] for members, change in changes]
    return looked_at[np.unique(np.concatenate(worst))]


def ladders(optics: Optics, grids: Sequence[int]) -> list[tuple[int, ...]]:
    """Candidate ladders: from every first rung on the configured rungs, or all candidates."""
    found = []
    for first in grids:
        found.append((first, *(n for n in optics.pupil_samples if n > first)))
        found.append(tuple(n for n in grids if n >= first))
    return list(dict.fromkeys(found))


def cheapest_within(time: np.ndarray, error: np.ndarray, budget: float) -> int | None:
    """Index of the least time whose error is within the budget.

    Parameters
    ----------
    time, error : ndarray, shape (n,)
        NaN times count as unknown and are never chosen.

    Returns
    -------
    int or None
        None if nothing is within the budget. Of equal times the first.
    """
    allowed = np.flatnonzero((error <= budget) & np.isfinite(time))
    return None if allowed.size == 0 else int(allowed[np.argmin(time[allowed])])


def choose(
    scene: Scene, sample: Sample, time_ms: Mapping[tuple[int, int, str], float]
) -> pd.DataFrame:
    """Worst error and mean time of every candidate, the cheapest one and the configured one.

    A candidate is a ladder, a number of nodes and a precision; every star takes
    the first rung that the sampling guard allows it.

    Parameters
    ----------
    scene, sample
    time_ms : mapping of (samples, nodes, precision) to the time of a stamp in ms

    Returns
    -------
    DataFrame
        Columns scene, ladder, first_rung, nodes, precision, stars, mse (the worst),
        budget, within_budget, time_ms (mean over all stars of the scene), cheapest,
        configured, config_is_cheapest.
    """
    import pandas as pd

    optics, rows = scene.optics, []
    nodes_tried = sorted({nodes for _, nodes, _ in sample.stamps})
    for ladder in ladders(optics, sample.grids()):
        if ladder[-1] < sample.population.max():
            continue
        own = choose_samples(sample.needed, ladder)
        everyone, count = np.unique(choose_samples(sample.population, ladder), return_counts=True)
        for nodes, precision in product(nodes_tried, PRECISIONS):
            worst = float(sample.mse(own, nodes, precision).max())
            times = [time_ms.get((int(n), nodes, precision), np.nan) for n in everyone]
            configured = (list(ladder), nodes, precision) == (
                optics.pupil_samples,
                optics.nodes,
                optics.precision,
            )
            rows.append(
                {
                    "scene": scene.name,
                    "ladder": "-".join(map(str, ladder)),
                    "first_rung": ladder[0],
                    "nodes": nodes,
                    "precision": precision,
                    "stars": len(own),
                    "mse": worst,
                    "budget": scene.budget,
                    "within_budget": yes(worst <= scene.budget),
                    "time_ms": float(np.average(times, weights=count)),
                    "configured": yes(configured),
                }
            )
    return _mark_cheapest(pd.DataFrame(rows), scene.budget)


def _mark_cheapest(table: pd.DataFrame, budget: float) -> pd.DataFrame:
    """Times within `SAME_TIME` are equal; among equal candidates the configured one stays."""
    best = cheapest_within(table["time_ms"].to_numpy(), table["mse"].to_numpy(), budget)
    good = (table["configured"] == "yes") & (table["mse"] <= budget)
    for configured in table.index[good]:
        if table.loc[configured, "time_ms"] <= (1.0 + SAME_TIME) * table.loc[best, "time_ms"]:
            best = int(configured)
    table.insert(10, "cheapest", [yes(i == best) for i in range(len(table))])
    agrees = best is not None and table.loc[best, "configured"] == "yes"
    return table.assign(config_is_cheapest=yes(agrees))


def guard_or_budget(scene: Scene, sample: Sample) -> pd.DataFrame:
    """What decides the pupil samples of the stars: the sampling guard or the error budget.

    Returns
    -------
    DataFrame
        One row per rung in use, columns scene, rung, share (of all stars), stars (of
        the sample), guard_min, guard_max (N that the guard asks for), budget_min,
        budget_max (N from which on a star stays within the budget with the configured
        nodes and precision, among the candidates; NaN if it never does), decided_by_budget
        (share of the evenly spread stars for which the budget asks for more).
    """
    import pandas as pd

    optics, grids = scene.optics, sample.grids()
    nodes, precision = optics.nodes, optics.precision
    error = np.stack(
        [stamp_mse(sample.stamps[n, nodes, precision], sample.truth) for n in grids], axis=1
    )
    by_budget = first_lasting(error <= scene.budget, np.array(grids, float))
    by_guard = choose_samples(sample.needed, grids)
    more = ~(by_budget <= by_guard)
    rung = choose_samples(sample.needed, tuple(optics.pupil_samples))
    whole = choose_samples(sample.population, tuple(optics.pupil_samples))
    rows = []
    for n in np.unique(rung):
        of_rung = rung == n
        everyone = sample.population[whole == n]
        rows.append(
            {
                "scene": scene.name,
                "rung": int(n),
                "share": float((whole == n).mean()),
                "stars": int(of_rung.sum()),
                "guard_min": int(everyone.min()),
                "guard_max": int(everyone.max()),
                "budget_min": np.fmin.reduce(by_budget[of_rung]),
                "budget_max": by_budget[of_rung].max(),
                "decided_by_budget": float(more[of_rung & sample.even].mean()),
            }
        )
    return pd.DataFrame(rows)


def first_lasting(fine: np.ndarray, values: np.ndarray) -> np.ndarray:
    """First value from which on all following entries of a row are true.

    Parameters
    ----------
    fine : ndarray of bool, shape (n, m)
    values : ndarray, shape (m,)

    Returns
    -------
    ndarray, shape (n,)
        NaN where even the last entry is false.
    """
    lasting = np.logical_and.accumulate(fine[:, ::-1], axis=1)[:, ::-1]
    return np.where(lasting.any(axis=1), values[lasting.argmax(axis=1)], np.nan)
