"""PSFs over the field in files of other programs: PSFEx, STPSF, STDPSF, photutils.

A model of PSFEx (Bertin 2011, ASP Conf. Ser. 442, 435) is a polynomial in the position. The
coefficient of each term is an image with a sample every `PSF_SAMP` pixels, to be interpolated by
Lanczos' kernel. STDPSF (Anderson 2016, WFC3 ISR 2016-12) and STPSF (`psf_grid`) are cubes of PSFs
at the positions of a grid. In all of them, as in psfdae, a value is the light that a whole pixel
centred there would get.
"""

from __future__ import annotations

import re
from abc import abstractmethod
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, NoReturn

import numpy as np

from psfdae.base.errors import keyword
from psfdae.base.files import atomic_path, compute_sha256, write_fits
from psfdae.base.version import __version__
from psfdae.image.errors import ascii_line, reading
from psfdae.image.fits_file import BLOCK_BYTES, Card, find_image, open_hdus, open_pixels, plain_file
from psfdae.psf.interface import FieldPsfs, PredictionError
from psfdae.stars.moments import measure_shapes


class FieldFile(FieldPsfs):
    """PSF over an image in a file of another program.

    Parameters
    ----------
    path : Path
        The file, whose name without its ending is the name of the model.
    """

    image_px = None
    order = 0

    def __init__(self, path: Path) -> None:
        self.path, self.name = path, path.stem

    def _refuse(self, problem: str) -> NoReturn:
        """Raise PredictionError with a problem of the file."""
        raise PredictionError(f"{self.path}: {problem}")

    @cached_property
    def sha256(self) -> str:
        """Checksum of the file."""
        return compute_sha256(self.path)

    def check_scale(self, pixel_scale_arcsec: float | None, source: str) -> None:
        """Accept any scale: these files do not say how large pixels are."""

    def draw_psfs(self, position: np.ndarray, oversampling: int) -> np.ndarray:
        """Return interpolated PSFs of flux 1 at positions (n, 2 to 4)."""
        position = position[:, :2]  # neither magnitude nor colour
        # Offset of the star from the middle of its pixel.
        phase = position - np.floor(position + 0.5)
        count = self.stamp_px if oversampling == 1 else oversampling * self.stamp_px + 1
        axis = (np.arange(count) - oversampling * (self.stamp_px // 2)) / oversampling
        # Sum 1 in the pixels of the stamp of a star in the middle of its pixel.
        pixels = np.arange(self.stamp_px) - self.stamp_px // 2
        flux = self.interpolate(position, pixels, np.zeros_like(phase)).sum(axis=(1, 2))
        return np.asarray(self.interpolate(position, axis, phase) / flux[:, None, None])

    @abstractmethod
    def interpolate(self, position: np.ndarray, axis: np.ndarray, phase: np.ndarray) -> np.ndarray:
        """Interpolate the samples of PSFs at pixels about their stars.

        Parameters
        ----------
        position : ndarray, shape (n, 2)
            Positions (x, y) of the stars in the image.
        axis : ndarray, shape (m,)
            Pixels along x and along y.
        phase : ndarray, shape (n, 2)
            Offsets (x, y) of the stars from the middle of their pixel.

        Returns
        -------
        ndarray, shape (n, m, m)
        """


class GridField(FieldFile):
    """PSFs on a grid, of STDPSF, STPSF or photutils; outside of the grid, the PSF of its edge.

    Parameters
    ----------
    path : Path
        A FITS cube of PSFs, each centred in the middle of its array.

    Attributes
    ----------
    grid_model : GriddedPSFModel
        A spline of each PSF, bilinear between the positions of the grid.

    Raises
    ------
    ObservationError
        If the file is missing or damaged, or its positions are not a grid.
    PredictionError
        If its positions are of several detectors.
    """

    def __init__(self, path: Path) -> None:
        from astropy.nddata import NDData
        from photutils.psf import GriddedPSFModel, STDPSFGrid

        super().__init__(path)
        image = find_image(path, 0)
        header = image.headers[0]
        with reading(path), open_pixels(image, in_pieces=False, dtype=np.float64) as pixels:
            if "NXPSFS" in header:
                grid = STDPSFGrid(str(image.file.path))
                positions, oversampling = np.array(grid.grid_xypos, float), 4
            else:
                # Rows and columns. photutils 3.0 exchanges the two, so that they are read here.
                pairs = [str(header[key]) for key in header if key.startswith("DET_YX")]
                positions = np.array([p.strip("( )").split(",") for p in pairs], float)[:, ::-1]
                oversampling = int(str(header["OVERSAMP"]))
            meta = {"grid_xypos": [*map(tuple, positions)], "oversampling": oversampling}
            psfs = pixels[:].reshape(-1, *image.shape[-2:])
            self.grid_model = GriddedPSFModel(NDData(psfs, meta=meta))
        self.low, self.high = positions.min(axis=0), positions.max(axis=0)
        # Detectors side by side, each with PSFs at its edge: positions in an image are of one.
        nodes = [np.unique(axis) for axis in positions.T]
        if any((np.diff(axis) <= 1).any() for axis in nodes):
            self._refuse("PSFs of several detectors, expected one")
        self.order = min(3, max(map(len, nodes)) - 1)
        # Stamps are as large as the sampled images, rounded down to an even number of pixels.
        self.stamp_px = 2 * int(min(psfs.shape[1:]) / oversampling / 2)

    def field_range(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the first and the last position (x, y) of the grid."""
        return self.low, self.high

    def interpolate(self, position: np.ndarray, axis: np.ndarray, phase: np.ndarray) -> np.ndarray:
        """Interpolate by photutils' grid of PSFs."""
        pixels = position[..., None] + axis - phase[..., None]
        stars = zip(position, pixels, strict=True)
        return np.stack(
            [self.grid_model.evaluate(*np.meshgrid(*xy), 1.0, *star) for star, xy in stars]
        )


class PsfexField(FieldFile):
    """Model of PSFEx; outside the field of its stars, the PSF is as at their edge.

    Parameters
    ----------
    path : Path
        A .psf file of one extension, whose polynomial is in the position alone.

    Attributes
    ----------
    order : int
        Order of the polynomial, POLDEG1; 0 for a PSF that is the same everywhere.
    terms : ndarray of int, shape (t, 2)
        Powers of u and v, the scaled positions, in the terms of the polynomial.
    basis : ndarray, shape (t, h, w)
        Sampled image of each term.
    step_px : float
        Pixels from one sample to the next.
    zero, width : ndarray, shape (2,)
        Position (x, y), 0-based, and pixels per unit of u and v.

    Raises
    ------
    ObservationError
        If the file is missing, damaged or no FITS file.
    PredictionError
        If it is not such a model.
    """

    unknown_width_px: ClassVar[float] = 1.0
    """Width of a field in pixels that stands for an unknown one."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        # PSFEx writes one table with one row, the images of all terms.
        file = plain_file(path)
        with reading(path), open_hdus(file) as hdus:
            tables = [
                (dict(hdu.header), np.array(hdu.data["PSF_MASK"][0], float))
                for hdu in hdus
                if hdu.name == "PSF_DATA"
            ]
        if len(tables) != 1:
            self._refuse(f"{len(tables)} tables PSF_DATA, expected one, as PSFEx writes it")
        try:
            self._read(*tables[0])
        except PredictionError:
            raise
        except (KeyError, TypeError, ValueError) as error:
            self._refuse(f"no model of PSFEx ({error})")

    def _read(self, header: Mapping[str, Any], mask: np.ndarray) -> None:
        """Set polynomial, sampling and scales.

        Parameters
        ----------
        header : mapping
            Header of the table PSF_DATA.
        mask : ndarray, shape (t, h, w) or (h, w)
            Images of the terms.

        Raises
        ------
        PredictionError, KeyError, TypeError, ValueError
            If the header lacks a key, or has one that is not a model of the position.
        """
        # Coordinates of the polynomial: none, or x and y in one group.
        axis_count = int(header["POLNAXIS"])
        names = [str(header[f"POLNAME{i + 1}"]).strip() for i in range(axis_count)]
        # Other coordinates, such as a magnitude, would need values for each star.
        is_position = re.fullmatch(r"X\S*_IMAGE Y\S*_IMAGE", " ".join(names))
        if names and not (is_position and int(header["POLNGRP"]) == 1):
            self._refuse(f"changes with {', '.join(names)}; expected X_IMAGE and Y_IMAGE")
        self.order = int(header["POLDEG1"]) if names else 0
        self.step_px = float(header["PSF_SAMP"])
        zero, self.width = np.full(2, 0.0), np.full(2, self.unknown_width_px)
        if names:
            zero, self.width = (
                np.array([float(header[f"{key}{i}"]) for i in (1, 2)])
                for key in ("POLZERO", "POLSCAL")
            )
        self.zero = zero - 1.0  # FITS counts pixels from 1
        # Limits far beyond any real PSF keep time and memory of a damaged file small.
        max_order, max_side = 12, 1025
        self.basis = mask.reshape(-1, *mask.shape[-2:])
        self.terms: np.ndarray = np.array(
            psfex_powers(self.order) if self.order <= max_order else []
        )
        # Stamps are as large as the sampled images, rounded down to an even number of pixels.
        side = min(mask.shape[-2:])
        is_usable = (
            0 <= self.order <= max_order
            and len(self.terms) == len(self.basis)
            and 1 < side <= max(mask.shape[-2:]) <= max_side
            and 0.01 < self.step_px <= 10
            and side * self.step_px <= max_side
            and np.isfinite([zero, self.width]).all()
            and (self.width > 0).all()
            and np.isfinite(mask).all()
        )
        if not is_usable:
            self._refuse("its polynomial, sampling, scales or pixels are out of range")
        self.stamp_px = 2 * max(1, int(side * self.step_px / 2))

    def field_range(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the range of positions (x, y) that PSFEx scaled; PredictionError if unknown."""
        if (self.width <= self.unknown_width_px).any():
            raise PredictionError(f"the model {self.name!r} knows no positions of its stars")
        return self.zero - self.width / 2, self.zero + self.width / 2

    def interpolate(self, position: np.ndarray, axis: np.ndarray, phase: np.ndarray) -> np.ndarray:
        """Interpolate by PSFEx's polynomial and kernel."""
        # Sampled PSF Σ uⁱ vʲ b_ij, with u and v within the field of the stars.
        u, v = np.clip((position - self.zero) / self.width, -0.5, 0.5).T
        samples = np.tensordot(np.stack([u**i * v**j for i, j in self.terms], 1), self.basis, 1)
        columns, rows = (
            _lanczos((axis - phase[:, i, None]) / self.step_px, samples.shape[2 - i])
            for i in (0, 1)
        )
        return np.asarray(rows @ samples @ columns.transpose(0, 2, 1))


def _lanczos(offset: np.ndarray, count: int) -> np.ndarray:
    """Return the weights (…, count) of samples at offsets (…) from the middle one, count//2.

    The kernel is as in PSFEx, sinc(t) sinc(t / 4) for |t| < 4.
    """

    def kernel(t: np.ndarray) -> np.ndarray:
        return np.where(np.abs(t) < 4, np.sinc(t) * np.sinc(t / 4), 0.0)

    # The sum over all samples would be close to 1 if there were no edge; divide by it.
    fraction = (offset - np.floor(offset))[..., None]
    total = kernel(fraction - np.arange(-3, 5)).sum(axis=-1, keepdims=True)
    return np.asarray(kernel(offset[..., None] - (np.arange(count) - count // 2)) / total)


def psfex_powers(order: int) -> list[tuple[int, int]]:
    """Return the powers of x and y in the terms of PSFEx's polynomial, in their order.

    The power of x changes first: 1, x, x², …, y, x y, …, y².
    """
    return [(i, j) for j in range(order + 1) for i in range(order + 1 - j)]


def write_psfex(path: Path, model: FieldPsfs, oversampling: int) -> float:
    """Write a model for PSFEx's readers.

    Parameters
    ----------
    path : Path
        File to write; it is replaced if it exists.
    model : FieldPsfs
        Model that knows the PSF at every position.
    oversampling : int
        Samples per pixel and axis.

    Returns
    -------
    float
        Largest error of the polynomial, over the brightest value of the PSFs.

    Raises
    ------
    PredictionError
        If the model knows no PSF of a position, or the number of samples would be even.
    """
    from astropy.io import fits

    order = model.order
    # Other programs take the middle sample for the centre.
    if oversampling == 1 and model.stamp_px % 2 == 0:
        raise PredictionError(
            f"{path}: stamps of {model.stamp_px} px have no middle pixel; "
            f"{keyword('oversampling')} takes 2 or more"
        )
    # A grid with about twice as many nodes along an axis as the polynomial has terms. A constant
    # PSF needs no field.
    try:
        low, high = model.field_range()
        positions = np.rint(model.grid(2 * order + 3, 2 * order + 3))
    except PredictionError:
        if order:
            raise
        low, high, positions = np.zeros(2), np.zeros(2), np.zeros((1, 2))
    # Least squares for the image of each term: psf(u, v) = Σ uⁱ vʲ b_ij.
    zero, width = (low + high) / 2, np.maximum(high - low, PsfexField.unknown_width_px)
    # Scaled positions, from −½ to ½ over the field.
    u, v = ((positions - zero) / width).T
    terms = np.stack([u**i * v**j for i, j in psfex_powers(order)], axis=1)
    x, y = positions.T
    psfs = model.psf_at(x, y, oversampling)
    basis = np.tensordot(np.linalg.pinv(terms), psfs, 1)
    error = float(np.abs(np.tensordot(terms, basis, 1) - psfs).max() / psfs.max())
    # Readers show the FWHM, here of the PSF in the middle of the list of positions.
    fwhm = float(measure_shapes(psfs[len(psfs) // 2][None]).fwhm_px[0]) / oversampling
    # One table of one row, whose only cell has the images of all terms.
    size = basis.shape[-1]
    column = fits.Column(
        "PSF_MASK",
        f"{basis.size}E",
        dim=f"({size}, {size}, {len(basis)})",
        array=basis[None].astype(np.float32),
    )
    table = fits.BinTableHDU.from_columns([column], name="PSF_DATA")
    # Cards in the words of PSFEx; scaled positions u = (x − POLZERO) / POLSCAL, x from 1.
    cards: dict[str, str | float] = {"LOADED": 0, "ACCEPTED": 0, "CHI2": 1.0, "POLNAXIS": 2}
    for i, axis in enumerate("XY"):
        cards[f"POLGRP{i + 1}"] = 1
        cards[f"POLNAME{i + 1}"] = f"{axis}_IMAGE"
        cards[f"POLZERO{i + 1}"] = float(zero[i] + 1.0)
        cards[f"POLSCAL{i + 1}"] = float(width[i])
    cards |= {"POLNGRP": 1, "POLDEG1": order, "PSF_FWHM": fwhm}
    cards |= {"PSF_SAMP": 1.0 / oversampling, "PSFNAXIS": 3}
    cards |= {"PSFAXIS1": size, "PSFAXIS2": size, "PSFAXIS3": len(basis)}
    cards |= {"CREATOR": f"psfdae {__version__}", "PSFMODEL": ascii_line(model.name)}
    table.header.update(cards)
    write_fits(path, fits.HDUList([fits.PrimaryHDU(), table]))
    return error


def write_stdpsf(path: Path, model: FieldPsfs, columns: int, rows: int) -> None:
    """Write PSFs on a grid as STScI's library of PSFs has them, 4 values per pixel and axis.

    Parameters
    ----------
    path : Path
        File to write; it is replaced if it exists.
    model : FieldPsfs
        Model that knows the PSF at every position.
    columns, rows : int
        Positions along x and along y, evenly over the field.

    Raises
    ------
    PredictionError
        If the grid has too many positions, or photutils would take the name for a detector's.
    """
    # Keys have two digits for the number of a column or row.
    if max(columns, rows) > 99:
        raise PredictionError(f"{path}: at most 99 places along an axis")
    if len(path.name.split("_")) in (3, 4):
        raise PredictionError(
            f"{path}: photutils takes the second part of a name with two or three underscores "
            "for a detector of STScI; expected another number of them"
        )
    # Columns and rows of the grid, whole pixels counted from 1.
    positions = np.rint(model.grid(columns, rows))
    grid = positions.reshape(rows, columns, 2)
    cards: list[Card] = [("NXPSFS", columns, ""), ("NYPSFS", rows, "")]
    cards += [(f"IPSFX{i + 1:02d}", int(x) + 1, "x, 1-based") for i, x in enumerate(grid[0, :, 0])]
    cards += [(f"JPSFY{j + 1:02d}", int(y) + 1, "y, 1-based") for j, y in enumerate(grid[:, 0, 1])]
    _write_cube(path, model, positions, 4, cards)


def write_grid(path: Path, model: FieldPsfs, positions: np.ndarray, oversampling: int) -> None:
    """Write a cube of PSFs at positions (n, 2), x and y, as STPSF's `psf_grid` lays it out.

    Parameters
    ----------
    path : Path
        File to write; it is replaced if it exists.
    model : FieldPsfs
        Model that knows the PSF at every position.
    positions : ndarray, shape (n, 2)
        Columns and rows, 0-based; the header has them as rows and columns.
    oversampling : int
        Values per pixel and axis.
    """
    cards: list[Card] = [
        ("OVERSAMP", oversampling, "values per pixel and axis"),
        # photutils 3.0 takes every key with these letters, in any case, for a position, and would
        # exchange x and y without a word: now it stops at this one. Others look for capitals.
        ("HIERARCH Det_yx for photutils 3.0", "this needs photutils 3.1 or newer", ""),
    ]
    # Keys of more than eight letters, from 100 on, need HIERARCH.
    for number, (column, row) in enumerate(positions.tolist()):
        key = f"DET_YX{number}" if number < 100 else f"HIERARCH DET_YX{number}"
        cards.append((key, f"({row:.8g}, {column:.8g})", "y, x, 0-based"))
    _write_cube(path, model, positions, oversampling, cards)


def _write_cube(
    path: Path, model: FieldPsfs, positions: np.ndarray, oversampling: int, cards: list[Card]
) -> None:
    """Write a FITS cube of centred PSFs.

    Parameters
    ----------
    path : Path
        File to write; it is replaced if it exists.
    model : FieldPsfs
        Model that knows the PSF at every position.
    positions : ndarray, shape (n, 2)
        Positions x and y; PSFs are drawn at the nearest whole pixel.
    oversampling : int
        Values per pixel and axis.
    cards : list of Card
        Cards of the format, which follow the model's cards.
    """
    from astropy.io import fits

    # PSFs about the middle of a pixel are centred.
    x, y = np.rint(positions).T
    first = model.psf_at(x[0], y[0], oversampling)
    # A header of the right axes, by the first PSF; the number of PSFs is set after.
    header = fits.PrimaryHDU(first[None].astype(np.float32)).header
    header["NAXIS3"] = len(positions)
    model_cards: list[Card] = [
        ("CREATOR", f"psfdae {__version__}", "program that made this file"),
        ("PSFMODEL", ascii_line(model.name), "model"),
        ("PSFSHA", model.sha256, ""),
        *(model.wings.cards() if model.wings else []),
    ]
    # One list of cards: `Header.extend` takes a time that grows as their square.
    header = fits.Header([*header.cards, *model_cards, *cards])
    # Written as bytes, some million values at a time for memory. Astropy's StreamingHDU would not
    # name the file when the disk is full.
    step = max(1, 2**20 // first.size)
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        file.write(header.tostring().encode("ascii"))
        for start in range(0, len(positions), step):
            part = slice(start, start + step)
            file.write(model.psf_at(x[part], y[part], oversampling).astype(">f4").tobytes())
        # A FITS file ends with a whole block.
        file.truncate(-(-file.tell() // BLOCK_BYTES) * BLOCK_BYTES)
