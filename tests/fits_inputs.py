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
from astropy.table import Table

from psfdae.image.observation import Source
from psfdae_paper.stars import example


def open_observation(path, stamp_px, margin=0, **stated):
    return Source(Path(path), **stated).open(stamp_px, margin)


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

GOOD = {
    "cube": ["cube.fits", "cube16.fits", "cube.fz", *(f"cube.{pack}" for pack in PACK)],
    "image": ["image.fits", "image.fz", "GZIP_1.fz", "GZIP_2.fz"],
    "catalogue": ["s.csv", "sky.csv", "s.fits", "s.ecsv", "s.cat"],
}


def write_good(folder):
    """Cubes, images and catalogues of every kind, as `GOOD` lists them."""
    rng = np.random.default_rng(1)
    grid = np.arange(16) - 8
    star = np.exp(-(grid[:, None] ** 2 + grid**2) / 8.0)
    stamps = rng.poisson(100 + 400 * star, (12, 16, 16)).astype(float)
    x, y = rng.uniform(0, 60, 12), rng.uniform(0, 40, 12)
    write_cube(folder / "cube.fits", stamps, PIXSCALE=0.1)
    write_cube(folder / "cube16.fits", stamps.astype(np.uint16), PIXSCALE=0.1)
    write_cube(folder / "cube.fz", stamps, compress=True, PIXSCALE=0.1)
    for name, compress in (("image.fits", False), ("image.fz", True)):
        options = {"shape": (40, 60), "pixel_scale_arcsec": 0.1, "compress": compress}
        write_field(folder / name, folder / "s.csv", 400 * stamps / 500, x, y, **options)
    for pack, packed in PACK.items():
        (folder / f"cube.{pack}").write_bytes(packed((folder / "cube.fits").read_bytes()))
    for coding in ("GZIP_1", "GZIP_2"):
        tiles = fits.CompImageHDU(rng.poisson(9, (40, 60)), compression_type=coding)
        fits.HDUList([fits.PrimaryHDU(), tiles]).writeto(folder / f"{coding}.fz")
    table = Table.read(folder / "s.csv")
    table["name"] = [f"star {k}" for k in range(12)]
    table["ra", "dec"].write(folder / "sky.csv")
    table.write(folder / "s.fits")
    table.write(folder / "s.ecsv")
    lines = [f"# {k + 1} {name}" for k, name in enumerate(("NUMBER", "X_IMAGE", "Y_IMAGE"))]
    lines += [f"{row['id']} {row['X_IMAGE']} {row['Y_IMAGE']}" for row in table]
    (folder / "s.cat").write_text("\n".join(lines))
