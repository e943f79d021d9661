"""Opening of an image, or of a cube of stamps, with its star list and the user's options.

Input: `ImageInput`, the options. Output: `Image` or `StampCube`, with a camera that is checked
against the pixels, the mask and the noise map, and listed or detected stars at their positions.
Pixels are read to find stars, and where there is a noise map; stamps are cut later.

Faults of a file raise `ObservationError`, with one line that names the file.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

from psfdae.base.errors import keyword
from psfdae.base.progress import task
from psfdae.image.camera import (
    LARGEST_STAMP_PX,
    CameraValue,
    camera_values,
    check_camera,
    describe_shared_noise,
    refuse_colours,
    sky_coordinate_remarks,
    unread_card_remarks,
)
from psfdae.image.catalogue import Catalogue, as_catalogue
from psfdae.image.detection import find_sources
from psfdae.image.errors import ObservationError, shorten, silent
from psfdae.image.fits_file import ImageFile, find_image
from psfdae.image.image import Image, PixelCache
from psfdae.image.image_input import ImageInput
from psfdae.image.layers import NoiseMap, find_layers, measure_photons
from psfdae.image.list_origin import find_origin
from psfdae.image.observation import ListedStars
from psfdae.image.position_columns import Positions
from psfdae.image.positions import SAME_STAR_PX, is_on_image, positions_in_image
from psfdae.image.sky import Sky
from psfdae.image.stamp_cube import StampCube
from psfdae.image.stamps import StarFlag, raise_flag

ImageOrCube = TypeVar("ImageOrCube", Image, StampCube)


def open_observation(source: ImageInput, stamp_px: int, margin: int = 0) -> Image | StampCube:
    """Open an image or a cube of stamps, with its star list.

    Pixels are read to find stars, and where there is a noise map.

    Parameters
    ----------
    source : ImageInput
        The image, its star list and options.
    stamp_px : int
        Side of the stamps.
    margin : int
        Pixels around each stamp; the stamps of a cube limit it.

    Raises
    ------
    ObservationError
        If the image, its list or an option cannot be used; one line that names the file.
    """
    # Ranges of whole numbers; a mask has up to 63 bits and a sign.
    if stamp_px < 1:
        raise ObservationError(source.path, f"stamp size {stamp_px}, expected at least 1 pixel")
    if margin < 0:
        raise ObservationError(source.path, f"margin {margin}, expected at least 0 pixels")
    if source.bad_bits is not None and not 0 < source.bad_bits < 2**63:
        option_text = keyword("bad_bits", source.bad_bits)
        raise ObservationError(source.path, f"{option_text}: expected 1 to 2**63 - 1")
    # The image, and whether it is a cube of stamps.
    data = find_image(source.image, source.extension)
    user_camera = source.camera(data.unit)
    table = None if source.catalogue is None else as_catalogue(source.catalogue)
    data, is_cube = image_or_cube(source, data, table, stamp_px)
    # The camera: values of a header are used as far as the pixels do not contradict them.
    camera, remarks = camera_values(data, user_camera), unread_card_remarks(data)
    noise_correlation = 1.0
    if not is_cube:
        camera, camera_remarks, noise_correlation = check_camera(data, camera)
        remarks += [*camera_remarks, *sky_coordinate_remarks(data)]
    # Pixels are read in a unit in which no square overflows, and at a level at which no noise is
    # rounded; stamps and tables have the image's own.
    data = data.to_single_precision()
    mask, noise_map, layer_remarks = find_layers(source, data, is_cube)
    # The noise of the electronics in counts: read noise / gain.
    gain, read_noise = camera["gain"].value, camera["read noise"].value
    fields: dict[str, Any] = {
        "path": source.path,
        "data": data,
        "mask": mask,
        "shape": data.shape,
        "stamp_px": stamp_px,
        "camera": camera,
        "least_noise": read_noise / gain if read_noise and gain else 0.0,
        "star_list": table,
        "colour_column": source.colour_column,
        "header_cards": data.provenance(),
        "remarks": (*remarks, *layer_remarks),
    }
    if is_cube:
        margin = min(margin, (data.shape[-1] - stamp_px) // 2)
        # A position in a stamp is not a position on the sky.
        fields["data"] = replace(data, wcs=None)
        return add_stars(source, StampCube(**fields, margin=margin))
    image = Image(**fields, margin=margin, noise_map=noise_map, noise_correlation=noise_correlation)
    # The map is scaled to the scatter of the sky, in which stars are detected.
    if source.detection_sigma is not None or noise_map is not None:
        image = search_sky(source, image)
    return add_stars(source, image)


def search_sky(source: ImageInput, image: Image) -> Image:
    """Measure the sky of an image, to scale its noise map and to find its stars.

    Parameters
    ----------
    source : ImageInput
        Options, of which the detection threshold is used.
    image : Image
        The image without its stars.

    Returns
    -------
    Image
        With remarks on the sky, `noise_map` to scale, and `detections` if stars are searched.

    Raises
    ------
    ObservationError
        If the sky cannot be measured, or no star is found.
    """
    threshold = source.detection_sigma
    with task("image", 2) as advance:
        sky = image.sky()
        advance(1, "sky")
        sky_notes = [f"{source.path}: {note}" for note in sky.notes]
        # The sample of the sky by which the camera was checked may have shown shared noise already.
        if sky.correlation > 1.0 and image.noise_correlation == 1.0:
            sky_notes.append(describe_shared_noise(source.path, sky.correlation))
            image = replace(image, noise_correlation=sky.correlation)
        image = replace(image, remarks=(*image.remarks, *sky_notes))
        if image.noise_map is not None:
            image = scale_noise_map(image, image.noise_map, sky)
        if threshold is not None:
            image = replace(image, detections=detect_stars(image, sky, threshold))
    return image


def scale_noise_map(image: Image, noise_map: NoiseMap, sky: Sky) -> Image:
    """Scale the noise map of an image to the scatter of its sky, and find the photons in it.

    If the map grows with the light of stars, it shows the gain, which is used if it is not known
    otherwise, with a remark.
    """
    camera, remarks = image.camera, image.remarks
    noise_map = replace(noise_map, scale=sky.noise_scale)
    if slope := measure_photons(noise_map, sky):
        # σ is scaled by the measured noise of the sky, and so is the slope of its square.
        noise_map = replace(noise_map, photons=slope / noise_map.scale**2)
        if camera["gain"].value is None:
            # In the unit of the file, light / g is its variance.
            gain, label = image.unit_factor / slope, noise_map.data.label
            camera = camera | {"gain": CameraValue(gain, label)}
            words = f"{label} grows with the light of the stars: gain {gain:.4g}"
            remarks = (*remarks, f"{image.data.path}: {words}")
    # With this map, whose scale includes noise that pixels share, the sky is measured anew when it
    # is needed; bad pixels stay.
    image = replace(image, noise_map=noise_map, noise_correlation=1.0, camera=camera)
    return replace(image, remarks=remarks, cache=PixelCache(image.bad_pixels))


def image_or_cube(
    source: ImageInput, image: ImageFile, table: Catalogue | None, stamp_px: int
) -> tuple[ImageFile, bool]:
    """Distinguish an image, out of which stars are cut, from a cube of stamps or one stamp.

    Parameters
    ----------
    source : ImageInput
        Options, of which the detection threshold and the origin are used.
    image : ImageFile
        The plane or cube of the file.
    table : Catalogue or None
        Star list, if there is one.
    stamp_px : int
        Minimum side of stamps.

    Returns
    -------
    image : ImageFile
        An image is a plane, even if its file has it as a cube with one.
    is_cube : bool
        True for a cube of stamps, or one stamp.

    Raises
    ------
    ObservationError
        If the image has several colours, an image has neither a list nor is to be searched, a cube
        is to be searched, or stamps are too small.
    """
    # A threshold means that the stars are to be found.
    is_searched = source.detection_sigma is not None
    # A cube with one plane is an image, unless it is the stamp of the only star of a list.
    if len(image.shape) == 3 and image.shape[0] == 1:
        has_stars = is_searched or (table is not None and len(table) != 1)
        if has_stars or max(image.shape) > LARGEST_STAMP_PX:
            image = image.one_plane()
    refuse_colours(image)
    shape, size = image.shape, "×".join(map(str, image.shape[-2:]))
    # A plane is an image if it has a list or is searched, else one stamp; stamps are squares.
    is_image = len(shape) == 2 and (table is not None or is_searched)
    is_square = shape[-2] == shape[-1] >= stamp_px
    if not is_image and not (is_square and (len(shape) == 3 or shape[-1] == stamp_px)):
        if len(shape) == 2:
            raise ObservationError(
                image.path,
                f"an image of {size} pixels needs {keyword('catalogue')}, a list of its stars, or "
                f"{keyword('detect', True)}",
            )
        raise ObservationError(
            image.path, f"stamps of {size} pixels, expected {stamp_px}×{stamp_px} pixels or larger"
        )
    if is_searched and (not is_image or table is not None or source.origin is not None):
        raise ObservationError(
            source.path,
            f"{keyword('detect', True)} takes an image, no cube; no list, and no origin of one",
        )
    return image, not is_image


def detect_stars(image: Image, sky: Sky, threshold: float) -> Catalogue:
    """Return the stars of an image that are `threshold` σ above its sky.

    Parameters
    ----------
    image : Image
        The image, in whose unit the list is.
    sky : Sky
        The image without its sky.
    threshold : float
        In σ of the slightly smoothed image.

    Raises
    ------
    ObservationError
        If no star is found.
    """
    from astropy.table import Table

    with silent():
        # The list has the columns of SExtractor, as a list in a file might.
        table = Table(find_sources(sky, threshold))
        if len(table):
            table["FLUX_ISO"] /= image.unit_factor
            table["BACKGROUND"] = image.to_image_unit(table["BACKGROUND"])
    if len(table) == 0:
        raise ObservationError(
            image.path,
            f"no star {threshold:g} σ above the sky; {keyword('threshold')} sets another limit",
        )
    return Catalogue(image.path, table)


def add_stars(source: ImageInput, image: ImageOrCube) -> ImageOrCube:
    """Return an image or cube with the stars of its list, or of a cube without one.

    Parameters
    ----------
    source : ImageInput
        Options, of which the origin and the columns of the list are used.
    image : Image or StampCube
        Without its stars. If the origin of the list is unknown, its sky is measured.

    Returns
    -------
    Image or StampCube
        With `stars`, `positions`, and remarks on the list's origin, and on rows of the same star.

    Raises
    ------
    ObservationError
        If the list does not fit the image, or a column that the user names is missing.
    """
    # Without a list, stars are numbered and their positions are unknown.
    remarks: list[str] = []
    positions: Any = None  # of a cube; an image has a list
    table, shape = image.detections or image.star_list, image.shape
    count = len(table) if table is not None else shape[0] if len(shape) == 3 else 1
    identifiers = np.arange(count, dtype=np.int64)
    flags = np.zeros(count, dtype=np.uint16)
    if table is not None:
        # Position columns of the list, with the pixel origin that the user gives, or by custom.
        columns = table.positions()
        if source.origin is not None:
            columns = replace(columns, origin=source.origin)
        # If neither the user nor the list gives the pixel origin, estimate it from the stars.
        if columns.origin is None and not columns.sky and isinstance(image, Image):
            columns, remarks = add_origin(table, columns, image)
        positions = positions_in_image(image.data, table, columns, isinstance(image, StampCube))
        identifiers, flags = table.identifiers(), table.flags(columns)
    # Columns that the user names; NaN where the list gives no number, or without a name.
    numbers = [np.full(count, np.nan) for _ in range(3)]
    for k, name in enumerate((source.flux_column, source.background_column, source.colour_column)):
        if name is not None and table is None:
            raise ObservationError(source.path, f"no catalogue is given to take {name!r} from")
        if name is not None and table is not None:
            numbers[k] = table.numbers(name)
    stars = ListedStars(identifiers, np.arange(count), numbers[0], numbers[1], numbers[2], flags)
    image = replace(image, stars=stars, positions=positions)
    # Rows that repeat a star of an earlier row are flagged.
    is_repeated = image.find_repeated_stars()
    raise_flag(flags, StarFlag.BLENDED, is_repeated)
    if rows := [str(row + 1) for row in np.flatnonzero(is_repeated)]:
        subject = "row is" if len(rows) == 1 else "rows are"
        remarks.append(
            f"{image.catalogue}: {len(rows)} {subject} within {SAME_STAR_PX:g} px of an earlier "
            f"one ({shorten(rows)}): flagged BLENDED, and not trained on"
        )
    image = replace(image, remarks=(*image.remarks, *remarks))
    # A list may cover a larger part of the sky than the image; rows keep their numbers.
    if source.on_image and isinstance(image, Image):
        return image.select(is_on_image(positions, shape))
    return image


def add_origin(table: Catalogue, columns: Positions, image: Image) -> tuple[Positions, list[str]]:
    """Return the columns of a list with the origin that the stars of an image show.

    Returns
    -------
    columns : Positions
        Unchanged if the stars do not show it clearly, or no sky can be measured.
    remarks : list of str
        A sentence on the origin that was found.
    """
    # Centroids of the stars differ from the pixels of the list by the origin.
    list_pixels = np.stack([table.pixels(columns.first), table.pixels(columns.second)], axis=1)
    try:
        data_origin = find_origin(image.sky(), list_pixels)
    except ObservationError:  # no sky can be measured
        data_origin = None
    if data_origin is None:
        return columns, []
    origin, offset, count = data_origin
    sentence = (
        f"{table.path}: {columns.first},{columns.second} count from {origin}, as {count} stars "
        f"show (their centroids are off by x {offset[0]:+.2f}, y {offset[1]:+.2f} px); "
        f"{keyword('origin')} sets it"
    )
    return replace(columns, origin=origin), [sentence]
