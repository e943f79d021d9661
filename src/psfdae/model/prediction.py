"""Predictions of a model, in memory and as a FITS file that is written piece by piece.

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
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from itertools import combinations
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, Self

import numpy as np

from psfdae.files import atomic_path
from psfdae.image.errors import ascii_line
from psfdae.image.fits_file import BLOCK_BYTES, Card
from psfdae.image.stamps import StarFlag
from psfdae.image.tables import as_fits, fits_values, html_table, star_table
from psfdae.version import __version__

if TYPE_CHECKING:
    from astropy.io.fits import Header
    from astropy.table import QTable, Table

    from psfdae.model.bundle import Bundle


@dataclass(frozen=True, kw_only=True)
class Prediction:
    """PSFs of n stars and what was measured on the way; every star has its row.

    Attributes
    ----------
    id : ndarray, shape (n,)
        By the star list, else the number of the star.
    x, y : ndarray, shape (n,), float64
        Place in the image by the list, 0-based; NaN where unknown.
    psf : ndarray, shape (n, d, d), float32
        Noise-free image of the star without sky, in the unit of the stamps: the PSF
        times the flux. NaN where there is no usable flux (flag NO_FLUX).
    residual : ndarray, shape (n, d, d), float32
        Stamp − sky − `psf`, and − the even light of the star's wings in it; NaN in pixels that
        were not used.
    uncertainty : ndarray, shape (n, d, d), float32
        Half-width that holds 68.27 % of the errors of `psf` at this S/N, of the brightest
        pixels (`psfdae.model.bundle.brightest`) and of the others, as found on test stars.
    ratio95, ratio95_bright : ndarray, shape (n,), float64
        `uncertainty` times this holds 95 % of the errors, in the brightest pixels the second one.
    flux, flux_error : ndarray, shape (n,), float64
        Flux inside the stamp, in the unit of the stamps; the error is NaN where the
        flux was given.
    flux_total, flux_total_error : ndarray, shape (n,), float64
        With the light beyond the stamp (`PsfModel.wings`); NaN if the model knows none.
    background, noise : ndarray, shape (n,), float64
        Sky level, without the light of the star's wings if the model knows it, and RMS of the sky
        noise in a pixel.
    snr : ndarray, shape (n,), float64
        Of a filter matched to the star as restored, √Σ psf² / noise: flux / (noise √A), with
        its own noise-equivalent area A.
    chi2 : ndarray, shape (n,), float64
        Mean of (residual / σ)² over the used pixels, divided by what is expected of it, which is
        below 1 where the restored star follows its own noise; σ² is noise² and, if the gain is
        known, the star's own photon noise. Stars that a model has learnt from have less than 1.
    distance : ndarray, shape (n,), float64
        Mahalanobis distance from the training set (`psfdae.model.bundle.mahalanobis`).
    outlier_score : ndarray, shape (n,), float64
        −2 ln of the probability density of the star by the model's own law of stars, in its leading
        components: the square of a Mahalanobis distance. NaN where it has no law.
    fwhm_px, ellipticity, position_angle_deg : ndarray, shape (n,), float64
        Of the PSF (`psfdae.moments`).
    x_fit, y_fit : ndarray, shape (n,), float64
        Centre of the star, 0-based: in the image where the star was cut from one, else in
        its stamp. NaN if the model's method measures none, and so all that follows.
    x_error, y_error, background_error : ndarray, shape (n,), float64
        Standard errors.
    corr_* : ndarray, shape (n,), float64
        Correlations of two errors each.
    shift_x, shift_y : ndarray, shape (n,), int16
        Pixels by which the stamp was moved along columns and rows to centre the star.
    flags : ndarray, shape (n,), uint16
        Sum of `psfdae.StarFlag`s.
    ra, dec : ndarray, shape (n,), float64, or None
        ICRS coordinates in degrees of (x_fit, y_fit), or of (x, y) where these are NaN; None if
        the image has no WCS.
    list_columns : Table or None
        n rows of further columns of the star list.
    unit : str
        Of the stamps; "" where nothing says it.

    Examples
    --------
    The first star was drawn with a flux of 2000 π 4.25 = 26704.

    >>> found = model.predict(stamps, position=xy)
    >>> bool(abs(found.flux[0] - 26704) < 3 * found.flux_error[0])
    True
    >>> int(found.flags[0])
    0
    >>> found
    Prediction(36 stars of 16×16 px, 36 without a flag)
    >>> table = found.to_table()
    >>> table.colnames[:5], table["flux"].unit
    (['id', 'x', 'y', 'flux', 'flux_error'], Unit("adu"))
    """

    id: np.ndarray
    x: np.ndarray
    y: np.ndarray
    ra: np.ndarray | None = None
    dec: np.ndarray | None = None
    flux: np.ndarray
    flux_error: np.ndarray
    flux_total: np.ndarray
    flux_total_error: np.ndarray
    background: np.ndarray
    noise: np.ndarray
    snr: np.ndarray
    ratio95: np.ndarray
    ratio95_bright: np.ndarray
    chi2: np.ndarray
    distance: np.ndarray
    outlier_score: np.ndarray
    fwhm_px: np.ndarray
    ellipticity: np.ndarray
    position_angle_deg: np.ndarray
    x_fit: np.ndarray
    y_fit: np.ndarray
    x_error: np.ndarray
    y_error: np.ndarray
    background_error: np.ndarray
    corr_flux_background: np.ndarray
    corr_flux_y: np.ndarray
    corr_flux_x: np.ndarray
    corr_background_y: np.ndarray
    corr_background_x: np.ndarray
    corr_y_x: np.ndarray
    shift_x: np.ndarray
    shift_y: np.ndarray
    flags: np.ndarray
    psf: np.ndarray
    residual: np.ndarray
    uncertainty: np.ndarray
    list_columns: Table | None = None
    unit: str = ""

    def __len__(self) -> int:
        return len(self.psf)

    def __repr__(self) -> str:
        side, clean = self.psf.shape[-1], int((self.flags == 0).sum())
        return f"Prediction({len(self)} stars of {side}×{side} px, {clean} without a flag)"

    def _repr_html_(self) -> str:
        """Counts of the stars and of their flags, for a notebook."""
        side, clean = self.psf.shape[-1], int((self.flags == 0).sum())
        rows = [["stars", str(len(self))], ["stamps", f"{side}×{side} px"]]
        rows += [["without a flag", str(clean)]]
        for flag in StarFlag:
            if count := int((self.flags & int(flag) > 0).sum()):
                rows.append([str(flag.name), str(count)])
        return html_table(["Prediction", ""], rows)

    def to_table(self) -> QTable:
        """Return a row for each star: all but the images, with units.

        It is the table STARS of the file that `psfdae predict` writes; further columns of a star
        list come last (`psfdae.image.tables.star_table`).
        """
        # FITS has no unsigned integers.
        columns = self.columns() | {"flags": self.flags.astype(np.int32)}
        return star_table(columns, self.unit, self.list_columns)

    def columns(self) -> dict[str, np.ndarray]:
        """Return the arrays with one value for each star, shape (n,), by their names."""
        return {name: values for name, values in self._arrays().items() if values.ndim == 1}

    def _arrays(self) -> dict[str, np.ndarray]:
        """Return all arrays, shape (n, ...), by their names."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: value for name, value in values.items() if isinstance(value, np.ndarray)}

    def of(self, rows: slice) -> Self:
        """Those of some stars."""
        parts: dict[str, Any] = {name: values[rows] for name, values in self._arrays().items()}
        if self.list_columns is not None:
            parts["list_columns"] = self.list_columns[rows]
        return replace(self, **parts)

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """One prediction of the stars of several."""
        if len(parts) == 1:
            return parts[0]
        columns: dict[str, Any] = {
            name: np.concatenate([getattr(part, name) for part in parts])
            for name in parts[0]._arrays()
        }
        if parts[0].list_columns is not None:
            from astropy.table import vstack

            columns["list_columns"] = vstack([part.list_columns for part in parts])
        return replace(parts[0], **columns)


def measured_of(centre: np.ndarray, covariance: np.ndarray) -> dict[str, np.ndarray]:
    """Columns from centres (row, column) and the covariance of `psfdae.method.Measured`.

    A number that is known has the error 0, and correlates with nothing.
    """
    errors = np.sqrt(np.maximum(np.einsum("nii->ni", covariance), 0.0))
    names = ("flux", "background", "y", "x")
    columns = {"y_fit": centre[:, 0], "x_fit": centre[:, 1]}
    columns |= {f"{name}_error": errors[:, i] for i, name in enumerate(names) if i}
    for i, j in combinations(range(4), 2):
        product = errors[:, i] * errors[:, j]
        share = covariance[:, i, j] / np.where(product > 0, product, 1.0)
        columns[f"corr_{names[i]}_{names[j]}"] = np.where(product > 0, share, 0.0)
    return columns


def unmeasured(count: int) -> dict[str, np.ndarray]:
    """Columns of `measured_of`, all NaN, for a method that measures nothing."""
    return dict.fromkeys(measured_of(np.zeros((0, 2)), np.zeros((0, 4, 4))), np.full(count, np.nan))


CUBES: dict[str, tuple[str, str]] = {
    "psf": ("PSF", "PSF times flux, without sky"),
    "residual": ("RESIDUAL", "stamp minus sky minus PSF, NaN where unused"),
    "uncertainty": ("UNCERT", "half-width that holds 68.27 % of the errors of PSF"),
}
"""Arrays of a prediction with the name and the meaning of their extensions."""


class PredictionFile:
    """A file that is open and as long as it will be; `prediction_file` makes it."""

    def __init__(self, file: IO[bytes], primary: Header, example: Prediction, count: int):
        self._file = file
        side, unit = example.psf.shape[-1], example.unit or "adu"
        table = as_fits(example.to_table(), "STARS")
        self._row = table.data.dtype.newbyteorder(">")
        self._offset: dict[str, int] = {}
        file.write(_text(primary))
        for name, (extension, about) in CUBES.items():
            header = _cube_header(extension, about, count, side, unit)
            self._append(name, header, 4 * count * side**2)
        self._append("stars", _with_flags(table.header, count), count * self._row.itemsize)
        file.truncate(file.tell())

    def _append(self, name: str, header: Header, size: int) -> None:
        """Write the header of a data unit, remember where it starts, and go to its end."""
        self._file.write(_text(header))
        self._offset[name] = self._file.tell()
        self._file.seek(self._offset[name] + -(-size // BLOCK_BYTES) * BLOCK_BYTES)

    def write(self, start: int, prediction: Prediction) -> None:
        """Write the stars from number `start` on."""
        for name in CUBES:
            cube = getattr(prediction, name)
            self._put(name, start * cube[0].nbytes if len(cube) else 0, cube.astype(">f4"))
        table = prediction.to_table()
        rows = np.zeros(len(table), dtype=self._row)
        for name in table.colnames:
            values = fits_values(table[name])
            # FITS keeps truth values as the letters T and F.
            is_truth = values.dtype.kind == "b"
            rows[name] = np.where(values, ord("T"), ord("F")) if is_truth else values
        self._put("stars", start * self._row.itemsize, rows)

    def _put(self, name: str, place: int, values: np.ndarray) -> None:
        self._file.seek(self._offset[name] + place)
        self._file.write(values.tobytes())


@contextmanager
def prediction_file(
    path: Path, bundle: Bundle, example: Prediction, count: int, cards: Sequence[Card], history: str
) -> Iterator[PredictionFile]:
    """A `PredictionFile` for so many stars that gets its name if the block succeeds.

    `example` is that of some of the stars, which says the types of the columns; `cards` are
    further provenance.
    """
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        primary = _primary_header(bundle, cards, history)
        yield PredictionFile(file, primary, example, count)


def _primary_header(bundle: Bundle, cards: Sequence[Card], history: str) -> Header:
    from astropy.io import fits

    info, header = bundle.info, fits.PrimaryHDU().header
    header["EXTEND"] = True
    own: list[Card] = [
        ("CREATOR", f"psfdae {__version__}", "program that made this file"),
        ("PSFMODEL", info.name, "model bundle"),
        ("PSFSHA", bundle.sha256, ""),
        ("PSFFORM", info.format_version, "format of the bundle"),
        ("STAMPPX", info.stamp_px, "[pix] side of the stamps"),
        ("NOISEAPX", info.noise_equivalent_px, "[pix] noise-equivalent area of a typical star"),
        ("SNRMIN", info.snr_min, "least S/N of the training"),
        ("SNRMAX", info.snr_max, "largest S/N of the training"),
        ("DISTMAX", bundle.distance_limit, "largest distance that raises no flag"),
    ]
    own += bundle.wings.cards() if bundle.wings else []
    with warnings.catch_warnings():
        # A long value leaves no room for its comment, which astropy reports.
        warnings.simplefilter("ignore", fits.verify.VerifyWarning)
        for key, value, comment in (*own, *cards):
            header[key] = (
                ascii_line(value) if isinstance(value, str) else value,
                ascii_line(comment),
            )
        header["HISTORY"] = ascii_line(history)
        header.tostring()
    return header


def _cube_header(name: str, about: str, count: int, stamp_px: int, unit: str) -> Header:
    from astropy.io import fits

    header = fits.ImageHDU(np.zeros((1, stamp_px, stamp_px), np.float32), name=name).header
    header["NAXIS3"] = count
    header["BUNIT"] = (ascii_line(unit), "as in the input")
    header["COMMENT"] = about
    header["COMMENT"] = "The star is about pixel (d/2, d/2), 0-based."
    return header


def _with_flags(header: Header, count: int) -> Header:
    """Return the header of a table of so many stars, with the meaning of their flags."""
    header["NAXIS2"] = count
    for flag in StarFlag:
        # A FITS keyword has eight characters.
        header[f"FLAG{int(flag)}" if flag < 10000 else f"FLG{int(flag)}"] = flag.name
        header["COMMENT"] = f"{int(flag)} {flag.name}: {flag.meaning}"
    return header


def _text(header: Header) -> bytes:
    """A header as it stands in the file."""
    encoded: bytes = header.tostring().encode("ascii")
    return encoded
