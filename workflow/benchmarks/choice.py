"""Which (pupil samples, points, precision) a scene should use: the cheapest within its budget."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product

import numpy as np

from measure import yes
from propagators import POINTS, PRECISIONS, candidate_samples
from psfdae_paper.optics.propagation import EXTRA_POINTS
from psfdae_paper.optics.pupil import SamplingError, choose_samples
from scenes import Selection, spread_evenly, stamp_mse, stamps_at

REFERENCE = (768, 12)  # samples and points of exact stamps; `build_cases` shows: they suffice
SCREENED = 32  # stars that are screened for large errors where not all are
SAME_TIME = 0.02  # relative difference of times that says nothing: repeats spread by more
EVERY_GRID = list(range(16, 2049))  # to ask the sampling guard what it needs


@dataclass(frozen=True)
class Sample:
    """n stars of a scene with their stamps (n, d, d) of sum 1 at every candidate setting.

    `needed` are the pupil samples that the sampling guard asks for each star, `population`
    those for all stars of the scene. `stamps` are by (samples, points, precision), where the
    grid does not alias the wavefront's own spectrum. `even` tells the stars that are spread
    evenly; the others were taken for their large errors.
    """

    needed: np.ndarray
    population: np.ndarray
    stamps: Mapping[tuple[int, int, str], np.ndarray]
    truth: np.ndarray
    even: np.ndarray

    def at(self, samples, points, precision):
        """Stamps with each star on a grid of its own, shape (n, d, d)."""
        return np.stack([self.stamps[int(n), points, precision][i] for i, n in enumerate(samples)])


def spread(needed, ladder, per_rung):
    """Stars spread evenly over what they need within every rung that they use, ascending.

    The least and the most demanding star of a rung are always among them.
    """
    rungs = choose_samples(needed, tuple(ladder))
    picks = []
    for rung in np.unique(rungs):
        members = np.flatnonzero(rungs == rung)
        members = members[np.argsort(needed[members], kind="stable")]
        picks.append(members[spread_evenly(members.size, per_rung)])
    return np.sort(np.concatenate(picks))


def take_sample(scene, stars, thorough):
    """Stars of each rung, with their stamps at all candidate settings or the next ones.

    The sample is spread over the rungs, and holds the stars with the largest errors of those
    that `screen` looks at, because the worst star of a set decides.
    """
    population = scene.propagation(scene.stars, scene.search_px, pupil_samples=EVERY_GRID).samples
    even = spread(population, scene.optics.pupil_samples, stars)
    index = np.union1d(even, screen(scene, population, max(1, stars // 8), thorough))
    source = Selection(scene.stars, index)
    offset = scene.propagation(source, scene.search_px).brightest()
    stamps = {}
    for samples in candidate_samples(scene.optics, thorough):
        for points, precision in product(POINTS[-2:], PRECISIONS):
            try:
                found = stamps_at(scene, source, offset, samples, points, precision)
            except SamplingError:
                break
            stamps[samples, points, precision] = found
    truth = stamps_at(scene, source, offset, *REFERENCE)
    return Sample(population[index], population, stamps, truth, np.isin(index, even))


def screen(scene, needed, kept, thorough):
    """Stars whose stamps change most on coarser grids or with more points, ascending.

    `kept` per grid size and for more points, of all stars or, if not thorough, of `SCREENED`.
    """
    looked_at = spread_evenly(needed.size, needed.size if thorough else SCREENED)
    slopes, optics, everyone = scene.stars.slopes(), scene.optics, np.arange(looked_at.size)
    together = Selection(scene.stars, looked_at, slopes)
    offset = scene.propagation(together, scene.search_px).brightest()

    def stamps(members, samples, points):
        some = Selection(scene.stars, looked_at[members], slopes)
        return stamps_at(scene, some, offset[members], samples, points, optics.precision)

    finest = int(choose_samples(needed[looked_at].max(keepdims=True), optics.pupil_samples)[0])
    exact, finer = (stamps(everyone, finest, points) for points in POINTS[-2:])
    changes = [(everyone, stamp_mse(exact, finer))]
    for samples in candidate_samples(optics, thorough):
        members = np.flatnonzero(needed[looked_at] <= samples)
        if members.size and samples <= optics.pupil_samples[0]:
            coarse = stamps(members, samples, EXTRA_POINTS)
            changes.append((members, stamp_mse(coarse, exact[members])))
    worst = [members[np.argsort(change)[-kept:]] for members, change in changes]
    return looked_at[np.unique(np.concatenate(worst))]


def ladders(optics, grids):
    """Candidate ladders: from every first rung on the configured rungs, or all candidates."""
    found = []
    for first in grids:
        found.append((first, *(n for n in optics.pupil_samples if n > first)))
        found.append(tuple(n for n in grids if n >= first))
    return list(dict.fromkeys(found))


def choose(scene, sample, time_ms):
    """Worst error and mean time of every candidate, the cheapest one and the configured one.

    A candidate is a ladder, a number of points and a precision; every star takes the first
    rung that the sampling guard allows it. The error is that of the worst star of the sample,
    the time the mean over all stars of the scene.
    """
    import pandas as pd

    optics, rows = scene.optics, []
    grids, points_tried, _ = (sorted(set(values)) for values in zip(*sample.stamps, strict=True))
    for ladder in ladders(optics, grids):
        if ladder[-1] < sample.population.max():
            continue
        own = choose_samples(sample.needed, ladder)
        everyone, count = np.unique(choose_samples(sample.population, ladder), return_counts=True)
        for points, precision in product(points_tried, PRECISIONS):
            worst = float(stamp_mse(sample.at(own, points, precision), sample.truth).max())
            times = [time_ms.get((int(n), points, precision), np.nan) for n in everyone]
            used = (optics.pupil_samples, EXTRA_POINTS, optics.precision)
            row = {"scene": scene.name, "ladder": "-".join(map(str, ladder))}
            row |= {"first_rung": ladder[0], "points": points, "precision": precision}
            row |= {"stars": len(own), "mse": worst, "budget": scene.budget}
            row |= {"within_budget": yes(worst <= scene.budget)}
            row |= {"time_ms": np.average(times, weights=count)}
            rows.append({**row, "configured": yes((list(ladder), points, precision) == used)})
    return mark_cheapest(pd.DataFrame(rows), scene.budget)


def mark_cheapest(table, budget):
    """Times within `SAME_TIME` are equal; among equal candidates the configured one stays."""
    timed = table[(table["mse"] <= budget) & table["time_ms"].notna()]
    equal = timed[timed["time_ms"] <= (1.0 + SAME_TIME) * timed["time_ms"].min()]
    configured = equal.index[equal["configured"] == "yes"].tolist()
    best = configured or timed.nsmallest(1, "time_ms").index.tolist()
    table.insert(10, "cheapest", np.where(table.index.isin(best), "yes", "no"))
    return table.assign(config_is_cheapest=yes(configured))


def guard_or_budget(scene, sample):
    """What decides the pupil samples of the stars, the sampling guard or the error budget.

    A row per rung in use: its share of all stars, the stars of the sample, the N that the
    guard asks for (guard_min, guard_max), the N from which on a star stays within the budget
    with the configured precision (budget_min, budget_max; NaN if it never does), and the share
    of the evenly spread stars for which the budget asks for more.
    """
    import pandas as pd

    optics, grids = scene.optics, tuple(sorted({samples for samples, *_ in sample.stamps}))
    stamps = [sample.stamps[n, EXTRA_POINTS, optics.precision] for n in grids]
    error = np.stack([stamp_mse(s, sample.truth) for s in stamps], axis=1)
    by_budget = first_lasting(error <= scene.budget, np.array(grids, float))
    more = ~(by_budget <= choose_samples(sample.needed, grids))
    rung = choose_samples(sample.needed, tuple(optics.pupil_samples))
    whole = choose_samples(sample.population, tuple(optics.pupil_samples))
    rows = []
    for n in np.unique(rung):
        of_rung, everyone = rung == n, sample.population[whole == n]
        row = {"scene": scene.name, "rung": int(n), "share": float((whole == n).mean())}
        row |= {"stars": of_rung.sum(), "guard_min": everyone.min(), "guard_max": everyone.max()}
        row["budget_min"] = np.fmin.reduce(by_budget[of_rung])
        row["budget_max"] = by_budget[of_rung].max()
        rows.append(row | {"decided_by_budget": more[of_rung & sample.even].mean()})
    return pd.DataFrame(rows)


def first_lasting(fine, values):
    """First of m values from which on all entries of a row of `fine`, (n, m), are true, or NaN."""
    lasting = np.logical_and.accumulate(fine[:, ::-1], axis=1)[:, ::-1]
    return np.where(lasting.any(axis=1), values[lasting.argmax(axis=1)], np.nan)
