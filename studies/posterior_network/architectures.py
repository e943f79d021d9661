"""Error against CPU seconds of training: architectures of a network for the posterior mean.

    python studies/posterior_network/architectures.py RESULTS SECONDS OUT.csv

RESULTS is the folder of a run with the stars of dataset 3. Each training of `TRAININGS` has the CPU
time SECONDS. All architectures correct the linear estimate in its own units, and have the same
stars (60 000 with all mirror images and centring errors, simulated before the clock starts), noise,
weights of the levels and course of the rate. The table has CPU seconds, steps and the MSE of fresh
stars at each noise level, and its ratio to the least possible one of the run of record (geometric
mean over the levels). One thread.
"""

from __future__ import annotations

import csv
import math
import sys
import time
from pathlib import Path

import numpy as np
import torch
from errors import STARS, read_least_errors
from torch import nn
from torch.nn import functional

from psfdae.base.files import read_product
from psfdae.methods.networks.training import Adam, Muon, use_half_precision
from psfdae.training.star_sets import noise_model
from psfdae_paper.bounds.posterior_network import FreshStars, measure_statistics
from psfdae_paper.configuration.compose import load, part
from psfdae_paper.configuration.consistency import SIMULATION
from psfdae_paper.stars.symmetry import SYMMETRIES

SIDE, STAR_COUNT, BATCH, WARM_UP = 16, 60_000, 1024, 0.05


class Block(nn.Module):
    """Residual block of a perceptron."""

    def __init__(self, layer, width, hidden, group):
        super().__init__()
        self.expand, self.reduce = layer(width, hidden), layer(hidden, width)
        self.level, self.group = nn.Linear(4, hidden // group), group
        nn.init.zeros_(next(self.reduce.parameters()))

    def forward(self, x, level):
        inner = self.expand(functional.rms_norm(x, x.shape[-1:]))
        inner = inner + self.level(level).repeat(1, self.group)
        return x + self.reduce(functional.gelu(inner))


class Perceptron(nn.Module):
    """Residual perceptron on the pixels."""

    def __init__(self, width=512, hidden=1024, blocks=4):
        super().__init__()
        self.first = nn.Linear(SIDE**2 + 4, width)
        self.blocks = nn.ModuleList(Block(nn.Linear, width, hidden, 1) for _ in range(blocks))
        self.last = nn.Linear(width, SIDE**2)
        nn.init.zeros_(self.last.weight)

    def forward(self, pixels, level):
        x = self.first(torch.cat([pixels, level], dim=1))
        for block in self.blocks:
            x = block(x, level)
        return self.last(functional.rms_norm(x, x.shape[-1:]))


FRAME = np.arange((SIDE + 1) ** 2).reshape(SIDE + 1, SIDE + 1)
IMAGES = [symmetry.image(FRAME) for symmetry in SYMMETRIES]
FILTERS = torch.from_numpy(np.stack([image[:SIDE, :SIDE].ravel() for image in IMAGES]))
NUMBERS = {image.tobytes(): number for number, image in enumerate(IMAGES)}
QUOTIENTS = torch.tensor([[NUMBERS[s.undo(i).tobytes()] for i in IMAGES] for s in SYMMETRIES])


class GroupLinear(nn.Module):
    """Group convolution as one dense matrix; `PosteriorNetwork` has a faster form."""

    def __init__(self, width, out):
        super().__init__()
        self.weight = nn.Parameter(torch.randn(out // 8, 8, width // 8) / math.sqrt(width))

    def forward(self, x):
        matrix = self.weight[:, QUOTIENTS].transpose(0, 1)
        return functional.linear(x, matrix.reshape(-1, x.shape[1]))


class GroupPerceptron(nn.Module):
    """Residual perceptron that commutes with the symmetries of a square."""

    def __init__(self, width=512, hidden=1024, blocks=4):
        super().__init__()
        self.first = nn.Parameter(torch.randn(width // 8, FRAME.size) / SIDE)
        self.level = nn.Linear(4, width // 8)
        self.blocks = nn.ModuleList(Block(GroupLinear, width, hidden, 8) for _ in range(blocks))
        self.last = nn.Parameter(torch.zeros(width // 8, FRAME.size))

    def forward(self, pixels, level):
        first, last = (
            weight[:, FILTERS].transpose(0, 1).flatten(0, 1) for weight in (self.first, self.last)
        )
        x = functional.linear(pixels, first) + self.level(level).repeat(1, 8)
        for block in self.blocks:
            x = block(x, level)
        return functional.rms_norm(x, x.shape[-1:]) @ last


class Attention(nn.Module):
    """Block of a transformer."""

    def __init__(self, width, heads):
        super().__init__()
        self.heads, self.inputs = heads, nn.Linear(width, 3 * width)
        self.mix, self.expand = nn.Linear(width, width), nn.Linear(width, 2 * width)
        self.reduce = nn.Linear(2 * width, width)
        for layer in (self.mix, self.reduce):
            nn.init.zeros_(layer.weight)

    def forward(self, x):
        inputs = self.inputs(functional.rms_norm(x, x.shape[-1:]))
        parts = inputs.unflatten(2, (3, self.heads, -1)).permute(2, 0, 3, 1, 4)
        mixed = functional.scaled_dot_product_attention(*parts)
        x = x + self.mix(mixed.transpose(1, 2).flatten(2))
        return x + self.reduce(functional.gelu(self.expand(functional.rms_norm(x, x.shape[-1:]))))


class Transformer(nn.Module):
    """Transformer on 16 patches of 4 × 4 pixels."""

    def __init__(self, width=128, heads=4, blocks=4):
        super().__init__()
        self.first, self.level = nn.Linear(16, width), nn.Linear(4, width)
        self.place = nn.Parameter(0.5 * torch.randn(16, width))
        self.blocks = nn.Sequential(*(Attention(width, heads) for _ in range(blocks)))
        self.last = nn.Linear(width, 16)
        nn.init.zeros_(self.last.weight)

    def forward(self, pixels, level):
        patches = pixels.view(-1, 4, 4, 4, 4).transpose(2, 3).reshape(-1, 16, 16)
        x = self.blocks(self.first(patches) + self.place + self.level(level)[:, None])
        outputs = self.last(functional.rms_norm(x, x.shape[-1:]))
        return outputs.view(-1, 4, 4, 4, 4).transpose(2, 3).reshape(-1, SIDE**2)


class UNet(nn.Module):
    """Convolutions on three scales, with two dense layers on the coarsest one."""

    def __init__(self, width=32, hidden=512):
        super().__init__()
        self.first = nn.Conv2d(5, width, 3, padding=1)
        self.down = nn.ModuleList(nn.Conv2d(a * width, 2 * a * width, 3, 2, 1) for a in (1, 2))
        self.dense = nn.Sequential(
            nn.Linear(64 * width, hidden), nn.GELU(), nn.Linear(hidden, 64 * width)
        )
        self.up = nn.ModuleList(nn.Conv2d(a * width, 2 * a * width, 1) for a in (4, 2))
        self.same = nn.ModuleList(nn.Conv2d(a * width, a * width, 3, padding=1) for a in (2, 1))
        self.last = nn.Conv2d(width, 1, 3, padding=1)
        nn.init.zeros_(self.last.weight)

    def forward(self, pixels, level):
        levels = level[:, :, None, None].expand(-1, -1, SIDE, SIDE)
        image = torch.cat([pixels.view(-1, 1, SIDE, SIDE), levels], dim=1)
        scales = [functional.gelu(self.first(image.to(memory_format=torch.channels_last)))]
        for layer in self.down:
            scales.append(functional.gelu(layer(scales[-1])))
        x = scales.pop()
        x = x + self.dense(x.flatten(1)).view_as(x)
        for up, same in zip(self.up, self.same, strict=True):
            x = functional.pixel_shuffle(up(x), 2) + scales.pop()
            x = x + functional.gelu(same(x))
        return self.last(x).flatten(1)


ARCHITECTURES = {
    "perceptron": Perceptron,
    "group perceptron": GroupPerceptron,
    "transformer": Transformer,
    "U-Net": UNet,
}


TRAININGS = [
    ("perceptron", "adam", 0.0005),
    ("perceptron", "muon", 0.001),
    ("group perceptron", "adam", 0.001),
    ("group perceptron", "muon", 0.003),
    ("U-Net", "adam", 0.001),
    ("transformer", "adam", 0.001),
]
"""Architecture, optimiser and maximum of the learning rate."""


def make_optimiser(network, optimiser, lr):
    """Return Adam, or Muon for the weights of the blocks and Adam for the others."""
    weights = [*network.parameters()]
    if optimiser == "adam":
        return Adam(weights, lr=lr, fused=True)
    inner = [w for name, w in network.named_parameters() if "blocks" in name and w.ndim > 1]
    others = [w for w in weights if all(w is not x for x in inner)]
    return Muon([{"params": others}, {"params": inner, "orthogonal": True}], lr=lr, fused=True)


def main(results, seconds, out):
    """Train all architectures, and write the errors on the way."""
    torch.set_num_threads(1)
    config = load(["dataset=dataset3"])
    simulation = part(SIMULATION, config.model_dump())
    product = read_product(Path(results) / STARS["dataset3"], "stars", ("field_index",))
    fields = np.isin(np.arange(121), product["field_index"])
    stars, fresh = (
        FreshStars.simulate(simulation, n, m, fields) for n, m in ((0, STAR_COUNT), (1, 4000))
    )
    with Path(out).open("w", newline="") as file:
        levels = [f"mse_{level:g}" for level in config.noise.levels]
        writer = csv.writer(file)
        writer.writerow(
            ["architecture", "optimiser", "lr", "cpu_s", "steps", *levels, "over_least"]
        )
        for name, optimiser, lr in TRAININGS:
            torch.manual_seed(0)
            steps = make_optimiser(network := ARCHITECTURES[name](), optimiser, lr)
            for row in train(network, steps, lr, float(seconds), (config, stars, fresh)):
                writer.writerow([name, optimiser, lr, *row])
                file.flush()


def train(network, steps, lr, seconds, source):
    """Train for some CPU seconds, and yield time, steps and errors on the way."""
    config, stars, fresh = source
    noise, rng = noise_model(config), np.random.default_rng(0)
    levels, least = np.array(config.noise.levels), read_least_errors("dataset3").value
    # The linear estimate, and the stars on which errors are measured.
    statistics = measure_statistics(stars.draw(40_000, rng), levels, config.grid.points)
    mean, axes, variance = (
        torch.from_numpy(statistics[name].astype(np.float32))
        for name in ("mean", "axes", "variance")
    )
    truth = fresh.draw(4096, rng)[0]
    tests = [noise.draw(truth, level, rng) for level in levels]

    def restore(noisy, level):
        sky = ((noise.kappa * level) ** 2 + noise.kappa * level / 100 / SIDE**2)[:, None]
        deviation, total = (noisy - mean) @ axes, variance + sky
        scaled = (level.log() - math.log(levels.mean())) / math.log(levels.max() / levels.min())
        powers = torch.stack([scaled**power for power in range(4)], dim=1)
        with use_half_precision():
            outputs = network((deviation / total.sqrt()) @ axes.T, powers).float()
        correction = (variance * sky / total).sqrt() * (outputs @ axes)
        return mean + (variance / total * deviation + correction) @ axes.T

    @torch.inference_mode()
    def measure():
        errors = []
        for level, noisy in zip(levels, tests, strict=True):
            psf = restore(torch.from_numpy(noisy), torch.full((len(noisy),), float(level)))
            errors.append(float(((psf.numpy() - truth) ** 2).mean()))
        ratio = np.exp(np.mean(np.log(errors / least[levels].to_numpy())))
        return [*(f"{error:.4g}" for error in errors), f"{ratio:.3f}"]

    weights = [*network.parameters()]
    start, paused, step, latest, report_s = time.process_time(), 0.0, 0, None, 20.0
    while (clock := time.process_time() - start - paused) < seconds:
        done = clock / seconds
        for group in steps.param_groups:
            group["lr"] = lr * min(done / WARM_UP + 1e-3, (1 - done) / (1 - WARM_UP))
        clean = stars.draw(BATCH, rng)[0]
        number = rng.integers(len(levels), size=BATCH)
        noisy = noise.draw_gaussian(clean, levels[number], rng)
        level = torch.from_numpy(levels[number].astype(np.float32))
        psf = restore(torch.from_numpy(noisy), level)
        errors = ((psf - torch.from_numpy(clean)) ** 2).mean(dim=1)
        mean_errors = np.array([errors.detach().numpy()[number == n].mean() for n in range(4)])
        latest = mean_errors if latest is None else 0.98 * latest + 0.02 * mean_errors
        loss = (errors / torch.from_numpy(latest[number].astype(np.float32))).mean()
        steps.zero_grad(set_to_none=True)
        loss.backward()
        nn.utils.clip_grad_norm_(weights, 1.0)
        steps.step()
        step += 1
        if clock > report_s:
            pause = time.process_time()
            yield [f"{clock:.0f}", step, *measure()]
            report_s *= 1.6
            paused += time.process_time() - pause
    yield [f"{seconds:.0f}", step, *measure()]


if __name__ == "__main__":
    main(*sys.argv[1:])
