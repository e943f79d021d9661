"""Stages `describe` and `export`: what a bundle is, its model card, and its network as ONNX."""

from __future__ import annotations

import json
import re
import textwrap
from collections.abc import Iterator, Mapping
from typing import Annotated, Any

from psfdae.bundle_info import BundleInfo
from psfdae.cli import command
from psfdae.files import check_outputs
from psfdae.image.errors import one_line
from psfdae.method import Exports, FitError, KnowsField, MeasuresStars
from psfdae.methods import method
from psfdae.model.bundle import SUFFIX, Bundle, estimator, read_bundle
from psfdae.model.psf_model import SCALE_TOLERANCE
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


@command("export")
def export(
    bundle: Annotated[File, {"argument": True}], *, out: Annotated[File, "ONNX file."]
) -> None:
    """Export the network of BUNDLE to ONNX and check it."""
    import logging
    import warnings

    check_outputs((out,), (bundle,))
    packed = read_bundle(bundle)
    # The exporter speaks of optional packages and of its own internals.
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)
        fitted = estimator(packed)
        if not isinstance(fitted, Exports):
            label = fitted.look.label
            raise FitError(f"{label}: is no network, ONNX has no form for it")
        fitted.export(packed.info.stamp_px, out)


@command("describe")
def describe(
    bundle: Packed = None,
    card: Annotated[bool, "As a model card, Markdown with a header for Hugging Face."] = False,
) -> None:
    """Say what BUNDLE (default: the shipped one) was trained for and how well it does."""
    print((model_card if card else description)(read_bundle(bundle)))


def description(packed: Bundle) -> str:
    """What a bundle says of itself, for people."""
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


# The model card.

SAID = {
    "λ": "noise level of the training",
    "noise/flux": "RMS of the sky noise in a pixel over the flux of the star",
    "S/N": "signal-to-noise ratio of a filter matched to the typical star",
    "MSE noisy": "mean squared error of the noisy stamp itself",
    "MSE": "mean squared error of the model, per pixel, of stars of flux 1",
    "gain": "MSE noisy over MSE",
    "SSIM": "structural similarity to the image that is to be restored",
    "in error68": "pixels whose error is within the stated uncertainty; 68.3 % is right",
    "in 95 %": "pixels within the wider interval; 95 % is right",
    "in rms": "pixels within the root mean square of the errors",
}
"""What the columns are, for readers of a card."""

RESTORED = {
    "realisation": "the image of the star without noise",
    "template": "the static PSF of the star's place in the field",
}

SPLITS = {
    "random": "other stars than those of the training, at the same places of the field",
    "held_out": "stars at places of the field that the training did not see",
}

NO_BREAK = "\N{NO-BREAK SPACE}"

UNKNOWN = "not stated"
"""The licence of a bundle whose maker gave none."""


def model_card(packed: Bundle) -> str:
    """What a bundle says of itself as a model card of Hugging Face: YAML header and Markdown."""
    info = packed.info
    parts = {
        "Model": _two_columns(_facts(packed)),
        "Intended use": _use(packed),
        "Training data": _data(info),
        "Errors by S/N, and coverage": _errors(info),
        "Limits": "\n".join(map(_item, _limits(packed))),
        "What the file does not say": "\n".join(map(_item, _gaps(info))),
        "Licence": _wrapped(
            f"{_code(info.licence)}, as its maker states in the file."
            if info.licence != UNKNOWN
            else "The maker stated none: ask before you pass the model on."
        ),
    }
    return "\n\n".join(
        [
            _header(info),
            f"# Model card of {_code(info.name)}",
            "`psfdae describe --card` wrote this page from the file of the model alone.",
            *(f"## {title}\n\n{text}" for title, text in parts.items()),
        ]
    )


def _header(info: BundleInfo) -> str:
    """YAML (JSON is a part of it); for Hugging Face, licences are SPDX names in lower case."""
    licence = {"license": "other", "license_name": one_line(info.licence)}
    if info.licence == UNKNOWN:
        licence = {"license": "unknown"}
    elif re.fullmatch(r"[A-Za-z0-9.+-]+", info.licence):
        licence = {"license": info.licence.lower()}
    tags = ["astronomy", "point-spread-function", info.method, info.source]
    fields: dict[str, Any] = {**licence, "library_name": "psfdae", "tags": tags}
    lines = (f"{key}: {_json(value)}" for key, value in fields.items())
    return "\n".join(["---", *lines, "---"])


def _use(packed: Bundle) -> str:
    info = packed.info
    reference = info.reference or _of_training(info).get("reference")
    what = RESTORED.get(str(reference), "the image of the star that its training had")
    fitted = None if info.dae else estimator(packed)
    places, bright = isinstance(fitted, KnowsField), isinstance(fitted, MeasuresStars)
    most = "" if bright else f", at most {info.snr_max:.3g}"
    shipped = packed.sha256 == read_bundle(None).sha256
    options = "" if shipped else f"--model FILE{SUFFIX} "
    like = (
        "of a telescope like the simulated one below"
        if info.source == "simulated"
        else f"like {_code(_said(info, 'image'))}: of the same camera and filter, with the same "
        "focus, seeing and guiding"
    )
    text = (
        f"It takes single stars, stamps of {info.stamp_px} × {info.stamp_px} px with the sky in "
        f"them, and estimates {what}{', and the PSF at places without a star' if places else ''}. "
        f"The pixels must be {info.pixel_scale_arcsec:g} arcsec wide, within "
        f"{100 * SCALE_TOLERANCE:g} %, and the S/N at least {info.snr_min:.3g}{most}. "
        f"It is meant for images {like}."
    )
    command = f"psfdae predict image.fits --catalogue stars.csv {options}--out restored.fits"
    return f"{_wrapped(text)}\n\n```sh\n{command}\n```"


def _data(info: BundleInfo) -> str:
    image = f"{_code(_said(info, 'image'))} (SHA-256 {_code(_said(info, 'image_sha256'))})"
    if info.source == "simulated":
        text = f"{info.training_stars} simulated stars; no image of the sky was used."
    elif info.adapted:
        text = (
            f"{info.training_stars} bright stars of an exposure that the file does not name; then "
            f"the model was adapted to another one, {image}."
        )
    else:
        text = f"{info.training_stars} bright stars of {image}."
    text += f" SHA-256 of the images: {_code(info.training_sha256)}. All settings:"
    settings = {
        f"{part}.{key}": value
        for part, tree in info.config.items()
        for key, value in (tree.items() if isinstance(tree, Mapping) else [("", tree)])
    }
    lines = ",\n".join(f"  {_json(key)}: {_json(value)}" for key, value in settings.items())
    return "\n".join([_wrapped(text), "", "```json", "{", lines, "}", "```"])


def _errors(info: BundleInfo) -> str:
    columns = _columns(info)
    if not columns:
        return "The file has none."
    counts = {int(row["stars"]) for row in info.metrics if "stars" in row}
    stars = f"{counts.pop()} images at each S/N" if len(counts) == 1 else "Images"
    split = str(_of_training(info).get("split"))
    whose = SPLITS.get(split, "stars of which the file says no more")
    if info.source == "stars":
        whose = "stars that were held out of the training"
    before = ", before the model was adapted" if info.adapted else ""
    rows = zip(*columns.values(), strict=True)
    table = [tuple(columns), ("--:",) * len(columns), *rows]
    lines = [f"| {' | '.join(row)} |" for row in table]
    meaning = [_item(f"{heading}: {SAID[heading]}") for heading in columns]
    said = _wrapped(f"{stars} of {whose}, with simulated noise{before}.")
    return "\n".join([said, "", *lines, "", *meaning])


def _limits(packed: Bundle) -> Iterator[str]:
    info = packed.info
    yield f"Its errors outside S/N {info.snr_min:.3g} to {info.snr_max:.3g} were not measured."
    worse = [row.get("snr", 0.0) for row in info.metrics if _gain(row).get("gain", 1.0) < 1.0]
    if worse:
        listed = ", ".join(f"{snr:.0f}" for snr in sorted(worse))
        yield f"At S/N {listed} the noisy stamp itself has the smaller error."
    if info.source == "simulated":
        yield "It knows the simulated telescope alone; its errors on images of the sky are unknown."
    else:
        yield "The truth of its errors is bright stars of the image, which have noise themselves."
    yield (
        "Stars unlike those of its training get the flag UNLIKE_TRAINING: farther than 99.9 % of "
        f"the test stars from them ({packed.distance_limit:.3g} in {info.components} components"
        f"{', or by its own law of stars' if packed.strange_limit is not None else ''}). Not all "
        "are found."
    )
    if packed.scales(packed.noise_nodes) is None:
        yield "Its uncertainties hold where flux, sky and noise are given, not estimated."
    if info.scale_assumed:
        yield "The pixel scale was assumed; the image of the training does not state it."


def _gaps(info: BundleInfo) -> Iterator[str]:
    yield "Who made it. The SHA-256 tells damage, not the maker."
    yield "Time, memory and energy of the training."
    yield "Errors by place in the field, by colour of the star, or in crowded fields."
    if info.pixel_lambda_d is None:
        yield "Aperture, wavelength and optics of the telescope."
    if not any(key.startswith("coverage") for row in info.metrics for key in row):
        yield "How often its uncertainties hold."
    if info.adapted:
        yield "Its errors after it was adapted."


def _of_training(info: BundleInfo) -> Mapping[str, Any]:
    tree = info.config.get("train")
    return tree if isinstance(tree, Mapping) else {}


def _said(info: BundleInfo, key: str) -> str:
    tree = info.config.get("stars")
    return str(tree.get(key, "not stated")) if isinstance(tree, Mapping) else "not stated"


def _json(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False)


def _code(text: str) -> str:
    """Text of a file as it is: in a code span, Markdown takes nothing of it for its own.

    Its spaces do not break, lest a part of it begins a line.
    """
    return f"`{one_line(text).replace('`', chr(39)).replace(' ', NO_BREAK)}`"


def _plain(text: str) -> str:
    """Text of a file outside of code: its marks of Markdown and HTML are shown as they are."""
    return re.sub(r"([\\`*_\[\]<>|])", r"\\\1", one_line(text))


def _two_columns(facts: Mapping[str, str]) -> str:
    rows = (f"| {name} | {_plain(value)} |" for name, value in facts.items())
    return "\n".join(["| | |", "|---|---|", *rows])


def _item(text: str) -> str:
    return _wrapped(f"- {text}", indent="  ")


def _wrapped(text: str, indent: str = "") -> str:
    """Lines of a page, all but the first one indented."""
    return textwrap.fill(
        text, 120, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False
    )
