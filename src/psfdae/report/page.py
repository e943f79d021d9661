"""Report page of a model: one HTML file that needs no other.

`quality_page` fills the template `report.html` with a summary and a table of checks; then follow
errors, photometry, the field, residuals, sizes and shapes, χ², and the stars that were not used.
"""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from html import escape
from io import BytesIO
from pathlib import Path
from string import Template
from typing import TYPE_CHECKING

import numpy as np

from psfdae.base.figures import as_png
from psfdae.image.selection import Verdict
from psfdae.image.stamps import StarFlag
from psfdae.image.tables import html_table
from psfdae.report.checks import Check, check_stars, method_labels
from psfdae.report.figures import chi2_figure, error_maps, errors_figure, shapes_figure

if TYPE_CHECKING:
    from astropy.table import Table
    from matplotlib.figure import Figure

    from psfdae.report.validation import Report


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


def quality_page(
    report: Report,
    stars: Mapping[str, np.ndarray],
    degraded_rows: np.ndarray,
    field_map: Figure | None,
    residuals: Figure | None,
) -> str:
    """Return the report page as HTML.

    Parameters
    ----------
    report : Report
    stars : mapping of str to ndarray, shape (n,)
        Columns of the prediction of all stars, and `verdict` and `part` of `selection.csv`.
    degraded_rows : ndarray of int
        Star of each held-out image in `report.restored`.
    field_map : Figure, optional
        Map of the PSF, if the stars have positions.
    residuals : Figure, optional
        Residuals of bright held-out stars (`residual_strip`), if there are any.
    """
    # The method of the model, and held-out stars as it restores them.
    name, images = type(report.model.method).name, report.restored_by_snr
    # Checks of all stars come before the number of stars held out.
    *checks, held_out_check = report.checks()
    # Sentences on the fit, and on the image and its list.
    facts = report.model.method.facts().values()
    notes = [line for note in report.stars.notes for line in note.splitlines()]
    # A star has one verdict, and may have several flags.
    verdicts, flags = stars["verdict"], stars["flags"]
    verdict_counts = [(v, int((verdicts == v).sum())) for v in Verdict]
    flag_counts = [(f.name or "", int(((flags & int(f)) > 0).sum())) for f in StarFlag]
    unflagged = ("none", str(int((flags == 0).sum())))
    template = Path(__file__).with_name("report.html").read_text(encoding="utf-8")
    return Template(template).substitute(
        title=escape(report.model.info.name),
        image=escape(report.stars.observation.path.name),
        summary=escape(str(report)),
        checks=checks_html([*checks, *check_stars(stars), held_out_check]),
        errors=_errors_table(report.table, name),
        truth_mse=f"{report.table['truth_mse'][0]:.1e}",
        errors_figure=image_tag(errors_figure(report.table, name)),
        strip=image_tag(report.strip_png),
        photometry=_photometry_table(report.photometry),
        facts="".join(f"<p>{escape(fact)}.</p>\n" for fact in facts),
        field_map=image_tag(field_map) if field_map else "<p>The stars have no positions.</p>",
        error_maps=image_tag(error_maps(images)),
        residuals=image_tag(residuals) if residuals else "",
        shapes=image_tag(shapes_figure(stars, degraded_rows, images)),
        chi2=image_tag(chi2_figure(stars)),
        verdicts=html_table(
            ("selection for the training", "stars"),
            [(escape(verdict), str(count)) for verdict, count in verdict_counts if count],
        ),
        flags=html_table(
            ("flag", "stars"), [*((f, str(count)) for f, count in flag_counts if count), unflagged]
        ),
        notes="".join(f"<li>{escape(line)}</li>\n" for line in notes),
    )


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


def _errors_table(errors: Table, model_method: str) -> str:
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


def _photometry_table(photometry: Table) -> str:
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
