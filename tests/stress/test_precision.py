"""The kernel in single precision."""

import numpy as np
import pytest

from psfdae.optics.wavefronts import seidel_wavefronts
from psfdae_paper.stars.fields import relative_field
from psfdae_paper.stars.scenes import template_wavefronts
from stress.bench import changed, propagation

pytestmark = pytest.mark.slow
EPS = float(np.finfo(np.float32).eps)  # relative spacing of single precision


@pytest.mark.parametrize(("scene", "number"), [("seidel", 1), ("turbulence", 2)])
def test_kernel(bench, record, scene, number):
    """complex64 against complex128 on the same grid."""
    config = getattr(bench, scene).config
    if scene == "seidel":
        field = relative_field(config.grid)
        sampled_fields = field[:: max(1, len(field) // 12)]
        source = seidel_wavefronts(
            np.tile(config.wavefront.coefficients, (len(sampled_fields), 1)), sampled_fields
        )
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
