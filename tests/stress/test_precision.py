"""Single precision, from the kernel to the metrics."""

import copy

import numpy as np
import pytest
import torch

from psfdae.optics.wavefronts import seidel_wavefronts
from psfdae_paper.stars.fields import relative_field
from psfdae_paper.stars.scenes import template_wavefronts
from stress.bench import changed, noisy_stars, propagation, rounding_of

pytestmark = pytest.mark.slow
EPS = float(np.finfo(np.float32).eps)  # relative spacing of single precision


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
    # A phase of W waves is rounded by 2πW·ε; the sum over the pupil can only average it.
    bound = 2 * np.pi * max(float(np.abs(source.slopes()).max()), 1.0) * EPS
    change = (np.abs(single - double) / double.max(axis=(1, 2), keepdims=True)).max()
    case = f"kernel in single precision, scene {number}"
    record.at_most(case, "largest pixel difference over peak", change, bound)


def test_network(bench, record):
    """The same weights in single and in double precision."""
    double = copy.deepcopy(bench.network).double()
    noisy = noisy_stars(bench, 64)
    images = torch.from_numpy(noisy.astype(np.float32))[:, None] * bench.factor
    with torch.inference_mode():
        exact = double(images.double())
        change = (bench.network(images).double() - exact).abs().max() / exact.abs().max()
    case, what = "DAE in single precision", "largest difference over largest output"
    record.at_most(case, what, change, rounding_of(bench.config.dae))
