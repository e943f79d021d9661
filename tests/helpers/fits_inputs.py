"""FITS files of stars for the tests, and their observation."""

from __future__ import annotations

import bz2
import gzip
import io
import lzma
import zipfile
from pathlib import Path

import numpy as np
from astropy.io import fits

from psfdae.image import opening
from psfdae.image.image_input import ImageInput
from psfdae_paper.stars import example


def open_observation(path, stamp_px, margin=0, **stated):
    return opening.open_observation(ImageInput(Path(path), **stated), stamp_px, margin)


def write_cube(path, stamps, compress=False, **cards):
    example.write_cube(path, stamps, **cards)
    if compress:
        pack(path)


def write_field(path, catalogue, stamps, x, y, shape, background=0.0, compress=False, **cards):
    """Stamps added to an image, with a catalogue of their 0-based positions."""
    image = np.zeros(shape) + background
    example.add_stamps(image, stamps, x, y)
    example.write_field(path, catalogue, image, x, y, **cards)
    if compress:
        pack(path)


def pack(path):
    """Compress the image of a file in tiles of up to 100 rows."""
    image = fits.getdata(path)
    tile = (min(len(image), 100), *image.shape[1:])
    packed = fits.CompImageHDU(image, fits.getheader(path), tile_shape=tile)
    fits.HDUList([fits.PrimaryHDU(), packed]).writeto(path, overwrite=True)


def _zip(raw):
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as packed:
        packed.writestr("a.fits", raw)
    return out.getvalue()


PACK = {"gz": gzip.compress, "bz2": bz2.compress, "xz": lzma.compress, "zip": _zip}
