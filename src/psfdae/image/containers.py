"""Images as Python hands them over: HDU, HDUList, CCDData, NDData, masked arrays, quantities.

Each becomes a temporary FITS file, with its mask as extension DQ and its uncertainty as
ERR (σ), so that it is read as a file is. Plain arrays stay arrays.
"""

from __future__ import annotations

import io
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from psfdae.base.types import HDUList, Header, ImageHDU, NDData, PrimaryHDU, Quantity
from psfdae.image.errors import ObservationError, reading
from psfdae.image.fits_file import PlainFile, write_temporary

ImageLike: TypeAlias = str | Path | np.ndarray | NDData | HDUList | PrimaryHDU | ImageHDU
"""Image as the public calls take it; see `as_image`."""


def as_images(images: Any) -> list[Path | PlainFile | np.ndarray]:
    """Return the path, array or file to read for each image; see `as_image`.

    Parameters
    ----------
    images : image or sequence of images
        Images of any type that `as_image` takes.

    Returns
    -------
    list of Path, PlainFile or ndarray
        One for each image; an HDUList holds the parts of one image.
    """
    from astropy.io.fits import HDUList

    # An HDUList lists the parts of one image, and an array could be iterated over.
    iterable = hasattr(images, "__iter__") and not isinstance(images, str | HDUList | np.ndarray)
    return [as_image(container) for container in images] if iterable else [as_image(images)]


def as_image(image: Any) -> Path | PlainFile | np.ndarray:
    """Return the source to read of an image: a path, an array of plain numbers, or a FITS file.

    Parameters
    ----------
    image : path-like, array, masked array, Quantity, NDData, HDU, or HDUList
        Image; mask, uncertainty, unit and WCS are kept.

    Raises
    ------
    ObservationError
        If the type is another one, or the image cannot be written as FITS.
    """
    from astropy.io import fits
    from astropy.nddata import NDData

    if isinstance(image, str | Path | PlainFile):
        return Path(image) if isinstance(image, str) else image
    # Messages call an image without a file by its type.
    name = Path(type(image).__name__)
    if isinstance(image, np.ndarray):
        # An array without mask and unit needs no file.
        data, mask, unit = split_array(image)
        if mask is None and not unit:
            return data
        header = fits.Header({"BUNIT": unit} if unit else {})
        return _write_fits(name, lambda: _build_hdus(data, header, mask, None))
    if isinstance(image, fits.HDUList):
        return _write_fits(Path(image.filename() or name), lambda: image)
    if isinstance(image, fits.PrimaryHDU | fits.ImageHDU | fits.CompImageHDU):
        # An extension stands behind a primary one.
        first = [] if isinstance(image, fits.PrimaryHDU) else [fits.PrimaryHDU()]
        return _write_fits(name, lambda: fits.HDUList([*first, image.copy()]))
    if not isinstance(image, NDData):
        raise ObservationError(
            name, "no image; expected a path, array, NDData, CCDData, HDU or HDUList"
        )
    return _write_fits(name, lambda: _convert_nddata(image))


def split_array(values: Any) -> tuple[np.ndarray, np.ndarray | None, str]:
    """Split an array of any kind into numbers, mask (None without) and unit ("" without).

    Masked arrays of numpy, and quantities of astropy, also masked ones.

    Parameters
    ----------
    values : array, masked array, Quantity or masked Quantity
        Array of any shape.

    Returns
    -------
    numbers : ndarray
        Plain numbers of the array.
    mask : ndarray of bool or None, of the same shape
        True where a value is masked.
    unit : str
        Unit as FITS writes it.
    """
    if isinstance(values, np.ma.MaskedArray):
        return np.asarray(values.data), np.ma.getmaskarray(values), ""
    # Quantities, perhaps with a mask.
    unit = getattr(values, "unit", None)
    mask = getattr(values, "mask", None)
    plain = getattr(values, "unmasked", values)  # of astropy's Masked
    array = np.asarray(plain if unit is None else plain.value)
    return array, None if mask is None else np.asarray(mask, bool), fits_unit(unit)


def compute_sigma(data: NDData) -> np.ndarray | None:
    """Compute σ of the pixels, in the unit of the data; None without an uncertainty.

    An uncertainty of another kind, such as a variance or its inverse, is converted into σ.
    """
    from astropy.nddata import StdDevUncertainty

    if data.uncertainty is None:
        return None
    # The uncertainty may be a variance, and in another unit than the data.
    sigma = data.uncertainty.represent_as(StdDevUncertainty)
    values = sigma.array
    if sigma.unit is not None and data.unit is not None and sigma.unit != data.unit:
        values = (values * sigma.unit).to_value(data.unit)
    return np.asarray(values)


def to_unit(value: float | Quantity | None, units: str, name: str, path: Path) -> float | None:
    """Convert a quantity to a number of the first of some units; plain numbers stay.

    Parameters
    ----------
    value : float, Quantity or None
        Value given by the user.
    units : str
        Names of astropy, separated by blanks; the others mean the same as the first, such as
        counts, adu and DN.
    name : str
        Keyword of the value, for the message.
    path : Path
        The image, for the message.

    Raises
    ------
    ObservationError
        If it has another unit, or more than one value.
    """
    from astropy import units as u

    if not isinstance(value, u.Quantity):
        return value
    # Counts, adu and DN are not converted into each other, so the first unit that fits is taken.
    for unit in units.split():
        with suppress(u.UnitConversionError, TypeError):
            return float(value.to_value(u.Unit(unit)))
    target_unit = " or ".join(units.split())
    raise ObservationError(path, f"{name}={value}: expected a number of {target_unit}")


def _convert_nddata(data: NDData) -> HDUList:
    """Convert an NDData to FITS: image, mask and σ, with its meta as header, unit and WCS.

    Meta other than numbers and texts, and a WCS of another kind than FITS has, are left out.
    """
    from astropy.io import fits
    from astropy.wcs import WCS

    # The meta of CCDData is the header that it was read with.
    header = fits.Header()
    for key, value in data.meta.items():
        # Meta may hold anything; values that cannot be FITS cards are left out.
        if isinstance(value, str | int | float | bool) and not str(key).startswith("NAXIS"):
            with suppress(ValueError):
                header[str(key)] = value
    if unit := fits_unit(data.unit):
        header["BUNIT"] = unit
    hdus = _build_hdus(np.asarray(data.data), header, data.mask, compute_sigma(data))
    # A WCS of another kind than FITS has is left out.
    wcs = getattr(data.wcs, "low_level_wcs", data.wcs)
    if isinstance(wcs, WCS):
        first, *tables = wcs.to_fits(relax=True)
        hdus[0].header.update(first.header)
        hdus += tables
    return hdus


def fits_unit(unit: Any) -> str:
    """Return a unit as FITS writes it; its own name if FITS knows none."""
    if unit is None:
        return ""
    try:
        return str(unit.to_string("fits"))
    except ValueError:
        return str(unit)


def _build_hdus(
    data: np.ndarray, header: Header, mask: np.ndarray | None, sigma: np.ndarray | None
) -> HDUList:
    """Return an image with its mask as DQ and σ as ERR.

    Parameters
    ----------
    data : ndarray
        Pixels of the image, or a cube of stamps.
    header : Header
        Header of the image.
    mask : ndarray or None
        Truth values or bits, of the shape of the data or of one stamp of a cube.
    sigma : ndarray or None
        σ of the pixels, of the shape of the data or of one stamp.
    """
    from astropy.io import fits

    # FITS supports neither half precision nor truth values.
    narrow = data.dtype.kind == "b" or data.dtype == np.float16
    hdus = fits.HDUList([fits.PrimaryHDU(data.astype(np.float32) if narrow else data, header)])
    # A mask of truth values, or of bits; one for all stamps of a cube is repeated.
    if mask is not None:
        bits = np.broadcast_to(np.asarray(mask), data.shape)
        bits = bits.astype(np.uint8) if bits.dtype.kind == "b" else np.array(bits)
        hdus.append(fits.ImageHDU(bits, name="DQ"))
    if sigma is not None:
        hdus.append(fits.ImageHDU(np.broadcast_to(sigma, data.shape).copy(), name="ERR"))
    return hdus


def _write_fits(name: Path, hdus: Callable[[], HDUList]) -> PlainFile:
    """Return a temporary file with an image, which is called `name` in messages.

    Parameters
    ----------
    name : Path
        Name of the image in messages.
    hdus : callable
        Returns the HDUList; called inside `reading`, as its content may not be valid FITS.
    """
    content = io.BytesIO()
    with reading(name):
        hdus().writeto(content, output_verify="silentfix+ignore")
        content.seek(0)
        return write_temporary(name, content)
