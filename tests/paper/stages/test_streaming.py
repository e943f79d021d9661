"""Simulation and inference a piece at a time, and the search for the brightest pixel."""

from __future__ import annotations

import os
import shutil

import h5py
import numpy as np
import pytest

import speed
from command_line import psfdae
from measure import isolate, measure_command
from prediction import make_cube
from psfdae.base.files import (
    Column,
    Empty,
    ProductError,
    read_product,
    stream_product,
    write_product,
)
from psfdae_paper.configuration.compose import compose, load_stage
from psfdae_paper.configuration.consistency import SIMULATION, STATIC
from psfdae_paper.stages import stars
from psfdae_paper.stars.framing import Propagation, brightest_pixel
from psfdae_paper.stars.scenes import template_wavefronts
from workflow_runs import captured, environment

CHEAP = (
    *("grid.points=3", "optics.pupil_samples=[40,80]", "optics.threads=1"),
    *("wavefront.spherical=0.05", "wavefront.coma=0.2", "wavefront.astigmatism=0.2"),
    *("wavefront.field_curvature=0.1", "stars.search_px=6", "framing.search_px=6"),
)


@pytest.fixture(scope="module")
def cheap(tmp_path_factory):
    """Config of 50 stars with weak aberrations on small pupils, and their templates."""
    path = tmp_path_factory.mktemp("cheap") / "templates.h5"
    stars.templates(load_stage(STATIC, CHEAP), path)
    return load_stage(SIMULATION, [*CHEAP, "stars.count=50"]), path


def test_streamed_product_is_that_of_one_write(tmp_path):
    values = np.random.default_rng(1).random((70, 5, 5))
    fixed = Column(np.arange(70), "1", "number")
    columns = {"a": Column(values, "m", "x"), "n": fixed}
    write_product(tmp_path / "one.h5", "k", columns, {"seed": 1})
    empty = Empty((70, 5, 5), float, "m", "x")
    columns = {"a": empty, "n": fixed, "b": empty}
    for name in ("two.h5", "three.h5"):
        with stream_product(tmp_path / name, "k", columns, {"seed": 1}) as data:
            for start in range(0, 70, 32):
                data["a"][start : start + 32] = values[start : start + 32]
    written_at_once, two = (read_product(tmp_path / name, "k") for name in ("one.h5", "two.h5"))
    assert (written_at_once["a"] == two["a"]).all() and (written_at_once["n"] == two["n"]).all()
    assert (two["b"] == two["a"]).all()  # the same empty column is a link
    assert written_at_once.config == two.config
    assert (tmp_path / "two.h5").read_bytes() == (tmp_path / "three.h5").read_bytes()
    with h5py.File(tmp_path / "one.h5") as single_write, h5py.File(tmp_path / "two.h5") as streamed:
        assert dict(single_write["a"].attrs) == dict(streamed["a"].attrs)
        assert streamed["a"].fletcher32


def test_unfilled_or_failed_stream_leaves_no_file(tmp_path):
    columns = {"a": Empty((300, 64, 64), float, "1", "x")}
    with (
        pytest.raises(ProductError, match="array 'a' was not filled"),
        stream_product(tmp_path / "p.h5", "k", columns, {}) as data,
    ):
        data["a"][:100] = 1
    with pytest.raises(KeyError), stream_product(tmp_path / "p.h5", "k", columns, {}):
        raise KeyError
    assert list(tmp_path.iterdir()) == []


def test_stars_do_not_depend_on_how_many_are_made_at_a_time(cheap, tmp_path, monkeypatch):
    config, fixed = cheap
    stars.stars(config, fixed, tmp_path / "whole.h5")
    monkeypatch.setattr(stars, "STARS_AT_A_TIME", 17)
    stars.stars(config, fixed, tmp_path / "pieces.h5")
    at_once, pieces = (read_product(tmp_path / f"{n}.h5", "stars") for n in ("whole", "pieces"))
    for name in ("field_index", "jitter", "peak", "seidel", "pupil_samples"):
        assert (at_once[name] == pieces[name]).all(), name
    for name in ("template", "realisation", "energy"):
        assert pieces[name] == pytest.approx(at_once[name], rel=1e-5, abs=1e-8), name


def test_search_is_exact_for_large_pixels():
    """Scene 2's pixel is 1.6 λ/D wide: point samples would shift its brightest pixels."""
    config = load_stage(STATIC, ["dataset=dataset7", "optics.threads=1"])
    source = template_wavefronts(config)
    # Measuring 400 slopes takes longer than the test; the largest grid serves all.
    source.slopes = lambda: np.zeros((len(source), 2, 2))  # type: ignore[method-assign]
    optics = config.optics.model_copy(update={"pupil_samples": [222]})
    sampled_stars = np.arange(4, 400, 39)
    settings = (source, config.telescope)
    peak = Propagation(*settings, optics, config.framing, 12).brightest(sampled_stars)
    fine = optics.model_copy(update={"precision": "complex128"})
    exact = Propagation(*settings, fine, config.framing, 12)
    images = exact.stamps(24, np.zeros((sampled_stars.size, 2), dtype=int), sampled_stars)
    expected = np.array([brightest_pixel(image, config.framing.tie) for image in images]) - 12
    assert (peak == expected).all()


@pytest.fixture(scope="module")
def memory(cheap, tmp_path_factory):
    """Memory that simulation and prediction of 4000 and of 20 000 stars take, MB."""
    folder = tmp_path_factory.mktemp("memory")
    tree = dict(compose([*CHEAP, "dae.kernels=[3,3]", "dae.widths=[2]"]))
    stars, cube, bundle = (folder / name for name in ("stars.h5", "stars.fits", "m.safetensors"))
    peak_memory = {"simulate": [], "predict": []}
    for count in (4000, 20_000):
        tree["stars"] = {**tree["stars"], "count": count}
        costs = {
            "simulate": isolate(1, measure_command, ["stars", "--templates", cheap[1]], stars, tree)
        }
        speed.write_untrained_bundle(tree, stars, bundle)
        make_cube(tree, stars, count, cube)
        words = ["predict", cube, "--model", bundle, "--threads", 1, "--overwrite", "--quiet"]
        costs["predict"] = isolate(1, measure_command, words, folder / "psf.fits")
        for job, cost in costs.items():
            peak_memory[job].append((cost["peak_b"] - cost["resting_b"]) / 2**20)
    return peak_memory


@pytest.mark.slow
@pytest.mark.parametrize("job", ["simulate", "predict"])
def test_memory_does_not_grow_with_the_stars(memory, job):
    few_stars, many_stars = memory[job]
    # Images alone would need 16 000 × 3 kB = 48 MB more; the drawn numbers 100 bytes a star.
    assert many_stars - few_stars < 20


@pytest.mark.slow
@pytest.mark.skipif(
    shutil.which("taskset") is None or os.cpu_count() < 2,
    reason="needs two CPUs and a way to leave out one",
)
def test_number_of_cpus_does_not_change_a_product(tmp_path):
    """Two threads of linear algebra, as configured, on two CPUs and on one."""
    sizes = ["grid.points=3", "stars.count=48", "optics.threads=2"]
    templates = tmp_path / "templates.h5"
    assert (
        psfdae("paper", "templates", "--out", templates, "dataset=dataset3", *sizes).exit_code == 0
    )
    products = []
    for cpus, threads in (("0,1", "2"), ("0", "1")):
        out = tmp_path / f"{threads}.h5"
        line = ["taskset", "--cpu-list", cpus, "psfdae", "paper", "stars", "--templates", templates]
        variables = environment(OMP_NUM_THREADS=threads)
        run = captured([*line, "--out", out, *sizes], env=variables)
        assert run.returncode == 0, run.stderr
        products.append(out.read_bytes())
    assert products[0] == products[1]
