"""Stage `simulate`: what a telescope does to a star, everywhere in its field."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from psfdae.evaluation.telescope_figure import FieldOfPsfs, field_of_psfs
from psfdae.files import Product, atomic_path, read_product, write_text
from psfdae.prediction.shapes import measure_shapes
from psfdae.stages import templates
from psfdae.stages.common import scene_module
from psfdae.stages.figures import write_png

ENOUGH_LIGHT = 0.8
"""Fraction of the light below which a stamp is called too small."""

LARGEST = 4
"""Stamps up to this many times as wide are tried to find one that is wide enough."""

LEAST_FWHM_PX = 1.5
"""A narrower PSF looks different in every place of a pixel."""


class FitError(ValueError):
    """The PSFs of a telescope do not fit into their stamps."""


def run(config: Any, out: Path, least_energy: float) -> tuple[FieldOfPsfs, list[str]]:
    """Propagate the static PSFs, look at them, and write them with a picture and a table.

    Writes `templates.h5` (byte by byte that of the stage `templates`), `psfs.png` and
    `fields.csv` into a folder. No file is written if the PSFs do not fit.

    Parameters
    ----------
    config : stage config of `templates`
    out : folder
    least_energy : float
        A stamp that holds less of the light is refused, 0 … 1.

    Returns
    -------
    fields : FieldOfPsfs
    warnings : list of str
        What a user should know, a line each.

    Raises
    ------
    FitError
        If a stamp holds too little of the light.
    SamplingError, FramingError, RayTracingError
        If the optics cannot be sampled, framed or traced.
    """
    with atomic_path(out / "templates.h5") as temporary:
        templates.templates(config, temporary)
        fields = measure_fields(read_product(temporary, "templates"))
        warnings = [*_light(config, fields, least_energy), *_sampling(config, fields)]
    draw(out / "templates.h5", out / "psfs.png", out / "fields.csv")
    return fields, warnings


def draw(templates_h5: Path, picture: Path, table: Path) -> None:
    """Draw and tabulate the static PSFs of a telescope.

    Parameters
    ----------
    templates_h5 : product "templates"
    picture : path of the PNG
    table : path of the CSV, a row for every field point
    """
    product = read_product(templates_h5, "templates")
    fields, telescope = measure_fields(product), product.config["telescope"]
    write_text(table, _table(fields, product["pupil_samples"]))
    write_png(field_of_psfs(fields, telescope["name"], telescope["pixel_scale_arcsec"]), picture)


def measure_fields(product: Product) -> FieldOfPsfs:
    """Stamps of the product "templates" without their margin, and their shapes."""
    margin = product.config["framing"]["jitter_px"]
    side = product["psf"].shape[-1] - margin
    psf = product["psf"][:, margin:side, margin:side]
    shapes = measure_shapes(psf)
    return FieldOfPsfs(
        psf,
        product["grid"],
        product["field"],
        product["energy"],
        shapes.fwhm_px * product.config["telescope"]["pixel_scale_arcsec"],
        shapes.ellipticity,
        shapes.position_angle_deg,
    )


def _light(config: Any, fields: FieldOfPsfs, least_energy: float) -> list[str]:
    energy, side = fields.energy, config.framing.stamp_px
    if not energy.min() < ENOUGH_LIGHT:
        return []
    worst = int(energy.argmin())
    x, y = np.rad2deg(fields.field[worst])
    wide = _wide_enough(config, worst)
    advice = (
        f"framing.stamp_px={wide} would hold {ENOUGH_LIGHT:.0%} of it everywhere"
        if wide
        else f"no stamp up to {LARGEST * side} px holds {ENOUGH_LIGHT:.0%} of it everywhere"
    )
    found = (
        f"{int((energy < ENOUGH_LIGHT).sum())} of {energy.size} fields have less than "
        f"{ENOUGH_LIGHT:.0%} of their light inside {side} × {side} px, the least "
        f"{energy[worst]:.1%} at ({x:.3g}, {y:.3g})°; {advice}"
    )
    if energy.min() < least_energy:
        raise FitError(f"telescope = {config.telescope.name}: {found} (--least-energy)")
    return [found]


def _wide_enough(config: Any, worst: int) -> int | None:
    """Least even stamp that holds enough light of the field that needs the widest one."""
    from psfdae.optics.sampling import SamplingError
    from psfdae.stars.framing import FramingError
    from psfdae.stars.scene import Propagation

    side = LARGEST * config.framing.stamp_px
    framing = config.framing.model_copy(update={"stamp_px": side})
    source = scene_module(config.scene.name).template_wavefronts(config)
    try:
        propagation = Propagation(
            source, config.telescope, config.optics, framing, framing.search_px
        )
        field = np.array([worst])
        stamp = propagation.stamps(side, propagation.brightest(field), field)[0]
    except (SamplingError, FramingError):
        return None
    for size in range(config.framing.stamp_px + 2, side + 1, 2):
        cut = slice((side - size) // 2, (side + size) // 2)
        if stamp[cut, cut].sum() >= ENOUGH_LIGHT:
            return size
    return None


def _sampling(config: Any, fields: FieldOfPsfs) -> list[str]:
    width = np.median(fields.fwhm_arcsec) / config.telescope.pixel_scale_arcsec
    if width >= LEAST_FWHM_PX:
        return []
    return [
        f"the PSFs are {width:.2f} px wide (median FWHM, the pixel included): undersampled, what "
        "a star looks like depends on its place in the pixel more than on the optics"
    ]


def _table(fields: FieldOfPsfs, pupil_samples: np.ndarray) -> str:
    """CSV of the field points."""
    x, y = np.rad2deg(fields.field).T
    columns = {
        "x_deg": x,
        "y_deg": y,
        "energy": fields.energy,
        "fwhm_arcsec": fields.fwhm_arcsec,
        "ellipticity": fields.ellipticity,
        "position_angle_deg": fields.position_angle_deg,
        "pupil_samples": pupil_samples,
    }
    rows = (
        ",".join(f"{value:.6g}" for value in row) for row in zip(*columns.values(), strict=True)
    )
    return "\n".join([",".join(columns), *rows]) + "\n"
