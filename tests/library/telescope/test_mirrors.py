"""Telescopes of mirrors alone against third-order theory.

Formulas: Schroeder, Astronomical Optics (2nd edition), chapters 5 and 6, with the pupil at the
primary. F is the system's focal ratio, m the secondary's magnification, b the distance of the
focus behind the primary in primary focal lengths; angles on the sky in radians.
"""

from __future__ import annotations

import numpy as np
import pytest

from psfdae.base.settings import ConfigError
from psfdae.telescope.aberrations import Prescription
from psfdae.telescope.raytracing import ZernikeTracer, build_optic
from psfdae_paper.configuration.compose import load

OWN_TELESCOPE = "dataset=_telescope"
FIELD = np.deg2rad([0.0, 0.1, 0.2])
F, M, B = 8.0, 8.0 / 3.0, 0.25
FOCUS, ASTIGMATISM, COMA_Y, COMA_X = 0, 2, 3, 4
"""Places of Z4, Z6, Z7 and Z8."""


def telescope_of(name):
    return load([OWN_TELESCOPE, f"telescope=example_{name}"]).telescope


@pytest.fixture(scope="module")
def newtonian():
    return telescope_of("newtonian")


@pytest.fixture(scope="module")
def ritchey():
    return telescope_of("ritchey_chretien")


def zernikes(telescope, prescription=None, defocus=0.0):
    """OPD in metres RMS at `FIELD` along x, shape (3, 19), from Z4 on."""
    optic = build_optic(prescription or telescope.aberrations.prescription, telescope, defocus)
    fields = np.stack([FIELD, 0 * FIELD], axis=1)
    tracer = ZernikeTracer(optic, telescope.wavelength_m, fields, 22)
    return -tracer(np.zeros((1, 4)))[0] * telescope.wavelength_m


def tangential_coma(coefficient, radius):
    """Length of the comatic image: W = w ρ³ cos φ = w Z8/(3√8) + …, and 3w/radius."""
    return 3.0 * 3.0 * 8.0**0.5 * coefficient / radius


def astigmatism(coefficient, radius):
    """Length of the tangential image in the sagittal focus: W = w ρ² cos² φ, and 2w/radius."""
    return 2.0 * 2.0 * 6.0**0.5 * coefficient / radius


def classical(prescription):
    """The Cassegrain with the same radii and distances: paraboloid and hyperboloid."""
    tree = prescription.model_dump()
    tree["primary"]["conic"] = -1.0
    tree["secondary"]["conic"] = -(((M + 1.0) / (M - 1.0)) ** 2)
    return Prescription.model_validate(tree)


def test_third_order_aberrations_of_a_paraboloid(newtonian):
    """Coma 3θ/(16F²), with its tail away from the axis, and astigmatism θ²/(2F)."""
    radius, opd = 0.5 * newtonian.diameter_m, zernikes(newtonian)
    ratio = newtonian.aberrations.prescription.best_focus_m / newtonian.diameter_m
    assert ratio == pytest.approx(5)
    coma = tangential_coma(opd[:, COMA_X], radius)
    assert coma == pytest.approx(3 * FIELD / (16 * ratio**2), rel=3e-3, abs=1e-12)
    # Light focuses earlier in the tangential plane: the wavefront runs ahead at its rim.
    astigmatic = astigmatism(-opd[:, ASTIGMATISM], radius)
    assert astigmatic == pytest.approx(FIELD**2 / (2 * ratio), rel=5e-3, abs=1e-12)
    # Perfect on the axis, and symmetric about the plane of the field.
    assert np.abs(opd[0]).max() < 1e-6 * newtonian.wavelength_m
    assert np.abs(opd[:, COMA_Y]).max() < 1e-6 * newtonian.wavelength_m


@pytest.mark.parametrize("name", ["newtonian", "ritchey_chretien"])
def test_detector_beyond_focus_sees_the_wavefront_ahead(name):
    """W = −δ r²/(8F²…): a displacement δ is δ/(8F²) of defocus at the rim, Z4 a 2√3th of it."""
    telescope = telescope_of(name)
    ratio = {"newtonian": 5.0, "ritchey_chretien": F}[name]
    change = zernikes(telescope, defocus=2e-4)[0] - zernikes(telescope)[0]
    expected = -2e-4 / (8 * ratio**2) / (2 * 3**0.5)
    assert change[FOCUS] == pytest.approx(expected, rel=0.01)


def test_ritchey_chretien_has_no_third_order_coma(ritchey):
    """Its rest is that of fifth order; astigmatism is what theory leaves."""
    radius, opd = 0.5 * ritchey.diameter_m, zernikes(ritchey)
    assert np.abs(opd[0]).max() < 0.005 * ritchey.wavelength_m
    of_a_paraboloid = 3 * FIELD / (16 * F**2)
    coma = tangential_coma(opd[:, COMA_X], radius)
    assert (np.abs(coma) < 0.01 * of_a_paraboloid + 1e-12).all()
    factor = (M * (2 * M + 1) + B) / (2 * M * (1 + B))
    expected = factor * FIELD**2 / (2 * F)
    assert astigmatism(-opd[:, ASTIGMATISM], radius) == pytest.approx(expected, rel=0.01, abs=1e-11)


def test_classical_cassegrain_has_the_coma_of_a_paraboloid_of_its_focal_ratio(ritchey):
    opd = zernikes(ritchey, classical(ritchey.aberrations.prescription))
    radius = 0.5 * ritchey.diameter_m
    assert np.abs(opd[0]).max() < 1e-3 * ritchey.wavelength_m
    coma = tangential_coma(opd[:, COMA_X], radius)
    assert coma == pytest.approx(3 * FIELD / (16 * F**2), rel=5e-3, abs=1e-11)
    factor = (M**2 + B) / (M * (1 + B))
    assert astigmatism(-opd[:, ASTIGMATISM], radius) == pytest.approx(
        factor * FIELD**2 / (2 * F), rel=0.01, abs=1e-11
    )


PRESCRIPTION = "telescope.aberrations.prescription"
LENS = (
    "{front_radius_m: -1, back_radius_m: -1, front_vertex_m: 0.5, back_vertex_m: 0.4, "
    "clear_radius_m: 0.1}"
)


@pytest.mark.parametrize(
    ("name", "override", "message"),
    [
        ("newtonian", f"{PRESCRIPTION}.best_focus_m=-1", "from primary to best focus = -1 m"),
        ("newtonian", f"++{PRESCRIPTION}.lenses.l1={LENS}", r"lenses = \['l1'\]: must lie behind"),
        ("ritchey_chretien", f"++{PRESCRIPTION}.lenses.l1={LENS}", "glass: must be given for lens"),
    ],
)
def test_mirrors_that_cannot_be_are_named(name, override, message):
    with pytest.raises(ConfigError, match=rf"prescription: .*{message}"):
        load([OWN_TELESCOPE, f"telescope=example_{name}", override])
