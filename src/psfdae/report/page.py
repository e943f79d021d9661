"""Report page of a model: one HTML file that needs no other.

`quality_page` fills the template `report.html` with a summary and a table of checks; then follow
errors, photometry, the field, residuals, sizes and shapes, χ², and the stars that were not used.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from html import escape
from io import BytesIO

import numpy as np

from psfdae.base.figures import as_png
from psfdae.base.types import Figure, Table
from psfdae.image.tables import html_table
from psfdae.report.checks import Check, method_labels


def checks_html(rows: Sequence[Check]) -> str:
    """Return an HTML table of checks, each passed or to be inspected.

    Parameters
    ----------
    rows : sequence of Check
        Question, answer, and True if the check is passed.
    """
    words = {True: "<b class=pass>pass</b>", False: "<b class=inspect>inspect</b>"}
    cells = [(escape(a), escape(b), words[bool(is_passed)]) for a, b, is_passed in rows]
    return html_table(("check", "result", ""), cells)


def image_tag(picture: Figure | bytes) -> str:
    """Return an HTML image with a figure, or the bytes of a PNG file, inside.

    Parameters
    ----------
    picture : Figure or bytes
        A figure is drawn with 110 dots per inch.
    """
    from PIL import Image

    content = picture if isinstance(picture, bytes) else as_png(picture, dpi=110)
    # A palette of 256 colours takes less than half of the bytes of full colour; dithering would
    # make even areas noisy.
    palette, dither = Image.Quantize.MEDIANCUT, Image.Dither.NONE
    image = Image.open(BytesIO(content)).convert("RGB").quantize(256, palette, dither=dither)
    image.save(small := BytesIO(), "PNG")
    # The picture stands in the page itself, in base 64.
    return f'<img src="data:image/png;base64,{base64.b64encode(small.getvalue()).decode()}">'


def errors_table(errors: Table, model_method: str) -> str:
    """Return the HTML table of MSE with standard errors: rows are methods, columns S/N.

    Parameters
    ----------
    errors : Table
        Columns of `report.csv`.
    model_method : str
        Name of the method that is marked as the model.
    """
    # Columns are the S/N, ascending.
    levels = np.unique(errors["snr"])
    # A method that was not measured at a S/N has an empty cell.
    cells = {(r["method"], r["snr"]): f"{r['mse']:.2e} ± {r['mse_stderr']:.0e}" for r in errors}
    rows = [
        [escape(f"{label} (the model)" if name == model_method else label)]
        + [cells.get((name, snr), "") for snr in levels]
        for name, label in method_labels(errors).items()
    ]
    return html_table(["MSE", *(f"S/N {snr:.3g}" for snr in levels)], rows)


def photometry_table(photometry: Table) -> str:
    """Return the HTML table of photometry of held-out stars, given nothing but their stamps.

    `photometry` has the columns of `found.csv`.

    Its columns are the S/N, the mean error of the flux in per cent, its pull and the RMS error of
    the centre, which is empty where no centre was fitted.
    """
    # Biases in per cent of the flux, with their standard errors.
    rows = [
        [
            f"{row['snr']:.3g}",
            f"{100 * row['flux_bias']:+.1f} ± {100 * row['flux_bias_stderr']:.1f} %",
            f"{row['flux_pull']:.2f}",
            f"{row['centre_rms_px']:.3f}" if np.isfinite(row["centre_rms_px"]) else "",
        ]
        for row in photometry
    ]
    head = ("S/N", "flux, mean error", "pull of the flux", "centre, RMS error (px)")
    return html_table(head, rows)
