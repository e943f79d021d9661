"""The PSF as splines whose coefficients are polynomials in the position in the field.

The light of a star on a pixel at the distance u from its centre is f(u; q), the effective PSF,
which includes the pixel (Anderson & King 2000, PASP 112, 1360),

    f(u; q) = Σ_k p_k(q) Σ_ij c_kij B(u_row/h − i) B(u_col/h − j),

a sum of cubic B-splines B with the distance h of their knots. The terms p_k are monomials of the
position q in the field, and of magnitude and colour of the star. This module has the model
(`FieldModel`), the least squares for its coefficients c and for flux and centre of stars, which
`psfdae.methods.field.fit` combines, and the deformations by which exposures differ. Equations are
numbered as on the page docs/field_model.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import isqrt

import numpy as np

from psfdae.stars.moments import cubic_splines

STAR_TERMS = 2
"""Number of powers, beginning with the first, of the magnitude and of the colour."""


@dataclass(frozen=True)
class FieldModel:
    """PSF at every position in a field (eq. 1).

    Attributes
    ----------
    coefficients : ndarray, shape (K, N, N)
        Coefficients c of the N × N splines, for each of the K terms of the polynomial.
    low, high : ndarray, shape (2,) to (4,)
        Range of x and y, and then of magnitude and colour. The PSF does not change with a
        coordinate of zero range, or without a range. Outside of a range, the PSF of its end is
        used.
    spacing : float
        Distance h of the knots, in pixels.
    """

    coefficients: np.ndarray
    low: np.ndarray
    high: np.ndarray
    spacing: float

    @property
    def order(self) -> int:
        """Order of the polynomial in the position, with (order + 1)(order + 2)/2 terms."""
        # K = (o + 1)(o + 2)/2, solved for the order o.
        place_terms = len(self.coefficients) - STAR_TERMS * len(self.star_coordinates)
        return (isqrt(8 * place_terms + 1) - 3) // 2

    @property
    def star_coordinates(self) -> np.ndarray:
        """Coordinates after x and y with which the PSF changes: 2 magnitude, 3 colour."""
        return np.asarray(2 + np.flatnonzero(self.high[2:] > self.low[2:]))

    def terms(self, position: np.ndarray) -> np.ndarray:
        """Return the terms p_k of the polynomial at positions, shape (n, K).

        Positions (n, 4) are x, y, magnitude and colour; the last ones may be left out for a model
        that does not change with them.
        """
        return field_terms(position, self.low, self.high, self.order)

    def images(
        self, terms: np.ndarray, centre: np.ndarray, side: int, oversampling: int = 1
    ) -> np.ndarray:
        """Return images (n, m, m) of stars at `centre` (n, 2) (row, column) px from the middle.

        The distance of pixels is 1/oversampling; index m//2 = oversampling · (side//2) is the
        middle. m = side without oversampling, else oversampling · side + 1, which includes both
        edges. Values are the light of whole pixels. Stars have the same light at every phase of the
        pixel grid.
        """
        # Coordinates of the pixels, and coefficients Σ_k p_k c_k at each position (eq. 1).
        count = side if oversampling == 1 else oversampling * side + 1
        axis = (np.arange(count) - oversampling * (side // 2)) / oversampling
        splines = np.tensordot(terms, self.coefficients, 1)
        # Pixels at integer distances have the same phase, and the same factor (eq. 1a).
        light = compute_relative_light(splines, axis[:oversampling], centre, self.spacing)
        phase = np.arange(count) % oversampling
        images = draw_splines(splines, axis, centre, self.spacing)
        return np.asarray(images / light[:, phase[:, None], phase])

    def psfs(
        self,
        terms: np.ndarray,
        position: np.ndarray,
        list_offset: np.ndarray,
        side: int,
        oversampling: int = 1,
    ) -> np.ndarray:
        """Return PSFs (n, m, m) at the phase of their position in its pixel; m as in `images`.

        The flux is the same at every phase (eq. 1a), and such that a star in the middle of its
        pixel has the sum 1 in its stamp.

        Parameters
        ----------
        terms : ndarray, shape (n, K)
            Terms of the polynomial at the positions.
        position : ndarray, shape (n, 2) or more columns
            x and y in pixels of the image, as in the star list.
        list_offset : ndarray, shape (2,)
            Offset (row, column) of the field's centres from the list.
        side, oversampling : int
            Side of a stamp in pixels, and values per pixel along each axis.
        """
        # The phase of (row, column) in a pixel, in the coordinates of the field's centres.
        phase = (position - np.floor(position + 0.5))[:, 1::-1]
        images = self.images(terms, phase + list_offset, side, oversampling)
        centre = np.broadcast_to(list_offset, phase.shape)
        total = self.images(terms, centre, side).sum(axis=(1, 2), keepdims=True)
        return np.asarray(images / total)

    def draw_lattice(
        self, terms: np.ndarray, rows: np.ndarray, columns: np.ndarray, side: int
    ) -> np.ndarray:
        """Return images (n, r c, m, m) of stars at all pairs of rows (r,) and columns (c,)."""
        # Products of B-splines of all rows and of all columns are the images on the lattice.
        splines = np.tensordot(terms, self.coefficients, 1)
        axis = np.arange(side) - side // 2
        down, across = (
            cubic_splines(axis - at[:, None], splines.shape[-1], self.spacing)
            for at in (rows, columns)
        )
        half = np.tensordot(splines, across, ((2,), (2,)))  # (n, knots, c, m)
        images = np.tensordot(down, half, ((2,), (1,)))  # (r, m, n, c, m)
        images = images.transpose(2, 0, 3, 1, 4)
        return np.asarray(images.reshape(len(terms), -1, side, side))

    def is_outside_range(self, position: np.ndarray) -> np.ndarray:
        """Return True for stars (n,) brighter, fainter, bluer or redder than all training stars.

        `position` has x, y, magnitude and colour (n, 4). Only coordinates with which the PSF
        changes are compared, with a tolerance of 2 % of the range for errors of measurement.
        """
        # Outside of the range by more than the tolerance, in any of these coordinates.
        columns = self.star_coordinates
        value, low, high = (a[..., columns] for a in (position, self.low, self.high))
        slack = 0.02 * (high - low)
        return np.asarray(((value < low - slack) | (value > high + slack)).any(axis=1))

    def facts(self) -> dict[str, str]:
        """Return titles and sentences about the field: how the PSF changes, and with what."""
        order = self.order
        changes = f"changes over the image by a polynomial of order {order}"
        constant = "is the same everywhere (order 0: more is not supported by stars left out)"
        facts = {"Field": f"the PSF {changes if order else constant}"}
        names = {
            2: ("Brightness", "magnitude −2.5 log₁₀ (flux / counts)"),
            3: ("Colour", "colour of the star list"),
        }
        # A sentence for each property of a star with which the PSF changes, with its range.
        for coordinate in self.star_coordinates.tolist():
            name, quantity = names[coordinate]
            low, high = self.low[coordinate], self.high[coordinate]
            facts[name] = (
                f"the PSF changes with the {quantity}, {low:.2f} to {high:.2f}; stars beyond this "
                "range have the PSF of its end"
            )
        return facts


def count_knots(frame_px: int, spacing: float) -> int:
    """Return the number of knots along a side of a frame, the outermost ½ pixel outside."""
    # At least four knots, on which a cubic spline depends.
    return max(round((frame_px + 1) / spacing), 3) + 1


def compute_spacing(frame_px: int, knots: int) -> float:
    """Return the distance in pixels of this number of knots along a side of a frame."""
    # The knots span the frame and ½ pixel on each side.
    return (frame_px + 1) / (knots - 1)


def field_terms(position: np.ndarray, low: np.ndarray, high: np.ndarray, order: int) -> np.ndarray:
    """Return monomials x^a y^b, a + b ≤ order, of positions scaled to ±1, shape (n, K).

    Powers of the other coordinates with a range above 0 are the last terms. An unknown coordinate
    is set to the middle of its range.
    """
    # Coordinates −1 … 1 over the range, clipped outside; the middle is 0.
    width = np.where(high > low, high - low, 1.0)
    unit_position = np.clip(2.0 * (position[:, : len(low)] - low) / width - 1.0, -1.0, 1.0)
    unit_position = np.nan_to_num(unit_position)
    # Monomials by their total power, then the powers of magnitude and of colour.
    x, y, *star_columns = unit_position.T
    powers = [(a, total - a) for total in range(order + 1) for a in range(total, -1, -1)]
    terms = [x**a * y**b for a, b in powers]
    varying = (column for column, ends in zip(star_columns, (high > low)[2:], strict=True) if ends)
    terms += [column**power for column in varying for power in range(1, STAR_TERMS + 1)]
    return np.stack(terms, axis=1)


def draw_splines(
    splines: np.ndarray, axis: np.ndarray, centre: np.ndarray, spacing: float
) -> np.ndarray:
    """Return images (n, m, m) of splines (n, N, N) with centres (n, 2) on an axis (m,)."""
    # The image is R c Cᵀ, with the B-splines R of its rows and C of its columns (eq. 1).
    rows, columns = (
        cubic_splines(axis[None] - centre[:, i, None], splines.shape[-1], spacing) for i in (0, 1)
    )
    return np.asarray(rows @ splines @ columns.transpose(0, 2, 1))


def compute_relative_light(
    splines: np.ndarray, axis: np.ndarray, centre: np.ndarray, spacing: float
) -> np.ndarray:
    """Return the light of a star on pixels at some phases, over its light in the middle phase.

    Splines whose knots do not divide a pixel follow undersampled stars, but their total light
    changes with the phase by some per cent. The PSF divided by this factor has the same light at
    every phase (eq. 1a).

    Parameters
    ----------
    splines : ndarray, shape (n, N, N)
        Coefficients of the field at the positions of the stars.
    axis : ndarray, shape (a,)
        Coordinates of pixels along either side, in pixels.
    centre : ndarray, shape (n, 2) or (1, 2)
        Centres of the stars (row, column), in the same coordinates.
    spacing : float
        Distance of the knots in pixels.

    Returns
    -------
    ndarray, shape (n, a, a)
        Factor of each phase; 1 for a star in the middle of its pixel.
    """
    # Sum over all pixels of the frame at integer distances, under a window w that moves with the
    # star, so that no light crosses an edge: w is 1, and falls to 0 as cos² in the outer 3 px,
    # where the light changes little within a pixel.
    knots = splines.shape[-1]
    reach = spacing * (knots - 1) / 2 - 1.0
    pixels = np.arange(-np.ceil(reach), np.ceil(reach) + 1)

    def light(place: np.ndarray) -> np.ndarray:
        # Σ w f(u) with f = R c Cᵀ: sums of the windowed rows of R, and of C (eq. 1).
        place = (place - np.floor(place + 0.5))[..., None] + pixels
        window = np.cos(np.pi / 2 * np.clip((np.abs(place) - reach) / 3.0 + 1.0, 0.0, 1.0)) ** 2
        sums = (window[..., None, :] @ cubic_splines(place, knots, spacing))[..., 0, :]
        rows, columns = sums.swapaxes(0, 1)
        return np.asarray(rows @ splines @ columns.transpose(0, 2, 1))

    return np.asarray(light(axis - centre[..., None]) / light(np.zeros((1, 2, 1))))


def adjust_stars(
    splines: np.ndarray,
    data: np.ndarray,
    weight: np.ndarray,
    centre: np.ndarray,
    axis: np.ndarray,
    spacing: float,
    steps: int,
    sky: bool = False,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fit flux, centre (n, 2) and optionally sky of stars by Gauss–Newton steps (eq. 4).

    Parameters
    ----------
    splines : ndarray, shape (n, N, N)
        Coefficients of the field at the positions of the stars.
    data, weight : ndarray, shape (n, s, s)
        Images and 1/variance of their pixels.
    centre : ndarray, shape (n, 2)
        First centres (row, column).
    axis : ndarray, shape (s,)
        Coordinates of the pixels along a side, in pixels.
    spacing : float
        Distance of the knots in pixels.
    steps : int
        Number of steps.
    sky : bool
        Fit a constant as well.

    Returns
    -------
    flux : ndarray, shape (n,)
        Flux in the unit of the images.
    centre : ndarray, shape (n, 2)
        Centres (row, column) in pixels.
    level : ndarray, shape (n,)
        Sky in the unit of the images; 0 unless it is fitted.
    """
    count, flat = len(data), data.reshape(len(data), -1, 1)
    for _ in range(steps):
        # Weighted least squares (A w Aᵀ) θ = A w d for θ = (F, F δ_row, F δ_col, sky), with the
        # rows A of the design; the centre moves by δ, at most by 0.3 px in a step, where an image
        # is nearly linear, and by at most 1.5 px from the brightest pixel.
        design = image_design(splines, centre, axis, spacing, sky)
        adjoint = design * weight.reshape(count, 1, -1)
        parameters = np.linalg.solve(adjoint @ design.transpose(0, 2, 1), adjoint @ flat)[..., 0]
        flux = parameters[:, 0]
        move = np.clip(parameters[:, 1:3] / flux[:, None], -0.3, 0.3)
        centre = np.clip(centre + move, -1.5, 1.5)
    return flux, centre, parameters[:, 3] if sky else np.zeros(count)


def image_design(
    splines: np.ndarray, centre: np.ndarray, axis: np.ndarray, spacing: float, sky: bool
) -> np.ndarray:
    """Return derivatives A of images, (n, 3 or 4, P), by flux, row, column and optionally sky."""
    # An image is R c Cᵀ, with the B-splines R of its rows and C of its columns; their slopes R' and
    # C' give its derivatives −R' c Cᵀ and −R c C'ᵀ with respect to the centre (eq. 4).
    place, knots = axis - centre[..., None], splines.shape[-1]
    rows, columns = cubic_splines(place, knots, spacing).swapaxes(0, 1)
    down, across = cubic_splines(place, knots, spacing, slope=True).swapaxes(0, 1)
    along = splines @ columns.transpose(0, 2, 1)
    image_across = rows @ splines @ across.transpose(0, 2, 1)
    parts = [rows @ along, -down @ along, -image_across]
    parts += [np.ones_like(image_across)] * sky
    return np.stack(parts, axis=1).reshape(len(centre), len(parts), -1)


def solve_splines(
    terms: np.ndarray,
    data: np.ndarray,
    weight: np.ndarray,
    splines: tuple[np.ndarray, np.ndarray],
    penalty: np.ndarray,
    ridge: np.ndarray,
    start: np.ndarray | None,
    tolerance: float,
    preconditioners: list[np.ndarray] | None = None,
) -> np.ndarray:
    """Return coefficients (K, N, N) of weighted least squares with penalties (eq. 2).

    They minimise Σ w (d − f)² + Σ_k η_k |D c_k|² + Σ ρ c², with the second differences D along
    rows and columns.

    Parameters
    ----------
    terms : ndarray, shape (n, K)
        Terms of the field at the positions of the stars.
    data, weight : ndarray, shape (n, s, s)
        Images d of flux 1, and 1/variance w of their pixels.
    splines : (ndarray, ndarray), shape (n, s, N)
        B-splines of the rows and of the columns of each image.
    penalty : ndarray, shape (K, 1, 1)
        Weight η of the squared second differences.
    ridge : ndarray, shape (K, N, N)
        Weight ρ of the squared coefficients.
    start : ndarray, shape (K, N, N), or None
        Coefficients at which the iterations begin; None for 0.
    tolerance : float
        Residual, relative to the right-hand side, at which the conjugate gradients stop.
    preconditioners : list of ndarray, optional
        Receives the preconditioner (K, K, N²); one of nearly the same stars may be in it already.
    """
    from scipy.sparse.linalg import LinearOperator, cg

    # |D c|² = tr(cᵀ B c) + tr(c B cᵀ) with B = DᵀD; its gradient is 2 (B c + c B).
    shape, knots = ridge.shape, ridge.shape[-1]
    difference = np.diff(np.eye(knots), 2, axis=0)
    bend = difference.T @ difference
    # Normal equations (Σ Tᵀ w T + penalty) c = Σ Tᵀ w d, solved by conjugate gradients, with the
    # linear map T from coefficients to images: T c = R (Σ_k p_k c_k) Cᵀ. The tolerance is 3e-4 or
    # more: single precision is enough for the products.
    single = (terms, data, weight, *splines)
    terms, data, weight, rows, columns = (a.astype(np.float32) for a in single)
    rows_t, columns_t = (np.ascontiguousarray(a.transpose(0, 2, 1)) for a in (rows, columns))

    def multiply_normal(flat: np.ndarray) -> np.ndarray:
        # T c, then Tᵀ w T c, then half of the gradient of the penalties.
        c = flat.reshape(shape)
        fields = (terms @ c.reshape(shape[0], -1).astype(np.float32)).reshape(-1, *shape[1:])
        image = rows @ fields @ columns_t
        back = (rows_t @ (weight * image) @ columns).reshape(len(terms), -1)
        smooth = penalty * (bend @ c + c @ bend) + ridge * c
        return np.asarray(((terms.T @ back).reshape(shape) + smooth).ravel())

    projection = (rows_t @ (weight * data) @ columns).reshape(len(terms), -1)
    preconditioners = [] if preconditioners is None else preconditioners
    if not preconditioners:
        # The terms of a knot are solved together, as they are far from orthogonal. Knots are
        # treated as independent: the diagonal of RᵀwC, and half of the diagonal of c ↦ B c + c B,
        # which is 12 inside: with 12 itself, fits of a field took 3.6 % more iterations.
        curvature = (rows_t**2 @ weight @ columns**2).reshape(len(terms), -1)
        pairs = (terms[:, :, None] * terms[:, None]).reshape(len(terms), -1)
        blocks = (curvature.T @ pairs).reshape(-1, shape[0], shape[0])
        diagonal = 6 * penalty.ravel() + ridge.reshape(shape[0], -1).T
        blocks += np.eye(shape[0]) * diagonal[:, None, :]
        # Knots last, over which products are then sums of rows.
        inverse = np.linalg.inv(blocks).transpose(1, 2, 0)
        preconditioners.append(np.ascontiguousarray(inverse, np.float32))
    size = (int(np.prod(shape)),) * 2

    def precondition(flat: np.ndarray) -> np.ndarray:
        # The terms of each knot by the inverse of its block.
        residual = flat.reshape(shape[0], -1).astype(np.float32)
        product = np.einsum("ijn,jn->in", preconditioners[0], residual)
        return np.asarray(product.ravel(), float)

    coefficients, _ = cg(
        LinearOperator(size, matvec=multiply_normal, dtype=float),
        (terms.T @ projection).ravel(),
        None if start is None else start.ravel(),
        rtol=tolerance,
        maxiter=150,
        M=LinearOperator(size, matvec=precondition, dtype=float),
    )
    return np.asarray(coefficients).reshape(shape)


def deform_splines(
    prior: FieldModel,
    terms: np.ndarray,
    data: np.ndarray,
    weight: np.ndarray,
    splines: tuple[np.ndarray, np.ndarray],
    deformation_sigma: float = 0.3,
) -> np.ndarray:
    """Return splines of another exposure, with a stretch and a blur fitted to its stars (eq. 5).

    Fluxes may be wrong: differences proportional to a star are ignored, as they are not its shape.

    Parameters
    ----------
    prior : FieldModel
        Field of the first exposure.
    terms, data, weight, splines
        Stars of the other exposure, see `solve_splines`.
    deformation_sigma : float
        Standard deviation of the stretch of a PSF between exposures, and of its blur in px².

    Returns
    -------
    ndarray, shape (K, N, N)
        Coefficients of the deformed field.
    """
    rows, columns_t = splines[0], splines[1].transpose(0, 2, 1)

    def scale_by_noise(coefficients: np.ndarray) -> np.ndarray:
        # Pixels √w T c of all stars, in standard deviations.
        image = rows @ np.tensordot(terms, coefficients, 1) @ columns_t
        return np.asarray((image * np.sqrt(weight)).reshape(len(terms), -1))

    scaled_data = (np.sqrt(weight) * data).reshape(len(terms), -1)
    coefficients = prior.coefficients
    # Three Gauss-Newton steps c ← c + Σ_l α_l Δ_l c.
    for _ in range(3):
        # Images of the deformations and the data, all without their component along the star.
        changes, star = deformations(coefficients, prior.spacing), scale_by_noise(coefficients)
        star /= np.linalg.norm(star, axis=1, keepdims=True)
        shapes = np.stack([*map(scale_by_noise, changes), scaled_data])
        shapes -= (shapes * star).sum(axis=2, keepdims=True) * star
        shapes = shapes.reshape(len(shapes), -1)
        # Normal equations for α with the prior N(0, σ²); the last column is the data.
        products = shapes @ shapes.T
        normal = products[:-1, :-1] + np.eye(len(changes)) / deformation_sigma**2
        coefficients = coefficients + np.tensordot(
            np.linalg.solve(normal, products[:-1, -1]), changes, 1
        )
    return np.asarray(coefficients)


def deformations(coefficients: np.ndarray, spacing: float) -> np.ndarray:
    """Return changes (6, K, N, N) of splines (K, N, N) by stretches and blurs (eq. 5).

    They are x ∂/∂x, y ∂/∂y and x ∂/∂y + y ∂/∂x, which stretch an image, and ∂²/∂x², ∂²/∂y² and
    ∂²/∂x∂y, which blur it.
    """
    # Coordinates of the knots in pixels: the middle of the frame is 0.
    place = (np.arange(coefficients.shape[-1]) - (coefficients.shape[-1] - 1) / 2) * spacing

    def slope(values: np.ndarray, axis: int) -> np.ndarray:
        """Return the slope of the polynomial through five knots."""
        one_apart, two_apart = (
            np.roll(values, -k, axis) - np.roll(values, k, axis) for k in (1, 2)
        )
        return np.asarray((8.0 * one_apart - two_apart) / (12.0 * spacing))

    along_y, along_x = (slope(coefficients, axis) for axis in (1, 2))
    yy, xy, xx = slope(along_y, 1), slope(along_y, 2), slope(along_x, 2)
    x, y = place, place[:, None]
    stretches = (x * along_x, y * along_y, x * along_y + y * along_x)
    return np.stack([*stretches, xx, yy, xy])
