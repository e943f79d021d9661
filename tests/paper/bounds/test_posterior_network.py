"""The posterior network: its linear start, its symmetry, and a training on simulated stars."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from scipy.stats import multivariate_normal

from costs import load_points
from psfdae.base.files import read_product
from psfdae.base.settings import ConfigError, parse_settings
from psfdae.denoise.bundle import read_bundle, write_bundle
from psfdae.denoise.star_model import StarModel
from psfdae.methods import method
from psfdae.methods.fit_files import delete_checkpoints
from psfdae.methods.interface import FitError
from psfdae.methods.networks.training import Training
from psfdae.optics.derivatives import PointSampling, SampledStamps
from psfdae.optics.wavefronts import monomial_images
from psfdae.stars.noise import CorrelatedNoise, GaussianNoise, NoiseModel
from psfdae.training.packing import build_uncalibrated
from psfdae.training.star_sets import training_set
from psfdae_paper.bounds.posterior_network import (
    DrawnStars,
    FreshStars,
    PosteriorNetwork,
    Proposals,
    WavefrontCoordinates,
    WavefrontNetwork,
    list_representations,
    measure_statistics,
)
from psfdae_paper.bounds.refinement import Combination
from psfdae_paper.configuration.compose import load, load_stage
from psfdae_paper.configuration.consistency import SIMULATION, STATIC
from psfdae_paper.configuration.posterior_network import PosteriorNetworkSettings
from psfdae_paper.stages import stars
from psfdae_paper.stars.symmetry import SYMMETRIES

NOISE, LEVELS = NoiseModel(kappa=4.98, background=1e4), np.array([1e-3, 5e-3])
SIZES = {"width": 32, "hidden": 64, "blocks": 2}
WORDS = (
    "dataset=dataset3",
    "preset=smoke",
    "grid.points=3",
    "stars.count=90",
    "grid.spacing_deg=5",
)
WORDS += ("parts.train_stars=60", "parts.test_stars=30")


def build(stamps, uses_position=False):
    count = len(stamps)
    stars = DrawnStars(stamps.reshape(count, -1), np.zeros((count, 2)), np.empty((count, 0)))
    statistics = measure_statistics(stars, LEVELS, points=11)
    settings = parse_settings(PosteriorNetworkSettings, SIZES)
    rng = np.random.default_rng(0)
    return PosteriorNetwork.build(statistics, settings, NOISE, uses_position, rng)


def randomise(network):
    """Give all weights random values, so that no layer is zero."""
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for weight in network.parameters():
            weight.copy_(0.3 * torch.randn(weight.shape, generator=generator))
    return network


def mirror(images, symmetry):
    """Mirror images about the pixel d // 2; their first row and column are zero."""
    mirrored = np.zeros_like(images)
    mirrored[..., 1:, 1:] = symmetry.image(images[..., 1:, 1:])
    return mirrored


def test_new_network_is_the_posterior_mean_of_one_gaussian_mode():
    """p = m + a u with a ~ N(0, τ²): the mean of a is τ²/(τ² + s²) times its projection."""
    rng, side, tau = np.random.default_rng(3), 8, 0.02
    mode = rng.standard_normal((side, side))
    mode = (mode - mode.mean()) / np.linalg.norm(mode - mode.mean())
    amplitudes = rng.standard_normal(400)
    amplitudes = tau * (amplitudes - amplitudes.mean()) / amplitudes.std()
    stamps = 1 / side**2 + amplitudes[:, None, None] * mode
    noisy = NOISE.draw(stamps, 1e-3, rng)
    psf = build(stamps).estimate(noisy, np.full(400, 1e-3), None).psf
    variance = NOISE.variance(np.array(1 / side**2), 1e-3)
    projection = ((noisy - 1 / side**2) * mode).sum(axis=(1, 2), keepdims=True)
    expected = 1 / side**2 + tau**2 / (tau**2 + variance) * projection * mode
    assert psf == pytest.approx(expected, abs=2e-7)
    # The mean errors are those of the posterior.
    error = np.square(psf - stamps).sum(axis=(1, 2)).mean()
    assert error == pytest.approx(tau**2 * variance / (tau**2 + variance), rel=0.2)


def test_coordinates_that_do_not_vary_are_standardised_to_0():
    """Without random aberrations, all stars have the same spherical aberration."""
    rng = np.random.default_rng(2)
    stamps, wavefront = rng.random((50, 8, 8)), rng.standard_normal((50, 8))
    wavefront[:, 0] = 0.3
    proposer = WavefrontNetwork.begin(build(stamps), wavefront, rng)
    scaled = (wavefront - proposer.coordinate_mean.numpy()) / proposer.coordinate_sd.numpy()
    assert scaled[:, 0] == pytest.approx(0.0, abs=1e-4)
    assert scaled[:, 3].std() == pytest.approx(1.0)


def test_estimates_have_the_sum_1():
    rng = np.random.default_rng(4)
    stamps = rng.random((300, 8, 8))
    stamps /= stamps.sum(axis=(1, 2), keepdims=True)
    network = randomise(build(stamps))
    noisy = NOISE.draw(stamps, 5e-3, rng)
    estimate = network.estimate(noisy, np.full(300, 5e-3), None)
    assert estimate.psf.std(axis=0).min() > 1e-4
    assert estimate.psf.sum(axis=(1, 2)) == pytest.approx(1.0, abs=1e-5)
    assert (estimate.sigma > 0).all()
    # Without stars, none.
    assert network.estimate(noisy[:0], np.empty(0), None).psf.shape == (0, 8, 8)


def test_network_commutes_with_mirror_images(monkeypatch):
    monkeypatch.setattr(torch.cpu, "get_capabilities", dict, raising=False)
    rng, level = np.random.default_rng(5), np.full(6, 2e-3)
    stamps = np.zeros((200, 8, 8))
    stamps[:, 1:, 1:] = rng.random((200, 7, 7))
    stamps /= stamps.sum(axis=(1, 2), keepdims=True)
    every = np.concatenate([mirror(stamps, symmetry) for symmetry in SYMMETRIES])
    network = randomise(build(every, uses_position=True))
    position = rng.integers(0, 11, (6, 2))
    estimate = network.estimate(stamps[:6], level, position)
    assert np.abs(estimate.psf - estimate.psf[0]).max() > 1e-3
    for symmetry in SYMMETRIES:
        fields = symmetry.field(position @ [1, 11], 11)
        place = np.stack(np.divmod(fields, 11)[::-1], axis=1)
        moved = network.estimate(mirror(stamps[:6], symmetry), level, place)
        assert moved.psf == pytest.approx(mirror(estimate.psf, symmetry), abs=2e-6)
        inner = mirror(estimate.sigma, symmetry)[:, 1:, 1:]
        assert moved.sigma[:, 1:, 1:] == pytest.approx(inner, rel=1e-4)


def test_wavefronts_move_with_the_star(monkeypatch):
    """A mirrored star has mirrored wavefronts with the same probabilities."""
    monkeypatch.setattr(torch.cpu, "get_capabilities", dict, raising=False)
    rng, level = np.random.default_rng(5), np.full(6, 2e-3)
    stamps = np.zeros((200, 8, 8))
    stamps[:, 1:, 1:] = rng.random((200, 7, 7))
    every = np.concatenate([mirror(stamps, symmetry) for symmetry in SYMMETRIES])
    matrices = WavefrontCoordinates.mirror()
    wavefronts = (rng.standard_normal((200, 8)) @ matrices).reshape(-1, 8)
    proposer = randomise(WavefrontNetwork.begin(build(every), wavefronts, rng))
    log_weight, wavefront, root = proposer.propose(stamps[:6], level)
    precision = root.swapaxes(2, 3) @ root
    assert np.abs(precision[..., 0, 3]).min() > 1e-3
    assert np.abs(wavefront - wavefront[0]).max() > 0.1
    assert (np.diff(log_weight, axis=1) <= 0).all()
    assert np.exp(log_weight).sum(axis=1) == pytest.approx(1.0)
    mean = proposer.coordinate_mean.numpy()
    for symmetry, matrix in zip(SYMMETRIES, matrices, strict=True):
        moved = proposer.propose(mirror(stamps[:6], symmetry), level)
        assert moved[0] == pytest.approx(log_weight, abs=1e-5)
        assert moved[1] - mean == pytest.approx((wavefront - mean) @ matrix.T, abs=1e-5)
        moved_precision = moved[2].swapaxes(2, 3) @ moved[2]
        assert moved_precision == pytest.approx(matrix @ precision @ matrix.T, rel=1e-3, abs=1e-3)


def test_proposals_are_a_mixture_of_normal_distributions():
    rng = np.random.default_rng(8)
    log_weight = np.log([[0.3, 0.7]])
    mean, log_sd = rng.standard_normal((2, 1, 2, 8))
    couplings = np.zeros((1, 2, 64))
    couplings[..., WavefrontNetwork.coupling_elements] = rng.standard_normal((1, 2, 26))
    arrays = log_weight, mean, log_sd, couplings.reshape(1, 2, 8, 8)
    proposals = Proposals(*(torch.from_numpy(array) for array in arrays))
    root, wavefront = proposals.root.numpy()[0], rng.standard_normal((5, 8))
    density = sum(
        np.exp(log_weight[0, k])
        * multivariate_normal(mean[0, k], np.linalg.inv(root[k].T @ root[k])).pdf(wavefront)
        for k in range(2)
    )
    expected = np.log(density) + 4.0 * np.log(2.0 * np.pi)
    many = Proposals(*(torch.from_numpy(np.repeat(array, 5, axis=0)) for array in arrays))
    assert many.log_density(torch.from_numpy(wavefront)).numpy() == pytest.approx(expected)


def test_densities_are_the_same_in_a_training_in_half_precision():
    """Sums of coordinates may be known a thousand times better than each of them."""
    generator = torch.Generator().manual_seed(9)
    wavefront, error = torch.randn((2, 4, 8), generator=generator)
    wavefront[:, 7] = wavefront[:, :6].sum(dim=1) + 1e-3 * error[:, 7]
    log_sd, couplings = torch.zeros(4, 1, 8), torch.zeros(4, 1, 8, 8)
    log_sd[..., 7], couplings[..., 7, :6] = float(np.log(1e-3)), -1.0
    proposals = Proposals(torch.zeros(4, 1), torch.zeros(4, 1, 8), log_sd, couplings)
    expected = proposals.log_density(wavefront)
    with torch.autocast("cpu", torch.bfloat16):
        assert proposals.log_density(wavefront).numpy() == pytest.approx(expected.numpy(), abs=0.01)


def test_representations_are_orthonormal():
    waves = list_representations()
    assert waves @ waves.T == pytest.approx(np.eye(8), abs=1e-12)


@pytest.fixture(scope="module")
def product(tmp_path_factory):
    """Simulated stars of scene 1 on nine fields."""
    folder = tmp_path_factory.mktemp("stars")
    stars.templates(load_stage(STATIC, WORDS), folder / "templates.h5")
    config = load_stage(SIMULATION, WORDS)
    stars.stars(config, folder / "templates.h5", folder / "stars.h5")
    return read_product(folder / "stars.h5", "stars")


def test_drawn_stamps_are_framed_in_the_fields_that_are_asked_for(product):
    """The brightest pixel, or one that is as bright, is within the centring error of the middle."""
    config = load_stage(SIMULATION, WORDS)
    fields = np.arange(9) % 2 == 0
    stars = FreshStars.simulate(config, 1, 27, fields)
    stamps, position, wavefront = stars.draw(400, np.random.default_rng(6))
    assert stamps.sum(axis=1) == pytest.approx(1.0, abs=1e-5)
    assert set(position @ [1, 3]) == {0, 2, 4, 6, 8}
    images = stamps.reshape(-1, 16, 16)
    middle = images[:, 7:10, 7:10].max(axis=(1, 2))
    assert middle == pytest.approx(images.max(axis=(1, 2)), rel=1e-3)
    # Each stamp is the image of its wavefront.
    coefficients = WavefrontCoordinates.decode(wavefront, config.telescope.pixel)
    optics = SampledStamps(0.3, monomial_images, PointSampling, 16, stars.pixel, "complex64", [318])
    propagated = optics.stamps(coefficients)
    propagated /= propagated.sum(axis=(1, 2), keepdims=True)
    assert np.square(propagated - images).mean() < 1e-9
    # All centring errors occur.
    pixels = images[:, 7:10, 7:10].reshape(-1, 9).argmax(axis=1)
    assert np.bincount(pixels, minlength=9).min() > 20


@pytest.mark.parametrize("name", ["posterior_network", "posterior_network_position"])
def test_training_lowers_the_error_and_calibrates_sigma(product, name, tmp_path):
    kind = method(name)
    reads = ("seed", "noise", "parts", "posterior_network")
    words = (*WORDS, "noise.levels=[0.001,0.003]", "posterior_network.stars=90")
    words += ("posterior_network.steps=150", "posterior_network.batch=128")
    words += ("posterior_network.width=256", "posterior_network.hidden=256")
    words += ("posterior_network.lr=0.006",)
    config = load_stage(reads, words)
    data = training_set(config, kind, product, "random", "realisation", checkpoint=tmp_path / "c")
    fitted = kind.fit(data, **kind.settings(config))
    # Without training, the network is the linear estimate.
    settings = config.posterior_network
    untrained = settings.model_copy(update={"epochs": 1, "steps": 1, "lr": 1e-9})
    linear, trained = (
        fit.diagnostic_rows["history.csv"][-1]["validation_mse"]
        for fit in (kind.fit(data, untrained), fitted)
    )
    assert 0.3 * linear < trained < 0.9 * linear
    # A saved network gives the same PSFs, and σ holds 68 % of the errors of unused stars.
    fitted.save(tmp_path / "fit.h5", config.model_dump())
    loaded = kind.load(tmp_path / "fit.h5")
    level = np.full(90, data.levels[-1])
    noisy = data.noise.draw(data.images, level[0], np.random.default_rng(7))
    estimate = fitted.estimate(noisy, level, data.positions)
    assert np.array_equal(estimate.psf, loaded.estimate(noisy, level, data.positions).psf)
    coverage = (np.abs(estimate.psf - data.images) < estimate.sigma).mean()
    assert coverage == pytest.approx(0.68, abs=0.06)
    levels, ratio95 = fitted.calibration
    assert levels[-1] == pytest.approx(level[0]) and "σ at λ = 0.003" in str(fitted.facts())
    wide = (np.abs(estimate.psf - data.images) < ratio95[-1] * estimate.sigma).mean()
    assert wide == pytest.approx(0.95, abs=0.03)
    # The same seed gives the same network.
    short = settings.model_copy(update={"epochs": 1, "steps": 5})
    once, again = (kind.fit(data, short).estimate(noisy, level, data.positions) for _ in range(2))
    assert np.array_equal(once.psf, again.psf)
    assert np.array_equal(once.sigma, again.sigma)


def test_refined_network_is_saved_with_its_optics(product, tmp_path):
    """At little noise the optics count more than a network of a few steps."""
    kind, plain = method("posterior_network_refined"), method("posterior_network")
    words = (*WORDS, "noise.levels=[0.0003,0.001]", "posterior_network.stars=40")
    words += ("posterior_network.steps=60", "posterior_network.lr=0.006")
    config = load_stage(("seed", "noise", "parts", "posterior_network"), words)
    data = training_set(config, kind, product, "random", "realisation", checkpoint=tmp_path / "c")
    fitted = kind.fit(data, **kind.settings(config))
    rng, level = np.random.default_rng(9), np.full(30, 1e-3)
    truth = data.images[:30]
    noisy = data.noise.draw(truth, 1e-3, rng)
    estimate = fitted.estimate(noisy, level)
    assert estimate.psf.sum(axis=(1, 2)) == pytest.approx(1.0, abs=1e-4)
    network = plain(fitted.network).estimate(noisy, level)
    assert np.square(estimate.psf - truth).mean() < np.square(network.psf - truth).mean()
    fitted.save(tmp_path / "fit.h5", config.model_dump())
    loaded = kind.load(tmp_path / "fit.h5").estimate(noisy, level)
    assert loaded.psf == pytest.approx(estimate.psf, abs=1e-7)
    assert loaded.sigma == pytest.approx(estimate.sigma, rel=1e-4)
    # Without stars, none.
    assert fitted.estimate(noisy[:0], level[:0]).psf.shape == (0, 16, 16)
    # A bundle measures flux and sky, too: a further error, but a small one.
    settings = {**config.model_dump(), "split": "random"}
    parts = product, "realisation", config, settings, "name", "MIT"
    write_bundle(build_uncalibrated(fitted, *parts)[0], tmp_path / "m.psf.safetensors")
    model = StarModel(read_bundle(tmp_path / "m.psf.safetensors"))
    flux = NOISE.flux(1e-3)
    prediction = model.predict(rng.poisson(flux * truth + NOISE.background), gain=1.0)
    psf = prediction.psf / prediction.flux[:, None, None]
    assert np.square(psf - truth).mean() < 0.3 * np.square(noisy - truth).mean()
    # Stars of turbulence, or with other noise than photons', have no such optics.
    turbulence = {**data.simulation, "scene": {"name": "turbulence"}}
    with pytest.raises(FitError, match="random Seidel aberrations"):
        kind.fit(replace(data, simulation=turbulence), **kind.settings(config))
    with pytest.raises(ConfigError, match="posterior_network_refined"):
        load(["dataset=dataset3", "noise.law=gaussian", f"methods=[{kind.name}]"])


def test_a_fit_killed_before_its_combination_keeps_both_trainings(product, tmp_path, monkeypatch):
    """The second one lost its checkpoint before the combination was fitted and written."""
    kind, checkpoint = method("posterior_network_refined"), tmp_path / "fit.pt"
    words = (*WORDS, "noise.levels=[0.0003,0.001]", "posterior_network.stars=40")
    words += ("posterior_network.epochs=2", "posterior_network.steps=2")
    words += ("posterior_network.checkpoint_seconds=0",)
    config = load_stage(("seed", "noise", "parts", "posterior_network"), words)
    data = training_set(config, kind, product, "random", "realisation", checkpoint=checkpoint)

    def kill(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(Combination, "fit", kill)
        kind.fit(data, **kind.settings(config))
    assert {path.name for path in tmp_path.iterdir()} == {"fit.pt", "fit.wavefront.pt"}
    # No epoch is run again.
    monkeypatch.setattr(Training, "run_epoch", kill)
    resumed = kind.fit(data, **kind.settings(config))
    assert len(resumed.diagnostic_rows["history.csv"]) == 4
    # The stage deletes the checkpoints of this fit, and no others, once the fit is written.
    (tmp_path / "fit-template.pt").touch()
    (tmp_path / "fit2.wavefront.pt").touch()
    delete_checkpoints(checkpoint)
    assert {path.name for path in tmp_path.iterdir()} == {"fit-template.pt", "fit2.wavefront.pt"}


@pytest.mark.parametrize("law", [GaussianNoise, partial(CorrelatedNoise, shift_px=0.5)])
def test_training_with_another_noise_law_begins_anew(product, law, tmp_path, monkeypatch):
    kind = method("posterior_network")
    config = load_stage(("seed", "noise", "parts", "posterior_network"), WORDS)
    data = training_set(config, kind, product, "random", "realisation", checkpoint=tmp_path / "c")
    changes = {"epochs": 2, "steps": 2, "checkpoint_seconds": 0.0}
    settings, run_epoch = config.posterior_network.model_copy(update=changes), Training.run_epoch

    def run_one_epoch(training):
        if training.history:
            raise KeyboardInterrupt
        return run_epoch(training)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(Training, "run_epoch", run_one_epoch)
        kind.fit(data, settings)
    # The checkpoint of the first law is not continued.
    other = replace(data, noise=law(data.noise.kappa, data.noise.background))
    fits = [kind.fit(replace(other, checkpoint=tmp_path / name), settings) for name in ("c", "d")]
    first, second = (fit.to_arrays()["output"] for fit in fits)
    assert np.array_equal(first, second) and first.any()


def test_stars_of_an_image_and_templates_are_rejected(product, tmp_path):
    kind = method("posterior_network")
    config = load_stage(("seed", "noise", "parts", "posterior_network"), WORDS)
    data = training_set(config, kind, product, "random", "realisation")
    with pytest.raises(FitError, match="needs stars of a simulation"):
        kind.fit(replace(data, simulation={}), **kind.settings(config))
    static = load_stage(SIMULATION, ("dataset=dataset8",)).model_dump()
    with pytest.raises(FitError, match="method static_posterior"):
        kind.fit(replace(data, simulation=static), **kind.settings(config))
    with pytest.raises(FitError, match="needs reference=realisation, not template"):
        kind.fit(replace(data, reference="template"), **kind.settings(config))


def test_networks_are_timed_only_on_request():
    points, config = load_points(), load(["dataset=dataset3"])
    kinds = ("", "_position", "_refined")
    for dataset in points.datasets:
        networks = points.on_request[dataset]
        assert networks == [f"posterior_network{kind}" for kind in kinds]
        assert set(networks).isdisjoint({*points.further_methods, *config.methods})
        assert {"configured", "epochs8"} <= {*points.overrides(dataset, networks[0])}
    # A dataset that only this target times has no other settings.
    assert "static_posterior" in points.on_request["dataset8"]
    assert points.overrides("dataset8", "dae") == {"configured": []}
