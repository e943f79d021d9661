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
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Any, Self

import numpy as np

from psfdae.base.types import QTable, Table
from psfdae.base.version import __version__
from psfdae.denoise.bundle import Bundle
from psfdae.image.errors import ascii_line
from psfdae.image.fits_file import BLOCK_BYTES, Card
from psfdae.image.stamps import StarFlag
from psfdae.image.tables import COLUMNS, as_fits, fits_values, html_table, star_table
from psfdae.methods.bundle_info import FORMAT_VERSION


@dataclass(frozen=True, kw_only=True)
class Prediction:
    """PSFs of n stars and what was measured on the way; every star has its row.

    Columns with a number for each star are attributes, arrays of shape (n,): `prediction.flux`.
    Their list, with units and meanings, is `psfdae.image.tables.COLUMNS`, and the page on
    `psfdae predict` explains them.

    Attributes
    ----------
    columns : dict of str to ndarray, shape (n,)
        Columns by name, in the order of that list. Among them are

        - `id`, `x`, `y`: by the star list; places from 0, NaN where unknown
        - `flux`, `flux_error`: flux inside the stamp, in the unit of the stamps; the error is NaN
          where the flux was given
        - `flux_total`, `flux_total_error`: with the light beyond the stamp (`PsfModel.wings`); NaN
          if the model knows none
        - `background`, `noise`: sky level, without the light of the star's wings if the model
          knows it, and RMS of the sky noise in a pixel
        - `snr`: of a filter matched to the denoised star, √Σ psf² / noise
        - `ratio95`, `ratio95_bright`: `uncertainty` times this holds 95 % of the errors, in the
          brightest pixels the second one
        - `chi2`: mean of (residual / σ)² over the used pixels, divided by what is expected of it
        - `distance`: from the training set (`psfdae.denoise.error_model.mahalanobis`)
        - `outlier_score`: −2 ln of the probability density of the star by the model's own
          distribution of stars, in its leading components; NaN where the model has none
        - `fwhm_px`, `ellipticity`, `position_angle_deg`: of the PSF (`psfdae.stars.moments`)
        - `x_fit`, `y_fit`: centre of the star, in the image where the star was cut from one, else
          in its stamp; NaN if the model's method measures none, and so are its errors, the sky's
          error, and the correlations `corr_*` of two errors each
        - `shift_x`, `shift_y`: pixels by which the stamp was moved to centre the star
        - `flags`: sum of `psfdae.StarFlag`s, uint16
    psf : ndarray, shape (n, d, d), float32
        Noise-free image of the star without sky, in the unit of the stamps: the PSF
        times the flux. NaN without a usable flux (flag NO_FLUX).
    residual : ndarray, shape (n, d, d), float32
        Stamp − sky − `psf`, and − the even light of the star's wings in it; NaN in pixels that
        were not used.
    uncertainty : ndarray, shape (n, d, d), float32
        Half-width that holds 68.27 % of the errors of `psf` at this S/N, of the brightest
        pixels (`psfdae.denoise.error_model.brightest`) and of the others, as found on test stars.
    list_columns : Table or None
        n rows of further columns of the star list.
    unit : str
        Unit of the stamps; "" where nothing says it.
    notes : tuple of str
        Sentences on an image and its list, and on what limits the trust in the predictions.

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

    columns: dict[str, np.ndarray]
    psf: np.ndarray
    residual: np.ndarray
    uncertainty: np.ndarray
    list_columns: Table | None = None
    unit: str = ""
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        # The order of the list, whatever the order in which columns were computed.
        ordered_names = {name: self.columns[name] for name in COLUMNS if name in self.columns}
        object.__setattr__(self, "columns", ordered_names)

    def __getattr__(self, name: str) -> np.ndarray:
        """Return a column by its name."""
        # Unpickling asks for attributes before there are any.
        columns: dict[str, np.ndarray] = self.__dict__.get("columns", {})
        if name not in columns:
            raise AttributeError(f"Prediction has no column {name!r}")
        return columns[name]

    def __dir__(self) -> list[str]:
        return [*super().__dir__(), *self.columns]

    @property
    def ra(self) -> np.ndarray | None:
        """ICRS right ascension of the fitted centre, or of (x, y), in degrees; None without WCS."""
        return self.columns.get("ra")

    @property
    def dec(self) -> np.ndarray | None:
        """ICRS declination of the fitted centre, or of (x, y), in degrees; None without a WCS."""
        return self.columns.get("dec")

    def __len__(self) -> int:
        return len(self.psf)

    def __repr__(self) -> str:
        side, clean = self.psf.shape[-1], int((self.flags == 0).sum())
        return f"Prediction({len(self)} stars of {side}×{side} px, {clean} without a flag)"

    def _repr_html_(self) -> str:
        """Return the counts of the stars and of their flags, for a notebook."""
        # Flags that no star has are left out.
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
        # FITS does not have unsigned integers.
        columns = self.columns | {"flags": self.flags.astype(np.int32)}
        return star_table(columns, self.unit, self.list_columns)

    def of(self, rows: slice) -> Self:
        """Return the predictions of some of the stars."""
        # Images, columns and columns of the list have a row for each star.
        cubes: dict[str, Any] = {name: getattr(self, name)[rows] for name in CUBES}
        return replace(
            self,
            columns={name: values[rows] for name, values in self.columns.items()},
            list_columns=None if self.list_columns is None else self.list_columns[rows],
            **cubes,
        )

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """Return one prediction of the stars of several, one after the other."""
        first = parts[0]
        if len(parts) == 1:
            return first
        # astropy joins tables, numpy the arrays.
        list_columns = None
        if first.list_columns is not None:
            from astropy.table import vstack

            list_columns = vstack([part.list_columns for part in parts])
        columns = {
            name: np.concatenate([part.columns[name] for part in parts]) for name in first.columns
        }
        cubes: dict[str, Any] = {
            name: np.concatenate([getattr(part, name) for part in parts]) for name in CUBES
        }
        return replace(first, columns=columns, list_columns=list_columns, **cubes)


CUBES: dict[str, tuple[str, str]] = {
    "psf": ("PSF", "PSF times flux, without sky"),
    "residual": ("RESIDUAL", "stamp minus sky minus PSF, NaN where unused"),
    "uncertainty": ("UNCERT", "half-width that holds 68.27 % of the errors of PSF"),
}
"""Arrays of a prediction with the name and the meaning of their extensions."""


class PredictionFile:
    """File that is open and has its full length from the start; `prediction_file` makes it.

    Parameters
    ----------
    file : binary file
        Open for writing and reading, empty.
    primary : bytes
        Primary header.
    example : Prediction
        Prediction of some of the stars, which says the types of the columns.
    count : int
        Number of all stars.
    """

    def __init__(self, file: IO[bytes], primary: bytes, example: Prediction, count: int) -> None:
        from astropy.io import fits

        self._file = file
        side, unit = example.psf.shape[-1], example.unit or "adu"
        # Headers of the cubes (n, d, d), made from a cube of one image.
        headers = {}
        for name, (extension, meaning) in CUBES.items():
            cube = fits.ImageHDU(np.zeros((1, side, side), np.float32), name=extension)
            header = headers[name] = cube.header
            header["NAXIS3"] = count
            header["BUNIT"] = (ascii_line(unit), "as in the input")
            header["COMMENT"] = meaning
            header["COMMENT"] = "The star is about pixel (d/2, d/2), 0-based."
        # Header of the table of stars, with the meaning of their flags.
        table = as_fits(example.to_table(), "STARS")
        self._row = table.data.dtype.newbyteorder(">")
        header = headers["stars"] = table.header
        header["NAXIS2"] = count
        for flag in StarFlag:
            # A FITS keyword has eight characters.
            header[f"FLAG{int(flag)}" if flag < 10000 else f"FLG{int(flag)}"] = flag.name
            header["COMMENT"] = f"{int(flag)} {flag.name}: {flag.meaning}"
        # Bytes of a star in each data unit, and where the unit starts.
        self._star_bytes = dict.fromkeys(CUBES, 4 * side**2) | {"stars": self._row.itemsize}
        self._start: dict[str, int] = {}
        file.write(primary)
        for name, header in headers.items():
            file.write(header.tostring().encode("ascii"))
            self._start[name] = file.tell()
            # A data unit ends with a whole block; its stars are written later.
            blocks = -(-count * self._star_bytes[name] // BLOCK_BYTES)
            file.seek(self._start[name] + blocks * BLOCK_BYTES)
        file.truncate(file.tell())

    def write(self, start: int, prediction: Prediction) -> None:
        """Write the stars from number `start` on."""
        # Rows of the table as FITS has them, big-endian.
        table = prediction.to_table()
        rows = np.zeros(len(table), dtype=self._row)
        for name in table.colnames:
            values = fits_values(table[name])
            # FITS keeps truth values as the letters T and F.
            is_truth = values.dtype.kind == "b"
            rows[name] = np.where(values, ord("T"), ord("F")) if is_truth else values
        # Each piece goes behind the stars before it in its data unit.
        cubes = {name: getattr(prediction, name).astype(">f4") for name in CUBES}
        for name, values in {**cubes, "stars": rows}.items():
            self._file.seek(self._start[name] + start * self._star_bytes[name])
            self._file.write(values.tobytes())


@contextmanager
def prediction_file(
    path: Path, bundle: Bundle, example: Prediction, count: int, cards: Sequence[Card], history: str
) -> Iterator[PredictionFile]:
    """Open a `PredictionFile` for so many stars.

    Parameters
    ----------
    path : Path
        Temporary file, as `atomic_path` makes it.
    bundle : Bundle
        Model of the predictions.
    example : Prediction
        Prediction of some of the stars, which says the types of the columns.
    count : int
        Number of stars.
    cards : sequence of Card
        Further provenance for the primary header.
    history : str
        The command.
    """
    from astropy.io import fits

    # The primary header: the model, further cards, and the command.
    info, header = bundle.info, fits.PrimaryHDU().header
    header["EXTEND"] = True
    model_cards: list[Card] = [
        ("CREATOR", f"psfdae {__version__}", "program that made this file"),
        ("PSFMODEL", info.name, "model bundle"),
        ("PSFSHA", bundle.sha256, ""),
        ("PSFFORM", FORMAT_VERSION, "format of the bundle"),
        ("STAMPPX", info.stamp_px, "[pix] side of the stamps"),
        ("NOISEAPX", info.noise_equivalent_px, "[pix] noise-equivalent area of a typical star"),
        ("SNRMIN", info.snr_min, "least S/N of the training"),
        ("SNRMAX", info.snr_max, "largest S/N of the training"),
        ("DISTMAX", bundle.errors.distance_limit, "largest distance that raises no flag"),
        *(bundle.wings.cards() if bundle.wings else []),
    ]
    with warnings.catch_warnings():
        # A long value leaves no room for its comment, which astropy reports.
        warnings.simplefilter("ignore", fits.verify.VerifyWarning)
        for key, value, comment in (*model_cards, *cards):
            text = ascii_line(value) if isinstance(value, str) else value
            header[key] = (text, ascii_line(comment))
        header["HISTORY"] = ascii_line(history)
        primary = header.tostring().encode("ascii")
    with path.open("wb") as file:
        yield PredictionFile(file, primary, example, count)
