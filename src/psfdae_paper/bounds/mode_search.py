"""Search for the modes of stars' posteriors, where the bank has too few stars that resemble them.

In go noisy stars and a bank of simulated ones; out come the fields, offsets and aberrations that
explain each star. The unknowns of a star are its field f, the offset o in pixels from the chief ray
to the middle of its stamp, and the Seidel coefficients c. For one (f, o) the image is smooth in c,
so a mode of the posterior is sought by Gauss–Newton steps from the bank's best matches.
"""

from __future__ import annotations

from dataclasses import replace
from functools import reduce
from itertools import product

import numpy as np

from psfdae.optics.wavefronts import MONOMIALS
from psfdae.sensing.climbing import Peaks, Steps, poisson_information
from psfdae.sensing.climbing import climb as climb_posterior
from psfdae_paper.bounds.modes import Knowledge, Modes, largest_of_groups, separate
from psfdae_paper.bounds.posterior import Bank, groups_by_field, jitters, score_bank
from psfdae_paper.bounds.stamp_model import StarPosteriors
from psfdae_paper.stars.symmetry import SYMMETRIES


def search(
    bank: Bank,
    posteriors: StarPosteriors,
    star_field: np.ndarray | None = None,
    in_all_fields: bool = True,
    fields: int = 4,
    offsets: int = 3,
    misfit_sigma: float = 3.0,
) -> tuple[Modes, np.ndarray]:
    """Search the modes of stars, without knowledge of them or with their fields known.

    Climbs begin at the bank's best matches, as they are and recentred. Stars that no mode explains
    get more of them, and then starts all around their best modes.

    Parameters
    ----------
    bank : Bank
    posteriors : StarPosteriors
    star_field : ndarray of int, shape (n,), optional
        Fields of the stars, in which modes are sought, too.
    in_all_fields : bool
        True if modes are sought in all fields.
    fields : int
        Fields with the best matches, in which modes are sought.
    offsets : int
        Offsets with the best matches in the star's own field, if it is known.
    misfit_sigma : float
        Standard deviations of χ² by which a star's best mode must fit worse than the truth would,
        for more modes to be sought. Chance alone makes a few in a thousand, with 2 one in forty.

    Returns
    -------
    modes : Modes
        At least one for every star.
    missed : ndarray of int
        Stars that none of the modes explains (`unexplained`).
    """

    def bank_starts(stars: np.ndarray, fields: int, offsets: int) -> Modes:
        """Return the best matches of the stars with these numbers, as they are and recentred."""
        field = None if star_field is None else star_field[stars]
        matches = []
        # Stars of one group share the part of the bank that may explain them.
        for group, members in groups_by_field(stars.size, None if in_all_fields else field, bank):
            in_group = best_matches(
                bank.take(members),
                posteriors.take(stars[group]),
                fields if in_all_fields else 0,
                offsets,
                None if field is None else field[group],
            )
            matches.append(replace(in_group, star=stars[group][in_group.star]))
        starts = reduce(Modes.__add__, matches)
        return starts + recentre(starts, posteriors)

    # First from a few matches of every star.
    modes = climb(bank_starts(np.arange(len(posteriors.noisy)), fields, offsets), posteriors)
    # Then from 16 fields or offsets of stars that the modes do not explain, and twice from all
    # around the best modes of those that still are not.
    for attempt in range(3):
        missed = unexplained(modes, posteriors, misfit_sigma)
        if not missed.size:
            break
        if attempt == 0:
            starts = bank_starts(missed, 16, 16)
        else:
            starts = recentre(corners(modes, missed), posteriors)
        modes = climb(modes + starts, posteriors)
    # Last in other fields and at other offsets that give nearly the same image as the best modes.
    if in_all_fields:
        modes = climb(modes + find_twins(modes, posteriors), posteriors)
    # χ² four standard deviations above its mean: the star has no mode that explains it.
    return modes, unexplained(modes, posteriors, 4.0)


def best_matches(
    bank: Bank, posteriors: StarPosteriors, fields: int, offsets: int, star_field: np.ndarray | None
) -> Modes:
    """Find the best star of the bank in each of the best `fields` of every image.

    If the stars' fields are known, the best at each of so many `offsets` in its own field
    is added for every star. Mirrored stars keep their coefficients.

    Parameters
    ----------
    bank : Bank
    posteriors : StarPosteriors
    fields, offsets : int
    star_field : ndarray of int, shape (n,), optional
    """
    # Best score, and star of the bank that has it, by image, field and frame (symmetry, jitter).
    shifts, images = np.array(jitters(bank.jitter_px)), np.arange(len(posteriors.noisy))
    shape = (images.size, bank.points**2, len(SYMMETRIES) * len(shifts))
    best_score, best_star = np.full(shape, -np.inf), np.zeros(shape, int)
    for part in score_bank(bank, posteriors.noisy, posteriors.likelihood):
        # Stars of the same field are adjacent: the best one of each run, for every image.
        start = np.flatnonzero(np.diff(part.field, prepend=-1))
        for first, end in zip(start, [*start[1:], part.field.size], strict=True):
            cell = (slice(None), part.field[first], part.symmetry * len(shifts) + part.jitter)
            top = part.scores[:, first:end].argmax(axis=1) + first
            score = part.scores[images, top]
            best_star[cell] = np.where(score > best_score[cell], part.star[top], best_star[cell])
            best_score[cell] = np.maximum(score, best_score[cell])
    # The middle of the stamp is the framed pixel less the jitter, after each symmetry.
    peaks = np.stack([s.pixel(bank.peak) for s in SYMMETRIES], axis=1)
    middle = (peaks[:, :, None] - shifts).reshape(len(bank), -1, 2)
    # A start is an image, a field, a frame (symmetry and jitter) and the knowledge that led to it.
    rows = []
    for star, scores in enumerate(best_score):
        # Without knowledge of the field, the best frame in each of the best fields.
        best_fields = np.argsort(-scores.max(axis=1), kind="stable")[:fields]
        rows += [(star, field, scores[field].argmax(), Knowledge.NONE) for field in best_fields]
        if star_field is None:
            continue
        # In the star's own field, the best frame at each offset.
        field = star_field[star]
        used: set[tuple[int, ...]] = set()
        for frame in np.argsort(-scores[field], kind="stable"):
            offset = tuple(middle[best_star[star, field, frame], frame])
            if np.isfinite(scores[field, frame]) and offset not in used and len(used) < offsets:
                used.add(offset)
                rows.append((star, field, frame, Knowledge.FIELD))
    # The bank's star of each start: its middle after the symmetry, and its coefficients, which the
    # symmetry leaves unchanged.
    star, field, frame, knowledge = np.array(rows).T
    match = best_star[star, field, frame]
    z = posteriors.model.standardised(bank.seidel[match])
    return Modes.at(star, field, middle[match, frame], knowledge, z)


def climb(modes: Modes, posteriors: StarPosteriors) -> Modes:
    """Follow matches to the modes of the posterior by damped Gauss–Newton steps.

    A match is given up when even twice the gain that the next step promises leaves it far
    below the best one; of those that meet, one is kept. The evidence of a mode is the mass of the
    Gaussian with its height and curvature, up to a constant: ln height + ½ ln det(covariance).

    Parameters
    ----------
    modes : Modes
        Starts of the climbs.
    posteriors : StarPosteriors
    """
    # At the mode, the covariance of z is the inverse of information + 1 (that of the prior). With
    # its Cholesky factor L, ½ ln det(covariance) = Σ ln L_kk.
    peaks = _climb_along(modes, posteriors, np.empty((0, len(MONOMIALS))))
    factor = np.linalg.cholesky(np.linalg.inv(peaks.information))
    evidence = peaks.height + np.log(np.diagonal(factor, axis1=1, axis2=2)).sum(axis=1)
    return separate(replace(modes, z=peaks.parameters, factor=factor, evidence=evidence))


def recentre(modes: Modes, posteriors: StarPosteriors) -> Modes:
    """Refine modes with a free stamp offset, rounded to whole pixels.

    A stamp that is a pixel beside its place leads to another mode, mostly a wrong one, from which
    steps of whole pixels do not lead back.
    """
    # Prior of the shift along rows and columns: normal, with this standard deviation.
    shift_sd_px = 1.5
    tilts = shift_sd_px * posteriors.model.tilt_coefficients(np.eye(2))
    # A tilt that moves the image by +u replaces an offset of the stamp by −u.
    # Unknowns are z, then the shift in units of its standard deviation.
    parameters = _climb_along(modes, posteriors, tilts).parameters
    z, shifts = np.split(parameters, [modes.z.shape[1]], axis=1)
    offset = modes.offset - np.rint(shift_sd_px * shifts).astype(int)
    return Modes.at(modes.star, modes.field, offset, modes.knowledge, z)


def _climb_along(modes: Modes, posteriors: StarPosteriors, added_directions: np.ndarray) -> Peaks:
    """Climb to maxima over z and along more directions of the coefficients.

    Parameters
    ----------
    modes : Modes
        Starts of the climbs.
    posteriors : StarPosteriors
    added_directions : ndarray, shape (K, 8)
        Directions of the monomials' coefficients, with a standard normal prior, as z has.
    """
    likelihood, model = posteriors.likelihood, posteriors.model

    def evaluate(rows: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        # Stamps and their slopes by z and along the added directions.
        field, terms = modes.field[rows], modes.z.shape[1]
        coefficients = model.coefficients(z[:, :terms], field) + z[:, terms:] @ added_directions
        directions = np.concatenate(
            [model.directions(field), np.tile(added_directions, (rows.size, 1, 1))], axis=1
        )
        stamps, slopes = model.derivatives(coefficients, directions, modes.offset[rows])
        # Poisson likelihood times the prior N(0, 1): their logarithms and derivatives add up.
        # ln posterior = −½ (deviance + |z|²), slope = score − z, information + 1.
        counts, expected = posteriors.counts[modes.star[rows]], likelihood.expected(stamps)
        deviance, score, information = poisson_information(
            counts, expected, likelihood.flux * slopes
        )
        height = -0.5 * (deviance + (z**2).sum(axis=1))
        return height, score - z, information + np.eye(z.shape[1])

    start = np.hstack([modes.z, np.zeros((len(modes.z), len(added_directions)))])
    steps = Steps(max_drop=modes.max_drop)
    return climb_posterior(evaluate, start, model.max_abs_z, steps, modes.group)


def unexplained(modes: Modes, posteriors: StarPosteriors, misfit_sigma: float) -> np.ndarray:
    """List the stars whose best mode does not explain their image, without or with their field.

    For the right mode and P pixels, χ² = Σ (n − μ)²/μ has the mean P and the variance 2P. A star is
    unexplained if its χ² is larger by more than `misfit_sigma` standard deviations.

    Parameters
    ----------
    modes : Modes
        Results of `climb`.
    posteriors : StarPosteriors
    misfit_sigma : float

    Returns
    -------
    ndarray of int
        Numbers of the stars, ascending.
    """
    modes = modes.best_of_group
    stamps = posteriors.model.stamps(modes.z, modes.field, modes.offset).astype(np.float64)
    # χ² of the photons about the counts that the mode predicts.
    expected = posteriors.likelihood.expected(stamps.reshape(len(stamps), -1))
    chi2 = ((posteriors.counts[modes.star] - expected) ** 2 / expected).sum(axis=1)
    pixels = expected.shape[1]
    return np.unique(modes.star[chi2 > pixels + misfit_sigma * np.sqrt(2.0 * pixels)])


def corners(modes: Modes, stars: np.ndarray) -> Modes:
    """Place starts all around the best modes of the stars with these numbers.

    They serve stars whose climbs have ended in local maxima: a climb from beside one mostly ends
    elsewhere. Starts are the 2⁵ corners of a cube around the mode, 0.5 away in every coefficient.
    """
    modes = modes.best_of_group
    stuck = np.flatnonzero(np.isin(modes.star, stars))
    # Every stuck mode with every combination of signs.
    signs = np.array(list(product((-1.0, 1.0), repeat=modes.z.shape[1])))
    start = modes.take(np.repeat(stuck, len(signs)))
    z = start.z + 0.5 * np.tile(signs, (stuck.size, 1))
    return Modes.at(start.star, start.field, start.offset, start.knowledge, z)


def find_twins(modes: Modes, posteriors: StarPosteriors) -> Modes:
    """Find other fields and offsets of every star that give nearly the same image.

    An image depends on eight coefficients of pupil monomials, of which the offset of the
    stamp changes the tilts; in every field they are another function of the five Seidel
    coefficients. Fields in one direction from the axis can give exactly the same image, and
    so does the wavefront with its even part negated. Around the best modes the likelihood is
    taken as a Gaussian of the eight; its product with the prior of every field and offset is
    a Gaussian, too, whose mass decides which are returned.

    Parameters
    ----------
    modes : Modes
        Results of `climb`; those found without the field are used.
    posteriors : StarPosteriors
        Their stamps and likelihood; the images are not used.

    Returns
    -------
    Modes
        Starts for `climb`, at most 40 of a star.
    """
    likelihood, model = posteriors.likelihood, posteriors.model
    # The three best modes of every star, their monomial coefficients m, and the Fisher
    # information F² ∂p ∂pᵀ / (F p + B) of the eight.
    blind = modes.take(np.flatnonzero(modes.knowledge == Knowledge.NONE))
    source = blind.take(largest_of_groups(blind.star, blind.evidence, 3))
    coefficients = model.coefficients(source.z, source.field)
    axes = np.tile(np.eye(len(MONOMIALS)), (len(coefficients), 1, 1))
    stamps, jacobian = model.derivatives(coefficients, axes, source.offset)
    light = likelihood.flux * jacobian
    metric = (light / likelihood.expected(stamps)[:, None]) @ light.swapaxes(1, 2)
    # Log-likelihood at the mode: its evidence without the width of the Gaussian and the prior.
    width = np.log(np.diagonal(source.factor, axis1=1, axis2=2)).sum(axis=1)
    height = source.evidence - width + 0.5 * (source.z**2).sum(axis=1)
    # Every field and every offset of up to a pixel: coefficients for z = 0, and their slopes.
    fields = np.arange(len(model.field))
    static = model.coefficients(np.zeros((fields.size, source.z.shape[1])), fields)
    directions = model.directions(fields)
    shifts = np.array(jitters(1))
    tilt = model.tilt_coefficients(shifts)
    # Signs that negate the even part of a wavefront, which leaves its image unchanged.
    even_signs = np.array([1 - 2 * (name in ("r4", "xx", "xy", "yy")) for name in MONOMIALS])
    # Best log-mass and z by star, field and offset.
    places: dict[tuple[int, ...], tuple[float, np.ndarray]] = {}
    # From each mode, and from its twin with the even part negated, to all fields and offsets.
    for m, star in enumerate(source.star):
        for sign in (np.ones(len(MONOMIALS)), even_signs):
            # Change of the coefficients that every field and offset needs to give this image, and
            # z that comes nearest to it, weighed against the prior.
            gap = sign * coefficients[m] + tilt - static[:, None]
            log_mass, z = _best_coefficients(sign[:, None] * metric[m] * sign, directions, gap)
            log_mass += height[m]
            possible = log_mass > log_mass.max() - modes.max_drop
            for f, k in zip(*np.nonzero(possible), strict=True):
                key = (star, f, *(source.offset[m] + shifts[k]))
                if key not in places or log_mass[f, k] > places[key][0]:
                    places[key] = (log_mass[f, k], z[f, k])
    # Star, field and offset of every candidate, with its log-mass and z.
    keys = np.array(list(places))
    log_mass, z = (np.array(column) for column in zip(*places.values(), strict=True))
    # The best offset of every field, then the best fields: no field crowds out another.
    star_and_field = keys[:, 0] * fields.size + keys[:, 1]
    twins = largest_of_groups(star_and_field, log_mass, 1)
    twins = twins[largest_of_groups(keys[twins, 0], log_mass[twins], 40)]
    keys = keys[twins]
    knowledge = np.full(twins.size, Knowledge.NONE)
    return Modes.at(keys[:, 0], keys[:, 1], keys[:, 2:], knowledge, z[twins])


def _best_coefficients(
    metric: np.ndarray, directions: np.ndarray, gap: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Maximise the Gaussian exp(−½ rᵀ M r − ½|z|²), r = gap − z·directions, over z.

    Parameters
    ----------
    metric : ndarray, shape (8, 8)
        M, the information of the monomials' coefficients.
    directions : ndarray, shape (F, 5, 8)
        Change of the coefficients by z in every field.
    gap : ndarray, shape (F, V, 8)
        Change that is needed in every field, for V offsets.

    Returns
    -------
    log_mass : ndarray, shape (F, V)
        Logarithm of the Gaussian's integral over z, up to a constant.
    z : ndarray, shape (F, V, 5)
        Place of the maximum.
    """
    # Normal equations (D M Dᵀ + 1) z = D M gap.
    weighted = directions @ metric
    curvature = weighted @ directions.swapaxes(1, 2) + np.eye(directions.shape[1])
    z = np.linalg.solve(curvature, weighted @ gap.swapaxes(1, 2)).swapaxes(1, 2)
    # Integral of the Gaussian: its height at the maximum times det(curvature)^−½.
    residual = gap - z @ directions
    loss = ((residual @ metric) * residual).sum(axis=2) + (z**2).sum(axis=2)
    return -0.5 * (loss + np.linalg.slogdet(curvature)[1][:, None]), z
