"""PSFs of a field as splines at the nodes of a grid, for the light of many stars.

A PSF between nodes is the bilinear interpolation of the four around it, and a parabola through
three magnitudes where the PSF changes with the magnitude of a star. The PSF of a node is a bicubic
spline through `oversampling` values per pixel. All pixels of a stamp then have the same phase
between the knots: a stamp needs one set of 4 × 4 weights (de Boor 1978, A practical guide to
splines), and its derivatives by the position of the star another one.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from psfdae.psf.interface import FieldPsfs
from psfdae.psf.wings import sum_outer_part
from psfdae.stars.bright_stars import magnitude


@dataclass(frozen=True)
class PsfGrid:
    """Splines of the PSFs of a field.

    Attributes
    ----------
    columns, rows : ndarray, shape (c,) and (r,)
        Positions of the nodes, in pixels of the image, ascending.
    psfs : ndarray, shape (r, c, m, m) or (3, r, c, m, m)
        Values of each PSF, at three magnitudes if there are any; index m//2 is its centre.
    oversampling : int
        Values per pixel and axis.
    magnitudes : ndarray, shape (0,) or (3,)
        Equidistant magnitudes, ascending, or none. Outside them the PSF is as at the nearest one.
    """

    columns: np.ndarray
    rows: np.ndarray
    psfs: np.ndarray
    oversampling: int
    magnitudes: np.ndarray = field(default_factory=lambda: np.zeros(0))

    @classmethod
    def sample(
        cls, model: FieldPsfs, nodes: int = 9, oversampling: int = 4, by_magnitude: bool = False
    ) -> PsfGrid:
        """Sample a model at `nodes` × `nodes` positions over the field of its training stars.

        `by_magnitude` samples it at three magnitudes as well if its PSF changes with them.
        Otherwise PSFs are averages over the training stars.

        Raises
        ------
        PredictionError
            If the model knows no PSF of a position.
        """
        x, y = np.rint(model.grid(nodes, nodes)).T
        ends = model.magnitude_range if by_magnitude else None
        magnitudes = np.zeros(0) if ends is None else np.linspace(*ends, 3)
        layers = [None] if ends is None else magnitudes.tolist()
        psfs = np.stack([model.psf_at(x, y, oversampling, mag=mag) for mag in layers])
        # An even stamp lacks a middle value: add a row and a column of zeros.
        psfs = np.pad(psfs, ((0, 0), (0, 0), *[(0, 1 - psfs.shape[-1] % 2)] * 2))
        psfs = psfs.reshape(*[3] * (ends is not None), nodes, nodes, *psfs.shape[2:])
        return cls(x[:nodes], y[::nodes], psfs, oversampling, magnitudes)

    def times(self, factor: float) -> PsfGrid:
        """Return the grid for fluxes in a unit in which all fluxes are larger by a factor."""
        return replace(self, magnitudes=self.magnitudes + magnitude(np.array(factor)))

    @cached_property
    def splines(self) -> np.ndarray:
        """Coefficients (nodes, k, k) of the splines, k = m + o + 3, in single precision.

        They are mirrored by two at each edge; o − 1 zeros follow, which stamps of `psf_px` reach.
        """
        from scipy.ndimage import spline_filter

        psfs = self.psfs.reshape(-1, *self.psfs.shape[-2:])
        splines = [np.pad(spline_filter(psf), 2, mode="reflect") for psf in psfs]
        zeros = (0, self.oversampling - 1)
        return np.pad(np.stack(splines), ((0, 0), zeros, zeros)).astype(np.float32)

    @property
    def psf_px(self) -> int:
        """Largest number of pixels of a row or column that a PSF covers."""
        return int((self.psfs.shape[-1] - 1) // self.oversampling + 1)

    def find_corners(self, centre: np.ndarray) -> np.ndarray:
        """Return column and row (n, 2) of the first pixel that the PSFs of stars (n, 2) cover."""
        half = self.psfs.shape[-1] // 2 / self.oversampling
        return np.asarray(np.ceil(centre - half).astype(int))

    @property
    def side_px(self) -> int:
        """Odd side of stamps that hold all light of a PSF wherever its star is in a pixel."""
        return 2 * int(self.psfs.shape[-1] // 2 // self.oversampling + 1) + 1

    def mix_splines(self, centre: np.ndarray, flux: np.ndarray | None = None) -> np.ndarray:
        """Return the splines (n, k, k) of stars at positions (n, 2), in single precision.

        They are the means of the splines of the nodes around each star, and of three magnitudes if
        the grid has these; for `flux` see `stamps`.
        """
        from scipy.sparse import csr_array

        node, share = self._nodes(centre, np.full(len(centre), np.nan) if flux is None else flux)
        # A product with a sparse matrix, whose rows have the weights of the nodes.
        ends, size = np.arange(len(node) + 1) * node.shape[1], (len(node), len(self.splines))
        weights = csr_array((share.astype(np.float32).ravel(), node.ravel(), ends), shape=size)
        # Of a faint or a bright star, whose PSF is that at one magnitude, eight of twelve are 0.
        weights.eliminate_zeros()
        mean_spline = weights @ self.splines.reshape(len(self.splines), -1)
        return np.asarray(mean_spline.reshape(len(centre), *self.splines.shape[1:]))

    def outer_shares(self, centre: np.ndarray, flux: np.ndarray, side_px: int) -> np.ndarray:
        """Return `psfdae.psf.wings.outer_shares` of stars from the PSFs of the nodes around them.

        Parameters
        ----------
        centre, flux : ndarray, shape (n, 2) and (n,)
            Positions and fluxes of the stars; the result is NaN where a position is not finite.
        side_px : int
            Side of the stamps, in which a PSF has the sum 1.
        """
        # Samples at whole pixels from the middle of the PSF.
        in_stamp = slice(0, self.oversampling * side_px, self.oversampling)
        node_shares = sum_outer_part(self.psfs[..., in_stamp, in_stamp]).ravel()
        shares, is_located = np.full(len(centre), np.nan), np.isfinite(centre).all(axis=1)
        node, weight = self._nodes(centre[is_located], flux[is_located])
        shares[is_located] = (node_shares[node] * weight).sum(axis=1)
        return shares

    def stamps(
        self,
        centre: np.ndarray,
        corner: np.ndarray,
        side_px: int,
        flux: np.ndarray | None = None,
        splines: tuple[np.ndarray, np.ndarray] | None = None,
    ) -> np.ndarray:
        """Return the light of stars of flux 1 in stamps of the image.

        Parameters
        ----------
        centre : ndarray, shape (n, 2)
            Centres of the stars, x and y, 0-based pixels of the image, finite.
        corner : ndarray of int, shape (n, 2)
            Column and row of the first pixel of each stamp.
        side_px : int
            Side of the stamps.
        flux : ndarray, shape (n,), optional
            Fluxes, counts, by which the PSFs differ if the grid has magnitudes. Where they are NaN
            or not given, the PSF is as at the middle magnitude.
        splines : tuple of ndarray, shapes (m, k, k) and (n,), optional
            PSFs of `mix_splines`, and the number of each star's, for stars that are drawn several
            times.

        Returns
        -------
        ndarray, shape (n, side_px, side_px), float32
            0 beyond the edge of the PSF.
        """
        stars = centre, corner, side_px, flux, splines
        return self._sum_splines(*stars, with_slopes=False)[:, 0]

    def stamps_and_slopes(
        self,
        centre: np.ndarray,
        corner: np.ndarray,
        side_px: int,
        splines: tuple[np.ndarray, np.ndarray] | None = None,
    ) -> np.ndarray:
        """Return the light of `stamps`, and its derivatives by x and y of the star, per pixel.

        Parameters are as in `stamps`; PSFs are as at the middle magnitude unless splines are given.
        The change of the PSF over the field is left out.

        Returns
        -------
        ndarray, shape (n, 3, side_px, side_px), float32
            0 beyond the edge of the PSF.
        """
        stars = centre, corner, side_px, None, splines
        values = self._sum_splines(*stars, with_slopes=True)
        # A star that moves by a pixel moves by −o knots under its pixels.
        values[:, 1:] *= -self.oversampling
        return values

    def _sum_splines(
        self,
        centre: np.ndarray,
        corner: np.ndarray,
        side_px: int,
        flux: np.ndarray | None,
        splines: tuple[np.ndarray, np.ndarray] | None,
        with_slopes: bool,
    ) -> np.ndarray:
        """Return the light (n, 1, s, s) of stars; with its slopes along x and y, (n, 3, s, s)."""
        values = np.zeros((len(centre), 3 if with_slopes else 1, side_px, side_px), np.float32)
        # Position of the first pixel among the knots, along x and y:
        # u = o (pixel − centre) + m//2, with its knot ⌊u⌋ and phase u − ⌊u⌋.
        size, between = self.psfs.shape[-1], self.oversampling
        first = between * (corner - centre) + size // 2
        knot = np.floor(first).astype(int)
        pixel_knot = knot[..., None] + between * np.arange(side_px)
        is_inside = (pixel_knot >= 0) & (pixel_knot + (first > knot)[..., None] <= size - 1)
        # Stamps with at least one pixel within the PSF; all others stay 0.
        stars = np.flatnonzero(is_inside.any(axis=2).all(axis=1))
        # Weights of the four taps of a pixel along y and x, of which one may be the slope.
        (x, y), (x_slope, y_slope) = (
            kernel.astype(np.float32).swapaxes(0, 1) for kernel in knot_weights(first - knot)
        )
        # Weights along y, each with those along x: for the light, its slope along x, and along y.
        terms = [(y, [x, x_slope]), (y_slope, [x])] if with_slopes else [(y, [x])]
        # Stamps may reach beyond a PSF: pad its spline with zeros, by no more than they do. Four
        # coefficients from the knot before the first pixel on are its taps.
        begin, span = knot[stars] + 1, between * (side_px - 1) + 4
        end = self.splines.shape[-1]
        room = max(0, -begin.min(initial=0), begin.max(initial=0) + span - end)
        # Batches of a quarter of a megabyte, which stay in the processor's cache.
        for batch in np.array_split(stars, len(stars) * 4 * side_px * span // 2**16 + 1):
            if splines is None:
                part = self.mix_splines(centre[batch], None if flux is None else flux[batch])
                spline = np.arange(len(batch))
            else:
                part, spline = splines[0], splines[1][batch]
            if room:
                part, spline = part[spline], np.arange(len(batch))
                part = np.pad(part, ((0, 0), (room, room), (room, room)))
            # View of the four taps along y of all rows of pixels, for stamps that begin at any
            # coefficient: pixels are o coefficients apart.
            star_step, down, across = part.strides
            taps = np.lib.stride_tricks.as_strided(
                part,
                (len(part), *[end + 2 * room - span + 1] * 2, 4, side_px, span),
                (star_step, down, across, down, between * down, across),
                writeable=False,
            )
            column, row = knot[batch].T + room + 1
            taps = taps[spline, row, column].reshape(len(batch), 4, side_px * span)
            # Sums over these taps, for all coefficients of a row, and then over those along x.
            number = 0
            for down_weight, across_weights in terms:
                sums = (down_weight[batch, None] @ taps).reshape(-1, side_px, span)
                columns = [sums[:, :, tap : tap + span - 3 : between] for tap in range(4)]
                for across_weight in across_weights:
                    weight = across_weight[batch, :, None, None]
                    total = weight[:, 0] * columns[0]
                    for tap in (1, 2, 3):
                        total += weight[:, tap] * columns[tap]
                    values[batch, number] = total
                    number += 1
        values *= (is_inside[:, 1, :, None] & is_inside[:, 0, None, :])[:, None]
        return values

    def _nodes(self, centre: np.ndarray, flux: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the numbers (n, 4 or 12) of the nodes around each star, and their weights."""
        # Along each axis: the nodes below and above, and their weights.
        axes = []
        for nodes, position in ((self.columns, centre[:, 0]), (self.rows, centre[:, 1])):
            lower = np.clip(np.searchsorted(nodes, position) - 1, 0, max(len(nodes) - 2, 0))
            upper = np.minimum(lower + 1, len(nodes) - 1)
            width = np.maximum(nodes[upper] - nodes[lower], 1.0)
            # Beyond the grid the PSF is that at its edge.
            fraction = np.clip((position - nodes[lower]) / width, 0.0, 1.0)
            axes.append((np.stack([lower, upper]), np.stack([1.0 - fraction, fraction])))
        # Four corners: weights are products of those along the axes.
        (column, column_share), (row, row_share) = axes
        number = row[:, None] * len(self.columns) + column[None]
        share = row_share[:, None] * column_share[None]
        number, share = number.reshape(4, -1).T, share.reshape(4, -1).T
        if not self.magnitudes.size:
            return number, share
        # Parabola through the PSFs at the magnitudes t = −1, 0 and 1 (Lagrange's weights).
        middle, step = self.magnitudes[1], self.magnitudes[2] - self.magnitudes[1]
        t = np.nan_to_num(np.clip((magnitude(flux) - middle) / step, -1.0, 1.0))
        weight = np.stack([0.5 * t * (t - 1.0), 1.0 - t**2, 0.5 * t * (t + 1.0)], axis=1)
        layer = len(self.columns) * len(self.rows) * np.arange(3)
        number, share = number[:, None] + layer[:, None], weight[:, :, None] * share[:, None]
        return number.reshape(-1, 12), share.reshape(-1, 12)


def knot_weights(phase: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the weights (…, 4) of the cubic B-splines around a position, and their slopes.

    `phase` (…) is the fraction t of the way from a knot to the next one. The four B-splines that
    are not 0 there are, times 6, (1 − t)³, 3t³ − 6t² + 4, the same of 1 − t, and t³.
    """
    # Slopes are the derivatives by t: −3u²/6 = −u²/2, (9t² − 12t)/6 = (3t² − 4t)/2, and so on.
    t, u = phase[..., None], 1.0 - phase[..., None]
    weights = [u**3, 3 * t**3 - 6 * t**2 + 4, 3 * u**3 - 6 * u**2 + 4, t**3]
    slopes = [-(u**2), 3 * t**2 - 4 * t, 4 * u - 3 * u**2, t**2]
    return np.concatenate(weights, axis=-1) / 6.0, np.concatenate(slopes, axis=-1) / 2.0
