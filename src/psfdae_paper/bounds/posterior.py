"""Posterior mean of test stars over a bank of simulated stars, a sample of their prior.

A bank holds noise-free stars with random aberrations. Each of them stands for 8 · (2j + 1)² images:
it is mirrored by the symmetries of a square and moved by all centring errors of up to j pixels.
With p_k the image k, and w_k ∝ prior × Poisson likelihood of the counts under it, the posterior
mean of a star's noise-free image is Σ w_k p_k / Σ w_k.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import ClassVar, Self

import numpy as np

from psfdae.base.progress import steps
from psfdae.base.rows import Rows
from psfdae.stars.noise import NoiseModel
from psfdae_paper.stars.framing import crop_jittered, normalise_flux
from psfdae_paper.stars.symmetry import SYMMETRIES, orbit


@dataclass(frozen=True)
class Bank:
    """Propagated stars from which stamps at all jitters and mirrored fields are cut.

    Attributes
    ----------
    framed : ndarray, shape (M, d + 2m, d + 2m), float32
        Intensities, brightest pixel at index d/2 + m, m = `jitter_px` + 1.
    field : ndarray of int, shape (M,)
        Field of every star, ix + P·iy.
    peak : ndarray of int, shape (M, 2)
        Brightest pixel (row, column) from the chief ray.
    seidel : ndarray, shape (M, 5)
        Seidel coefficients in waves.
    points : int
        Field points P along a side.
    jitter_px : int
        Largest centring error in pixels per axis.
    chunk : int
        Stars per matrix product, which does not change results; scores of 420 test stars then fit
        the cache.
    mirror_margin : int
        Pixels in addition to the jitter that a flipped stamp needs (`Symmetry.window`).
    """

    framed: np.ndarray
    field: np.ndarray
    peak: np.ndarray
    seidel: np.ndarray
    points: int
    jitter_px: int
    chunk: int = 512
    mirror_margin: ClassVar[int] = 1

    @classmethod
    def from_columns(cls, columns: Mapping[str, np.ndarray], points: int, jitter_px: int) -> Self:
        """Make a bank from the columns of `estimates.simulate_fresh_stars`."""
        frames, field, peak = (columns[name] for name in ("framed", "field_index", "peak"))
        return cls(frames, field, peak, columns["seidel"], points, jitter_px)

    def __len__(self) -> int:
        return len(self.framed)

    @property
    def margin(self) -> int:
        """Pixels m on either side of the stamp."""
        return self.jitter_px + self.mirror_margin

    def take(self, stars: np.ndarray) -> Bank:
        """Return the bank of the stars with these numbers, in the order given."""
        part = (self.framed[stars], self.field[stars], self.peak[stars], self.seidel[stars])
        return Bank(*part, self.points, self.jitter_px, self.chunk)

    def stamps(self, window: tuple[int, int]) -> np.ndarray:
        """Cut stamps at a window (first row, first column), sum 1, shape (M, d, d), float64."""
        row, column = window
        # The margin stands on either side of a stamp.
        side = self.framed.shape[-1] - 2 * self.margin
        # A slice: the same window in all stars needs no list of pixels for each.
        stamps = self.framed[:, row : row + side, column : column + side]
        return normalise_flux(stamps.astype(np.float64))[0]


def compute_symmetry_weights(field: np.ndarray, peak: np.ndarray, points: int) -> np.ndarray:
    """Count how often each symmetry of each star is used, so that all fields stay equally likely.

    At a field point on a mirror axis two symmetries (in the centre all eight) lead
    to the same star, with its equal maxima exchanged. Only the symmetry that frames the
    first maximum in (row, column) order is right; it has the weight of all of them.

    Parameters
    ----------
    field : ndarray of int, shape (M,)
        Field of every star, ix + P·iy.
    peak : ndarray of int, shape (M, 2)
        The star's framed pixel (row, column) from the chief ray.
    points : int
        Field points P along a side.

    Returns
    -------
    ndarray of int, shape (M, 8)
        Zero, or the number of symmetries that lead to the same field; rows sum to 8.
    """
    # Field and framed pixel of every star after every symmetry.
    mirrored_field = np.stack([s.field(field, points) for s in SYMMETRIES], axis=1)
    pixel = np.stack([s.pixel(peak) for s in SYMMETRIES], axis=1)
    # One number that rises with row, then column, then number of the symmetry.
    reach = 2 * int(np.abs(peak).max()) + 3
    order = (pixel[..., 0] * reach + pixel[..., 1]) * len(SYMMETRIES) + np.arange(len(SYMMETRIES))
    # Among symmetries that lead to the same field, the first in that order has all the weight.
    is_same_field = mirrored_field[:, :, None] == mirrored_field[:, None, :]
    first = np.where(is_same_field, order[:, None, :], np.iinfo(order.dtype).max).min(axis=2)
    return np.where(order == first, is_same_field.sum(axis=2), 0)


def list_jitters(jitter_px: int) -> list[tuple[int, int]]:
    """List all centring errors (row, column) of up to `jitter_px` pixels per axis."""
    shifts = range(-jitter_px, jitter_px + 1)
    return list(product(shifts, shifts))


def cut_templates(frames: np.ndarray, jitter_px: int) -> np.ndarray:
    """Cut static PSFs at all centring errors, as the stage `stars` cuts them.

    Parameters
    ----------
    frames : ndarray, shape (F, d + 2·jitter_px, d + 2·jitter_px)
        Array `psf` of the product "templates".
    jitter_px : int
        Largest centring error in pixels per axis.

    Returns
    -------
    ndarray, shape (F, J, d, d), float32
        Sum 1; order of `list_jitters`.
    """
    frames = frames.astype(np.float64)
    cuts = [
        crop_jittered(frames, np.array(jitter), jitter_px) for jitter in list_jitters(jitter_px)
    ]
    return np.stack([normalise_flux(stamps)[0] for stamps in cuts], axis=1).astype(np.float32)


@dataclass(frozen=True)
class Likelihood:
    """Poisson likelihood of stars of one noise level, n ~ Poisson(F p + B) in every pixel.

    Attributes
    ----------
    flux, background : float
        Photons F in the stamp and B per pixel.
    mean_image : ndarray, shape (P,)
        Image p̄ that is subtracted, so that sums in single precision stay exact enough. It must
        not change under the symmetries of the square: counts and images are compared mirrored, too.
    """

    flux: float
    background: float
    mean_image: np.ndarray

    @classmethod
    def from_noise(cls, noise: NoiseModel, level: float, images: np.ndarray) -> Likelihood:
        """Make the likelihood at noise level λ, around the mean of images of shape (n, d, d)."""
        # The mean over its eight mirror images does not change under any symmetry.
        mean = images.mean(axis=0, dtype=np.float64)
        symmetric = np.mean([symmetry.image(mean) for symmetry in SYMMETRIES], axis=0)
        return cls(float(noise.flux(level)), noise.background, symmetric.ravel())

    def residuals(self, noisy: np.ndarray) -> np.ndarray:
        """Return counts n − n̄, n̄ = F p̄ + B, of images (n, d, d), shape (n, P), float64."""
        return self.counts(noisy) - self.background - self.flux * self.mean_image

    def counts(self, noisy: np.ndarray) -> np.ndarray:
        """Return the photons of images (n, d, d), sky included, shape (n, P), float64.

        `NoiseModel.draw` gives images in single precision, without sky. Counts are whole numbers,
        so rounding undoes the loss.
        """
        signal = np.rint(self.flux * noisy.reshape(len(noisy), -1).astype(np.float64))
        return signal + self.background

    def predict_counts(self, stamps: np.ndarray) -> np.ndarray:
        """Return the mean counts F p + B of noise-free stamps."""
        return np.asarray(self.flux * stamps + self.background)

    def factors(self, stamps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Split the log-likelihood of stamps p (K, P) into a product with residuals and a constant.

        Up to terms of the counts alone it is Σ n ℓ − F Σ p with ℓ = ln(1 + F p / B), which is
        Σ (n − n̄)(ℓ − ℓ̄) + Σ n̄ (ℓ − ℓ̄) − F Σ (p − p̄), with the mean image p̄ and its ℓ̄.

        Returns
        -------
        ratio : ndarray, shape (K, P), float64
            ℓ − ℓ̄, the factor of the residuals.
        offset : ndarray, shape (K,), float64
            n̄·(ℓ − ℓ̄) − F Σ (p − p̄): small, too, so that single precision is enough for scores.
        """
        # ℓ̄ is ℓ of the mean image. Residuals and ℓ − ℓ̄ are small, and so is the error of their
        # product in single precision.
        scale = self.flux / self.background
        ratio = np.log1p(scale * stamps) - np.log1p(scale * self.mean_image)
        light = self.flux * (stamps.sum(axis=1) - self.mean_image.sum())
        return ratio, ratio @ self.predict_counts(self.mean_image) - light


@dataclass(frozen=True)
class ScoredStars:
    """Log-weights of stars of a bank at one symmetry and jitter, given noisy images.

    Attributes
    ----------
    star, field : ndarray of int, shape (K,)
        Their numbers in the bank and their fields after `symmetry`; equal fields are adjacent.
    symmetry, jitter : int
        Numbers in `SYMMETRIES` and `list_jitters`.
    images : ndarray, shape (K, P), float32
        Noise-free images before `symmetry`.
    scores : ndarray, shape (n, K), float32
        Log-likelihood plus log-prior, relative to the likelihood of the mean image.
    """

    star: np.ndarray
    field: np.ndarray
    symmetry: int
    jitter: int
    images: np.ndarray
    scores: np.ndarray


@dataclass
class PosteriorSums(Rows):
    """Weighted sums over samples of the posterior of n test stars.

    Attributes
    ----------
    log_scale : ndarray, shape (n,)
        Largest log-weight of every test star; weights w are relative to exp(`log_scale`).
    weight_sum, weight_square_sum : ndarray, shape (n,)
        Σw and Σw².
    image_sum, image_square_sum : ndarray, shape (n, P)
        Σw p and Σw p², p the noise-free images.
    template_weight : ndarray, shape (n, F, J)
        Σw by field and jitter, that is by static PSF.
    """

    log_scale: np.ndarray
    weight_sum: np.ndarray
    weight_square_sum: np.ndarray
    image_sum: np.ndarray
    image_square_sum: np.ndarray
    template_weight: np.ndarray

    @classmethod
    def empty(cls, stars: int, pixels: int, fields: int, shifts: int) -> PosteriorSums:
        """Return sums over no sample."""
        shapes = ((), (), (pixels,), (pixels,), (fields, shifts))
        zeros = (np.zeros((stars, *shape)) for shape in shapes)
        return cls(np.full(stars, -np.inf), *zeros)

    def rescale(self, log_scale: np.ndarray) -> PosteriorSums:
        """Return the same sums with weights relative to exp(`log_scale`), shape (n,)."""
        # A star without any possible image has scale 0 and keeps sums of zero.
        # Σw changes by the ratio of the scales, Σw² by its square.
        scale = np.exp(self.log_scale - np.maximum(log_scale, np.finfo(float).min))
        return PosteriorSums(
            log_scale,
            scale * self.weight_sum,
            scale**2 * self.weight_square_sum,
            scale[:, None] * self.image_sum,
            scale[:, None] * self.image_square_sum,
            scale[:, None, None] * self.template_weight,
        )

    @property
    def mean_image(self) -> np.ndarray:
        """Posterior mean of the noise-free image, shape (n, P); NaN where none was possible."""
        with np.errstate(invalid="ignore"):
            return np.asarray(self.image_sum / self.weight_sum[:, None])

    @property
    def effective_size(self) -> np.ndarray:
        """Effective sample size (Σw)²/Σw², shape (n,)."""
        # 0 for a star without any possible image.
        square = np.maximum(self.weight_square_sum, np.finfo(float).tiny)
        return np.asarray(self.weight_sum**2 / square)

    @property
    def variance(self) -> np.ndarray:
        """Posterior variance of every pixel of the noise-free image, (n, P); NaN as above."""
        with np.errstate(invalid="ignore"):
            mean_square = self.image_square_sum / self.weight_sum[:, None]
            # Rounding must not lead to a negative variance.
            return np.asarray(np.maximum(mean_square - self.mean_image**2, 0.0))

    def template(self, templates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return posterior mean and variance of the static PSF, (n, P) both; NaN as `mean_image`.

        Parameters
        ----------
        templates : ndarray, shape (F, J, d, d)
            Static PSF of every field at every centring error.
        """
        # Mean and variance of the mixture of static PSFs with their posterior probabilities.
        weight = self.template_weight.reshape(len(self.template_weight), -1)
        with np.errstate(invalid="ignore"):
            weight = weight / self.weight_sum[:, None]
        return compute_mixture_moments(
            weight, templates.reshape(weight.shape[1], -1).astype(np.float64)
        )

    def add(self, part: ScoredStars) -> None:
        """Add images of one symmetry and jitter."""
        log_scale = np.maximum(self.log_scale, part.scores.max(axis=1))
        # Images with a log-weight more than 30 below a star's best are left out: millions of them
        # together weigh less than 1e-6 of the best one.
        lowest = (log_scale - 30.0).astype(np.float32)
        columns = np.flatnonzero((part.scores > lowest[:, None]).any(axis=0))
        if not columns.size:
            return
        # The sums of stars with a new best image are rescaled to it.
        star_numbers = np.flatnonzero(log_scale != self.log_scale)
        self.put(star_numbers, self.select(star_numbers).rescale(log_scale[star_numbers]))
        # A star without any possible image so far keeps weights of zero.
        highest = np.maximum(log_scale, np.finfo(np.float32).min).astype(np.float32)
        weight = np.exp(part.scores[:, columns] - highest[:, None])
        self.weight_sum += weight.sum(axis=1, dtype=np.float64)
        self.weight_square_sum += np.einsum("nk,nk->n", weight, weight, dtype=np.float64)
        # The symmetry moves the sum over images, instead of every image.
        images, symmetry = part.images[columns], SYMMETRIES[part.symmetry]
        side = int(np.sqrt(images.shape[1]))
        for image_sum, values in ((self.image_sum, images), (self.image_square_sum, images**2)):
            moved_sum = symmetry.image((weight @ values).reshape(-1, side, side))
            np.add(image_sum, moved_sum.reshape(image_sum.shape), out=image_sum)
        # Images of the same field are adjacent: one sum for each run.
        field = part.field[columns]
        start = np.flatnonzero(np.diff(field, prepend=-1))
        by_field = np.add.reduceat(weight, start, axis=1)
        self.template_weight[:, field[start], part.jitter] += by_field


def compute_mixture_moments(
    weight: np.ndarray, images: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and variance, (n, P) both, of images (K, P) with weights (n, K) of sum 1."""
    # E[p] and E[p²] − E[p]²; rounding must not make the variance negative.
    mean = weight @ images
    return mean, np.maximum(weight @ images**2 - mean**2, 0.0)


def merge(parts: Sequence[PosteriorSums]) -> PosteriorSums:
    """Return the sums over several sets of samples of the same stars; the parts stay unchanged."""
    # All sums are rescaled to the maximum of every star, then added.
    log_scale = np.max([part.log_scale for part in parts], axis=0)
    total = parts[0].rescale(log_scale)
    for part in parts[1:]:
        for name, values in vars(part.rescale(log_scale)).items():
            if name != "log_scale":
                setattr(total, name, getattr(total, name) + values)
    return total


def score_bank(bank: Bank, noisy: np.ndarray, likelihood: Likelihood) -> Iterator[ScoredStars]:
    """Weight all stars of a bank at all jitters and symmetries; parameters as `sum_posterior`."""
    residuals = likelihood.residuals(noisy).reshape(noisy.shape)
    # Instead of mirroring every image of the bank, the test stars are mirrored back.
    mirrored_residuals = [
        symmetry.undo(residuals).reshape(len(noisy), -1).astype(np.float32)
        for symmetry in SYMMETRIES
    ]
    # Symmetries and jitters that need the same pixels of a framed star share its stamp.
    by_window = defaultdict(list)
    for s, symmetry in enumerate(SYMMETRIES):
        for j, jitter in enumerate(list_jitters(bank.jitter_px)):
            by_window[symmetry.window(jitter, bank.margin)].append((s, j))
    order = np.argsort(bank.field, kind="stable")  # stars of a field are adjacent
    for start in steps("bank", range(0, order.size, bank.chunk)):
        stars = order[start : start + bank.chunk]
        part = bank.take(stars)
        with np.errstate(divide="ignore"):  # −∞ where a symmetry is not used
            log_prior = np.log(compute_symmetry_weights(part.field, part.peak, part.points))
        for window, members in by_window.items():
            # Factors in double precision, their product with the residuals in single.
            stamps = part.stamps(window).reshape(len(part), -1)
            ratio, offset = likelihood.factors(stamps)
            images, ratio_t = stamps.astype(np.float32), ratio.T.astype(np.float32)
            for s, j in members:
                # ln prior + Σ (n − n̄)(ℓ − ℓ̄) + offset
                scores = mirrored_residuals[s] @ ratio_t
                scores += (offset + log_prior[:, s]).astype(np.float32)
                field = SYMMETRIES[s].field(part.field, bank.points)
                yield ScoredStars(stars, field, s, j, images, scores)


def group_by_field(
    count: int, star_field: np.ndarray | None, bank: Bank
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Group test stars with the stars of a bank that may explain them.

    Without fields, all test stars are one group with the whole bank. With fields, only stars of
    the bank are used that a symmetry moves to the field of the test star; fields that are mirror
    images of each other share a group.

    Parameters
    ----------
    count : int
        Number n of test stars.
    star_field : ndarray of int, shape (n,), optional
        Field of every test star.
    bank : Bank
        Simulated stars of all fields.

    Returns
    -------
    list of pairs of ndarray of int
        Numbers of the group's test stars, and of its stars of the bank.
    """
    if star_field is None:
        return [(np.arange(count), np.arange(len(bank)))]
    # An orbit is the set of fields to which symmetries take a field; its name is the lowest one.
    star_orbit, bank_orbit = orbit(star_field, bank.points), orbit(bank.field, bank.points)
    return [
        (np.flatnonzero(star_orbit == name), np.flatnonzero(bank_orbit == name))
        for name in np.unique(star_orbit)
    ]


def sum_posterior(
    bank: Bank, noisy: np.ndarray, likelihood: Likelihood, star_field: np.ndarray | None = None
) -> PosteriorSums:
    """Sum over all stars of a bank, at all jitters and symmetries, weighted by noisy images.

    Parameters
    ----------
    bank : Bank
        M simulated stars, samples of the prior.
    noisy : ndarray, shape (n, d, d)
        Noisy images of one noise level.
    likelihood : Likelihood
        Likelihood at that noise level.
    star_field : ndarray of int, shape (n,), optional
        Field of every noisy image: only stars that a symmetry moves there are used. Each star
        of the bank must have such a symmetry.
    """
    shifts = len(list_jitters(bank.jitter_px))
    sums = PosteriorSums.empty(len(noisy), noisy[0].size, bank.points**2, shifts)
    for part in score_bank(bank, noisy, likelihood):
        # Images in other fields are impossible if the field is known.
        if star_field is not None:
            part.scores[star_field[:, None] != part.field] = -np.inf
        sums.add(part)
    return sums


def compute_exact_posterior(
    noisy: np.ndarray,
    templates: np.ndarray,
    likelihood: Likelihood,
    star_field: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute posterior mean, variance and probability of templates, summed over centring errors.

    All templates and all centring errors have the same prior probability.

    Parameters
    ----------
    noisy : ndarray, shape (n, d, d)
        Noisy images of one noise level.
    templates : ndarray, shape (F, J, d, d)
        Every template at every centring error.
    likelihood : Likelihood
        Likelihood at that noise level.
    star_field : ndarray of int, shape (n,), optional
        Field of every noisy image: only the template of this field is possible.

    Returns
    -------
    mean : ndarray, shape (n, d, d)
        Posterior mean of the image.
    variance : ndarray, shape (n,)
        Posterior variance, mean of the pixels.
    probability : ndarray, shape (n, F)
        Posterior probability of every template.
    """
    fields, shifts = templates.shape[:2]
    images = templates.reshape(fields * shifts, -1).astype(np.float64)
    # Log-likelihood of every template at every centring error.
    ratio, offset = likelihood.factors(images)
    scores = likelihood.residuals(noisy) @ ratio.T + offset
    # Templates of other fields are impossible if the field is known.
    if star_field is not None:
        scores[star_field[:, None] != np.repeat(np.arange(fields), shifts)] = -np.inf
    # Bayes' rule with a flat prior; the maximum score is subtracted against overflow.
    weight = np.exp(scores - scores.max(axis=1, keepdims=True))
    weight /= weight.sum(axis=1, keepdims=True)
    # Moments of the mixture; a template's probability is summed over all its centring errors.
    mean, variance = compute_mixture_moments(weight, images)
    probability = weight.reshape(-1, fields, shifts).sum(axis=2)
    return mean.reshape(noisy.shape), variance.mean(axis=1), probability


def average_nested(
    parts: Sequence[PosteriorSums], measure: Callable[[PosteriorSums], np.ndarray]
) -> dict[int, np.ndarray]:
    """Measure a quantity of every star for banks of one, two, four … parts.

    Several disjoint banks of k parts can be formed from the same parts. The mean over them
    reduces the scatter of the small sizes.

    Parameters
    ----------
    parts : sequence of PosteriorSums
        Sums over equally large disjoint parts; their number is a power of two.
    measure : function
        Function from the sums over a bank to an array.

    Returns
    -------
    dict of int to ndarray
        Mean of the array by number of parts, ascending.
    """
    means: dict[int, np.ndarray] = {}
    banks = list(parts)
    while True:
        # Mean over all banks of this size.
        means[len(parts) // len(banks)] = np.mean([measure(sums) for sums in banks], axis=0)
        if len(banks) == 1:
            return means
        # Pairs of neighbours make banks of twice the size.
        banks = [merge(banks[i : i + 2]) for i in range(0, len(banks), 2)]


def extrapolate(draws: np.ndarray, errors: np.ndarray) -> tuple[float, float, float]:
    """Fit error(M) = a + b M^−c to the errors of posterior means over banks of M stars.

    Parameters
    ----------
    draws : ndarray, shape (k,)
        Bank sizes M.
    errors : ndarray, shape (k,)
        Mean squared errors, all positive.

    Returns
    -------
    limit, exponent, residual : float
        a, c and the RMS of the relative residuals; NaN for fewer than four sizes. The limit lies
        between 0 and the smallest error: the fit extrapolates, it proves nothing.
    """
    from scipy.optimize import least_squares

    if len(draws) < 4:  # a fit of three parameters needs four sizes for a residual
        return (float("nan"),) * 3
    # Sizes in units of the largest, errors in units of the smallest: all parameters are near 1.
    size = np.asarray(draws, float) / draws[-1]
    scale = float(np.min(errors))
    ratio = np.asarray(errors) / scale

    def misfit(parameters: np.ndarray) -> np.ndarray:
        limit, excess, exponent = parameters
        return np.asarray((limit + excess * size**-exponent) / ratio - 1.0)

    # Least squares of relative residuals: small errors of large banks weigh as much as large ones.
    start = (0.9, max(ratio[-1] - 0.9, 1e-3), 0.7)
    fit = least_squares(misfit, start, bounds=((0.0, 0.0, 0.05), (1.0, np.inf, 3.0)), xtol=1e-12)
    return scale * fit.x[0], float(fit.x[2]), float(np.sqrt(np.mean(fit.fun**2)))
