"""Command `describe`: what a model was trained for, and how well it does."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated

from psfdae.bundle_info import BundleInfo
from psfdae.cli import command
from psfdae.image.errors import one_line
from psfdae.method import KnowsField
from psfdae.methods import method
from psfdae.model.bundle import Bundle, estimator, read_bundle
from psfdae.options import File

Packed = Annotated[File | None, {"argument": True}]

METRICS = {
    "noise_level": ("λ", ".2g"),
    "noise": ("noise/flux", ".2e"),
    "snr": ("S/N", ".1f"),
    "mse_noisy": ("MSE noisy", ".2e"),
    "mse": ("MSE", ".2e"),
    "gain": ("gain", ".3g"),
    "ssim": ("SSIM", ".4f"),
    "coverage68": ("in error68", ".1%"),
    "coverage95": ("in 95 %", ".1%"),
    "coverage_rms": ("in rms", ".1%"),
}
"""Columns of the table: key, heading, format."""


@command("describe")
def describe(
    bundle: Packed = None,
) -> None:
    """Say what BUNDLE (default: the shipped one) was trained for and how well it does."""
    print(description(read_bundle(bundle)))


def description(packed: Bundle) -> str:
    """Return the facts and the errors of a bundle as text."""
    facts = _facts(packed)
    width = max(len(name) for name in facts)
    lines = [f"{name:<{width}}  {one_line(value)}" for name, value in facts.items()]
    return "\n".join([*lines, "", "Errors of the test stars:", _table(packed.info)])


def _facts(packed: Bundle) -> dict[str, str]:
    info = packed.info
    scale = f"{info.pixel_scale_arcsec:g} arcsec{', assumed' if info.scale_assumed else ''}"
    if info.pixel_lambda_d is not None:
        scale += f" ({info.pixel_lambda_d:.3g} λ/D)"
    framing = f"{info.framing}, ± {info.jitter_px} px"
    count = sum(array.size for array in packed.weights.values())
    normalisation = f"{info.normalisation} 1"
    if info.dae:
        normalisation += f"; the network sees it × {info.image_scale:g}"
        shape = f"kernels {_list(info.dae.kernels)}; widths {_list(info.dae.widths)}"
        network = {"Network": f"{shape}; {count} weights"}
    else:
        network = {"Method": f"{method(info.method).look.label}; {count} numbers"}
    fitted = None if info.dae else estimator(packed)
    own: Mapping[str, str] = fitted.facts() if isinstance(fitted, KnowsField) else {}
    return {
        "Name": info.name,
        "Format": f"{info.format_version}, written {info.created} by psfdae {info.psfdae_version}",
        "Licence": info.licence,
        "SHA-256": packed.sha256,
        "Stamp": f"{info.stamp_px} × {info.stamp_px} px of {scale}",
        "Framing": framing + (", any sub-pixel position" if info.subpixel else ""),
        "Normalisation": normalisation,
        "S/N": f"{info.snr_min:.3g} to {info.snr_max:.3g}",
        "Noise-equivalent area": f"{info.noise_equivalent_px:.3g} px",
        **network,
        **own,
        "Trained on": f"{info.training_stars} {_KINDS[info.source]}, "
        f"SHA-256 {info.training_sha256[:16]}…",
        **({"Adapted to": f"{info.adapted}, after its training"} if info.adapted else {}),
        **({"Light beyond the stamp": str(packed.wings)} if packed.wings else {}),
        "Distance limit": f"{packed.distance_limit:.3g} in {info.components} components",
    }


_KINDS = {"simulated": "simulated stars", "stars": "stars of an image"}


def _list(values: tuple[int, ...]) -> str:
    return " ".join(str(value) for value in values)


def _gain(row: dict[str, float]) -> dict[str, float]:
    """How many times the error of the stamp itself; below 1 the network is no use."""
    noisy, mse = row.get("mse_noisy"), row.get("mse")
    return {"gain": noisy / mse} if noisy and mse else {}


def _table(info: BundleInfo) -> str:
    from astropy.table import Table

    table = Table(_columns(info))
    head, _, *rows = (
        table.pformat(max_lines=-1, max_width=-1, align=">") if table.columns else ("", "")
    )
    return "\n".join(line.rstrip() for line in (head, *rows))


def _columns(info: BundleInfo) -> dict[str, list[str]]:
    """Errors of the test stars as text, by heading."""
    metrics = [row | _gain(row) for row in info.metrics]
    return {
        heading: [format(row[key], form) if key in row else "" for row in metrics]
        for key, (heading, form) in METRICS.items()
        if any(key in row for row in metrics)
    }
