"""Positions and fluxes of all stars of an image from one weighted least-squares fit.

The image x is the sum of the light of its stars, each a flux F times the PSF P at its position:

    x = Σ_i F_i P(p − p_i) + n,    n ~ N(0, σ²).

The parameters of a star are those for which the derivatives of its light, in a box of pixels about
it, are orthogonal to the residuals of the whole model, Σ_box (x − model) ∂model_i / σ² = 0:
the light that every other star has in the box belongs to the model, but what the PSF is like far
from the star does not decide. The equations of stars whose boxes overlap are solved together, by
Gauss–Newton steps on one sparse matrix (Stetson 1987, PASP 99, 191, solves them group by group).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from psfdae.base.progress import steps
from psfdae.base.types import csc_array
from psfdae.psf.grid import PsfGrid


@dataclass(frozen=True)
class JointFit:
    """Stars of an image as they were fitted; NaN for those without pixels to fit.

    Attributes
    ----------
    position, position_error : ndarray, shape (n, 2)
        Centres, x and y, 0-based pixels, and their standard errors.
    flux, flux_error : ndarray, shape (n,)
        Light in the stamp of the PSF, counts, and its standard errors.
    flux_bias : ndarray, shape (n,)
        Mean excess of the fluxes because centres are free, counts.
    chi2 : ndarray, shape (n,)
        Reduced χ² of the pixels of the box.
    flags : ndarray of int, shape (n,)
        Flags as photutils' `PSFPhotometry` has them (`photutils.psf.decode_psf_flags`).
    light : ndarray, shape (h, w)
        Light of all stars, counts.
    """

    position: np.ndarray
    position_error: np.ndarray
    flux: np.ndarray
    flux_error: np.ndarray
    flux_bias: np.ndarray
    chi2: np.ndarray
    flags: np.ndarray
    light: np.ndarray


def fit_stars(
    psfs: PsfGrid,
    image: np.ndarray,
    error: np.ndarray,
    bad: np.ndarray,
    position: np.ndarray,
    flux: np.ndarray | None,
    box_px: int,
    range_px: float,
    origin: np.ndarray | None = None,
    position_prior: tuple[np.ndarray, float] | None = None,
) -> JointFit:
    """Fit all stars of an image together.

    Parameters
    ----------
    psfs : PsfGrid
        PSFs on a grid over the image, of flux 1.
    image, error : ndarray, shape (h, w)
        Image without its sky, and σ of its pixels, counts.
    bad : ndarray of bool, shape (h, w)
        Pixels that do not count.
    position : ndarray, shape (n, 2)
        Start of the fit, x and y; stars whose position is not finite are not fitted.
    flux : ndarray, shape (n,), or None
        Fluxes at the start, if known.
    box_px : int
        Side of the pixels about each star that decide on it, odd.
    range_px : float
        Distance that a star may move from its origin along either axis.
    origin : ndarray, shape (n, 2), optional
        Positions of the stars by a list or by detection, by default where the fit starts.
    position_prior : tuple of ndarray, shape (n, 2), and float, optional
        Positions that are known independently of this image, and their standard error along either
        axis, px: the fit is the most probable one, given these. By default, pixels alone decide.
    """
    fit = _Fit(psfs, image, error, bad, position, flux, min(box_px, psfs.side_px), range_px)
    middle = fit.start if origin is None else origin[fit.stars]
    # A position is known to its range: an even chance of ± a has the variance a²/3.
    prior = np.array([0.0, 3.0, 3.0]) / range_px**2
    if position_prior is not None:
        fit.prior_position, fit.pull = position_prior[0][fit.stars], 1.0 / position_prior[1] ** 2
        prior[1:] = fit.pull
    count, group, cost = len(fit.stars), chains(fit.start, range_px), fit.cost()
    damping, moving, is_active = np.zeros(count), *np.ones((2, count), dtype=bool)
    # Stars are at most half a pixel off the middles of their boxes: no two boxes of different
    # clusters overlap, whose equations are thus independent.
    cluster = chains(fit.start, max(fit.box_px, range_px), norm=np.inf)
    # Stars without neighbours take three or four steps, close pairs ten.
    for _ in steps("joint fit", range(15)):
        rows = np.flatnonzero(is_active)
        step, gradient = np.zeros((2, count, fit.parameters))
        step[rows], gradient[rows] = fit.solve(fit.design(rows), prior, damping[rows], rows)
        # No farther at once than the light is nearly linear in the position, nor out of its range.
        move = np.clip(step[:, 1:], -range_px / 4, range_px / 4)
        move = np.clip(fit.position + move, middle - range_px, middle + range_px) - fit.position
        step[rows, 1:] = move[rows]
        # A group is at rest if its χ² would fall by less than 0.01: it is within 0.1 σ.
        expected_gain = np.bincount(group, (step * gradient).sum(axis=1))
        moving = (expected_gain > 0.01)[group]
        if not moving.any():
            break
        # Stars of a group at rest stay where they are.
        rows = np.flatnonzero(moving)
        fit.move(rows, step[rows])
        # Levenberg (1944, Q. Appl. Math. 2, 164): a step of a group after which it fits worse is
        # taken back, and the next one is shorter the less this one was worth what was expected.
        earlier_cost, new_cost = cost, fit.cost()
        gain = np.bincount(group, cost - new_cost)
        is_worse, is_poor = ((gain < part * expected_gain)[group] & moving for part in (-0.5, 0.1))
        back = np.flatnonzero(is_worse)
        fit.take_back(back, step[back])
        damping = np.where(is_poor, np.maximum(4.0 * damping, 0.03), 0.1 * damping)
        cost = fit.cost() if len(back) else new_cost
        # A cluster in whose boxes nothing has changed, and that is not damped, would get the same
        # steps as before, which were not worth to be taken.
        is_changed = (cost != earlier_cost) | (new_cost != earlier_cost) | (damping > 1e-3)
        is_active = (np.bincount(cluster, is_changed) > 0)[cluster]
    bound = np.abs(fit.position - middle) > 0.999 * range_px
    return fit.result(len(position), prior, moving, bound)


def pairs_within(position: np.ndarray, distance_px: float, norm: float = 2.0) -> np.ndarray:
    """Return the pairs of stars that are nearer to each other than a distance, (k, 2), by number.

    Stars of which no position (n, 2) is known are in no pair. With the norm inf, the distance is
    the larger one along the two axes.
    """
    from scipy.spatial import cKDTree

    rows_with_position = np.flatnonzero(np.isfinite(position).all(axis=1))
    # The tree numbers the located stars.
    tree = cKDTree(position[rows_with_position])
    pairs = tree.query_pairs(distance_px, norm, output_type="ndarray")
    return np.asarray(rows_with_position[pairs])


def chains(position: np.ndarray, distance_px: float, norm: float = 2.0) -> np.ndarray:
    """Return the numbers (n,) from 0 of the chains of stars nearer to each other than a distance.

    A star of which no position (n, 2) is known is a chain of its own. For the `norm`, see
    `pairs_within`.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    # Chains are the connected components of the graph of these pairs.
    pairs = pairs_within(position, distance_px, norm)
    links = coo_array((np.ones(len(pairs)), pairs.T), shape=(len(position),) * 2)
    return np.asarray(connected_components(links, directed=False)[1])


class _Fit:
    """State of a fit of m stars: their positions and fluxes, and the residuals of the image.

    The image has a border of pixels that do not count, as wide as a stamp and as the whole range of
    a star, so that the light of stars at its edge is whole.
    """

    parameters = 3  # of a star: flux, and position x and y

    def __init__(
        self,
        psfs: PsfGrid,
        image: np.ndarray,
        error: np.ndarray,
        bad: np.ndarray,
        position: np.ndarray,
        flux: np.ndarray | None,
        box_px: int,
        range_px: float,
    ) -> None:
        self.psfs, self.image, self.bad, self.box_px = psfs, image, bad, box_px
        # The image and 1/σ of its pixels with a border; bad pixels have the weight 0.
        self.border = psfs.side_px + int(np.ceil(2.0 * range_px))
        shape = [side_px + 2 * self.border for side_px in image.shape]
        self.residual, weight = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
        self._core = (np.s_[self.border : -self.border],) * 2
        np.copyto(self.residual[self._core], image, "same_kind", where=~bad)
        np.divide(1.0, error, out=weight[self._core], where=~bad, casting="same_kind")
        # Stars on the image whose boxes have at least as many pixels as a star has parameters.
        height, width = image.shape
        on_image = np.isfinite(position).all(axis=1)
        on_image[on_image] = (
            (position[on_image] > -1) & (position[on_image] < (width, height))
        ).all(axis=1)
        self.stars = np.flatnonzero(on_image)
        self._middle = np.rint(position[self.stars]).astype(int)
        boxes = self._pixel_numbers(self._middle - box_px // 2, box_px)
        pixels = np.count_nonzero(weight.ravel()[boxes], axis=(1, 2))
        is_fitted = pixels >= self.parameters
        self.stars, self._middle, self.pixels = (
            values[is_fitted] for values in (self.stars, self._middle, pixels)
        )
        # Pixels of the boxes, which decide on a star. Rows of the design are the pixels of all
        # boxes.
        self.boxes = boxes[is_fitted]
        self._rows = np.unique(self.boxes, return_inverse=True)[1].reshape(self.boxes.shape)
        # Positions and fluxes at the start, the stars' light and its derivatives there.
        self.weight = weight.ravel()[self.boxes]
        self.start = position[self.stars].astype(np.float64)
        self.position, self.flux = self.start.copy(), np.zeros(len(self.stars))
        if flux is not None:
            self.flux = np.nan_to_num(flux[self.stars].astype(np.float64))
        # Positions that are known beforehand, and their inverse variance; 0 if none are.
        self.prior_position, self.pull = self.start, 0.0
        # A star moves so little that its PSF stays as it is at the start, of these fluxes.
        self._mix_psfs()
        self._corner = np.empty((len(self.stars), 2), int)
        self._light = np.empty((len(self.stars), psfs.psf_px, psfs.psf_px), np.float32)
        self._derivatives = np.empty((len(self.stars), self.parameters, box_px, box_px))
        rows = np.arange(len(self.stars))
        self._draw(rows)
        # Fluxes are linear in the pixels: those at the positions of the start are one step away.
        if flux is None:
            self.flux = self.solve_fluxes()
            # Where the PSF changes with the magnitude, these fluxes determine it from now on.
            if self.psfs.magnitudes.size:
                self._mix_psfs()
                self._draw(rows)
        self._subtract(rows, self.flux)

    def _pixel_numbers(self, corner: np.ndarray, side_px: int) -> np.ndarray:
        """Return the numbers (m, s, s) of pixels in the image with its border.

        `corner` (m, 2) has column and row of the first pixel of each square in the image.
        """
        row, column = (corner[:, k, None] + np.arange(side_px) + self.border for k in (1, 0))
        return np.asarray(row[:, :, None] * self.residual.shape[1] + column[:, None, :])

    def _mix_psfs(self) -> None:
        """Mix the PSFs of the stars for their fluxes; PSFs of over 100 MB are mixed as needed."""
        self._psf_flux, self._splines = self.flux.copy(), None
        if len(self.stars) * self.psfs.splines[0].nbytes < 100e6:
            self._splines = self.psfs.mix_splines(self.start, self._psf_flux)

    def _draw(self, rows: np.ndarray) -> None:
        """Draw the light of some stars of flux 1, and its derivatives by x and y in their boxes."""
        # 256 stars at a time, for memory.
        for part in np.array_split(rows, len(rows) // 256 + 1):
            position, box_corner = self.position[part], self._middle[part] - self.box_px // 2
            if self._splines is None:
                psfs = self.psfs.mix_splines(self.start[part], self._psf_flux[part])
                splines = psfs, np.arange(len(part))
            else:
                splines = self._splines, part
            self._corner[part] = self.psfs.find_corners(position)
            stamps = position, self._corner[part], self.psfs.psf_px
            self._light[part] = self.psfs.stamps(*stamps, splines=splines)
            # The box stays where it is while the stamp moves with its star: its light is drawn by
            # itself, with its derivatives.
            box = position, box_corner, self.box_px
            self._derivatives[part] = self.psfs.stamps_and_slopes(*box, splines=splines)

    def _subtract(self, rows: np.ndarray, flux: np.ndarray) -> None:
        """Subtract the light of some stars with these fluxes from the residuals."""
        # Stamps of stars overlap: pixels that several have are subtracted from several times. 512
        # stars at a time, for memory.
        for part in np.array_split(np.arange(len(rows)), len(rows) // 512 + 1):
            light = flux[part, None, None].astype(np.float32) * self._light[rows[part]]
            numbers = self._pixel_numbers(self._corner[rows[part]], self.psfs.psf_px)
            np.subtract.at(self.residual.reshape(-1), numbers.ravel(), light.ravel())

    def solve_fluxes(self) -> np.ndarray:
        """Return the fluxes (m,) that fit best at the positions as they are."""
        design = self._derivatives[:, :1] * self.weight[:, None]
        rows = np.arange(len(design))
        return self.solve(design, np.zeros(1), np.zeros(len(rows)), rows)[0][:, 0]

    def move(self, rows: np.ndarray, change: np.ndarray) -> None:
        """Change flux, x and y of some stars, ascending, by (k, 3)."""
        self._before_move = rows, [values[rows] for values in self._star_arrays]
        # The old light is added to the residuals, and the light at the new position is subtracted.
        self._subtract(rows, -self.flux[rows])
        self.flux[rows] += change[:, 0]
        self.position[rows] += change[:, 1:]
        self._draw(rows)
        self._subtract(rows, self.flux[rows])

    @property
    def _star_arrays(self) -> tuple[np.ndarray, ...]:
        """Arrays with a row for each star, which are computed when it is drawn."""
        return self._corner, self._light, self._derivatives

    def take_back(self, rows: np.ndarray, change: np.ndarray) -> None:
        """Take the last change (k, 3) of some of the moved stars back, which are not drawn anew."""
        self._subtract(rows, -self.flux[rows])
        self.flux[rows] -= change[:, 0]
        self.position[rows] -= change[:, 1:]
        moved_rows, earlier_arrays = self._before_move
        at = np.searchsorted(moved_rows, rows)
        for values, earlier_values in zip(self._star_arrays, earlier_arrays, strict=True):
            values[rows] = earlier_values[at]
        self._subtract(rows, self.flux[rows])

    def design(self, rows: np.ndarray) -> np.ndarray:
        """Return the derivatives (k, 3, b, b) of the light of stars by flux, x and y, over σ."""
        # ∂(F P)/∂F = P, ∂(F P)/∂x = F ∂P/∂x, and the same by y.
        flux = self.flux[rows]
        factor = np.stack([np.ones_like(flux), flux, flux], axis=1)[..., None, None]
        return np.asarray(self._derivatives[rows] * factor * self.weight[rows, None])

    def squares(self) -> np.ndarray:
        """Return the sums (m,) of the squared residuals in the boxes, in units of σ."""
        # χ² of each box; the light of all other stars is subtracted there, too.
        residual = self.weight * self.residual.ravel()[self.boxes]
        return np.asarray(np.square(residual).sum(axis=(1, 2)))

    def cost(self) -> np.ndarray:
        """Return χ² (m,) of the boxes and of the distances from the expected positions."""
        distance_square = np.square(self.position - self.prior_position).sum(axis=1)
        return np.asarray(self.squares() + self.pull * distance_square)

    def solve(
        self, design: np.ndarray, prior: np.ndarray, damping: np.ndarray, rows: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the Gauss–Newton step (m, k) of some stars, and the slope of −χ²/2.

        The design (m, k, b, b), and the damping (m,), are of these stars.
        """
        from scipy.sparse import diags_array
        from scipy.sparse.linalg import splu

        # Levenberg's damping is a part of the diagonal, which is 1 in these units.
        matrix, unit = _normal_matrix(design, self._rows[rows], prior)
        matrix = (matrix + diags_array(np.repeat(damping, design.shape[1]))).tocsc()
        # Gradient of −χ²/2: Σ over the pixels of a box of residual times derivative, over σ².
        residual = self.weight[rows] * self.residual.ravel()[self.boxes[rows]]
        gradient = np.einsum("mkrc,mrc->mk", design, residual)
        # Positions, if they are fitted, are drawn to where they are expected.
        if design.shape[1] == self.parameters:
            gradient[:, 1:] -= self.pull * (self.position - self.prior_position)[rows]
        if not len(unit):
            return gradient, gradient
        # It is positive definite: no pivots, and an order for symmetric matrices.
        options = {"SymmetricMode": True}
        factors = splu(matrix, "MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
        return factors.solve((gradient / unit).ravel()).reshape(unit.shape) / unit, gradient

    def result(
        self, count: int, prior: np.ndarray, moving: np.ndarray, bound: np.ndarray
    ) -> JointFit:
        """Return the fit of `count` stars, these among them.

        `moving` stars (m,) were not at rest; x or y at the end of its range is in `bound` (m, 2).
        """
        # Standard errors, and the reduced χ² of the pixels of each box.
        matrix, unit = _normal_matrix(self.design(np.arange(len(self.stars))), self._rows, prior)
        error = standard_errors(matrix, unit)
        # The centre is fitted where noise makes the flux largest: with two free coordinates, it is
        # too large by F/S² in the mean, where S is the signal-to-noise ratio of the star alone
        # (Portillo et al. 2020, AJ 159, 165). Below S = 2, the range of the centre limits that.
        bias = self.flux / np.fmax(np.square(self.flux * unit[:, 0]), 4.0)
        chi2 = self.squares() / np.maximum(self.pixels - self.parameters, 1)
        # Flags as photutils has them: 1 not all pixels, 2 off the image, 4 no flux above 0, 8 not
        # at rest, 32 at the bound of its range.
        height, width = self.image.shape
        outside = (self.position < -0.5) | (self.position > (width - 0.5, height - 0.5))
        flags = 1 * (self.pixels < self.box_px**2) + 2 * outside.any(axis=1) + 4 * (self.flux <= 0)
        flags += 8 * moving + 32 * bound.any(axis=1)

        def fill_rows(values: np.ndarray, missing: float = np.nan) -> np.ndarray:
            # Rows of all stars of the list, without a value for stars that were not fitted.
            column = np.full((count, *values.shape[1:]), missing, values.dtype)
            column[self.stars] = values
            return column

        # The light of all stars is what the image has beyond the residuals.
        light = np.where(self.bad, 0.0, self.image).astype(np.float32)
        np.subtract(light, self.residual[self._core], out=light, casting="same_kind")
        return JointFit(
            fill_rows(self.position),
            fill_rows(error[:, 1:]),
            fill_rows(self.flux),
            fill_rows(error[:, 0]),
            fill_rows(bias),
            fill_rows(chi2),
            fill_rows(flags, 64),  # no overlap with usable pixels
            light,
        )


def _normal_matrix(
    design: np.ndarray, boxes: np.ndarray, prior: np.ndarray
) -> tuple[csc_array, np.ndarray]:
    """Return the sums over pixels of products of derivatives, scaled to a diagonal of 1.

    Parameters
    ----------
    design : ndarray, shape (m, k, b, b)
        Derivatives by k parameters of m stars in their boxes, in units of σ.
    boxes : ndarray of int, shape (m, b, b)
        Numbers of the pixels, from 0, ascending in a box.
    prior : ndarray, shape (k,)
        Inverse variances of the parameters.

    Returns
    -------
    matrix : csc_array, shape (m k, m k)
        Normal matrix DᵀD of the design D in units of `unit`, with the prior.
    unit : ndarray, shape (m, k)
        Root of the diagonal, 1/σ of a parameter if all others were known.
    """
    from scipy.sparse import csc_array, diags_array

    # Root of the diagonal of DᵀD + prior.
    stars, parameters, *box = design.shape
    unit = np.sqrt(np.square(design).sum(axis=(2, 3)) + prior)
    # A column for each parameter, a row for each pixel.
    size = box[0] * box[1]
    values = (design / unit[..., None, None]).ravel()
    rows = np.repeat(boxes.reshape(stars, 1, size), parameters, axis=1).ravel()
    ends = size * np.arange(unit.size + 1)
    columns = csc_array((values, rows, ends), shape=(int(boxes.max(initial=0)) + 1, unit.size))
    # Two stars at one position make the matrix singular: a millionth more splits their flux.
    diagonal = diags_array((prior / unit**2).ravel() + 1e-6)
    return (columns.T @ columns + diagonal).tocsc(), unit


def standard_errors(matrix: csc_array, unit: np.ndarray) -> np.ndarray:
    """Return the standard errors (m, k) of the k parameters of m stars.

    A star's covariance comes from the inverse of the part of the matrix that belongs to it and to
    the stars whose boxes overlap with its own; what these share with others changes little.

    Parameters
    ----------
    matrix : sparse array, shape (m k, m k)
        Normal matrix of all parameters, with 1 on its diagonal.
    unit : ndarray, shape (m, k)
        Factors by which its rows and columns were divided.
    """
    # Blocks of 3 × 3 numbers, one for each pair of stars that overlap.
    stars, parameters = unit.shape
    blocks = matrix.tobsr((parameters, parameters))
    blocks.sort_indices()
    # Key of the block of two stars (i, j) is i · m + j, ascending; each star has its neighbours.
    row = np.repeat(np.arange(stars), np.diff(blocks.indptr))
    key = row * stars + blocks.indices
    neighbours = np.diff(blocks.indptr)
    variance = np.empty((stars, parameters))
    for count in np.unique(neighbours):
        members = np.flatnonzero(neighbours == count)
        # Few at a time: matrices of (count · k)² numbers.
        for part in np.array_split(members, len(members) * count**2 // 2**16 + 1):
            neighbour_rows = blocks.indices[blocks.indptr[part, None] + np.arange(count)]
            # Blocks among the neighbours of each star; 0 for those that do not overlap.
            block_keys = neighbour_rows[:, :, None] * stars + neighbour_rows[:, None, :]
            block_rows = np.minimum(np.searchsorted(key, block_keys), len(key) - 1)
            local = blocks.data[block_rows] * (key[block_rows] == block_keys)[..., None, None]
            # The diagonal of the inverse at the block of the star itself.
            side = count * parameters
            inverse = np.linalg.inv(local.transpose(0, 1, 3, 2, 4).reshape(-1, side, side))
            diagonal = np.einsum("nii->ni", inverse).reshape(-1, count, parameters)
            variance[part] = diagonal[neighbour_rows == part[:, None]]
    return np.asarray(np.sqrt(variance) / unit)
