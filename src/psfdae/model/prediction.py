"""What comes out of a model, in memory and as a FITS file that is written piece by piece.

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
from dataclasses import dataclass, fields
from itertools import combinations
from pathlib import Path
from typing import IO, TYPE_CHECKING, Self

import numpy as np

from psfdae.files import atomic_path
from psfdae.image.errors import ascii_line
from psfdae.image.fits_file import BLOCK_BYTES, Card
from psfdae.image.stamps import MEANING, Stamps
from psfdae.version import __version__

if TYPE_CHECKING:
    from astropy.io.fits import Header

    from psfdae.model.bundle import Bundle


@dataclass(frozen=True)
class Prediction:
    """PSFs of n stars and what was measured on the way; every star has its row.

    Attributes
    ----------
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

    Examples
    --------
    The first star was drawn with a flux of 2000 π 4.25 = 26704.

    >>> found = model.predict(stamps, position=xy)
    >>> bool(abs(found.flux[0] - 26704) < 3 * found.flux_error[0])
    True
    >>> int(found.flags[0])
    0
    """

    psf: np.ndarray
    residual: np.ndarray
    uncertainty: np.ndarray
    ratio95: np.ndarray
    ratio95_bright: np.ndarray
    flux: np.ndarray
    flux_error: np.ndarray
    flux_total: np.ndarray
    flux_total_error: np.ndarray
    background: np.ndarray
    noise: np.ndarray
    snr: np.ndarray
    chi2: np.ndarray
    distance: np.ndarray
    outlier_score: np.ndarray
    fwhm_px: np.ndarray
    ellipticity: np.ndarray
    position_angle_deg: np.ndarray
    shift_x: np.ndarray
    shift_y: np.ndarray
    flags: np.ndarray
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

    def __len__(self) -> int:
        return len(self.psf)

    @property
    def strangeness(self) -> np.ndarray:
        """Former name of `outlier_score`."""
        return self.outlier_score

    def of(self, rows: slice) -> Self:
        """Those of some stars."""
        return type(self)(*(getattr(self, f.name)[rows] for f in fields(self)))

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """One prediction of the stars of several."""
        if len(parts) == 1:
            return parts[0]
        columns = (np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(cls))
        return cls(*columns)


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

UNIT = "adu"  # of the pixels: counts, as in the input

COLUMNS: dict[str, tuple[str, str | None, str]] = {
    "x": ("D", "pix", "position in the image, 0-based, columns"),
    "y": ("D", "pix", "position in the image, 0-based, rows"),
    "flux": ("D", UNIT, "inside the stamp"),
    "flux_error": ("D", UNIT, "standard error; NaN if the flux was given"),
    "flux_total": ("D", UNIT, "within FLUXRAD; NaN if the model has no wings"),
    "flux_total_error": ("D", UNIT, "standard error"),
    "background": ("D", UNIT, "sky per pixel"),
    "noise": ("D", UNIT, "RMS of the sky noise in a pixel"),
    "snr": ("D", None, "of a matched filter, sqrt(sum of PSF^2) / noise"),
    "ratio95": ("D", None, "UNCERT times this holds 95 % of the errors"),
    "ratio95_bright": ("D", None, "the same in the brightest 8 % of the pixels"),
    "chi2": ("D", None, "squared residuals over their expectation"),
    "distance": ("D", None, "Mahalanobis distance from the training set"),
    "outlier_score": ("D", None, "its square by the model's own law of stars"),
    "strangeness": ("D", None, "former name of outlier_score"),
    "fwhm_px": ("D", "pix", "of the PSF, adaptive moments"),
    "ellipticity": ("D", None, "1 - b/a of the PSF"),
    "position_angle_deg": ("D", "deg", "of the major axis, from +x to +y"),
    "x_fit": ("D", "pix", "centre of the star, columns, 0-based"),
    "y_fit": ("D", "pix", "centre of the star, rows, 0-based"),
    "x_error": ("D", "pix", "standard error of x_fit"),
    "y_error": ("D", "pix", "standard error of y_fit"),
    "background_error": ("D", UNIT, "standard error of background"),
    "corr_flux_background": ("D", None, "correlation of errors"),
    "corr_flux_y": ("D", None, "correlation of errors"),
    "corr_flux_x": ("D", None, "correlation of errors"),
    "corr_background_y": ("D", None, "correlation of errors"),
    "corr_background_x": ("D", None, "correlation of errors"),
    "corr_y_x": ("D", None, "correlation of errors"),
    "shift_x": ("I", "pix", "stamp moved along columns"),
    "shift_y": ("I", "pix", "stamp moved along rows"),
    "flags": ("J", None, "sum of the FLAG values in this header"),
}
"""FITS format, unit and meaning of the columns of STARS, besides `id`."""

OF_STAMPS = ("id", "x", "y")  # columns that the stamps bring along


class PredictionFile:
    """A file that is open and as long as it will be; `prediction_file` makes it."""

    def __init__(self, file: IO[bytes], primary: Header, example: Stamps, count: int, side: int):
        self._file = file
        width = max(example.id.dtype.itemsize // 4, 1)
        id_is_text = example.id.dtype.kind == "U"
        big_endian = {"D": ">f8", "I": ">i2", "J": ">i4"}
        self._row = np.dtype(
            [
                ("id", f"S{width}" if id_is_text else ">i8"),
                *((name, big_endian[f]) for name, (f, _, _) in COLUMNS.items()),
            ]
        )
        self._offset: dict[str, int] = {}
        file.write(_text(primary))
        for name, (extension, about) in CUBES.items():
            self._append(name, _cube_header(extension, about, count, side), 4 * count * side**2)
        header = _table_header(f"{width}A" if id_is_text else "K", count)
        self._append("stars", header, count * self._row.itemsize)
        file.truncate(file.tell())

    def _append(self, name: str, header: Header, size: int) -> None:
        """Write the header of a data unit, remember where it starts, and go to its end."""
        self._file.write(_text(header))
        self._offset[name] = self._file.tell()
        self._file.seek(self._offset[name] + -(-size // BLOCK_BYTES) * BLOCK_BYTES)

    def write(self, start: int, stamps: Stamps, prediction: Prediction) -> None:
        """Write the stars from number `start` on."""
        for name in CUBES:
            cube = getattr(prediction, name)
            self._put(name, start * cube[0].nbytes if len(cube) else 0, cube.astype(">f4"))
        rows = np.zeros(len(prediction), dtype=self._row)
        for name in self._row.names or ():
            value = getattr(stamps if name in OF_STAMPS else prediction, name)
            rows[name] = as_ascii(value) if value.dtype.kind == "U" else value
        self._put("stars", start * self._row.itemsize, rows)

    def _put(self, name: str, place: int, values: np.ndarray) -> None:
        self._file.seek(self._offset[name] + place)
        self._file.write(values.tobytes())


@contextmanager
def prediction_file(
    path: Path, bundle: Bundle, example: Stamps, count: int, cards: Sequence[Card], history: str
) -> Iterator[PredictionFile]:
    """A `PredictionFile` for so many stars that gets its name if the block succeeds.

    `example` are some of the stars, for the type of their identifiers; `cards` are further
    provenance.
    """
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        primary = _primary_header(bundle, cards, history)
        yield PredictionFile(file, primary, example, count, bundle.info.stamp_px)


def as_ascii(text: np.ndarray) -> np.ndarray:
    """FITS tables hold ASCII; other characters become question marks."""
    return np.array([name.encode("ascii", "replace") for name in text.tolist()], dtype=bytes)


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


def _cube_header(name: str, about: str, count: int, stamp_px: int) -> Header:
    from astropy.io import fits

    header = fits.ImageHDU(np.zeros((1, stamp_px, stamp_px), np.float32), name=name).header
    header["NAXIS3"] = count
    header["BUNIT"] = (UNIT, "counts, as in the input")
    header["COMMENT"] = about
    header["COMMENT"] = "The star is about pixel (d/2, d/2), 0-based."
    return header


def _table_header(id_format: str, count: int) -> Header:
    from astropy.io import fits

    columns = [fits.Column("id", id_format)]
    columns += [fits.Column(name, f, unit) for name, (f, unit, _) in COLUMNS.items()]
    header = fits.BinTableHDU.from_columns(columns, nrows=0, name="STARS").header
    header["NAXIS2"] = count
    for number, (_, _, about) in enumerate(COLUMNS.values(), start=2):
        header[f"TCOMM{number}"] = about
    for flag, about in MEANING.items():
        # A FITS keyword has eight characters.
        header[f"FLAG{int(flag)}" if flag < 10000 else f"FLG{int(flag)}"] = flag.name
        header["COMMENT"] = f"{int(flag)} {flag.name}: {about}"
    return header


def _text(header: Header) -> bytes:
    """A header as it stands in the file."""
    encoded: bytes = header.tostring().encode("ascii")
    return encoded
