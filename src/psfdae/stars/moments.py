"""Robust scatter, centroids, sub-pixel shifts, and sizes and shapes of PSFs.

Inputs: stamps of stars, (n, s, s). Outputs: one value for each star, or shifted stamps.

Sizes and shapes are the moments of a PSF under an elliptical Gaussian weight that is matched to
them (Bernstein & Jarvis 2002, AJ 123, 583; Hirata & Seljak 2003, MNRAS 343, 459): the ellipse of
the Gaussian that fits the PSF best. They depend less on the wings and the edge of the stamp than
unweighted second moments, and less on single pixels than a contour at half the maximum.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

SIGMA_OF_MAD = 1.4826
"""Ratio of the standard deviation of a normal variable to its median absolute deviation."""

FWHM_OF_SIGMA = 2.0 * np.sqrt(2.0 * np.log(2.0))
"""Ratio of the FWHM of a Gaussian to its standard deviation."""


def robust_scatter(values: np.ndarray) -> np.ndarray:
    """Return the standard deviation along the first axis, from the median absolute deviation."""
    median = np.median(values, axis=0)
    return np.asarray(SIGMA_OF_MAD * np.median(np.abs(values - median), axis=0))


def label_medians(values: np.ndarray, label: np.ndarray, count: int) -> np.ndarray:
    """Return the medians of the values with each label 0 … `count` − 1, NaN where there is none.

    Parameters
    ----------
    values, label : ndarray, shape (…)
        Values, and the label of each, an integer from 0 to at most 32,767.
    count : int
        Number of labels.
    """
    # A stable sort of 16-bit integers is a radix sort, much faster than a sort of the values.
    label = label.ravel().astype(np.int16)
    groups = np.split(
        values.ravel()[np.argsort(label, kind="stable")],
        np.cumsum(np.bincount(label, minlength=count))[: count - 1],
    )
    return np.array([middle_value(group) if group.size else np.nan for group in groups])


def middle_value(values: np.ndarray) -> Any:
    """Return the median of one or more finite numbers (n,), in an eighth of `np.median`'s time.

    It is the middle one in their order, or the mean of the two middle ones, of the array's type.
    """
    # numpy parts an array at one index with the processor's vectors, and at two without them.
    half = len(values) // 2
    halves = np.partition(values, half)
    return halves[half] if len(values) % 2 else 0.5 * (halves[:half].max() + halves[half])


def row_medians(values: np.ndarray) -> np.ndarray:
    """Return the median (n,) of each row (n, m) without its NaN; NaN if all values are."""
    # NaN are last in the order. A sort of all rows takes a tenth of the time of `np.nanmedian`.
    values, count = np.sort(values, axis=1), np.count_nonzero(~np.isnan(values), axis=1)
    middle = np.stack([np.maximum(count - 1, 0) // 2, count // 2], axis=1)
    return np.asarray(np.take_along_axis(values, middle, axis=1).mean(axis=1))


def count_step(values: np.ndarray) -> float:
    """Return the quantisation step of pixels (m, n), if it is above a tenth of their scatter.

    The step is the smallest difference of two values, in the unit of the pixels. The result is 0
    where the noise is wider or pixels are not quantised. Pixels that are not finite are ignored.
    """
    # At most 2 million pixels of evenly spaced rows. Differences of neighbours in a row contain
    # little starlight; their scatter is √2 σ.
    sample = values[:: len(values) * values.shape[1] // 2_000_000 + 1]
    distinct = np.unique(sample[np.isfinite(sample)])
    differences = np.diff(sample, axis=1)
    differences = differences[np.isfinite(differences)]
    if distinct.size < 2 or not differences.size:
        return 0.0
    step = float(np.diff(distinct).min())
    scatter = SIGMA_OF_MAD * middle_value(np.abs(differences - middle_value(differences)))
    return step if scatter < 10.0 * np.sqrt(2.0) * step else 0.0


def dither(values: np.ndarray, step: float) -> tuple[np.ndarray, float]:
    """Return pixels (…, m, n) with uniform noise of ± one step, and the variance of this noise.

    The median of integer counts is an integer for every level and scatter of the sky.
    With this noise, which is the same in every call, medians, modes and clipped deviations differ
    by less than 0.2 σ from their values before rounding, for a noise of 0.3 steps or more.
    """
    # Values that are not quantised need no noise.
    if not step:
        return values, 0.0
    noise = np.random.default_rng(0).uniform(-step, step, values.shape[-2:])
    return values + noise.astype(values.dtype), step**2 / 3.0


def remove_dither(sigma: np.ndarray, variance: float) -> np.ndarray:
    """Return σ of dithered pixels without the variance that `dither` added.

    The result is at least the rounding error of the pixels, step/√12.
    """
    # The variance of rounding, step²/12, is a quarter of the variance of the dither, step²/3.
    return np.sqrt(np.maximum(sigma**2 - variance, variance / 4.0)) if variance else sigma


def shift_stamps(
    stamps: np.ndarray, shift: np.ndarray, stamp: np.ndarray | None = None
) -> np.ndarray:
    """Return stamps shifted by cubic splines, with edge pixels repeated outside the stamp.

    The mean squared error is 1e-8 for a star of flux 1 with a FWHM of 3 px.

    Parameters
    ----------
    stamps : ndarray, shape (n, s, s)
        Images of stars.
    shift : ndarray, shape (m, 2)
        Shift of the star along the row and column axes, in pixels.
    stamp : ndarray of int, shape (m,), optional
        Index of the stamp of each shift; by default each stamp is shifted once, m = n.

    Returns
    -------
    ndarray, shape (m, s, s)
        Shifted stamps.
    """
    from scipy import ndimage

    # The influence of the edge on the splines decreases by a factor of 3.7 per pixel, to 1e-7 after
    # a margin of 12 px.
    side, margin = stamps.shape[-1], 12
    stamp = np.arange(len(stamps)) if stamp is None else stamp
    # Coefficients of the splines through the pixels of an axis are linear in these. The pixels of a
    # shifted stamp lie at −shift among the knots: with matrices R, C of the splines at its rows and
    # columns, times the coefficients of each pixel, its values are R x Cᵀ. 256 stamps at a time
    # limit the memory.
    pixels = np.pad(np.eye(side), ((margin, margin), (0, 0)), mode="edge")
    splines = ndimage.spline_filter1d(pixels, 3, 0, mode="nearest")
    shifted_stamps, knots = np.empty((len(stamp), side, side)), side + 2 * margin
    axis, farthest = np.arange(side) - (side - 1) / 2, (knots - 3) / 2
    for part in (slice(start, start + 256) for start in range(0, len(stamp), 256)):
        position = np.clip(axis - shift[part, :, None], -farthest, farthest)
        rows, columns = (cubic_splines(position, knots, 1.0) @ splines).swapaxes(0, 1)
        shifted_stamps[part] = rows @ stamps[stamp[part]] @ columns.transpose(0, 2, 1)
    return shifted_stamps


def cubic_splines(
    position: np.ndarray, knots: int, spacing: float, slope: bool = False
) -> np.ndarray:
    """Return the values of cubic B-splines at some positions, or their slopes.

    Parameters
    ----------
    position : ndarray, shape (…)
        Positions in pixels.
    knots : int
        Number of equidistant knots; position 0 is in the middle between the first and the last.
    spacing : float
        Distance of two knots in pixels.
    slope : bool
        True for slopes per pixel instead of values.

    Returns
    -------
    ndarray, shape (…, knots)
        Value or slope of the spline of every knot.
    """
    # At a fraction t of the way from one knot to the next, only the splines of two knots on each
    # side are not 0: the cubic B-spline is ((1−t)³, 4 − 3t²(2−t), 4 − 3(1−t)²(1+t), t³)/6 there
    # (de Boor 1978, A Practical Guide to Splines).
    knot_position = position / spacing + (knots - 1) / 2
    first = np.floor(knot_position)
    t = knot_position - first
    if slope:
        # Their derivatives with respect to the position.
        values = (-0.5 * (1 - t) ** 2, t * (1.5 * t - 2), (1 - t) * (1.5 * t + 0.5), 0.5 * t**2)
        scale = spacing
    else:
        u = 1 - t
        values = (u**3, 4 - 3 * t**2 * (1 + u), 4 - 3 * u**2 * (1 + t), t**3)
        scale = 6.0
    # Four additional knots on each side take the values that belong to knots outside the range;
    # they are cut off.
    count = knots + 8
    matrix = np.zeros((*position.shape, count))
    knot = np.clip(np.nan_to_num(first), -3, knots + 1).astype(np.intp)
    # Index, in the flattened matrix, of the first of the four knots of each position.
    index = np.arange(position.size).reshape(position.shape) * count + knot + 3
    for number, value in enumerate(values):
        matrix.reshape(-1)[index + number] = value / scale
    return matrix[..., 4:-4]


def moving_matrices(side: int, steps: np.ndarray) -> np.ndarray:
    """Return matrices (…, s, s) that shift the pixels of an axis by steps (…) in px; 0 outside."""
    from scipy import ndimage

    # Cubic splines through the pixels, reflected at the edges, at the pixels before the shift.
    splines = ndimage.spline_filter1d(np.eye(side), 3, 0, mode="mirror")
    position = np.arange(side) - steps[..., None]
    weights = cubic_splines(position - (side - 1) / 2, side + 4, 1.0)
    weights[(position < 0) | (position > side - 1)] = 0.0
    return np.asarray(weights @ np.pad(splines, ((2, 2), (0, 0)), mode="reflect"))


def find_centroids(
    stamps: np.ndarray, start: np.ndarray, window_px: np.ndarray, rounds: int, reach_px: float
) -> np.ndarray:
    """Return centroids under a Gaussian window that follows the star (SExtractor's XWIN, YWIN).

    Parameters
    ----------
    stamps : ndarray, shape (n, s, s)
        Sky-subtracted images of stars.
    start : ndarray, shape (n, 2)
        First estimate (row, column), in pixels from index (s//2, s//2).
    window_px : ndarray, shape (n,)
        σ of the window in pixels, about the σ of the star.
    rounds : int
        Number of iterations; each reduces the distance to the centroid to less than a fifth.
    reach_px : float
        Largest distance from the start, per axis, in pixels.

    Returns
    -------
    ndarray, shape (n, 2)
        (row, column), in pixels from index (s//2, s//2).
    """
    # A Gaussian window is a product of Gaussians along rows and along columns.
    axis = np.arange(stamps.shape[-1]) - stamps.shape[-1] // 2
    centre = start.astype(np.float64)
    for _ in range(rounds):
        rows, columns = (axis - centre[:, i : i + 1] for i in (0, 1))
        along = [np.exp(-0.5 * (a / window_px[:, None]) ** 2) for a in (rows, columns)]
        weighted_light = along[0][:, :, None] * along[1][:, None, :] * stamps
        # First moments of the light under the window.
        total = weighted_light.sum(axis=(1, 2))
        row_moment = np.einsum("nij,ni->n", weighted_light, rows)
        column_moment = np.einsum("nij,nj->n", weighted_light, columns)
        # A window as wide as the star halves the distance of the centroid, hence the factor of 2.
        step = (
            2.0
            * np.stack([row_moment, column_moment], axis=1)
            / np.where(total > 0, total, np.inf)[:, None]
        )
        centre = np.clip(centre + step, start - reach_px, start + reach_px)
    return centre


@dataclass(frozen=True)
class Shapes:
    """Shapes of n PSFs, NaN where a PSF has no light.

    Attributes
    ----------
    fwhm_px : ndarray, shape (n,)
        2 √(2 ln 2) · |M|^¼ of the moments M, in pixels; the pixel broadens it.
    ellipticity : ndarray, shape (n,)
        1 − b/a with the semi-axes a ≥ b of the ellipse.
    position_angle_deg : ndarray, shape (n,)
        Angle of the major axis from +x (columns) towards +y (rows), −90° … 90°.
    """

    fwhm_px: np.ndarray
    ellipticity: np.ndarray
    position_angle_deg: np.ndarray


def measure_shapes(psf: np.ndarray) -> Shapes:
    """Return shapes of PSFs (n, d, d) of any flux; negative pixels are set to 0."""
    # The eigenvalues of the moments are (M_xx + M_yy ± spread)/2, the squares of the semi-axes.
    # With spread² = (M_xx − M_yy)² + 4 M_xy², the ratio of the squared axes gives b/a, and the
    # direction of the major axis is ½ atan2(2 M_xy, M_xx − M_yy). |M|^¼ is σ of a round Gaussian
    # of the same area.
    xx, xy, yy = _adaptive_moments(psf)
    with np.errstate(invalid="ignore"):
        determinant = xx * yy - xy**2
        spread = np.hypot(xx - yy, 2.0 * xy)
        ratio = (xx + yy - spread) / (xx + yy + spread)
        return Shapes(
            fwhm_px=FWHM_OF_SIGMA * determinant**0.25,
            ellipticity=1.0 - np.sqrt(np.maximum(ratio, 0.0)),
            position_angle_deg=np.rad2deg(0.5 * np.arctan2(2.0 * xy, xx - yy)),
        )


def _adaptive_moments(psf: np.ndarray) -> np.ndarray:
    """Return the moments M_xx, M_xy, M_yy under a matched Gaussian weight, shape (3, n)."""
    # In single precision; the brightest pixel is scaled to 1.
    count, side = len(psf), psf.shape[-1]
    light = np.maximum(psf.reshape(count, side * side), 0.0).astype(np.float32)
    peak = light.max(axis=1, initial=0.0)
    # PSFs without light are replaced by flat ones here, and become NaN at the end.
    has_light = np.isfinite(peak) & (peak > 0)
    light /= np.where(has_light, peak, 1.0)[:, None]
    light[~has_light] = 1.0
    # Terms 1, x, y, x², xy, y² of every pixel, from the middle of the stamp, shape (6, d²).
    row, column = (axis.ravel() for axis in np.indices((side, side)) - 0.5 * (side - 1))
    terms = np.stack(
        [np.ones_like(row), column, row, column * column, column * row, row * row]
    ).astype(np.float32)
    # Start with unweighted moments. A column of `gaussian` is x, y, M_xx, M_xy, M_yy of a PSF.
    x, y, moments = _centre_and_moments(light @ terms.T)
    gaussian = np.stack([x, y, *_bound_moments(*moments, side)])
    last_update = last_change = None
    # A Gaussian needs two updates of the weight, aberrated PSFs need more: after 14, the width of
    # the ring of a star out of focus by 1.5 waves has an error of 2e-4. All PSFs get as many, so
    # that none depends on the others.
    for _ in range(14):
        update = _update_gaussian(gaussian, light, terms, side)
        # Anderson acceleration of depth 1 (Walker & Ni 2011, SIAM J. Numer. Anal. 49, 1715): with
        # updates g and their changes f, the next Gaussian is g − θ (g − g'), θ = f·Δf / Δf·Δf.
        # Where changes shrink by a constant factor, this is the limit of the updates.
        change, gaussian = update - gaussian, update
        if last_update is not None and last_change is not None:
            difference = change - last_change
            squares = np.maximum((difference * difference).sum(axis=0), 1e-12)
            theta = np.clip((change * difference).sum(axis=0) / squares, -9.0, 0.5)
            x, y, xx, xy, yy = update - theta * (update - last_update)
            centre = np.clip([x, y], -0.5 * side, 0.5 * side)
            gaussian = np.stack([*centre, *_bound_moments(xx, xy, yy, side)])
        last_update, last_change = update, change
    return np.where(has_light, update[2:], np.nan)


def _update_gaussian(
    gaussian: np.ndarray, light: np.ndarray, terms: np.ndarray, side: int
) -> np.ndarray:
    """Return the Gaussians (5, n) that have the moments of the light under a weight like them.

    Parameters
    ----------
    gaussian : ndarray, shape (5, n)
        x, y, M_xx, M_xy and M_yy, in px and px².
    light : ndarray, shape (n, d²)
        Pixels of PSFs.
    terms : ndarray, shape (6, d²)
        1, x, y, x², xy and y² of the pixels.
    side : int
        d.
    """
    x, y, *moments = gaussian
    # Moments under a weight that is wider than the PSF by 0.5 px² of variance, because narrow PSFs
    # fall between pixels; from them, the moments of the Gaussian without the weight.
    weight = (moments[0] + 0.5, moments[1], moments[2] + 0.5)
    weighted_light = _exponent(x, y, *weight) @ terms
    np.exp(weighted_light, out=weighted_light)
    weighted_light *= light
    x1, y1, apparent = _centre_and_moments(weighted_light @ terms.T)
    moments_without_weight = _bound_moments(*_correct_moments(apparent, weight), side)
    centre = _correct_centre(x, y, x1, y1, apparent, moments_without_weight)
    return np.stack(
        [*(np.clip(v, -0.5 * side, 0.5 * side) for v in centre), *moments_without_weight]
    )


Matrix = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Elements xx, xy, yy of n symmetric 2 × 2 matrices, in px²."""


def _centre_and_moments(sums: np.ndarray) -> tuple[np.ndarray, np.ndarray, Matrix]:
    """Return x, y and central second moments from sums of 1, x, y, x², xy and y², (n, 6)."""
    # Means of x, y, x², xy and y²; then the central moments, such as ⟨x²⟩ − ⟨x⟩².
    total = np.maximum(sums[:, 0].astype(np.float64), 1e-30)
    x, y, xx, xy, yy = sums[:, 1:].T / total
    return x, y, (xx - x * x, xy - x * y, yy - y * y)


def _correct_moments(apparent: Matrix, weight: Matrix) -> Matrix:
    """Return the moments T + T(W − T)⁻¹T of the Gaussian that has moments T under the weight W.

    The result is 2 T where no such Gaussian exists, because the PSF is flat.
    """
    # Elements of W − T, and T (W − T)⁻¹ T written out.
    a, b, c = (w - t for w, t in zip(weight, apparent, strict=True))
    determinant = a * c - b * b
    is_gaussian = (a > 0) & (determinant > 1e-3 * weight[0] * weight[2])
    determinant = np.where(is_gaussian, determinant, 1.0)
    xx, xy, yy = apparent
    correction = (
        (xx * xx * c - 2.0 * xx * xy * b + xy * xy * a) / determinant,
        (xx * xy * c - (xx * yy + xy * xy) * b + xy * yy * a) / determinant,
        (xy * xy * c - 2.0 * xy * yy * b + yy * yy * a) / determinant,
    )
    xx, xy, yy = (
        t + np.where(is_gaussian, m, t) for t, m in zip(apparent, correction, strict=True)
    )
    return xx, xy, yy


def _correct_centre(
    x: np.ndarray, y: np.ndarray, x1: np.ndarray, y1: np.ndarray, apparent: Matrix, moments: Matrix
) -> tuple[np.ndarray, np.ndarray]:
    """Return the centre c + M T⁻¹ (c₁ − c) of a Gaussian of moments M.

    Its centre under a weight about c is c₁ = (x1, y1), with the moments T = `apparent`.
    """
    xx, xy, yy = apparent
    # (u, v) = T⁻¹ (c₁ − c).
    determinant = np.maximum(xx * yy - xy * xy, 1e-12)
    u = (yy * (x1 - x) - xy * (y1 - y)) / determinant
    v = (xx * (y1 - y) - xy * (x1 - x)) / determinant
    return x + moments[0] * u + moments[1] * v, y + moments[1] * u + moments[2] * v


def _bound_moments(xx: np.ndarray, xy: np.ndarray, yy: np.ndarray, side: int) -> Matrix:
    """Limit moments to widths between a pixel and the stamp, and to positive determinants."""
    # The variance of a pixel of side 1 is 1/12 ≈ 0.08 px² along an axis.
    xx, yy = (np.clip(variance, 0.08, (0.5 * side) ** 2) for variance in (xx, yy))
    limit = 0.99 * np.sqrt(xx * yy)
    return xx, np.clip(xy, -limit, limit), yy


def _exponent(
    x: np.ndarray, y: np.ndarray, xx: np.ndarray, xy: np.ndarray, yy: np.ndarray
) -> np.ndarray:
    """Return the coefficients of 1, x, y, x², xy and y² in the exponent of the weight, (n, 6)."""
    # −½ (a (x−x₀)² + 2b (x−x₀)(y−y₀) + c (y−y₀)²) with the inverse (a, b; b, c) of the moments;
    # the centre (x₀, y₀) is the arguments x and y.
    determinant = xx * yy - xy**2
    a, b, c = yy / determinant, -xy / determinant, xx / determinant
    constant = a * x * x + 2.0 * b * x * y + c * y * y
    linear_x, linear_y = -2.0 * (a * x + b * y), -2.0 * (b * x + c * y)
    powers = np.stack([constant, linear_x, linear_y, a, 2.0 * b, c], axis=1)
    return (-0.5 * powers).astype(np.float32)
