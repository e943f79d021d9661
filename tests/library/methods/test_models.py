"""Baseline, linear estimator, network and training."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from contextlib import nullcontext
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

from psfdae.base.files import ProductError
from psfdae.methods import all_methods
from psfdae.methods.dae import Dae as Fitted
from psfdae.methods.interface import FitError, TrainingSet
from psfdae.methods.lmmse import LinearMmse
from psfdae.methods.metrics import mse
from psfdae.methods.networks import dae as dae_network
from psfdae.methods.networks import training as loop
from psfdae.methods.networks.dae import (
    DaeTraining,
    SingleChannelConv,
    build_dae,
)
from psfdae.methods.networks.settings import DaeSettings, Train
from psfdae.methods.networks.training import Adam, DeadNetworkError, TrainingError, orthogonal
from psfdae.methods.networks.weights import load_weights, save_checkpoint, save_weights
from psfdae_paper.methods import pca_som
from psfdae_paper.methods.pca_som import Baseline, PcaFit, PcaSom, fit_pca_som
from psfdae_paper.source import SOURCES

BASELINE = {"rows": 4, "columns": 4, "epochs": 3, "sigma": 1.0, "learning_rate": 0.5}
BASELINE |= {"components": 4, "threads": 1}
DAE = DaeSettings(kernels=[5, 3, 1, 3, 5], widths=[4] * 4, init="he", scale="mean")
TRAIN = Train(
    epochs=3,
    batch=50,
    lr=3e-3,
    schedule="onecycle",
    optimiser="adam",
    level_weight=0.0,
    grad_clip=1.0,
    threads=1,
    validate_every=1,
    validation_draws=1,
    dead_check_steps=2,
    restarts=1,
    checkpoint_seconds=0.0,
    noise="fresh",
    crop_epochs=0.0,
    continued_epochs=0.0,
    patience=0,
)


@pytest.fixture
def data(gaussian_stars, noise):
    return TrainingSet(
        images=gaussian_stars,
        references=gaussian_stars,
        fit=np.arange(250),
        validation=np.arange(250, 300),
        levels=np.array([1e-3, 5e-3]),
        noise=noise,
    )


def train(data, folder, train_config=TRAIN, report=lambda row: None, dae=DAE):
    path = folder / "checkpoint.pt"
    begin = partial(DaeTraining, data, dae, train_config, 3)
    result = loop.train(begin, path, "config", report, train_config.restarts)
    path.unlink(missing_ok=True)
    return result


def interrupted(data, folder, epoch, **options):
    """A training that stops when an epoch ends; the checkpoint is that of the one before."""

    def interrupt(row):
        if row["epoch"] == epoch:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(data, folder, report=interrupt, **options)


def are_equal(first, second):
    return all(torch.equal(first[key], second[key]) for key in first)


def test_linear_mmse_is_the_posterior_mean_of_gaussian_data(noise):
    """The error for Gaussian images of known covariance is tr(C − C(C + N)⁻¹C)/P."""
    rng = np.random.default_rng(0)
    mixing = rng.normal(size=(64, 5)) * 0.01
    images = (rng.normal(size=(20000, 5)) @ mixing.T + 1 / 64).reshape(-1, 8, 8)
    fitted = LinearMmse.from_images(images[:10000], images[:10000], noise)
    level = 2e-3
    sigma2 = (noise.kappa * level) ** 2 + (1 / 64) / float(noise.flux(level))
    noisy = images[10000:] + rng.normal(size=(10000, 8, 8)) * np.sqrt(sigma2)
    cov = mixing @ mixing.T
    expected = np.trace(cov - cov @ np.linalg.solve(cov + sigma2 * np.eye(64), cov)) / 64
    assert mse(fitted.predict(noisy, level), images[10000:]).mean() == pytest.approx(
        expected, rel=0.05
    )


def test_linear_mmse_finds_references_that_are_another_image(noise):
    """References of few linear modes of the images, almost no noise: they come back."""
    rng = np.random.default_rng(0)
    modes, images, references = rng.normal(size=(500, 4)), *rng.normal(size=(2, 4, 64)) * 1e-3
    x, y = ((1 / 64 + modes @ mixing).reshape(-1, 8, 8) for mixing in (images, references))
    estimate = LinearMmse.from_images(x[:400], y[:400], noise).predict(x[400:], 1e-8)
    assert mse(estimate, y[400:]).max() < 1e-4 * y.var()


def test_baseline_assigns_the_nearest_node():
    rng = np.random.default_rng(0)
    mean, components = 1.0 + rng.random(64), rng.normal(size=(5, 64))
    nodes = rng.normal(size=(20, 5)) * rng.uniform(1, 30, size=(20, 1))
    images = mean.reshape(8, 8) + rng.normal(size=(500, 8, 8))
    features = (images.reshape(-1, 64) - mean) @ components.T
    nearest = np.linalg.norm(features[:, None] - nodes, axis=2).argmin(axis=1)
    assert len(set(nearest)) > 10
    assert (PcaFit(mean, components, nodes, np.empty((20, 64))).assign(images) == nearest).all()


def test_baseline_recovers_separate_classes():
    rng = np.random.default_rng(0)
    classes = rng.random((3, 8, 8))
    label = np.arange(300) % 3
    images = classes[label] + 0.01 * rng.normal(size=(300, 8, 8))
    fitted = fit_pca_som(images, Baseline(**BASELINE), seed=1)
    assert mse(fitted.predict(images), classes[label]).max() < 1e-4
    assert np.isfinite(fitted.psf).all()  # of 16 nodes, those without stars are left out


def test_baseline_refuses_more_components_than_stars_and_stars_that_are_not_finite(
    data, gaussian_stars
):
    with pytest.raises(FitError, match=r"components = 9999: must be at most \d+, the number"):
        PcaSom.fit(data, Baseline(**BASELINE | {"components": 9999}))
    fitted = fit_pca_som(gaussian_stars, Baseline(**BASELINE), seed=1)
    broken = gaussian_stars.copy()
    broken[7, 0, 0], broken[9, 3, 3] = np.nan, np.inf
    with pytest.raises(ValueError, match="not finite, the first is number 7"):
        fitted.predict(broken)


def test_map_of_mixed_levels_depends_on_the_seed_and_ignores_the_level(data, monkeypatch):
    seeds, settings = [], Baseline(**BASELINE, per_level=False)

    def begun(images, settings, seed):
        seeds.append(seed)
        return fit_pca_som(images, settings, seed)

    monkeypatch.setattr(pca_som, "fit_pca_som", begun)
    fits = [PcaSom.fit(replace(data, seed=seed), settings) for seed in (1, 2, 1)]
    assert seeds[0] == seeds[2] != seeds[1]
    low, high = (fits[0].predict(data.images, level) for level in (1e-5, 1.0))
    assert (low == high).all()


def test_baseline_of_each_level_has_that_level_s_noise(data, tmp_path):
    """Cluster means carry noise of the fit's own stars."""
    settings = Baseline(**BASELINE, per_level=True)
    fitted = PcaSom.fit(data, settings)
    assert fitted.level.tolist() == [1e-3, 5e-3]
    low, high = (fit.predict(data.images) for fit in fitted.fits)
    assert (low != high).any(axis=(1, 2)).all()
    levels = np.where(np.arange(len(data.images)) % 2, 2e-3, 3e-3)
    psfs = fitted.predict(data.images, levels)
    assert (psfs == np.where(levels[:, None, None] < 2.2e-3, low, high)).all()
    fitted.save(tmp_path / "fit.h5", {})
    assert (PcaSom.load(tmp_path / "fit.h5").predict(data.images, levels) == psfs).all()


@pytest.mark.parametrize(("kernel", "shape"), [(9, (13, 17)), (9, (3, 5)), (1, (6, 7))])
def test_single_channel_convolution_is_the_plain_one(kernel, shape):
    torch.manual_seed(3)
    layer = SingleChannelConv(5, 1, kernel, padding=kernel // 2)
    x = torch.randn(2, 5, *shape).to(memory_format=torch.channels_last)
    x.requires_grad_()
    plain = torch.nn.functional.conv2d(x, layer.weight, layer.bias, padding=kernel // 2)
    torch.testing.assert_close(layer(x), plain)
    upstream, inputs = torch.randn_like(plain), (x, *layer.parameters())
    gradients = (torch.autograd.grad(y, inputs, upstream) for y in (layer(x), plain))
    torch.testing.assert_close(*gradients)


def test_he_initialisation_keeps_the_variance(gaussian_stars):
    model = build_dae([9, 9], [64], "he", torch.Generator().manual_seed(0))
    first = model.layers[0].weight
    assert first.std().item() == pytest.approx(np.sqrt(2 / 81), rel=0.05)
    assert not model.layers[0].bias.any()


@pytest.mark.parametrize("widths", [[7, 3, 5, 9], [1] * 4])
def test_linear_start_has_the_least_squares_of_what_its_last_layer_sees(data, widths, monkeypatch):
    """A linear function of the layer before has no smaller error: the two are uncorrelated."""
    monkeypatch.setattr(DaeTraining, "linear_px", data.images[data.fit].size)
    dae = DAE.model_copy(update={"init": "linear", "widths": widths})
    training = DaeTraining(data, dae, TRAIN, 3)
    noisy, _ = data.draw(data.fit, np.random.default_rng(5))
    x = torch.from_numpy(noisy)[:, None] * training.factor
    with torch.no_grad():
        for layer in training.model.layers[:-1]:
            x = torch.relu(layer(x))
        missing = training.model.layers[-1](x)[:, 0].numpy()
    missing -= training.factor * data.images[data.fit]
    power = np.sqrt(np.mean(missing**2))
    assert abs(missing.mean()) < 0.05 * power
    for channel in x.numpy().transpose(1, 0, 2, 3):
        strength = np.sqrt(np.mean(channel**2))
        assert abs(np.mean(channel * missing)) < 0.1 * strength * power


def test_training_learns_and_repeats(data, tmp_path):
    longer = TRAIN.model_copy(update={"epochs": 8})
    first = train(data, tmp_path, longer)
    second = train(data, tmp_path, longer)
    assert are_equal(first.result, second.result)
    errors = [row["validation_mse"] for row in first.history]
    assert errors[-1] < 0.5 * errors[0]
    # One-cycle begins and ends with small steps; none goes backwards.
    assert min(row["lr"] for row in first.history) > 0


@pytest.mark.parametrize("optimiser", ["adam", "muon"])
def test_interrupted_training_continues_as_if_nothing_had_happened(data, tmp_path, optimiser):
    settings, epochs = TRAIN.model_copy(update={"optimiser": optimiser}), []
    complete = train(data, tmp_path, settings)
    interrupted(data, tmp_path, 2, train_config=settings)
    resumed = train(data, tmp_path, settings, report=lambda row: epochs.append(row["epoch"]))
    assert epochs == [2, 3]
    assert are_equal(complete.result, resumed.result)


def test_best_epoch_before_an_interruption_stays_the_best(data, tmp_path):
    """Validation on what no star looks like: the better the fit, the worse the score."""
    references = data.references.copy()
    references[data.validation] = 0.0
    contrary = replace(data, references=references)
    quick = TRAIN.model_copy(update={"lr": 1e-2})
    complete = train(contrary, tmp_path, quick)
    errors = [row["validation_mse"] for row in complete.history]
    assert errors[0] < min(errors[1:])
    interrupted(contrary, tmp_path, 2, train_config=quick)
    assert are_equal(complete.result, train(contrary, tmp_path, quick).result)


@pytest.mark.parametrize("change", [lambda raw: raw, lambda raw: raw[:-1] + b"x"])
def test_another_training_s_or_a_damaged_checkpoint_is_ignored(data, tmp_path, change):
    path, epochs = tmp_path / "checkpoint.pt", []
    save_checkpoint(path, "another", {})
    path.write_bytes(change(path.read_bytes()))
    train(data, tmp_path, report=lambda row: epochs.append(row["epoch"]))
    assert epochs == [1, 2, 3]


def test_numbers_that_are_not_finite_stop_a_training_with_advice(data, tmp_path, monkeypatch):
    wild = TRAIN.model_copy(update={"lr": 1.0, "grad_clip": 0.0, "schedule": "constant"})
    bright = replace(data, references=data.references * np.float32(1e30))
    with pytest.raises(TrainingError, match=r"the loss is .* lower train\.lr = 1\.0"):
        train(bright, tmp_path, wild)
    references = np.where(np.arange(300)[:, None, None] == data.fit[0], np.nan, data.references)
    linear = DAE.model_copy(update={"init": "linear"})
    with pytest.raises(TrainingError, match="training stars that are not finite"):
        DaeTraining(replace(data, references=references), linear, TRAIN, 3)
    nan = torch.tensor(float("nan"))
    monkeypatch.setattr(torch.nn.utils, "clip_grad_norm_", lambda *_: nan)
    with pytest.raises(TrainingError, match=r"gradient's norm is nan .* lower train\.lr"):
        train(data, tmp_path)


def killed(model):
    with torch.no_grad():
        model.layers[-1].bias.fill_(-1e6)
    return model


def test_dead_network_restarts_and_then_gives_up(data, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(dae_network, "build_dae", lambda *arguments: killed(build_dae(*arguments)))
    with pytest.raises(TrainingError, match="died in all 2 attempts"):
        train(data, tmp_path)
    # Only the first is followed by another one.
    first, last = capsys.readouterr().out.splitlines()
    assert first.startswith("attempt 1 of 2: ") and first.endswith("starting from another seed")
    assert last.startswith("attempt 2 of 2: ") and "another seed" not in last


def test_every_check_notices_a_dead_network_and_no_other_step_looks(data):
    training = DaeTraining(data, DAE, TRAIN, 3, 0)
    killed(training.model)
    batch = next(training.batches(0))
    for step in range(1, 7):
        dead = step % TRAIN.dead_check_steps == 0
        refused = pytest.raises(DeadNetworkError, match=f"at step {step}$")
        with refused if dead else nullcontext():
            assert training.loss(batch, step) > 0


def test_restart_uses_other_weights(data, tmp_path, monkeypatch):
    attempts = []

    def dead_once(*arguments):
        model = build_dae(*arguments)
        attempts.append(model.layers[0].weight.detach().clone())
        return killed(model) if len(attempts) == 1 else model

    monkeypatch.setattr(dae_network, "build_dae", dead_once)
    uninterrupted = train(data, tmp_path)
    assert uninterrupted.attempt == 1
    assert not torch.equal(*attempts)
    attempts.clear()
    interrupted(data, tmp_path, 2)
    resumed = train(data, tmp_path)
    # The dead one, the one that was interrupted, and that again.
    assert len(attempts) == 3 and torch.equal(attempts[1], attempts[2])
    assert resumed.attempt == 1
    assert are_equal(uninterrupted.result, resumed.result)


@pytest.mark.parametrize("kind", ["fixed", "fresh"])
def test_noise_is_the_same_in_every_epoch_only_if_fixed(data, kind):
    settings = TRAIN.model_copy(update={"noise": kind, "batch": 250})
    training, twin = (DaeTraining(data, DAE, settings, 3, 0) for _ in range(2))
    batches = [next(t.batches(epoch))[0] for t, epoch in ((training, 0), (training, 1), (twin, 1))]
    first, second, repeated = (noisy.sum((1, 2, 3)).sort()[0] for noisy in batches)
    assert torch.equal(first, second) == (kind == "fixed")
    assert torch.equal(second, repeated)


def test_errors_of_faint_stars_count_less_by_a_power_of_their_noise(data):
    settings = TRAIN.model_copy(update={"level_weight": 1.0, "batch": 250})
    training = DaeTraining(data, DAE, settings, 3, 0)
    noisy, target, weight = next(training.batches(0))
    assert sorted(set(weight.ravel().tolist())) == pytest.approx(
        sorted((1 / data.levels) / np.mean(1 / data.levels)), rel=1e-6
    )
    errors = ((training.model(noisy) - target) ** 2).mean(dim=(1, 2, 3))
    mean_error = (errors * weight.ravel()).mean().item()
    assert training.loss((noisy, target, weight), 1).item() == pytest.approx(mean_error, rel=1e-5)
    # The history has the mean without weights, on the scale of images of sum 1.
    row = training.row(1, 1e-3, mean_error, float("nan"))
    plain_error = errors.mean().item() / training.factor**2
    assert row["train_mse"] == pytest.approx(plain_error, rel=1e-5)
    assert plain_error != pytest.approx(mean_error / training.factor**2, rel=0.05)
    assert row["side_px"] == target.shape[-1]


@pytest.mark.parametrize("fused", [False, True])
def test_adam_without_the_compiler_is_torchs(fused):
    start = torch.randn(5, 3, generator=torch.Generator().manual_seed(1))
    weights = {kind: torch.nn.Parameter(start.clone()) for kind in (Adam, torch.optim.Adam)}
    for kind, weight in weights.items():
        optimiser = kind([weight], lr=0.1, fused=fused)
        for _ in range(5):
            optimiser.zero_grad()
            weight.pow(4).sum().backward()
            optimiser.step()
    assert torch.equal(*weights.values())
    assert (weights[Adam] - start).abs().max() > 0.1


def test_trainings_do_not_import_torchs_compiler():
    code = (
        "import sys, torch; from psfdae.methods.networks.training import Muon;"
        "weight = torch.nn.Parameter(torch.eye(2));"
        "optimiser = Muon([{'params': [weight], 'orthogonal': True}], lr=0.1);"
        "weight.sum().backward(); optimiser.step(); optimiser.zero_grad();"
        "optimiser.load_state_dict(optimiser.state_dict());"
        "sys.exit('torch._dynamo' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_half_precision_rounds_all_layers_but_the_last(monkeypatch):
    network = build_dae([3, 1, 3], [4, 4], "he", torch.Generator().manual_seed(1))
    images = torch.rand(2, 1, 8, 8, generator=torch.Generator().manual_seed(2))
    expected = network(images)
    # A processor without instructions for it computes as always, and so do those of Intel that
    # have them in vector units alone.
    intel = {"cpu_name": "Intel Xeon", "avx512_bf16": True, "amx_bf16": False}
    for capabilities in ({}, intel):
        monkeypatch.setattr(torch.cpu, "get_capabilities", lambda c=capabilities: c, raising=False)
        with loop.use_half_precision():
            assert torch.equal(network(images), expected)
    for capabilities in (
        {"cpu_name": "AMD Zen4 (EPYC)", "avx512_bf16": True},
        {**intel, "amx_bf16": True},
    ):
        monkeypatch.setattr(torch.cpu, "get_capabilities", lambda c=capabilities: c, raising=False)
        with loop.use_half_precision():
            assert not torch.equal(network(images), expected)
    with loop.use_half_precision(False):
        assert torch.equal(network(images), expected)
    with loop.use_half_precision():
        rounded = network(images)
    # Eight bits err by 2^-9, and more where terms cancel; the result itself has all its digits.
    assert rounded.dtype == torch.float32 and not torch.equal(rounded, rounded.bfloat16().float())
    error = (rounded - expected).abs().max() / expected.max()
    assert 1e-4 < error < 2e-2
    # The gradient has the precision of the weights.
    rounded.sum().backward()
    assert {weight.grad.dtype for weight in network.parameters()} == {torch.float32}


def test_second_half_of_the_epochs_has_half_precision(data, monkeypatch):
    halves = []
    half_precision = loop.use_half_precision
    monkeypatch.setattr(
        loop, "use_half_precision", lambda half: (halves.append(half), half_precision(False))[1]
    )
    training = DaeTraining(data, DAE, TRAIN.model_copy(update={"epochs": 4}), 3, 0)
    while not training.is_finished():
        training.run_epoch()
    assert halves == [False] * 2 * training.steps + [True] * 2 * training.steps


def test_steps_of_muon_are_along_orthogonal_matrices():
    generator, shapes = torch.Generator().manual_seed(1), [(8, 200), (200, 8), (16, 16)]
    matrices = [torch.randn(shape, generator=generator) for shape in shapes]
    for matrix, step in zip(matrices, orthogonal(matrices), strict=True):
        assert step.shape == matrix.shape
        u, _, vt = torch.linalg.svd(matrix, full_matrices=False)
        along = u.T @ step @ vt.T
        assert along.diagonal().min() > 0.65 and along.diagonal().max() < 1.3
        assert (along - along.diagonal().diag()).abs().max() < 1e-3


@pytest.mark.parametrize(
    ("reference", "sides"),
    [
        ("realisation", (8, 8, 8, 10, 12, 14, 16, 16)),
        ("template", (12,) * 4 + (16,) * 4),
    ],
)
def test_training_begins_with_the_middle_of_the_stamps(data, reference, sides):
    settings = TRAIN.model_copy(update={"crop_epochs": 0.75, "epochs": len(sides)})
    data = replace(data, reference=reference)
    training, uncropped = (
        DaeTraining(data, DAE, settings, 3, 0),
        DaeTraining(data, DAE, TRAIN, 3, 0),
    )
    for epoch, side in enumerate(sides):
        for part, full in zip(
            next(training.batches(epoch))[:2], next(uncropped.batches(epoch))[:2], strict=True
        ):
            edge = (16 - side) // 2
            assert training.side_px == side
            assert torch.equal(part, full[:, :, edge : 16 - edge, edge : 16 - edge])


def test_training_goes_on_from_another_network(data):
    anew = DaeTraining(data, DAE, TRAIN, 3, 0)
    first_network = DaeTraining(data, DAE, TRAIN, 4, 0).model
    training = DaeTraining(replace(data, start=Fitted(first_network, "mean")), DAE, TRAIN, 3, 0)
    for started, weight in zip(
        training.model.parameters(), first_network.parameters(), strict=True
    ):
        assert torch.equal(started, weight) and started.data_ptr() != weight.data_ptr()
    assert not torch.equal(anew.model.layers[1].weight, first_network.layers[1].weight)
    assert torch.equal(next(training.batches(0))[0], next(anew.batches(0))[0])


def test_muon_steps_as_far_as_adam_and_leaves_the_rest_to_it(data):
    steps = {}
    for optimiser in ("adam", "muon"):
        settings = TRAIN.model_copy(update={"optimiser": optimiser, "schedule": "constant"})
        training = DaeTraining(data, DAE, settings, 3, 0)
        start = [p.detach().clone() for p in training.model.parameters()]
        training.take_step(next(training.batches(0)), 1)
        pairs = zip(training.model.parameters(), start, strict=True)
        steps[optimiser] = [(p - b).detach() for p, b in pairs]
    hidden = [f"layers.{i}.weight" for i in range(1, len(training.model.layers) - 1)]
    for (name, _), a, m in zip(training.model.named_parameters(), *steps.values(), strict=True):
        if name in hidden:
            assert not torch.equal(a, m)
            # Adam's first step is the learning rate in every element.
            assert 0.1 < (m.square().mean() / a.square().mean()).sqrt() < 0.4
        else:
            assert torch.equal(a, m)


def test_patience_stops_a_training_that_no_longer_improves(data, tmp_path):
    hopeless = TRAIN.model_copy(
        update={"epochs": 12, "lr": 1e-12, "schedule": "constant", "patience": 2}
    )
    # At this rate nothing changes, so every validation after the first brings nothing new.
    assert len(train(data, tmp_path, hopeless).history) < 12
    unlimited = hopeless.model_copy(update={"epochs": 5, "patience": 0})
    assert len(train(data, tmp_path, unlimited).history) == 5


def test_weights_come_back_and_damage_is_noticed(tmp_path):
    """Every byte of the file counts, the checksum covers the tensors."""
    state = {"w": torch.arange(600.0).reshape(20, 30).T, "steps": torch.tensor(7)}
    path = tmp_path / "dae.safetensors"
    save_weights(path, state, {"seed": 1})
    weights = load_weights(path)
    assert all(np.array_equal(weights[name], tensor) for name, tensor in state.items())
    content = path.read_bytes()
    flipped = (content[:k] + bytes([content[k] ^ 1]) + content[k + 1 :] for k in (300, 1000, 2400))
    for damaged in (*flipped, content[:-5], content[:20], b"hello"):
        path.write_bytes(damaged)
        with pytest.raises(ProductError, match=r"dae\.safetensors: damaged"):
            load_weights(path)
    path.unlink()
    with pytest.raises(ProductError, match="no such file"):
        load_weights(path)


def test_methods_have_the_functions_of_their_capabilities_and_no_others():
    field = ("measure", "psf_at", "order", "is_outside_range", "draw_stars", "estimate_flux_error")
    functions = {**dict.fromkeys(field, "knows_field"), "flux": "finds_flux"}
    for kind in all_methods():
        for function, capability in functions.items():
            assert hasattr(kind, function) == getattr(kind, capability), (kind.name, function)


# The example of docs/developers.md


@pytest.fixture
def kernel_module(monkeypatch):
    """The module of the page, with the name that the page gives it."""
    path = SOURCES.parent / "docs/trained_kernel.py"
    assert f"cp {path.relative_to(SOURCES.parent)} src/psfdae_paper/methods/kernel.py" in (
        path.with_name("developers.md").read_text()
    )
    spec = importlib.util.spec_from_file_location("psfdae_paper.methods.kernel", path)
    module = importlib.util.module_from_spec(spec)
    # Annotations of dataclasses are looked up in the module.
    monkeypatch.setitem(sys.modules, spec.name, module)
    spec.loader.exec_module(module)
    return module


def test_the_learned_example_resumes_and_shows_its_epochs(
    data, tmp_path, kernel_module, monkeypatch
):
    kind, seen = kernel_module.Kernel, []
    settings = kernel_module.KernelSettings(epochs=4, lr=0.1, checkpoint_seconds=0.0)
    monkeypatch.setattr(loop, "listener", lambda checkpoint: seen.append)
    assert kind.name == "kernel"
    complete = kind.fit(replace(data, checkpoint=tmp_path / "a.pt"), settings)
    history = complete.diagnostic_rows["history.csv"]
    assert seen == history and [row["epoch"] for row in history] == [1, 2, 3, 4]
    assert history[-1]["validation_mse"] < 0.9 * history[0]["validation_mse"]
    # Killed after two epochs, then begun again: the same bytes, of two more epochs.
    run_epoch = loop.Training.run_epoch

    def run_two_epochs(training):
        if len(training.history) == 2:
            raise KeyboardInterrupt
        return run_epoch(training)

    again = replace(data, checkpoint=tmp_path / "b.pt")
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(loop.Training, "run_epoch", run_two_epochs)
        kind.fit(again, settings)
    seen.clear()
    resumed = kind.fit(again, settings)
    assert [row["epoch"] for row in seen] == [3, 4]
    assert resumed.weights.tobytes() == complete.weights.tobytes()
    # Its files, and what it is for.
    noisy, _ = data.draw(data.validation, np.random.default_rng(1))
    complete.save(tmp_path / "fit.h5", {})
    loaded = kind.load(tmp_path / "fit.h5")
    truth = data.references[data.validation]
    assert mse(loaded.predict(noisy), truth).mean() < 0.5 * mse(noisy, truth).mean()
