"""Search for the modes of stars' posteriors, where the bank has too few stars that resemble them.

The input is noisy stars and a bank of simulated stars, the output the fields, offsets and
aberrations that explain each star. The unknowns of a star are its field f, the offset o in pixels
from the chief ray to the middle of its stamp, and the Seidel coefficients c. For one (f, o) the
image is smooth in c: a mode of the posterior is searched by Gauss–Newton steps from the bank's best
matches.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np

from psfdae.optics.wavefronts import MONOMIALS
from psfdae.sensing.climbing import (
    Evaluation,
    Peaks,
    Steps,
    add_normal_prior,
    compute_deviance_limit,
    poisson_information,
)
from psfdae.sensing.climbing import climb as climb_posterior
from psfdae_paper.bounds.modes import (
    Knowledge,
    Modes,
    rank_in_group,
    select_largest,
    separate,
)
from psfdae_paper.bounds.posterior import Bank, group_by_field, list_jitters, score_bank
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

    Climbs start at the bank's best matches, unchanged and recentred. Stars that are not explained
    by any mode get more of these starts, and then starts all around their best modes.

    Parameters
    ----------
    bank : Bank
        Simulated stars among which the best matches are searched.
    posteriors : StarPosteriors
        Noisy images and likelihood of the n stars, and the model of their stamps.
    star_field : ndarray of int, shape (n,), optional
        Fields of the stars, in which modes are searched in addition.
    in_all_fields : bool
        True if modes are searched in all fields.
    fields : int
        Number of fields with the best matches, in which modes are searched.
    offsets : int
        Number of offsets with the best matches in the star's own field, if it is known.
    misfit_sigma : float
        More modes are searched if χ² of a star's best mode exceeds its expectation by this many
        standard deviations. By chance this happens for a few stars in 1000; with 1, for 1 in 6.

    Returns
    -------
    modes : Modes
        At least one for every star.
    misfits : ndarray of int
        Stars that are not explained by any mode (`find_unexplained`).
    """
    # The bank's best matches of every star, best first. Stars of one group share the part of the
    # bank that may explain them.
    count, matches = len(posteriors.noisy), []
    for stars, members in group_by_field(count, None if in_all_fields else star_field, bank):
        in_group = find_best_matches(
            bank.take(members),
            posteriors.take(stars),
            max(fields, 16) if in_all_fields else 0,
            max(offsets, 16),
            None if star_field is None else star_field[stars],
        )
        matches.append(replace(in_group, star=stars[in_group.star]))
    starts = Modes.join(matches)
    # First from a few matches of every star, unchanged and recentred.
    first_count = np.where(starts.knowledge == Knowledge.NONE, fields, offsets)
    is_first = rank_in_group(starts.group, np.arange(starts.star.size)) < first_count
    modes = climb(propose_starts(starts.select(is_first), posteriors), posteriors)
    # Then from the other matches of stars that the modes do not explain, and twice from all around
    # the best modes of stars that are still not explained.
    for attempt in range(3):
        misfits = find_unexplained(select_best(modes, star_field), posteriors, misfit_sigma)
        if not misfits.star.size:
            break
        if attempt == 0:
            other_starts = starts.select(~is_first & np.isin(starts.star, misfits.star))
            if not other_starts.star.size:
                continue
            trials = propose_starts(other_starts, posteriors)
        else:
            trials = recentre(place_corners(misfits), posteriors)[0]
        # Their modes climb along, so that climbs far below these are abandoned.
        is_misfit = np.isin(modes.star, misfits.star)
        trials = climb(Modes.join([modes.select(is_misfit), trials]), posteriors)
        modes = Modes.join([modes.select(~is_misfit), trials])
    # Finally in other fields and at other offsets that give nearly the same image.
    if in_all_fields:
        modes = climb(Modes.join([modes, find_twins(modes, posteriors)]), posteriors)
    # χ² four standard deviations above its mean: no mode explains the star.
    misfits = find_unexplained(select_best(modes, star_field), posteriors, 4.0)
    return modes, np.unique(misfits.star)


def find_best_matches(
    bank: Bank, posteriors: StarPosteriors, fields: int, offsets: int, star_field: np.ndarray | None
) -> Modes:
    """Find the best star of the bank in each of the best `fields` of every image.

    If the stars' fields are known, the best match at each of the best `offsets` in its own field
    is added for every star. Mirrored stars keep their coefficients.

    Parameters
    ----------
    bank : Bank
        Simulated stars among which the matches are searched.
    posteriors : StarPosteriors
        Noisy images and likelihood of the n stars, and the model of their stamps.
    fields, offsets : int
        Number of matches per star in any field, and in its own field.
    star_field : ndarray of int, shape (n,), optional
        True field of every star, if it is known.
    """
    # Best score, and star of the bank that has it, by image, field and frame (symmetry, jitter).
    shifts, images = np.array(list_jitters(bank.jitter_px)), np.arange(len(posteriors.noisy))
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
        used_offsets: set[tuple[int, ...]] = set()
        for frame in np.argsort(-scores[field], kind="stable"):
            offset = tuple(middle[best_star[star, field, frame], frame])
            if (
                np.isfinite(scores[field, frame])
                and offset not in used_offsets
                and len(used_offsets) < offsets
            ):
                used_offsets.add(offset)
                rows.append((star, field, frame, Knowledge.FIELD))
    # The bank's star of each start: its middle after the symmetry, and its coefficients, which the
    # symmetry leaves unchanged.
    star, field, frame, knowledge = np.array(rows).T
    match = best_star[star, field, frame]
    z = posteriors.model.standardise(bank.seidel[match])
    return Modes.make_starts(star, field, middle[match, frame], knowledge, z)


def climb(modes: Modes, posteriors: StarPosteriors) -> Modes:
    """Follow matches to the modes of the posterior by damped Gauss–Newton steps.

    A climb is stopped when even twice the gain that the next step promises leaves it far below the
    best one; of climbs that end at the same mode, one is kept. The evidence of a mode is the mass
    of the Gaussian with its height and curvature, ln height + ½ ln det(covariance) + constant.

    Parameters
    ----------
    modes : Modes
        Starts of the climbs.
    posteriors : StarPosteriors
        Photon counts and likelihood of the stars, and the model of their stamps.
    """
    peaks = _climb_along(modes, posteriors, np.empty((0, len(MONOMIALS))))
    covariance, evidence = peaks.laplace()
    factor = np.linalg.cholesky(covariance)
    return separate(replace(modes, z=peaks.parameters, factor=factor, evidence=evidence))


def propose_starts(starts: Modes, posteriors: StarPosteriors) -> Modes:
    """Return recentred starts, and also the original ones where recentring moves the stamp."""
    # Where it does not, a climb from the original start would lead to the same mode.
    places, is_moved = recentre(starts, posteriors)
    return Modes.join([places, starts.select(is_moved)])


def recentre(modes: Modes, posteriors: StarPosteriors) -> tuple[Modes, np.ndarray]:
    """Refine starts with a free stamp offset, rounded to whole pixels.

    A stamp that is off by a pixel leads to another mode, mostly a wrong one, from which steps of
    whole pixels do not lead back.

    Returns
    -------
    places : Modes
        Refined starts; a place that several starts reach is returned once.
    is_moved : ndarray of bool, shape (M,)
        True for starts whose offset has changed.
    """
    # Prior of the shift along rows and columns: normal, with this standard deviation.
    shift_sd_px = 1.5
    tilts = shift_sd_px * posteriors.model.tilt_coefficients(np.eye(2))
    # A tilt that moves the image by +u replaces an offset of the stamp by −u.
    # Unknowns are z, then the shift in units of its standard deviation.
    peaks, terms = _climb_along(modes, posteriors, tilts), modes.z.shape[1]
    z, shifts = np.split(peaks.parameters, [terms], axis=1)
    shift_px = np.rint(shift_sd_px * shifts).astype(int)
    # Many climbs end at the same maximum, and offsets are whole pixels: the best free maxima are
    # the best places to start from, each once.
    covariance, evidence = peaks.laplace()
    factor, offset = np.linalg.cholesky(covariance[:, :terms, :terms]), modes.offset - shift_px
    places = separate(replace(modes, offset=offset, z=z, factor=factor, evidence=evidence))
    columns = places.star, places.field, places.offset, places.knowledge, places.z
    return Modes.make_starts(*columns), (shift_px != 0).any(axis=1)


def _climb_along(modes: Modes, posteriors: StarPosteriors, added_directions: np.ndarray) -> Peaks:
    """Climb to maxima over z and along more directions of the coefficients.

    Parameters
    ----------
    modes : Modes
        Starts of the climbs.
    posteriors : StarPosteriors
        Photon counts and likelihood of the stars, and the model of their stamps.
    added_directions : ndarray, shape (K, 8)
        Directions of the monomials' coefficients, with a standard normal prior like z.
    """
    likelihood, model = posteriors.likelihood, posteriors.model

    def evaluate(rows: np.ndarray, z: np.ndarray) -> Evaluation:
        # Stamps and their derivatives by z and along the added directions.
        field, terms = modes.field[rows], modes.z.shape[1]
        coefficients = model.coefficients(z[:, :terms], field) + z[:, terms:] @ added_directions
        directions = np.concatenate(
            [model.directions(field), np.tile(added_directions, (rows.size, 1, 1))], axis=1
        )
        stamps, slopes = model.derivatives(coefficients, directions, modes.offset[rows])
        # Poisson likelihood times the prior N(0, 1).
        counts, mean_counts = posteriors.counts[modes.star[rows]], likelihood.predict_counts(stamps)
        by_counts = poisson_information(counts, mean_counts, likelihood.flux * slopes)
        return add_normal_prior(by_counts, z, np.ones(z.shape[1]))

    start = np.hstack([modes.z, np.zeros((len(modes.z), len(added_directions)))])
    steps = Steps(max_drop=modes.max_drop)
    return climb_posterior(evaluate, start, model.max_abs_z, steps, modes.group)


def select_best(modes: Modes, star_field: np.ndarray | None) -> Modes:
    """Select the best mode of every star: of all found without its field, and of all in its field.

    Parameters
    ----------
    modes : Modes
        Results of `climb`.
    star_field : ndarray of int, shape (n,), optional
        Fields of the stars, if they are known.

    Returns
    -------
    Modes
        At most two for every star. A mode that is the best of its field, but not of all, has the
        knowledge `Knowledge.FIELD`.
    """

    def find_best(numbers: np.ndarray) -> np.ndarray:
        return np.asarray(numbers[select_largest(modes.star[numbers], modes.evidence[numbers], 1)])

    blind = find_best(np.flatnonzero(modes.knowledge == Knowledge.NONE))
    if star_field is None:
        return modes.select(blind)
    # The best mode in the field may have been found without knowledge of it.
    in_field = find_best(np.flatnonzero(modes.field == star_field[modes.star]))
    in_field_only = modes.select(np.setdiff1d(in_field, blind))
    knowledge = np.full(in_field_only.star.size, Knowledge.FIELD)
    return Modes.join([modes.select(blind), replace(in_field_only, knowledge=knowledge)])


def find_unexplained(modes: Modes, posteriors: StarPosteriors, misfit_sigma: float) -> Modes:
    """Select the modes that do not explain the image of their star.

    A mode does not if χ² = Σ (n − μ)²/μ is more than `misfit_sigma` standard deviations above its
    mean for the right mode (`compute_deviance_limit`).

    Parameters
    ----------
    modes : Modes
        Results of `select_best`.
    posteriors : StarPosteriors
        Photon counts and likelihood of the stars, and the model of their stamps.
    misfit_sigma : float
        Allowed excess of χ² in standard deviations.
    """
    stamps = posteriors.model.stamps(modes.z, modes.field, modes.offset).astype(np.float64)
    # χ² of the photons about the counts that the mode predicts.
    mean_counts = posteriors.likelihood.predict_counts(stamps.reshape(len(stamps), -1))
    chi2 = ((posteriors.counts[modes.star] - mean_counts) ** 2 / mean_counts).sum(axis=1)
    return modes.select(chi2 > compute_deviance_limit(mean_counts.shape[1], misfit_sigma))


def place_corners(modes: Modes) -> Modes:
    """Place starts on all sides of modes.

    They are for stars whose climbs have ended in local maxima: a climb that starts next to such a
    maximum mostly ends elsewhere. Starts are the 2⁵ corners of a cube around the mode, 0.5 away
    in every coefficient.
    """
    # Every mode with every combination of signs.
    signs = np.array(list(product((-1.0, 1.0), repeat=modes.z.shape[1])))
    start = modes.select(np.repeat(np.arange(modes.star.size), len(signs)))
    z = start.z + 0.5 * np.tile(signs, (modes.star.size, 1))
    return Modes.make_starts(start.star, start.field, start.offset, start.knowledge, z)


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
        Results of `climb`; modes found without knowledge of the field are used.
    posteriors : StarPosteriors
        Their stamps and likelihood; the images are not used.

    Returns
    -------
    Modes
        Starts for `climb`, at most 40 per star.
    """
    likelihood, model = posteriors.likelihood, posteriors.model
    # The three best modes of every star, their monomial coefficients m, and the Fisher
    # information F² ∂p ∂pᵀ / (F p + B) of the eight.
    blind = modes.select(modes.knowledge == Knowledge.NONE)
    source = blind.select(select_largest(blind.star, blind.evidence, 3))
    coefficients = model.coefficients(source.z, source.field)
    axes = np.tile(np.eye(len(MONOMIALS)), (len(coefficients), 1, 1))
    stamps, jacobian = model.derivatives(coefficients, axes, source.offset)
    light = likelihood.flux * jacobian
    metric = (light / likelihood.predict_counts(stamps)[:, None]) @ light.swapaxes(1, 2)
    # Log-likelihood at the mode: its evidence without the width of the Gaussian and the prior.
    width = np.log(np.diagonal(source.factor, axis1=1, axis2=2)).sum(axis=1)
    height = source.evidence - width + 0.5 * (source.z**2).sum(axis=1)
    # Every field and every offset of up to a pixel: coefficients for z = 0, and their slopes.
    fields = np.arange(len(model.field))
    static = model.coefficients(np.zeros((fields.size, source.z.shape[1])), fields)
    directions = model.directions(fields)
    shifts = np.array(list_jitters(1))
    tilt = model.tilt_coefficients(shifts)
    # Signs that negate the even part of a wavefront, which leaves its image unchanged.
    even_signs = np.array([1 - 2 * (name in ("r4", "xx", "xy", "yy")) for name in MONOMIALS])
    # Best log-mass and z by star, field and offset.
    candidates: dict[tuple[int, ...], tuple[float, np.ndarray]] = {}
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
                if key not in candidates or log_mass[f, k] > candidates[key][0]:
                    candidates[key] = (log_mass[f, k], z[f, k])
    # Star, field and offset of every candidate, with its log-mass and z.
    keys = np.array(list(candidates))
    log_mass, z = (np.array(column) for column in zip(*candidates.values(), strict=True))
    # The best offset of every field, then the best fields, so that many fields are represented.
    star_and_field = keys[:, 0] * fields.size + keys[:, 1]
    twins = select_largest(star_and_field, log_mass, 1)
    twins = twins[select_largest(keys[twins, 0], log_mass[twins], 40)]
    keys = keys[twins]
    knowledge = np.full(twins.size, Knowledge.NONE)
    return Modes.make_starts(keys[:, 0], keys[:, 1], keys[:, 2:], knowledge, z[twins])


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
        Position of the maximum.
    """
    # Normal equations (D M Dᵀ + 1) z = D M gap.
    weighted_directions = directions @ metric
    curvature = weighted_directions @ directions.swapaxes(1, 2) + np.eye(directions.shape[1])
    z = np.linalg.solve(curvature, weighted_directions @ gap.swapaxes(1, 2)).swapaxes(1, 2)
    # Integral of the Gaussian: its height at the maximum times det(curvature)^−½.
    residual = gap - z @ directions
    loss = ((residual @ metric) * residual).sum(axis=2) + (z**2).sum(axis=2)
    return -0.5 * (loss + np.linalg.slogdet(curvature)[1][:, None]), z
