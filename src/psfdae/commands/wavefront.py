"""Command `wavefront`: measure the aberrations of a known telescope from stars of an image.

In: an image or stamps, a star list or detection, the YAML file of a telescope. Out: a FITS file
with coefficients, PSFs and residuals, perhaps a figure, and a report on the terminal. The
measurement itself is `psfdae.wavefront`.
"""

from __future__ import annotations

from typing import Annotated

import click
import numpy as np

from psfdae.base.figures import write_png
from psfdae.base.files import rename_together, write_fits
from psfdae.base.options import File
from psfdae.commands.cli import command
from psfdae.commands.predict import check_targets, write_list
from psfdae.denoise.star_model import SCALE_TOLERANCE
from psfdae.image.catalogue import StarList, as_catalogue
from psfdae.image.detector_frame import find_offset
from psfdae.image.image import Image
from psfdae.image.image_input import ImageInput, ImageOptions
from psfdae.image.observation import Observation
from psfdae.image.opening import open_observation
from psfdae.image.positions import list_offset
from psfdae.image.stamps import central_pixel
from psfdae.sensing.output import report_lines, wavefront_hdus
from psfdae.sensing.plot import wavefront_map
from psfdae.sensing.results import Wavefronts
from psfdae.sensing.results import wavefront as measure_wavefronts
from psfdae.sensing.stars import SensingError
from psfdae.telescope.settings import OwnTelescope, read_telescope


@command("wavefront")
def wavefront_command(
    stars: Annotated[File, {"argument": True, "metavar": "INPUT"}],
    options: ImageOptions,
    telescope: File,
    stamp_px: Annotated[int, click.IntRange(8, 64)] = 16,
    axis: Annotated[tuple[float, float] | None, {"type": (float, float)}] = None,
    joint: bool = False,
    plot: File | None = None,
    seed: Annotated[int, click.IntRange(min=0)] = 0,
    overwrite: bool = False,
    *,
    out: File,
) -> None:
    """Measure the aberrations of a known telescope from the stars in INPUT.

    INPUT is a FITS image with --catalogue or --detect, or a cube of stamps with a catalogue. The
    field angle of a star is in the columns x_deg, y_deg of the list, or follows from its position.
    Two modes of a star are two wavefronts that its image cannot distinguish.

    Parameters
    ----------
    stars : Path
        FITS image, or FITS cube of stamps.
    options : ImageOptions
        Options of the image, and its star list.
    telescope : Path
        YAML file of the telescope, as in config/telescope.
    stamp_px : int
        Side of the stamps.
    axis : tuple[float, float], optional
        Pixel x y (0-based) of the optical axis. [default: the image's middle]
    joint : bool
        Fit the telescope's state to all stars together.
    plot : Path, optional
        PNG: wavefronts over the field.
    seed : int
        Seed of the search.
    overwrite : bool
        Replace files that exist.
    out : Path
        FITS file for coefficients, PSFs and residuals.
    """
    # Refuse options that do not fit together, and outputs that exist.
    if options.colour_column:
        raise SensingError("psfdae wavefront takes light of one colour: no --colour-column")
    source = ImageInput(stars, **vars(options))
    list_path = out.with_name(f"{out.stem}_stars.csv") if options.detect else None
    check_targets((*source.files(), telescope), out, plot, list_path, overwrite=overwrite)
    optics = read_telescope(telescope)
    observation = open_observation(source, stamp_px)
    check_scale(observation, optics)
    field_deg = field_angles(observation, source.catalogue, optics, axis)
    notes = note_axis(observation) if axis is None else []
    # All stars are one piece: the joint fit takes them together.
    stamps = next(observation.chunks(observation.count))
    wavefronts = measure_wavefronts(stamps, optics, field_deg=field_deg, joint=joint, seed=seed)
    notes += _list_note(wavefronts, observation)
    lines = [observation.summary(), *notes, *report_lines(wavefronts)]
    # The FITS file gets its name last: if it exists, everything is done.
    with rename_together(out):
        if list_path is not None:
            write_list(observation, list_path)
        if plot is not None:
            write_png(wavefront_map(wavefronts, f"{source.path.name}: {optics.name}"), plot)
        write_fits(out, wavefront_hdus(wavefronts, source.path.name))
    # Many stars that no wavefront explains mean that the description of the telescope is wrong.
    count, failures = len(wavefronts.stamps), int((~wavefronts.explained).sum())
    summary = (
        f"{out}: {count} stars, {failures} not explained ({failures / count:.1%}), "
        f"χ² {np.nanmedian(wavefronts.chi2):.2f} median"
    )
    if failures > 0.1 * count:
        summary += ": the telescope, its seeing or the prior do not fit the image"
    print("\n".join([*lines, summary]))


def _list_note(wavefronts: Wavefronts, observation: Observation) -> list[str]:
    """Return a sentence on how far stars are off the positions of their list, if there is one.

    This is not a mistake of the list: aberrations such as coma move the light of a star.

    Returns
    -------
    list of str
        Empty for stamps without an image, and if stars are where the list says.
    """
    if not isinstance(observation, Image):
        return []
    # Centroid of the light of the fitted star, in pixels of its stamp (Σ x I / Σ I); the chief
    # ray, about which PSFs are centred, is elsewhere if there is coma.
    rows, columns = np.indices(wavefronts.model.shape[1:])
    total = wavefronts.model.sum(axis=(1, 2))
    centroid = np.stack(
        [(wavefronts.model * index).sum(axis=(1, 2)) / total for index in (columns, rows)]
    )
    # From pixels of the stamp to pixels of the image: add the stamp's first pixel.
    corner = central_pixel(observation.positions.T) - wavefronts.model.shape[-1] // 2
    offset = centroid + corner - observation.positions.T
    offset = np.where(wavefronts.explained, offset, np.nan).T
    note = list_offset(observation.catalogue, offset, accept=True)
    return [] if note is None else [note]


def note_axis(observation: Observation) -> list[str]:
    """Return a sentence if the image is a part of the detector, whose middle is not the axis."""
    frames, any_size = observation.detector_frames, np.full(2, np.inf)
    offset = find_offset({}, any_size, frames, np.zeros(2))
    if offset is None or not offset.any():
        return []
    x, y = offset
    first = f"{observation.path}: its first pixel is x {x:g}, y {y:g} of the detector"
    return [f"{first}, but field angles count from the image's middle: --axis gives the axis"]


def check_scale(observation: Observation, telescope: OwnTelescope) -> None:
    """Refuse an image with pixels of another scale than the telescope's.

    Raises
    ------
    SensingError
        If they differ by more than `SCALE_TOLERANCE`.
    """
    # A cube of stamps without a scale cannot be compared.
    scale, telescope_scale = observation.pixel_scale_arcsec, telescope.pixel_scale_arcsec
    # "not <=" refuses a scale that is not a number, too.
    if scale is not None and not abs(scale / telescope_scale - 1.0) <= SCALE_TOLERANCE:
        raise SensingError(
            f"{observation.path}: pixels of {scale:.6g} arcsec, but the telescope "
            f"{telescope.name!r} has {telescope_scale:.6g} arcsec (tolerance "
            f"{100 * SCALE_TOLERANCE:g} %)"
        )


def field_angles(
    observation: Observation,
    catalogue: StarList | None,
    telescope: OwnTelescope,
    axis: tuple[float, float] | None,
) -> np.ndarray:
    """Return the field angles of the stars: listed ones, or computed from their pixel positions.

    Parameters
    ----------
    observation : Observation
        The image or cube with n stars.
    catalogue : StarList or None
        The star list, perhaps with columns x_deg and y_deg.
    telescope : OwnTelescope
        Gives the angle of a pixel.
    axis : tuple of float or None
        Pixel x, y of the optical axis, by default the middle of the image. If it is given,
        angles in the list are not used.

    Returns
    -------
    ndarray, shape (n, 2)
        x and y in degrees, along columns and rows.

    Raises
    ------
    SensingError
        If neither the list has angles, nor the stars positions in an image.
    """
    # Angles of the list.
    if catalogue is not None and axis is None:
        table = as_catalogue(catalogue)
        if {"x_deg", "y_deg"} <= set(table.table.colnames):
            angle = np.stack([table.numbers("x_deg"), table.numbers("y_deg")], axis=1)
            # --on-image has removed stars from the observation, but not from the list.
            if len(table) != observation.count:
                raise SensingError(f"{table.path}: --on-image takes no list with x_deg, y_deg")
            incomplete = ~np.isfinite(angle).all(axis=1)
            if incomplete.any():
                row = incomplete.argmax() + 1
                raise SensingError(f"{table.path}: no x_deg, y_deg in row {row}")
            return angle
    # Else positions, counted from the axis.
    positions, shape = observation.positions, observation.shape
    if axis is None and isinstance(observation, Image):
        axis = (0.5 * (shape[1] - 1), 0.5 * (shape[0] - 1))
    if positions is None or axis is None:
        raise SensingError(
            f"{observation.path}: the stars' field angles are not known: a star list with columns "
            "x_deg, y_deg, an image, or --axis with positions says them"
        )
    # Distance from the axis in pixels, times arcseconds per pixel, in degrees.
    angle = (positions - np.asarray(axis)) * telescope.pixel_scale_arcsec / 3600.0
    if not np.isfinite(angle).all():
        raise SensingError(f"{observation.path}: stars without a position (--on-image leaves out)")
    return np.asarray(angle)
