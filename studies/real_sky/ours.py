"""`psfdae train`, with another fifth of the stars held out: `ours.py SPLIT …`, SPLIT 0 to 4.

Everything after SPLIT is the command line of `psfdae train`; with 0 it is that command.
"""

import sys

import numpy as np

from psfdae.commands.cli import main
from psfdae.training import stars

split, *words = sys.argv[1:]
lattice = stars.star_grid
# Each fifth is a residue of the lattice, so that moving it holds out the next one.
stars.star_grid = lambda position: lattice(position) + np.array([int(split), 0])
main(["train", *words])
