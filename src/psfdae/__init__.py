"""psfdae: point spread function modelling with a denoising autoencoder.

The package follows the science: `optics` turns wavefronts into pixels, `stars`
turns pixels into noisy star images, `models` learns the point spread function
from them, `evaluation` measures how well. `stages` binds one step of each to
files; the command line and the Snakemake workflow call stages only.
"""

__version__ = "0.1.0"
