"""The FITS file of a prediction, written piece by piece.

| extension | content |
|---|---|
| primary | no pixels; where everything comes from |
| PSF, RESIDUAL, UNCERT | float32 cubes (n, d, d) |
| STARS | a row per star |

All sizes are known before the first star, so each piece goes straight to its place
in the file. `astropy.io.fits` makes the headers, but its own streaming fills one
extension after the other.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np

import psfdae
from psfdae.bundle import Bundle
from psfdae.files import atomic_path
from psfdae.prediction.flags import MEANING
from psfdae.prediction.results import Prediction

BLOCK_BYTES = 2880
"""FITS files consist of blocks of this size."""

CUBES: dict[str, tuple[str, str]] = {
    "psf": ("PSF", "PSF times flux, without sky"),
    "residual": ("RESIDUAL", "stamp minus sky minus PSF, NaN where unused"),
    "uncertainty": ("UNCERT", "half-width that holds 68.27 % of the errors of PSF"),
}
"""Arrays of a prediction with the name and the meaning of their extensions."""

UNIT = "adu"
"""Of the pixels: counts, as in the input."""

COLUMNS: dict[str, tuple[str, str | None, str]] = {
    "x": ("D", "pix", "position in the image, 0-based, columns"),
    "y": ("D", "pix", "position in the image, 0-based, rows"),
    "flux": ("D", UNIT, "inside the stamp"),
    "flux_error": ("D", UNIT, "standard error; NaN if the flux was given"),
    "background": ("D", UNIT, "sky per pixel"),
    "noise": ("D", UNIT, "RMS of the sky noise in a pixel"),
    "snr": ("D", None, "flux / (noise sqrt(A))"),
    "chi2": ("D", None, "mean squared residual over its variance"),
    "distance": ("D", None, "Mahalanobis distance from the training set"),
    "fwhm_px": ("D", "pix", "of the PSF, adaptive moments"),
    "ellipticity": ("D", None, "1 - b/a of the PSF"),
    "position_angle_deg": ("D", "deg", "of the major axis, from +x to +y"),
    "shift_x": ("I", "pix", "stamp moved along columns"),
    "shift_y": ("I", "pix", "stamp moved along rows"),
    "flags": ("J", None, "sum of the FLAG values in this header"),
}
"""FITS format, unit and meaning of the columns of STARS, besides `id`."""

Card = tuple[str, Any, str]


class PredictionFile:
    """A file that is open and as long as it will be; `writing` makes it.

    Parameters
    ----------
    file : binary file, empty
    count : int
        Number of stars.
    stamp_px : int
    id_type : dtype
        Of the identifiers: int64 or a str of fixed length.
    bundle : Bundle
    cards : sequence of (key, value, comment)
        Further provenance, into the primary header.
    history : str
    """

    def __init__(
        self,
        file: IO[bytes],
        count: int,
        stamp_px: int,
        id_type: np.dtype,
        bundle: Bundle,
        cards: Sequence[Card],
        history: str,
    ) -> None:
        self._file = file
        self._row = _row_type(id_type)
        file.write(_text(_primary_header(bundle, cards, history)))
        self._offset: dict[str, int] = {}
        cube_bytes = 4 * count * stamp_px**2
        for name, (extension, about) in CUBES.items():
            file.write(_text(_cube_header(extension, about, count, stamp_px)))
            self._skip(name, cube_bytes)
        file.write(_text(_table_header(id_type, count)))
        self._skip("stars", count * self._row.itemsize)
        file.truncate(file.tell())

    def _skip(self, name: str, size: int) -> None:
        """Remember where a data unit starts, and go to its end."""
        self._offset[name] = self._file.tell()
        self._file.seek(self._offset[name] + -(-size // BLOCK_BYTES) * BLOCK_BYTES)

    def write(self, start: int, prediction: Prediction, columns: Mapping[str, np.ndarray]) -> None:
        """Write the stars from number `start` on.

        Parameters
        ----------
        start : int
        prediction : Prediction
        columns : mapping
            `id`, `x` and `y`, shape (n,) each.
        """
        for name in CUBES:
            cube = getattr(prediction, name)
            self._put(name, start * cube[0].nbytes if len(cube) else 0, cube.astype(">f4"))
        rows = np.zeros(len(prediction), dtype=self._row)
        for name in self._row.names or ():
            value = columns[name] if name in columns else getattr(prediction, name)
            rows[name] = _as_ascii(value) if value.dtype.kind == "U" else value
        self._put("stars", start * self._row.itemsize, rows)

    def _put(self, name: str, place: int, values: np.ndarray) -> None:
        self._file.seek(self._offset[name] + place)
        self._file.write(values.tobytes())


@contextmanager
def writing(path: Path, *arguments: Any) -> Iterator[PredictionFile]:
    """A `PredictionFile` (`arguments` are its own) that gets its name if the block succeeds."""
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        yield PredictionFile(file, *arguments)


def _as_ascii(text: np.ndarray) -> np.ndarray:
    """FITS tables hold ASCII; other characters become question marks."""
    return np.array([name.encode("ascii", "replace") for name in text.tolist()], dtype=bytes)


def _row_type(id_type: np.dtype) -> np.dtype:
    """Big-endian layout of a row of STARS."""
    formats: dict[str, str] = {"D": ">f8", "I": ">i2", "J": ">i4"}
    width = max(id_type.itemsize // 4, 1)
    identifier = f"S{width}" if id_type.kind == "U" else ">i8"
    return np.dtype(
        [("id", identifier), *((name, formats[f]) for name, (f, _, _) in COLUMNS.items())]
    )


def _primary_header(bundle: Bundle, cards: Sequence[Card], history: str) -> Any:
    from astropy.io import fits

    info, header = bundle.info, fits.PrimaryHDU().header
    header["EXTEND"] = True
    own: list[Card] = [
        ("CREATOR", f"psfdae {psfdae.__version__}", "program that made this file"),
        ("PSFMODEL", info.name, "model bundle"),
        ("PSFSHA", bundle.sha256, ""),
        ("PSFFORM", info.format_version, "format of the bundle"),
        ("STAMPPX", info.stamp_px, "[pix] side of the stamps"),
        ("NOISEAPX", info.noise_equivalent_px, "[pix] noise-equivalent area A of the S/N"),
        ("SNRMIN", info.snr_min, "least S/N of the training"),
        ("SNRMAX", info.snr_max, "largest S/N of the training"),
        ("DISTMAX", bundle.distance_limit, "largest distance that raises no flag"),
    ]
    with warnings.catch_warnings():
        # A long value leaves no room for its comment, which astropy reports.
        warnings.simplefilter("ignore", fits.verify.VerifyWarning)
        for key, value, comment in (*own, *cards):
            header[key] = (_printable(value), _printable(comment))
        header["HISTORY"] = _printable(history)
        header.tostring()
    return header


def _printable(value: Any) -> Any:
    if not isinstance(value, str):
        return value
    text = " ".join(value.split()).encode("ascii", "replace").decode()
    return "".join(c if c.isprintable() else "?" for c in text)


def _cube_header(name: str, about: str, count: int, stamp_px: int) -> Any:
    from astropy.io import fits

    header = fits.ImageHDU(np.zeros((1, stamp_px, stamp_px), np.float32), name=name).header
    header["NAXIS3"] = count
    header["BUNIT"] = (UNIT, "counts, as in the input")
    header["COMMENT"] = about
    header["COMMENT"] = "The star is about pixel (d/2, d/2), 0-based."
    return header


def _table_header(id_type: np.dtype, count: int) -> Any:
    from astropy.io import fits

    width = max(id_type.itemsize // 4, 1)
    columns = [fits.Column("id", f"{width}A" if id_type.kind == "U" else "K")]
    columns += [fits.Column(name, f, unit) for name, (f, unit, _) in COLUMNS.items()]
    header = fits.BinTableHDU.from_columns(columns, nrows=0, name="STARS").header
    header["NAXIS2"] = count
    for number, (_, _, about) in enumerate(COLUMNS.values(), start=2):
        header[f"TCOMM{number}"] = about
    for flag, about in MEANING.items():
        header[f"FLAG{int(flag)}"] = flag.name
        header["COMMENT"] = f"{int(flag)} {flag.name}: {about}"
    return header


def _text(header: Any) -> bytes:
    """A header as it stands in the file."""
    encoded: bytes = header.tostring().encode("ascii")
    return encoded
