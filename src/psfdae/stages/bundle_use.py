"""Stages `ship`, `export` and `describe`: what is done with a finished bundle."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from psfdae.own_stars.bundle import (
    SHIPPED,
    SUFFIX,
    Bundle,
    BundleError,
    BundleInfo,
    network,
    read_bundle,
    write_bundle,
)
from psfdae.own_stars.errors import one_line
from psfdae.stages.common import check_outputs

LARGEST_SHIPPED = 300_000
"""Bytes of the bundle that comes with the package, at most."""

LICENCE = "MIT"
"""Of the shipped bundle, as of the package: its stars are simulated."""

WELL_COVERED = (0.63, 0.73)
"""Coverage of `error68` that a shipped bundle must have at every noise level."""

METRICS = {
    "noise_level": ("λ", ".2g"),
    "noise": ("noise/flux", ".2e"),
    "snr": ("S/N", ".1f"),
    "mse_noisy": ("MSE noisy", ".2e"),
    "mse": ("MSE", ".2e"),
    "gain": ("gain", ".3g"),
    "ssim": ("SSIM", ".4f"),
    "coverage68": ("in error68", ".1%"),
    "coverage_rms": ("in rms", ".1%"),
}
"""Columns of the table: key, heading, format."""


def ship(path: Path, folder: Path) -> Path:
    """Make a bundle the one that comes with the package.

    Parameters
    ----------
    path : bundle
    folder : of the package's bundles; the one there is replaced

    Returns
    -------
    Path
        The new file.

    Raises
    ------
    BundleError
        If it is too large, or `error68` does not hold 68 ± 5 % of the errors.
    """
    bundle = read_bundle(path)
    low, high = WELL_COVERED
    for row in bundle.info.metrics:
        if not low <= row.get("coverage68", 0.0) <= high:
            raise BundleError(
                f"{path}: at noise level {row.get('noise_level', 0.0):g} error68 holds "
                f"{row.get('coverage68', 0.0):.1%} of the errors ({low:.0%} to {high:.0%} allowed)"
            )
    info = bundle.info.model_copy(update={"name": SHIPPED, "licence": LICENCE})
    if path.stat().st_size > LARGEST_SHIPPED:
        raise BundleError(f"{path}: {path.stat().st_size} bytes, at most {LARGEST_SHIPPED}")
    out = folder / f"{SHIPPED}{SUFFIX}"
    write_bundle(replace(bundle, info=info), out)
    return out


def export(path: Path | None, out: Path) -> None:
    """Write the network of a bundle as ONNX and check the file against torch.

    Parameters
    ----------
    path : bundle; None for the shipped one
    out : path of the ONNX file

    Raises
    ------
    BundleError
        As `read_bundle`.
    ExportError
        As `export_onnx`; no file is left then.
    OutputError
        If the ONNX file would replace the bundle.
    """
    import logging
    import warnings

    from psfdae.models.export import export_onnx

    check_outputs((out,), (path,))
    bundle = read_bundle(path)
    # The exporter speaks of optional packages and of its own internals.
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)
        export_onnx(network(bundle), bundle.info.image_scale, bundle.info.stamp_px, out)


def describe(path: Path | None) -> str:
    """What a bundle says of itself, for people.

    Parameters
    ----------
    path : bundle; None for the shipped one
    """
    bundle = read_bundle(path)
    facts = _facts(bundle)
    width = max(len(name) for name in facts)
    lines = [f"{name:<{width}}  {one_line(value)}" for name, value in facts.items()]
    return "\n".join([*lines, "", "Errors of the test stars:", _table(bundle.info)])


def _facts(bundle: Bundle) -> dict[str, str]:
    info = bundle.info
    scale = f"{info.pixel_scale_arcsec:g} arcsec"
    if info.pixel_lambda_d is not None:
        scale += f" ({info.pixel_lambda_d:.3g} λ/D)"
    framing = f"{info.framing}, ± {info.jitter_px} px"
    weights = sum(array.size for array in bundle.weights.values())
    return {
        "Name": info.name,
        "Format": f"{info.format_version}, written {info.created} by psfdae {info.psfdae_version}",
        "Licence": info.licence,
        "SHA-256": bundle.sha256,
        "Stamp": f"{info.stamp_px} × {info.stamp_px} px of {scale}",
        "Framing": framing + (", any sub-pixel position" if info.subpixel else ""),
        "Normalisation": f"{info.normalisation} 1; the network sees it × {info.image_scale:g}",
        "S/N": f"{info.snr_min:.3g} to {info.snr_max:.3g}",
        "Noise-equivalent area": f"{info.noise_equivalent_px:.3g} px",
        "Network": f"kernels {_list(info.dae.kernels)}; widths {_list(info.dae.widths)}; "
        f"{weights} weights",
        "Trained on": f"{info.training_stars} {_KINDS[info.source]}, "
        f"SHA-256 {info.training_sha256[:16]}…",
        "Distance limit": f"{bundle.distance_limit:.3g} in {info.components} components",
    }


_KINDS = {"simulated": "simulated stars", "stars": "stars of an image"}


def _list(values: tuple[int, ...]) -> str:
    return " ".join(str(value) for value in values)


def _gain(row: dict[str, float]) -> dict[str, float]:
    """How many times the error of the stamp itself; below 1 the network is no use."""
    noisy, mse = row.get("mse_noisy"), row.get("mse")
    return {"gain": noisy / mse} if noisy and mse else {}


def _table(info: BundleInfo) -> str:
    from tabulate import tabulate

    metrics = [row | _gain(row) for row in info.metrics]
    shown = [key for key in METRICS if any(key in row for row in metrics)]
    rows = [
        [format(row[key], METRICS[key][1]) if key in row else "" for key in shown]
        for row in metrics
    ]
    headings = [METRICS[key][0] for key in shown]
    return str(tabulate(rows, headings, tablefmt="plain", disable_numparse=True, stralign="right"))
