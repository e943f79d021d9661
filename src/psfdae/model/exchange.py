"""PSFs at places of an image in files of other programs: PSFEx, STPSF, STDPSF, photutils.

A model of PSFEx (Bertin 2011, ASP Conf. Ser. 442, 435) is a polynomial in the position, of which
each term has an image with samples of `PSF_SAMP` pixels, to be interpolated by Lanczos' kernel.
STDPSF (Anderson 2016, WFC3 ISR 2016-12) and STPSF (`psf_grid`) are cubes of PSFs at places of a
grid. In all of them, as in psfdae, a value is what a whole pixel there would get.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from psfdae.files import atomic_path, write_fits
from psfdae.image.errors import ascii_line, reading
from psfdae.image.fits_file import BLOCK_BYTES, Card, open_hdus, plain_file
from psfdae.model.field_psfs import FieldPsfs, PredictionError
from psfdae.model.psf_model import load_model
from psfdae.moments import measure_shapes
from psfdae.version import __version__

PSFEX, STDPSF = ".psf", ".stdpsf.fits"
"""Ends of names: what a file is written as, or read as."""

LANCZOS = 4  # order of the kernel, as of PSFEx
GRID_SAMPLES, PSFEX_SAMPLES = 4, 8  # values per pixel and axis
STDPSF_PLACES = 99  # along an axis, at most
LARGEST_PSF = 1025  # samples, and pixels, along an axis of a file of PSFEx
HIGHEST_ORDER = 12
NO_WIDTH = 1.0  # of a field in pixels, whose places nobody knows
AT_ONCE = 2**20  # values of PSFs that are made before they are written


def load_field(path: Path) -> FieldPsfs:
    """The PSF at every place of an image: a bundle of psfdae, or a .psf file of PSFEx.

    Raises
    ------
    Error
        If the file cannot be read or is something else.
    """
    return PsfexField(path) if path.suffix == PSFEX else load_model(path)


class PsfexField(FieldPsfs):
    """A model of PSFEx; beyond the stars it was made of, the PSF is that of their edge.

    Parameters
    ----------
    path : Path
        A .psf file, of one extension, whose polynomial is in the position alone.

    Raises
    ------
    ObservationError
        If the file is missing, damaged or no FITS file.
    PredictionError
        If it is not such a model.
    """

    image_px = None

    def __init__(self, path: Path) -> None:
        self.path, self.name = path, path.stem
        file = plain_file(path)
        with reading(path), open_hdus(file) as hdus:
            tables = [hdu for hdu in hdus if hdu.name == "PSF_DATA"]
            found = [(dict(t.header), np.array(t.data["PSF_MASK"][0], float)) for t in tables]
        if len(found) != 1:
            self._refuse(f"{len(found)} tables PSF_DATA, expected one, as PSFEx writes it")
        try:
            self._read(*found[0])
        except (KeyError, TypeError, ValueError) as error:
            if isinstance(error, PredictionError):
                raise
            self._refuse(f"no model of PSFEx ({error})")

    def _refuse(self, why: str) -> NoReturn:
        raise PredictionError(f"{self.path}: {why}")

    def _read(self, header: Mapping[str, Any], mask: np.ndarray) -> None:
        axes = int(header["POLNAXIS"])
        names = [str(header[f"POLNAME{i + 1}"]).strip() for i in range(axes)]
        at_place = len(names) == 2 and all(
            name.startswith(axis) and name.endswith("_IMAGE")
            for axis, name in zip("XY", names, strict=True)
        )
        if names and not (at_place and int(header["POLNGRP"]) == 1):
            self._refuse(f"changes with {', '.join(names)}; expected X_IMAGE and Y_IMAGE")
        self._order = order = int(header["POLDEG1"]) if names else 0
        self.step = float(header["PSF_SAMP"])
        zero, width = np.full(2, 0.0), np.full(2, NO_WIDTH)
        if names:
            zero, width = (
                np.array([float(header[f"{key}{i}"]) for i in (1, 2)])
                for key in ("POLZERO", "POLSCAL")
            )
        mask = mask.reshape(-1, *mask.shape[-2:])
        powers = psfex_powers(order) if order <= HIGHEST_ORDER else []
        self.terms: np.ndarray = np.array(powers)
        side = min(mask.shape[-2:])
        usable = (
            0 <= order <= HIGHEST_ORDER
            and len(self.terms) == len(mask)
            and 1 < side <= max(mask.shape[-2:]) <= LARGEST_PSF
            and 0.01 < self.step <= 10
            and side * self.step <= LARGEST_PSF
            and np.isfinite([zero, width]).all()
            and (width > 0).all()
            and np.isfinite(mask).all()
        )
        if not usable:
            self._refuse("its polynomial, sampling, scales or pixels are out of range")
        self.basis, self.stamp_px = mask, 2 * max(1, int(side * self.step / 2))
        self.zero, self.width = zero - 1.0, width

    @property
    def order(self) -> int:
        return self._order

    @cached_property
    def sha256(self) -> str:
        return hashlib.sha256(self.path.read_bytes()).hexdigest()

    def field_range(self) -> tuple[np.ndarray, np.ndarray]:
        if (self.width <= NO_WIDTH).any():
            raise PredictionError(f"the model {self.name!r} knows no places of its stars")
        return self.zero - self.width / 2, self.zero + self.width / 2

    def check_scale(self, pixel_scale_arcsec: float | None, what: str) -> None:
        """Files of PSFEx do not say how large pixels are."""

    def _drawn(self, place: np.ndarray, oversampling: int) -> np.ndarray:
        place = place[:, :2]  # neither magnitude nor colour
        u, v = np.clip((place - self.zero) / self.width, -0.5, 0.5).T
        sampled = np.tensordot(np.stack([u**i * v**j for i, j in self.terms], 1), self.basis, 1)
        phase = place - np.floor(place + 0.5)
        count = self.stamp_px if oversampling == 1 else oversampling * self.stamp_px + 1
        axis = (np.arange(count) - oversampling * (self.stamp_px // 2)) / oversampling
        whole = np.arange(self.stamp_px) - self.stamp_px // 2  # of a star in the middle
        inside = self._interpolated(sampled, whole, np.zeros_like(phase)).sum(axis=(1, 2))
        return np.asarray(self._interpolated(sampled, axis, phase) / inside[:, None, None])

    def _interpolated(self, sampled: np.ndarray, axis: np.ndarray, phase: np.ndarray) -> np.ndarray:
        """Images (n, m, m) on an axis (m,) of samples (n, h, w), moved by phases (n, 2), x, y."""
        columns, rows = (
            _lanczos((axis - phase[:, i, None]) / self.step, sampled.shape[2 - i]) for i in (0, 1)
        )
        return np.asarray(rows @ sampled @ columns.transpose(0, 2, 1))


def _lanczos(place: np.ndarray, count: int) -> np.ndarray:
    """Weights (…, count) of samples about the middle one, count//2, at places (…) from it."""

    def kernel(t: np.ndarray) -> np.ndarray:
        return np.where(np.abs(t) < LANCZOS, np.sinc(t) * np.sinc(t / LANCZOS), 0.0)

    # The sum over all samples, were there no edge, is nearly 1, and shall be.
    fraction = (place - np.floor(place))[..., None]
    total = kernel(fraction - np.arange(1 - LANCZOS, LANCZOS + 1)).sum(axis=-1, keepdims=True)
    return np.asarray(kernel(place[..., None] - (np.arange(count) - count // 2)) / total)


def psfex_powers(order: int) -> list[tuple[int, int]]:
    """Powers of x and y in the terms of PSFEx's polynomial, in their order."""
    return [(i, j) for j in range(order + 1) for i in range(order + 1 - j)]


def _require_middle(path: Path, model: FieldPsfs, oversampling: int) -> None:
    """Refuse PSFs without a middle sample, which other programs take for their centre."""
    if oversampling == 1 and model.stamp_px % 2 == 0:
        raise PredictionError(
            f"{path}: stamps of {model.stamp_px} px have no middle pixel; --oversampling 2 or more"
        )


def write_psfex(path: Path, model: FieldPsfs, oversampling: int) -> float:
    """Write a model for PSFEx's readers; how far it is off, over the brightest value.

    Parameters
    ----------
    path : Path
    model : FieldPsfs
    oversampling : int
        Samples per pixel and axis.

    Raises
    ------
    PredictionError
        If the model knows no PSF of a place, or the PSF would have no middle sample.
    """
    from astropy.io import fits

    order = model.order
    _require_middle(path, model, oversampling)
    try:
        low, high = model.field_range()
        places = np.rint(model.grid(2 * order + 3, 2 * order + 3))
    except PredictionError:
        if order:
            raise
        low, high, places = np.zeros(2), np.zeros(2), np.zeros((1, 2))
    zero, width = (low + high) / 2, np.maximum(high - low, NO_WIDTH)
    powers = psfex_powers(order)
    u, v = ((places - zero) / width).T
    terms = np.stack([u**i * v**j for i, j in powers], axis=1)
    x, y = places.T
    psfs = model.psf_at(x, y, oversampling)
    basis = np.tensordot(np.linalg.pinv(terms), psfs, 1)
    off = float(np.abs(np.tensordot(terms, basis, 1) - psfs).max() / psfs.max())
    size = basis.shape[-1]
    table = fits.BinTableHDU.from_columns(
        [
            fits.Column(
                "PSF_MASK",
                f"{basis.size}E",
                dim=f"({size}, {size}, {len(basis)})",
                array=basis[None].astype(np.float32),
            )
        ],
        name="PSF_DATA",
    )
    stars = {"LOADED": 0, "ACCEPTED": 0, "CHI2": 1.0}
    said: dict[str, str | float] = {**stars, "POLNAXIS": 2}
    for i, axis in enumerate("XY"):
        said[f"POLGRP{i + 1}"] = 1
        said[f"POLNAME{i + 1}"] = f"{axis}_IMAGE"
        said[f"POLZERO{i + 1}"] = float(zero[i] + 1.0)
        said[f"POLSCAL{i + 1}"] = float(width[i])
    middle = psfs[len(psfs) // 2]
    fwhm = float(measure_shapes(middle[None]).fwhm_px[0]) / oversampling
    said |= {"POLNGRP": 1, "POLDEG1": order, "PSF_FWHM": fwhm}
    said |= {"PSF_SAMP": 1.0 / oversampling, "PSFNAXIS": 3}
    said |= {"PSFAXIS1": size, "PSFAXIS2": size, "PSFAXIS3": len(basis)}
    said |= {"CREATOR": f"psfdae {__version__}", "PSFMODEL": ascii_line(model.name)}
    table.header.update(said)
    write_fits(path, fits.HDUList([fits.PrimaryHDU(), table]))
    return off


def write_stdpsf(path: Path, model: FieldPsfs, columns: int, rows: int) -> None:
    """Write PSFs on a grid as STScI's library of PSFs has them, 4 values per pixel and axis.

    Raises
    ------
    PredictionError
        If the grid has too many places, or photutils would take the name for that of a detector.
    """
    if max(columns, rows) > STDPSF_PLACES:
        raise PredictionError(f"{path}: at most {STDPSF_PLACES} places along an axis")
    if len(path.name.split("_")) in (3, 4):
        raise PredictionError(
            f"{path}: photutils takes the second part of a name with two or three underscores "
            "for a detector of STScI; expected another number of them"
        )
    places = np.rint(model.grid(columns, rows))
    cards: list[Card] = [("NXPSFS", columns, ""), ("NYPSFS", rows, "")]
    along = places.reshape(rows, columns, 2)
    cards += [(f"IPSFX{i + 1:02d}", int(x) + 1, "x, 1-based") for i, x in enumerate(along[0, :, 0])]
    cards += [(f"JPSFY{j + 1:02d}", int(y) + 1, "y, 1-based") for j, y in enumerate(along[:, 0, 1])]
    _write_cube(path, model, places, GRID_SAMPLES, cards)


def write_grid(path: Path, model: FieldPsfs, places: np.ndarray, oversampling: int) -> None:
    """A cube of PSFs (n, m, m) at places (n, 2), x and y, as STPSF's `psf_grid` lays it out."""
    cards: list[Card] = [
        ("OVERSAMP", oversampling, "values per pixel and axis"),
        # photutils 3.0 takes every key with these letters, in any case, for a place, and would
        # exchange x and y without a word: now it stops at this one. Others look for capitals.
        ("HIERARCH Det_yx for photutils 3.0", "this needs photutils 3.1 or newer", ""),
    ]
    for number, (column, row) in enumerate(places.tolist()):
        key = f"DET_YX{number}" if number < 100 else f"HIERARCH DET_YX{number}"
        cards.append((key, f"({row:.8g}, {column:.8g})", "y, x, 0-based"))
    _write_cube(path, model, places, oversampling, cards)


def _write_cube(
    path: Path,
    model: FieldPsfs,
    places: np.ndarray,
    oversampling: int,
    cards: list[Card],
) -> None:
    from astropy.io import fits

    # About the middle of a pixel: what comes out is centred.
    x, y = np.rint(places).T
    first = model.psf_at(x[0], y[0], oversampling)
    header = fits.PrimaryHDU(first[None].astype(np.float32)).header
    header["NAXIS3"] = len(places)
    made = ("CREATOR", f"psfdae {__version__}", "program that made this file")
    of: list[Card] = [("PSFMODEL", ascii_line(model.name), "model"), ("PSFSHA", model.sha256, "")]
    of += model.wings.cards() if model.wings else []
    header = fits.Header([*header.cards, made, *of, *cards])  # `extend` takes the square of time
    # Not by astropy's StreamingHDU: its error on a full disk has no cause and no file.
    step = max(1, AT_ONCE // first.size)
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        file.write(header.tostring().encode("ascii"))
        for start in range(0, len(places), step):
            part = slice(start, start + step)
            file.write(model.psf_at(x[part], y[part], oversampling).astype(">f4").tobytes())
        file.truncate(-(-file.tell() // BLOCK_BYTES) * BLOCK_BYTES)
