"""A telescope of one's own: its aberrations against Seidel's theory and the ray trace."""

from __future__ import annotations

import numpy as np
import pytest

from command_line import psfdae, refused
from fits_inputs import open_observation
from psfdae.base.files import read_product
from psfdae.base.settings import ConfigError
from psfdae.optics.pupil import annular_pupil
from psfdae.optics.wavefronts import (
    field_coefficients,
    seidel_wavefronts,
    zernike_wavefronts,
)
from psfdae.telescope.field import static_zernikes
from psfdae_paper.alignment.stamps import AlignmentStamps, mean_slope
from psfdae_paper.alignment.telescope import StateTracer
from psfdae_paper.configuration.alignment import Alignment
from psfdae_paper.configuration.compose import load, load_stage
from psfdae_paper.configuration.consistency import SIMULATION, STATIC
from psfdae_paper.stages import stars
from psfdae_paper.stars.fields import relative_field, square_grid
from psfdae_paper.stars.framing import Propagation, normalise_flux
from psfdae_paper.stars.scenes import star_wavefronts, template_wavefronts

OWN_TELESCOPE = "dataset=_telescope"
Z4, Z5, Z8, Z11 = 2 * np.sqrt(3), np.sqrt(6), 3 * np.sqrt(8), 6 * np.sqrt(5)


def angles_of(grid):
    """Field angles (x, y) of a grid in degrees."""
    return square_grid(grid.points, grid.spacing_deg)[1]


def zernikes_of_scene_1(seidel):
    """Seidel's theory in Noll's terms by hand: ρ⁴, ρ³ cos, ρ² cos 2θ … expanded.

    Piston is left out. Per Noll index, coefficient by powers of the field (x, y).
    """
    w040, w131, w222, w220, w311 = seidel
    focus = (w220 + 0.5 * w222) / Z4
    tilt = w131 / 3
    return {
        2: {(1, 0): tilt, (3, 0): w311 / 2, (1, 2): w311 / 2},
        3: {(0, 1): tilt, (0, 3): w311 / 2, (2, 1): w311 / 2},
        4: {(0, 0): w040 / Z4, (2, 0): focus, (0, 2): focus},
        5: {(1, 1): w222 / Z5},
        6: {(2, 0): w222 / (2 * Z5), (0, 2): -w222 / (2 * Z5)},
        7: {(0, 1): w131 / Z8},
        8: {(1, 0): w131 / Z8},
        11: {(0, 0): w040 / Z11},
    }


@pytest.fixture(scope="module")
def sources(scene1):
    """Scene 1's templates as Seidel's monomials and as Zernikes over the field."""
    field = relative_field(scene1.grid)
    seidel = scene1.wavefront.coefficients
    terms = zernikes_of_scene_1(seidel)
    coefficients = field_coefficients(list(terms.values()), field)
    return (
        seidel_wavefronts(np.tile(seidel, (len(field), 1)), field),
        zernike_wavefronts(tuple(terms), coefficients),
    )


def test_seidel_s_wavefront_in_zernikes(sources):
    pupil = annular_pupil(64, 0.0)
    everyone = np.arange(121)
    lit = pupil.amplitude > 0.5
    opd, expected = (
        source.opd(everyone, pupil, np.dtype(np.float64))[:, lit] for source in sources[::-1]
    )
    assert np.ptp(expected) > 10
    difference = opd - expected
    assert np.ptp(difference, axis=1) == pytest.approx(0, abs=1e-9)


def test_slopes_are_those_of_the_same_polynomials(sources):
    seidel, zernikes = sources
    assert zernikes.slopes() == pytest.approx(seidel.slopes(), abs=1e-5)
    focus = zernike_wavefronts((4,), np.array([[1.0]]))
    assert focus.slopes()[0] == pytest.approx(
        np.full((2, 2), [-4 * np.sqrt(3), 4 * np.sqrt(3)]), abs=1e-6
    )


@pytest.fixture(scope="module")
def traced():
    """The ray-traced example on fields of which five are scene 3's."""
    edge = 0.5 / 2**0.5
    names = [OWN_TELESCOPE, "telescope=example_raytraced", "grid.points=3"]
    return load([*names, f"telescope.field_edge_deg={edge!r}"])


def test_ray_trace_is_that_of_scene_3(traced):
    alignment = load(Alignment.choice)
    tracer = StateTracer(alignment.telescope, alignment.prescription, alignment.alignment)
    noll, zernikes = static_zernikes(traced.telescope, angles_of(traced.grid))
    traced_zernikes = -tracer(np.zeros((1, 4)))[0]
    assert noll == tuple(range(4, 23))
    assert traced.telescope.aberrations.defocus_m == alignment.alignment.defocus_m
    # Scene 3's circle starts on the x axis; its odd points are the corners of the grid.
    assert zernikes[[4, 8, 6, 0, 2]] == pytest.approx(traced_zernikes[[0, 2, 4, 6, 8]], abs=1e-9)
    assert np.abs(traced_zernikes).max() > 0.3


def test_ray_traced_stamps_are_those_of_scene_3(traced):
    """Positions in pixels, to which the sign of every term and both axes count."""
    alignment = load(Alignment.choice)
    source = template_wavefronts(traced)
    leaning = source.coefficients[[0, 4, 8]]
    leaning[:, 3:5] += [0.2, -0.1]  # the aligned telescope has too little coma to tell its sign
    operator = AlignmentStamps(traced.telescope, alignment.optics, alignment.alignment)
    expected, _ = operator(-leaning)
    # Scene 3 centres a stamp on the centroid, 2 λ/D per wave of mean slope away.
    slopes = np.array([mean_slope(j, traced.telescope.obscuration) for j in range(4, 23)])
    centroid = 2.0 * (leaning @ slopes)[:, ::-1] / traced.telescope.pixel
    source = zernike_wavefronts(range(4, 23), leaning)
    propagation = Propagation(source, traced.telescope, traced.optics, traced.framing, 24)
    stamps, _ = normalise_flux(propagation.stamps(16, centroid))
    assert np.abs(stamps - expected).max() < 2e-3 * expected.max()
    for mirrored in (expected[:, ::-1], expected[:, :, ::-1], expected.swapaxes(1, 2)):
        assert np.abs(stamps - mirrored).max(axis=(1, 2)).min() > 0.1 * expected.max()


def test_seidel_telescope_is_scene_1_byte_by_byte(tmp_path):
    small = ["grid.points=3", "stars.count=24", "stars.name=seidel_10pct"]
    words = [OWN_TELESCOPE, "telescope=example_seidel", "grid.spacing_deg=1.1"]
    words += ["optics.pupil_samples=[158,222,254,318,398]", "framing.subpixel=false"]
    words += ["framing.search_px=24", "stars.search_px=24"]
    products = []
    for name, choice in (("paper", ["dataset=dataset3"]), ("telescope", words)):
        fields, out = tmp_path / f"{name}_t.h5", tmp_path / f"{name}.h5"
        stars.templates(load_stage(STATIC, [*choice, *small]), fields)
        stars.stars(load_stage(SIMULATION, [*choice, *small]), fields, out)
        products.append((read_product(fields, "templates"), read_product(out, "stars")))
    for paper, seidel in zip(*products, strict=True):
        assert set(paper.arrays) == set(seidel.arrays)
        for column, values in paper.arrays.items():
            assert values.tobytes() == seidel[column].tobytes(), column


def test_random_aberrations_have_both_spreads():
    config = load([OWN_TELESCOPE, "stars.aberration_fraction=0.2", "grid.points=3"])
    field = np.full(20000, 8)
    wavefronts = star_wavefronts(config, field)
    _, static = static_zernikes(config.telescope, angles_of(config.grid))
    assert wavefronts.coefficients.mean(axis=0) == pytest.approx(static[8], abs=0.005)
    jitter = config.telescope.aberrations.jitter_waves
    assert wavefronts.coefficients.std(axis=0) == pytest.approx(
        np.hypot(0.2 * static[8], jitter), rel=0.03
    )
    assert (wavefronts.star_columns["zernike"][0] == wavefronts.coefficients).all()
    repeated = star_wavefronts(config, field)
    assert (repeated.coefficients == wavefronts.coefficients).all()


TERMS = "telescope.aberrations.terms"


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["telescope=example_zernike"], "brings its own aberrations, but scene = seidel"),
        ([OWN_TELESCOPE, f"++{TERMS}.z1=1"], r"'z1': must be between z2 and z45"),
        (
            [OWN_TELESCOPE, "++telescope.aberrations.seing=1"],
            r"^telescope\.aberrations\.seing: unknown key",
        ),
        ([OWN_TELESCOPE, "stars.aberration_fraction=0"], "jitter_waves = 0.03"),
    ],
)
def test_every_mistake_is_named(overrides, message):
    with pytest.raises(ConfigError, match=message):
        load(overrides)


CHOICE = ["telescope=example_zernike", "grid.points=3"]


def simulate(folder, *arguments):
    return psfdae("simulate", "--out", folder, *arguments)


@pytest.fixture(scope="module")
def simulated(tmp_path_factory):
    """Two simulations with the same words."""
    folders = [tmp_path_factory.mktemp("simulated") for _ in range(2)]
    for folder in folders:
        result = simulate(folder, "--fits", "--image-snr", "40", *CHOICE)
        assert result.exit_code == 0, result.output
    return folders


def test_simulate_writes_what_the_stage_writes(simulated, tmp_path):
    first, second = simulated
    names = {"templates.h5", "psfs.png", "fields.csv", "psfs.fits", "image.fits", "stars.csv"}
    assert {path.name for path in first.iterdir()} == names
    for name in names:
        assert (first / name).read_bytes() == (second / name).read_bytes(), name
    stars.templates(load_stage(STATIC, [OWN_TELESCOPE, *CHOICE]), tmp_path / "t.h5")
    assert (first / "templates.h5").read_bytes() == (tmp_path / "t.h5").read_bytes()
    table = np.genfromtxt(first / "fields.csv", delimiter=",", names=True)
    assert sorted(set(table["x_deg"])) == [-1, 0, 1]
    product = read_product(tmp_path / "t.h5", "templates")
    assert table["energy"] == pytest.approx(product["energy"], rel=1e-5)
    assert (table["fwhm_arcsec"] > 0.8).all()


def test_simulated_observations_can_be_read(simulated):
    folder, _ = simulated
    cube = open_observation(folder / "psfs.fits", stamp_px=16)
    assert (cube.count, cube.pixel_scale_arcsec) == (9, 0.8)
    psf = next(cube.chunks(9)).data
    image = open_observation(folder / "image.fits", catalogue=folder / "stars.csv", stamp_px=16)
    assert image.pixel_scale_arcsec == pytest.approx(0.8, rel=1e-6)
    data = next(image.chunks(9)).data - 1000.0
    mean = (psf / psf.sum(axis=(1, 2), keepdims=True)).mean(axis=0)
    flux = (data * mean).sum(axis=(1, 2)) / (mean**2).sum()
    assert np.mean(flux) / np.sqrt(1000.0 / (mean**2).sum()) == pytest.approx(40, rel=0.1)


@pytest.mark.parametrize(
    ("words", "key"),
    [
        (["--least-energy=0.9", f"{TERMS}.z4.constant=1.2"], "framing.stamp_px"),
        ([f"{TERMS}.z4.constant=40"], "optics.pupil_samples"),
    ],
)
def test_psf_beyond_stamp_or_grid_is_refused(tmp_path, words, key):
    assert key in refused("simulate", "--out", tmp_path, *CHOICE, *words)
    assert not list(tmp_path.iterdir())
