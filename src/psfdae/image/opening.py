"""Opening of an observation from an image, its star list and the user's options.

Input: `ImageInput`, the options. Output: `Observation`, with a camera that is checked against the
pixels, the mask and the noise map, and listed or detected stars at their positions. Pixels are read
to find stars, and where there is a noise map; stamps are cut later.

Faults of a file raise `ObservationError`, with one line that names the file.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from psfdae.base.errors import keyword
from psfdae.base.progress import task
from psfdae.image.camera import (
    LARGEST_STAMP_PX,
    camera_values,
    check_camera,
    refuse_colours,
    sky_coordinate_remarks,
    unread_card_remarks,
)
from psfdae.image.catalogue import Catalogue, as_catalogue
from psfdae.image.detection import Sky
from psfdae.image.errors import ObservationError, shorten, silent
from psfdae.image.fits_file import ImageFile, find_image
from psfdae.image.image_input import ImageInput
from psfdae.image.layers import Layers, add_photon_noise, find_layers
from psfdae.image.observation import ListedStars, Observation
from psfdae.image.positions import (
    SAME_STAR_PX,
    add_origin,
    find_repeated_rows,
    is_on_image,
    positions_in_image,
)
from psfdae.image.stamps import StarFlag, raise_flag


def open_observation(source: ImageInput, stamp_px: int, margin: int = 0) -> Observation:
    """Open an image and its star list as an observation.

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
    image = find_image(source.image, source.extension)
    user_camera = source.camera(image.unit)
    table = None if source.catalogue is None else as_catalogue(source.catalogue)
    image, is_cube = image_or_cube(source, image, table, stamp_px)
    # The camera: values of a header are used as far as the pixels do not contradict them.
    camera, remarks = camera_values(image, user_camera), unread_card_remarks(image)
    noise_correlation = 1.0
    if not is_cube:
        camera, camera_remarks, noise_correlation = check_camera(image, camera)
        remarks += [*camera_remarks, *sky_coordinate_remarks(image)]
    # Pixels are read in a unit in which no square overflows; stamps and tables have the image's.
    image = image.to_noise_unit()
    # Mask and noise map. The map is scaled to the scatter of the sky, in which stars are
    # detected.
    layers, layer_remarks = find_layers(source, image, is_cube, camera)
    remarks += layer_remarks
    detections, threshold = None, source.detection_sigma
    if threshold is not None or layers.noise is not None:
        with task("image", 2) as advance:
            sky = layers.sky()
            advance(1, "sky")
            remarks += [f"{source.path}: {note}" for note in sky.notes]
            if layers.noise is not None:
                layers = replace(layers, noise=replace(layers.noise, scale=sky.noise_scale))
                layers, camera, photon_remarks = add_photon_noise(layers, camera, sky)
                remarks += photon_remarks
            if threshold is not None:
                detections = detect_stars(source.path, sky, threshold, image.unit_factor)
    star_list = detections or table
    stars, positions, list_remarks = locate_stars(source, image, star_list, layers, is_cube)
    return Observation(
        source.path,
        stamp_px,
        margin=min(margin, (image.shape[-1] - stamp_px) // 2) if is_cube else margin,
        shape=None if is_cube else image.shape,
        camera=camera,
        positions=positions,
        stars=stars,
        header_cards=image.provenance(),
        catalogue=None if table is None else table.path,
        detections=detections,
        colour_column=source.colour_column,
        remarks=(*remarks, *list_remarks),
        # The scale of a noise map includes it.
        noise_correlation=noise_correlation if layers.noise is None else 1.0,
        _list=table,
        _layers=layers,
    )


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


def detect_stars(path: Path, sky: Sky, threshold: float, unit_factor: float = 1.0) -> Catalogue:
    """Return the stars of an image that are `threshold` σ above its sky.

    Parameters
    ----------
    path : Path
        The image, for messages.
    sky : Sky
        The image without its sky.
    threshold : float
        In σ of the slightly smoothed image.
    unit_factor : float
        Factor from the unit of the list to the unit of the sky.

    Raises
    ------
    ObservationError
        If no star is found.
    """
    from astropy.table import Table

    with silent():
        # The list has the columns of SExtractor, as a list in a file might.
        table = Table(sky.stars(threshold))
        for name in {"FLUX_ISO", "BACKGROUND"}.intersection(table.colnames):
            table[name] /= unit_factor
    if len(table) == 0:
        raise ObservationError(
            path,
            f"no star {threshold:g} σ above the sky; {keyword('threshold')} sets another limit",
        )
    return Catalogue(path, table)


def locate_stars(
    source: ImageInput, image: ImageFile, table: Catalogue | None, layers: Layers, is_cube: bool
) -> tuple[ListedStars, np.ndarray | None, list[str]]:
    """Return the stars of a list, or of a cube without one, with their positions.

    Parameters
    ----------
    source : ImageInput
        Options, of which the origin and the columns of the list are used.
    image : ImageFile
        Image or cube, with the WCS.
    table : Catalogue or None
        Star list, or the stars that were found in the image.
    layers : Layers
        The image with its sky, from which an unknown origin of the list is estimated.
    is_cube : bool
        The image is a cube of stamps.

    Returns
    -------
    stars : ListedStars
        Columns of the list.
    positions : ndarray or None, shape (n, 2)
        0-based x and y; None for a cube without a list of pixel positions.
    remarks : list of str
        Sentences on the list's origin, and on rows of the same star.

    Raises
    ------
    ObservationError
        If the list does not fit the image, or a column that the user names is missing.
    """
    # Without a list, stars are numbered and their positions are unknown.
    remarks: list[str] = []
    positions = None
    count = len(table) if table is not None else image.shape[0] if len(image.shape) == 3 else 1
    identifiers = np.arange(count, dtype=np.int64)
    flags = np.zeros(count, dtype=np.uint16)
    if table is not None:
        # Position columns of the list, with the pixel origin that the user gives, or by custom.
        columns = table.positions()
        if source.origin is not None:
            columns = replace(columns, origin=source.origin)
        # If neither the user nor the list gives the pixel origin, estimate it from the stars.
        if columns.origin is None and not (columns.sky or is_cube):
            columns, remarks = add_origin(table, columns, layers)
        positions = positions_in_image(image, table, columns, is_cube)
        identifiers, flags = table.identifiers(), table.flags(columns)
        # Rows that repeat a star of an earlier row are flagged.
        if positions is not None and not is_cube and source.detection_sigma is None:
            is_repeated = find_repeated_rows(positions)
            raise_flag(flags, StarFlag.BLENDED, is_repeated)
            if rows := [str(row + 1) for row in np.flatnonzero(is_repeated)]:
                subject = "row is" if len(rows) == 1 else "rows are"
                remarks.append(
                    f"{table.path}: {len(rows)} {subject} within {SAME_STAR_PX:g} px of an earlier "
                    f"one ({shorten(rows)}): flagged BLENDED, and not learnt from"
                )
    # Columns that the user names; NaN where the list gives no number, or without a name.
    numbers = [np.full(count, np.nan) for _ in range(3)]
    for k, name in enumerate((source.flux_column, source.background_column, source.colour_column)):
        if name is not None and table is None:
            raise ObservationError(source.path, f"no catalogue is given to take {name!r} from")
        if name is not None and table is not None:
            numbers[k] = table.numbers(name)
    stars = ListedStars(identifiers, np.arange(count), numbers[0], numbers[1], numbers[2], flags)
    # A list may cover a larger part of the sky than the image.
    if source.on_image and positions is not None and not is_cube:
        # Rows keep their numbers in the list.
        is_selected = is_on_image(positions, image.shape)
        stars, positions = stars.select(is_selected), positions[is_selected]
    return stars, positions, remarks
