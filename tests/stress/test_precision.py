"""Single precision, from the kernel to the metrics."""

import copy

import numpy as np
import pytest
import torch
from sklearn.decomposition import PCA

from psfdae.metrics import mse, ssim
from psfdae.optics.wavefronts import seidel_wavefronts
from psfdae_paper.stars.fields import relative_field
from psfdae_paper.stars.framing import normalise_flux
from psfdae_paper.stars.scenes import template_wavefronts
from stress.bench import changed, propagation, rounding_of, stamp_mse, subspace_angle

EPS = float(np.finfo(np.float32).eps)  # relative spacing of single precision


@pytest.mark.slow
@pytest.mark.parametrize(("scene", "number"), [("seidel", 1), ("turbulence", 2)])
def test_kernel(bench, record, scene, number):
    """complex64 against complex128 on the same grid."""
    config = getattr(bench, scene).config
    if scene == "seidel":
        field = relative_field(config.grid)
        some = field[:: max(1, len(field) // 12)]
        source = seidel_wavefronts(np.tile(config.wavefront.coefficients, (len(some), 1)), some)
    else:
        source = template_wavefronts(changed(config, grid={"points": 3}))
    reach, stamp_px = config.framing.search_px, config.framing.stamp_px
    kernels = [propagation(config, source, reach, precision=p) for p in ("complex64", "complex128")]
    offset = kernels[0].brightest()
    single, double = (kernel.stamps(stamp_px, offset) for kernel in kernels)
    case, error = f"kernel in single precision, scene {number}", stamp_mse(single, double)
    record.at_most(case, "MSE of normalised stamps", error, bench.budget(config))
    # A phase of W waves is rounded by 2πW·ε; the sum over the pupil can only average it.
    bound = 2 * np.pi * max(float(np.abs(source.slopes()).max()), 1.0) * EPS
    change = (np.abs(single - double) / double.max(axis=(1, 2), keepdims=True)).max()
    record.at_most(case, "largest pixel difference over peak", change, bound)
    rounded, exact = (normalise_flux(stamps)[0] for stamps in (double.astype(np.float32), double))
    # Pairwise summation of P positive terms rounds log2 P times, the quotient once.
    case = f"flux normalisation in single precision, scene {number}"
    bound = (2 + np.log2(double[0].size)) * EPS
    record.close(case, "largest relative difference", rounded / exact, 1, bound)


@pytest.mark.slow
def test_principal_components(bench, record):
    """The subspace of the components in single and in double precision."""
    count = bench.config.baseline.components
    images = noisy_stars(bench).reshape(len(bench.seidel.images), -1)
    fit = PCA(count, svd_solver="full").fit
    single, double = (fit(images.astype(t)).components_ for t in (np.float32, np.float64))
    spectrum = np.linalg.svd(images - images.mean(axis=0), compute_uv=False)
    # Davis & Kahan 1970: the angle is at most the perturbation over the gap; the singular
    # values of rounded data move by their norm times ε times the root of the size.
    gap = (spectrum[count - 1] - spectrum[count]) / spectrum[0]
    bound, angle = np.sqrt(images.shape[0]) * EPS / gap, subspace_angle(single, double)
    what = "sine of the largest angle between the subspaces"
    record.at_most("PCA in single precision", what, angle, bound)


@pytest.mark.slow
def test_network(bench, record):
    """The same weights in single and in double precision."""
    double = copy.deepcopy(bench.network).double()
    images = torch.from_numpy(noisy_stars(bench)[:64].astype(np.float32))[:, None] * bench.factor
    with torch.inference_mode():
        exact = double(images.double())
        change = (bench.network(images).double() - exact).abs().max() / exact.abs().max()
    case, what = "DAE in single precision", "largest difference over largest output"
    record.at_most(case, what, change, rounding_of(bench.config.dae))


def test_metrics(bench, record):
    """MSE and SSIM of images rounded to single precision."""
    truth, noisy = bench.seidel.images.astype(np.float64), noisy_stars(bench)
    rounded, exact = noisy.astype(np.float32), mse(noisy, truth)
    # ε/2 per pixel, relative to the pixel, enters the squared difference twice.
    bound, ratio = EPS * np.abs(noisy).max() / np.sqrt(exact.min()), mse(rounded, truth) / exact
    record.close("MSE in single precision", "largest relative difference", ratio, 1, bound)
    first, second = (ssim(x, truth, bench.config.evaluation.data_range) for x in (rounded, noisy))
    # SSIM changes by at most the relative change of its windows' second moments.
    record.close("SSIM in single precision", "largest difference", first, second, 10 * EPS)


def noisy_stars(bench):
    """Noisy stars at the band's smallest level in double precision."""
    images = bench.seidel.images
    sigma = np.sqrt(bench.noise.variance(images.astype(np.float64), bench.level))
    return images + sigma * bench.stream("precision").standard_normal(images.shape)
