"""Methods of scene 3: CNN, mirror symmetries, maximum likelihood, Cramér–Rao bounds."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import nn

from psfdae.methods.networks.training import train
from psfdae_paper.alignment.emulator import StampEmulator
from psfdae_paper.alignment.likelihood import (
    StateLikelihood,
    StateOptics,
    compute_bounds,
    compute_deviance,
    compute_mean_abs_error,
    refit_twins,
)
from psfdae_paper.alignment.networks import (
    AlignmentCnn,
    NetworkTraining,
    TrainingStates,
    make_training,
    predict_states,
    scale_stamps,
)
from psfdae_paper.alignment.stamps import AlignmentStamps
from psfdae_paper.alignment.telescope import (
    coma_free_decentre,
    mirror_symmetries,
    twin_states,
    uniform_states,
)
from psfdae_paper.configuration.alignment import Cnn, Perceptron


def _optics(scene3, movable, precision="complex64"):
    optics = scene3.optics.model_copy(update={"precision": precision})
    return AlignmentStamps(scene3.telescope, optics, scene3.alignment, movable)


@pytest.fixture(scope="module")
def states():
    return uniform_states(30, np.random.default_rng(5))


@pytest.fixture(scope="module")
def stamps(model, operator, states):
    return operator(model(states))[0]


# --- mirror symmetries


def test_mirrored_states_have_the_mirrored_stamps(model, operator, states, stamps):
    symmetries = mirror_symmetries(8)
    images = [symmetry.states(states[:1]).tolist() for symmetry in symmetries]
    assert len({str(image) for image in images}) == 8
    # Six points on the ring do not map on themselves when x and y are exchanged.
    assert len(mirror_symmetries(6)) == 4
    for symmetry in symmetries:
        expected = operator(model(symmetry.states(states[:3])))[0]
        # The fit of the quadratic model to rays is symmetric to 1e-6 waves.
        assert symmetry.stamps(stamps[:3]) == pytest.approx(expected, abs=1e-5)
        assert symmetry.state_matrix @ symmetry.state_matrix.T == pytest.approx(np.eye(4))


# --- networks

CNN = Cnn(widths=[4] * 5, kernels=[3] * 5, strides=[1, 2, 1, 2, 2], leak=0.01)
PERCEPTRON = Perceptron(components=10, widths=[16, 8])


def test_cnn_is_the_paper_s(scene3):
    network = AlignmentCnn(scene3.cnn, 9, 16)
    kinds = [type(layer) for layer in network.features]
    assert kinds == [nn.Conv2d, nn.BatchNorm2d, nn.LeakyReLU] * 5
    assert network.features[0].in_channels == 9
    linear = [layer for layer in network.modules() if isinstance(layer, nn.Linear)]
    assert len(linear) == 1
    assert linear[0].out_features == 4
    assert network(torch.zeros(3, 9, 16, 16)).shape == (3, 4)
    train = scene3.train_original
    assert (train.batch, train.epochs, train.lr) == (10, 100, 1e-3)
    assert not train.mirrors


@pytest.fixture(scope="module")
def tiny():
    """Six made-up stamps and states."""
    rng = np.random.default_rng(0)
    return rng.random((6, 9, 16, 16), dtype=np.float32), rng.uniform(-1, 1, (6, 4))


def _training(scene3, epochs, data, seed=3, network=CNN):
    stamps, states = data
    defaults = scene3.train_original if network is CNN else scene3.train_noise_trained
    settings = defaults.model_copy(
        update={"epochs": epochs, "batch": 3, "mirrors": True, "checkpoint_seconds": 0}
    )
    return make_training(network, TrainingStates(states, stamps), settings, seed, "test")


def _train(path, *arguments, report=lambda row: None):
    return train(lambda attempt: _training(*arguments), path, path.name, report)


@pytest.mark.parametrize("network", [CNN, PERCEPTRON])
def test_training_is_deterministic_and_resumes_where_it_was(scene3, tiny, network, tmp_path):
    complete, other_seed = (
        _train(tmp_path / str(seed), scene3, 4, tiny, seed, network) for seed in (3, 4)
    )

    def interrupt(row):
        if row["epoch"] == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        _train(tmp_path / "c", scene3, 4, tiny, 3, network, report=interrupt)
    epochs = []
    resumed = _train(
        *(tmp_path / "c", scene3, 4, tiny, 3, network),
        report=lambda row: epochs.append(row["epoch"]),
    )
    assert epochs == [3, 4]
    assert [row["loss"] for row in resumed.history] == [row["loss"] for row in complete.history]
    for key, value in complete.result.items():
        assert torch.equal(value, resumed.result[key]), key
    assert not torch.equal(complete.model.linear.weight, other_seed.model.linear.weight)


@pytest.mark.parametrize("network", [CNN, PERCEPTRON])
def test_networks_learn_states_from_clean_stamps(scene3, stamps, states, network, tmp_path):
    training = _train(tmp_path / "x", scene3, 45, (stamps, states), 3, network)
    error = np.abs(predict_states(training.model, stamps) - states).mean()
    assert error < 0.7 * np.abs(states).mean()


def test_perceptron_sees_uncorrelated_numbers_of_variance_1(scene3, stamps, states):
    model = _training(scene3, 1, (stamps, states), network=PERCEPTRON).model
    images = np.concatenate([m.stamps(stamps) for m in mirror_symmetries(8)])
    scaled = torch.from_numpy(images).flatten(1) * stamps.shape[-1] ** 2
    features = ((scaled - model.mean) @ model.axes).numpy()
    assert np.cov(features.T) == pytest.approx(np.eye(10), abs=1e-3)
    assert features.mean(axis=0) == pytest.approx(np.zeros(10), abs=1e-3)
    # No other ten numbers hold more of the stamps.
    held_variance = np.square(features / np.linalg.norm(model.axes.numpy(), axis=0)).sum()
    largest = np.linalg.svd(scaled.numpy() - model.mean.numpy(), compute_uv=False)[:10]
    assert held_variance == pytest.approx(np.square(largest).sum(), rel=1e-3)


# --- batches


def _batches(scene3, size, data, epoch=0):
    """Batches of an epoch without mirror images, as arrays."""
    settings = scene3.train_original.model_copy(update={"batch": size})
    training = NetworkTraining(data, scene3.cnn, settings, 1, "x")
    batches = [tuple(part.numpy() for part in batch) for batch in training.batches(epoch)]
    assert len(batches) == training.steps
    return batches


def test_every_epoch_shows_every_state_once(scene3, states, stamps):
    data = TrainingStates(states, stamps)
    first, second = (
        np.concatenate([truth for _, truth in _batches(scene3, 8, data, epoch)]) for epoch in (0, 1)
    )
    once = sorted(states.astype(np.float32).tolist())
    assert sorted(first.tolist()) == sorted(second.tolist()) == once
    assert first.tolist() != second.tolist()
    assert len(_batches(scene3, 8, data)) == 4
    # A batch of one has no variance to normalise.
    assert len(_batches(scene3, 29, data)) == 1


def test_components_are_those_of_mirrored_noisy_stamps(scene3, noise, stamps, states):
    """A perceptron learns from components that its network would find in the stamps."""
    network = scene3.perceptron.model_copy(update={"components": 20})
    settings = scene3.train_noise_trained.model_copy(update={"epochs": 1, "batch": 5})
    level = 0.005
    draws = np.stack([stamps, 2 * stamps]).astype(np.float32)
    for data in (TrainingStates(states, draws), TrainingStates(states, stamps, noise, [level])):
        training = make_training(network, data, settings, 1, "x")
        scaled = scale_stamps(np.asarray(stamps, np.float32))
        parts = training.parts[0].sum(axis=1)
        assert parts == pytest.approx(training.model.components(scaled).numpy(), abs=1e-3)
    repeated = np.repeat(np.mean(stamps, axis=0, keepdims=True), 1500, axis=0)
    errors = noise.draw(repeated, level, np.random.default_rng(2)) - repeated
    spread = training.model.components(scale_stamps(errors)).numpy().std(axis=0)
    expected = np.sqrt(np.square(training.roots[0]).sum(axis=0))
    # A standard deviation of 1500 draws scatters by 1.8 %.
    assert spread == pytest.approx(expected, rel=0.1)


@pytest.mark.parametrize("count", [0, 1, 2, 3, 5])
def test_any_number_of_states_is_estimated(count):
    """The estimate of no state at all ended in an error of numpy."""
    stamps = np.random.default_rng(3).random((count, 9, 4, 4)).astype(np.float32)

    class FirstPixels(nn.Module):
        def forward(self, images):
            return images[:, 0, 0]

    first = predict_states(FirstPixels(), stamps, batch=2)
    assert first.dtype == np.float64 and first.shape == (count, 4)
    assert first == pytest.approx(16.0 * stamps[:, 0, 0])
    mirrored = predict_states(FirstPixels(), stamps, batch=2, mirrors=mirror_symmetries(8))
    assert mirrored.shape == (count, 4)


# --- Fisher information and maximum likelihood


def test_fisher_matrix_against_finite_differences(model, exact_operator, noise):
    state = np.array([[0.3, -0.5, 0.4, 0.2]])
    stamps, slopes = StateOptics(model, exact_operator)(state)
    _, _, fisher = compute_deviance(noise, 0.002, stamps, stamps, slopes)
    step = 1e-4
    plus, minus = (exact_operator(model(state + sign * step * np.eye(4)))[0] for sign in (1, -1))
    slopes = ((plus - minus) / (2 * step)).reshape(4, -1)
    expected = (slopes / noise.variance(stamps.ravel(), 0.002)) @ slopes.T
    assert fisher[0] == pytest.approx(expected, rel=1e-4, abs=1e-4 * expected.max())


def test_decentre_and_tilt_errors_are_correlated_with_the_signs_of_coma(
    model, operator, noise, states
):
    """More decentre along x is hidden by less tilt about y, along y by more tilt about x."""
    optics = StateOptics(model, operator)
    bounds = compute_bounds(optics, noise, [0.002], states, [False])[0, 0]
    sigma = np.sqrt(np.diagonal(bounds, axis1=1, axis2=2))
    matrix = (bounds / (sigma[:, :, None] * sigma[:, None, :])).mean(axis=0)
    assert -0.9 < matrix[0, 3] < -0.6
    assert 0.6 < matrix[1, 2] < 0.9
    assert np.abs(matrix[[0, 1, 2], [1, 3, 3]]).max() < 0.3


@pytest.mark.parametrize("movable", [False, True])
def test_noise_free_parameters_are_recovered(model, scene3, noise, movable):
    """The start is 0.08 of the range aside; with flux and place unknown, they are found, too."""
    optics = StateOptics(model, _optics(scene3, movable, "complex128"))
    truth = np.array([[0.3, -0.5, 0.4, 0.2], [0.9, 0.8, -0.7, -0.95]])
    parameters = optics.to_parameters(truth)
    parameters[:, 4:] = np.random.default_rng(4).uniform(-0.2, 0.2, parameters[:, 4:].shape)
    images, _ = optics(parameters)
    flux = 1 + parameters[:, 4::3] if movable else np.ones((2, 9))
    assert images.sum(axis=(2, 3)) == pytest.approx(flux)
    likelihood = StateLikelihood(optics, noise, 0.002, images)
    settings = scene3.fit.model_copy(update={"iterations": 25, "tolerance": 1e-7})
    fit = likelihood.maximise(optics.to_parameters(truth + 0.08), settings)
    assert fit.has_converged.all()
    assert fit.parameters == pytest.approx(parameters, abs=1e-6)
    assert (-2 * fit.height) == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize("movable", [False, True])
def test_scatter_of_the_fit_is_the_bound(model, scene3, noise, states, stamps, movable):
    """The estimator is efficient at low noise: χ² of 20 × 4 errors within its 99.9 % range."""
    optics = StateOptics(model, _optics(scene3, movable))
    level, truth = 2e-4, states[:20]
    images = noise.draw(stamps[:20], level, np.random.default_rng(7))
    fit = StateLikelihood(optics, noise, level, images).maximise(
        optics.to_parameters(truth + 0.01), scene3.fit
    )
    covariances = compute_bounds(optics, noise, [level], truth, [movable])[0, 0]
    error = fit.parameters[:, :4] - truth
    chi2 = np.einsum("nk,nkl,nl->", error, np.linalg.inv(covariances), error)
    assert 45 < chi2 < 128
    # Pixels minus parameters, with the spread √(2 N) of χ².
    pixels, fitted = 9 * 16 * 16, 4 + 27 * movable
    assert (-2 * fit.height).mean() == pytest.approx(
        pixels - fitted, abs=5 * np.sqrt(2 * pixels / 20)
    )


def test_free_flux_and_place_cost_precision(model, scene3, operator, noise, states):
    """Errors grow by a quarter to a third, and shrink in no direction."""
    movable, fixed = StateOptics(model, _optics(scene3, True)), StateOptics(model, operator)
    covariances = compute_bounds(movable, noise, [0.002], states[:12], [False, True])
    known_flux, unknown = covariances[:, 0]
    without_flux = compute_bounds(fixed, noise, [0.002], states[:12], [False])[0, 0]
    assert known_flux == pytest.approx(without_flux, rel=1e-3)
    ratio = compute_mean_abs_error(unknown).mean() / compute_mean_abs_error(known_flux).mean()
    assert 1.2 < ratio < 1.35
    assert np.linalg.eigvalsh(unknown - known_flux).min() > -1e-9


def test_emulator_of_few_states(scene3, model, operator, states, stamps):
    """Stamps that it was given come back, in all mirror images; derivatives are differences."""
    settings = scene3.fit.model_copy(update={"outer_states": 5})
    emulator = StampEmulator(StateOptics(model, operator), states, stamps, settings)
    mirror = mirror_symmetries(8)[3]
    emulated, slopes = emulator(mirror.states(states))
    assert emulated == pytest.approx(mirror.stamps(stamps), abs=2e-3)
    assert slopes.sum(axis=(-2, -1)) == pytest.approx(0, abs=1e-3)
    step, queries = 1e-3 * np.eye(4)[2], states[:4] * 0.9
    expected = (emulator(queries + step)[0] - emulator(queries - step)[0]) / 2e-3
    off = np.abs(emulator(queries)[1][:, :, 2] - expected)
    assert off.max() < 0.1 * np.abs(expected).max()


@pytest.mark.parametrize("movable", [False, True])
def test_wrong_twin_is_left_for_the_more_likely_state(model, scene3, noise, movable):
    optics = StateOptics(model, _optics(scene3, movable))
    tilt = np.array([[0.1, 0.12]])
    truth = np.hstack([coma_free_decentre(model, tilt), tilt])
    images, _ = optics(optics.to_parameters(truth))
    likelihood = StateLikelihood(optics, noise, 0.002, images)
    settings = scene3.fit.model_copy(update={"tolerance": 0.05})
    # A fit that stopped at the twin.
    twin = optics.to_parameters(twin_states(model, truth))
    stuck = likelihood.maximise(twin, settings.model_copy(update={"iterations": 1}))
    fit, in_range = refit_twins(likelihood, stuck, model, settings)
    assert in_range.all()
    assert fit.parameters[:, :4] == pytest.approx(truth, abs=2e-3)
    assert (-2 * fit.height)[0] < (-2 * stuck.height)[0]
