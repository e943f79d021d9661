"""The PSF over an image from the file of any program."""

from __future__ import annotations

from pathlib import Path

from psfdae.denoise.bundle import name_foreign_format
from psfdae.denoise.star_model import StarModel
from psfdae.psf.exchange import GridField, PsfexField
from psfdae.psf.interface import FieldPsfs


def load_field(path: Path) -> FieldPsfs:
    """Return the PSF over an image from a model of psfdae, or from a file of another program.

    These are .psf of PSFEx, STDPSF, and grids of STPSF and photutils.

    Raises
    ------
    Error
        If the file cannot be read or is something else.
    """
    kind = name_foreign_format(path)
    if kind == "PSFEx":
        return PsfexField(path)
    return GridField(path) if kind in ("STDPSF", "STPSF") else StarModel.load(path)
