"""Pupil, Seidel wavefronts, Zernike polynomials and the sampling guard."""

from __future__ import annotations

import numpy as np
import pytest

from psfdae.optics.pupil import (
    SamplingError,
    annular_pupil,
    choose_samples,
    count_samples,
    disc_coverage,
    pupil_axis,
)
from psfdae.optics.wavefronts import (
    monomial_coefficients,
    monomial_images,
    noll_to_nm,
    seidel_wavefronts,
    zernike,
    zernike_images,
)

STATIC = np.array([0.5, 4.0, 4.196, 1.813, -0.113])


@pytest.mark.parametrize("sharpen", [False, True])
def test_annulus_has_its_area(sharpen):
    pupil = annular_pupil(96, 0.3, sharpen)
    area = pupil.amplitude.sum() * pupil.spacing**2
    assert area == pytest.approx(np.pi * (1 - 0.09), rel=3e-5)


def test_sharpening_takes_the_cell_s_second_moment_out():
    """∫ x² over the unit disc is π/4; a plain grey edge adds area/12 cell²."""
    plain, sharp = (
        (p.amplitude * p.axis[None, :] ** 2).sum() * p.spacing**2 - np.pi / 4
        for p in (annular_pupil(48, 0.0, sharpen=False), annular_pupil(48, 0.0, sharpen=True))
    )
    added = np.pi / 12 / 24**2
    assert plain == pytest.approx(added, rel=0.15)
    assert sharp == pytest.approx(0, abs=0.15 * added)


def test_seidel_wavefront_equals_its_formula():
    rng = np.random.default_rng(0)
    hx, hy = 0.5, -0.7
    rho, angle = rng.uniform(0, 1, 50), rng.uniform(0, 2 * np.pi, 50)
    field = np.hypot(hx, hy)
    phi = angle - np.arctan2(hy, hx)
    w040, w131, w222, w220, w311 = STATIC
    expected = (
        w040 * rho**4
        + w131 * field * rho**3 * np.cos(phi)
        + w222 * field**2 * rho**2 * np.cos(phi) ** 2
        + w220 * field**2 * rho**2
        + w311 * field**3 * rho * np.cos(phi)
    )
    images = monomial_images(rho * np.cos(angle), rho * np.sin(angle))
    wavefront = monomial_coefficients(STATIC, np.array([hx, hy])) @ images
    assert wavefront == pytest.approx(expected, abs=1e-12)


def test_slopes_are_the_extremes_over_the_disc():
    """ρ³ cosφ has slopes 3 at the rim along x and ±1 along y; a tilt has one slope."""
    coma, tilt = seidel_wavefronts(
        np.array([[0, 1, 0, 0, 0], [0, 0, 0, 0, 2]], float), np.array([[1.0, 0.0], [1.0, 0.0]])
    ).slopes()
    assert coma == pytest.approx(np.array([[0, 3], [-1, 1]]), abs=1e-4)
    assert tilt == pytest.approx(np.array([[2, 2], [0, 0]]), abs=1e-8)


def test_templates_need_131_samples():
    """The steepest template of scene 1, in the corner of the field."""
    corner = seidel_wavefronts(STATIC[None], np.array([[1.0, 1.0]]))
    small = np.array([[-1.0, 1.0], [-1.0, 1.0]])
    assert count_samples(corner.slopes(), small)[0] == pytest.approx(131, abs=1)
    # Replicas must stay off a distant stamp.
    distant_stamp = np.array([[100.0, 116.0], [-8.0, 8.0]])
    assert count_samples(np.zeros((1, 2, 2)), distant_stamp)[0] == 116


def test_ladder_takes_the_first_rung_that_suffices():
    assert choose_samples(np.array([100, 130, 131]), (100, 130, 200)).tolist() == [100, 130, 200]
    with pytest.raises(SamplingError, match="needs N ≥ 217"):
        choose_samples(np.array([100, 217]), (96, 128))


def test_zernikes_against_poppy():
    import poppy.zernike

    rng = np.random.default_rng(2)
    r, theta = np.sqrt(rng.uniform(0, 1, 200)), rng.uniform(0, 2 * np.pi, 200)
    x, y = r * np.cos(theta), r * np.sin(theta)
    for j in range(1, 37):
        expected = np.asarray(poppy.zernike.zernike1(j, rho=r, theta=theta), float)
        assert zernike(j, x, y) == pytest.approx(expected, abs=1e-10)


def test_zernikes_are_orthonormal():
    axis = pupil_axis(400)
    weight = disc_coverage(400, 1.0)
    basis = zernike_images(range(1, 16), axis[None, :], axis[:, None])
    gram = np.einsum("iyx,jyx,yx->ij", basis, basis, weight) / weight.sum()
    assert gram == pytest.approx(np.eye(15), abs=2e-3)


def test_numbers_outside_their_range_are_refused():
    with pytest.raises(ValueError, match="Noll index 0"):
        noll_to_nm(0)
    with pytest.raises(ValueError, match="obscuration"):
        annular_pupil(32, 1.0)
