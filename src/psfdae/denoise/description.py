"""Description of a model: what it was trained for, and how accurately it denoises stars.

The command `describe` prints it, and a notebook shows a part of it for a `PsfModel`.
"""

from __future__ import annotations

from psfdae.base.types import Table
from psfdae.denoise.bundle import Bundle, estimator
from psfdae.methods import method
from psfdae.methods.bundle_info import FORMAT_VERSION, BundleInfo


def model_facts(bundle: Bundle) -> dict[str, str]:
    """Return the facts about a model, each with its name, in the order in which they are shown.

    Parameters
    ----------
    bundle : Bundle
        Model to describe.
    """
    info = bundle.info
    # Width of a pixel in arcsec, and in units of λ/D where the telescope is known.
    scale = f"{info.pixel_scale_arcsec:g} arcsec{', assumed' if info.scale_assumed else ''}"
    if info.pixel_lambda_d is not None:
        scale += f" ({info.pixel_lambda_d:.3g} λ/D)"
    # A network is described by its layers; another method by its name and by what its fit knows
    # about the field, such as the order of the polynomial.
    number_count = sum(array.size for array in bundle.weights.values())
    normalisation = "flux 1"
    if info.dae:
        normalisation += f"; the network sees it × {info.image_scale:g}"
        kernels, widths = (" ".join(map(str, v)) for v in (info.dae.kernels, info.dae.widths))
        method_facts = {"Network": f"kernels {kernels}; widths {widths}; {number_count} weights"}
    else:
        method_facts = {"Method": f"{method(info.method).look.title}; {number_count} numbers"}
        method_facts |= estimator(bundle).facts()
    star_kind = {"simulated": "simulated stars", "stars": "stars of an image"}[info.source]
    # Only bundles of one format are read.
    return {
        "Name": info.name,
        "Written": f"{info.created} by psfdae {info.psfdae_version}, in format {FORMAT_VERSION}",
        "Licence": info.licence,
        "SHA-256": bundle.sha256,
        "Stamp": f"{info.stamp_px} × {info.stamp_px} px of {scale}",
        "Framing": f"brightest pixel at (d/2, d/2), ± {info.jitter_px} px"
        + (", any sub-pixel position" if info.subpixel else ""),
        "Normalisation": normalisation,
        "S/N": f"{info.snr_min:.3g} to {info.snr_max:.3g}",
        "Noise-equivalent area": f"{info.noise_equivalent_px:.3g} px",
        **method_facts,
        "Trained on": f"{info.training_stars} {star_kind}, SHA-256 {info.training_sha256[:16]}…",
        **({"Adapted to": f"{info.adapted}, after its training"} if info.adapted else {}),
        **({"Light beyond the stamp": str(bundle.wings)} if bundle.wings else {}),
        "Flagged as unlike": "stars farther from the training stars than a Mahalanobis distance of "
        f"{bundle.errors.distance_limit:.3g} in {info.components} components",
    }


def error_table(info: BundleInfo) -> Table | None:
    """Return the errors of the test stars as a table of texts, a row for each noise level.

    The column "gain" is added: the MSE of the noisy stamps over the MSE of the denoised ones. Below
    1 the model makes stars worse than they were. The result is None for a model
    that was never tested on stars, such as a registered one.

    Parameters
    ----------
    info : BundleInfo
        Description of the model, with the metrics of its test stars.
    """
    from astropy.table import Table

    rows: list[dict[str, float]] = []
    for metrics in info.metrics:
        mse_noisy, mse = metrics.get("mse_noisy"), metrics.get("mse")
        rows.append(metrics | ({"gain": mse_noisy / mse} if mse_noisy and mse else {}))
    # Heading and number format of each column, by the name of the metric.
    formats = {
        "noise_level": ("noise level", ".2g"),
        "noise": ("noise/flux", ".2e"),
        "snr": ("S/N", ".1f"),
        "mse_noisy": ("MSE noisy", ".2e"),
        "mse": ("MSE", ".2e"),
        "gain": ("gain", ".3g"),
        "ssim": ("SSIM", ".4f"),
        "coverage68": ("in 68 %", ".1%"),
        "coverage95": ("in 95 %", ".1%"),
    }
    # Columns that no row has are left out; a row without a value has an empty cell.
    columns = {
        heading: [format(row[key], number_format) if key in row else "" for row in rows]
        for key, (heading, number_format) in formats.items()
        if any(key in row for row in rows)
    }
    return Table(columns) if columns else None
