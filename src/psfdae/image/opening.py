"""Opening of an observation: an image, its list and what is stated of them become `Observation`.

In: `ImageInput`, the statements on an image. Out: the observation, with the camera checked against
the pixels, mask and map of noise, and the stars of the list, or those found, at their positions.
Pixels are read to find stars, and where there is a map of noise; stamps are cut later.

Whatever is wrong with a file ends in one `ObservationError` of one line that names it.
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
    checked_camera,
    refuse_colours,
    sky_coordinate_remarks,
    unread_card_remarks,
)
from psfdae.image.catalogue import Catalogue, as_catalogue
from psfdae.image.detection import Sky
from psfdae.image.errors import ObservationError, shorten, silent
from psfdae.image.fits_file import ImageFile, find_image
from psfdae.image.image_input import ImageInput
from psfdae.image.layers import Layers, find_layers, with_photons
from psfdae.image.observation import ListedStars, Observation
from psfdae.image.positions import (
    SAME_STAR_PX,
    on_image,
    positions_in_image,
    repeated_rows,
    with_origin,
)
from psfdae.image.stamps import StarFlag, raise_flag


def open_observation(source: ImageInput, stamp_px: int, margin: int = 0) -> Observation:
    """Return the stars of an image, with all that its file, its list and the user say of them.

    Pixels are read to find stars, and where there is a map of noise.

    Parameters
    ----------
    source : ImageInput
        The image, its star list and options.
    stamp_px : int
        Side of the stamps.
    margin : int
        Pixels around each stamp; those of a cube get as many of these as they have.

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
        typed = keyword("bad_bits", source.bad_bits)
        raise ObservationError(source.path, f"{typed}: expected 1 to 2**63 - 1")
    # The image, and whether it is a cube of stamps.
    image = find_image(source.image, source.extension)
    stated_camera = source.camera(image.unit)
    table = None if source.catalogue is None else as_catalogue(source.catalogue)
    image, is_cube = image_or_cube(source, image, table, stamp_px)
    # The camera: values of a header are used as far as the pixels do not contradict them.
    camera, remarks = camera_values(image, stated_camera), unread_card_remarks(image)
    noise_correlation = 1.0
    if not is_cube:
        camera, camera_remarks, noise_correlation = checked_camera(image, camera)
        remarks += [*camera_remarks, *sky_coordinate_remarks(image)]
    # Pixels are read in a unit in which no square overflows; stamps and tables have the image's.
    image = image.to_noise_unit()
    # Mask and map of noise. The map is scaled to the scatter of the sky, above which stars are
    # searched.
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
                layers, camera, photon_remarks = with_photons(layers, camera, sky)
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
    """Tell an image, out of which stars are cut, from a cube of stamps, or one stamp.

    Parameters
    ----------
    source : ImageInput
    image : ImageFile
    table : Catalogue or None
        Star list, if there is one.
    stamp_px : int
        Least side of stamps.

    Returns
    -------
    image : ImageFile
        An image is a plane, even if its file has it as a cube with one.
    is_cube : bool

    Raises
    ------
    ObservationError
        If the image has several colours, an image has neither a list nor is to be searched, a cube
        is to be searched, or stamps are too small.
    """
    # A threshold means that the stars are to be found.
    is_searched = source.detection_sigma is not None
    # A cube with one plane is an image, if it is no stamp of the only star of a list.
    if len(image.shape) == 3 and image.shape[0] == 1:
        has_stars = is_searched or (table is not None and len(table) != 1)
        if has_stars or max(image.shape) > LARGEST_STAMP_PX:
            image = image.one_plane()
    refuse_colours(image)
    shape, size = image.shape, "×".join(map(str, image.shape[-2:]))
    # A plane is an image if it has stars, and else one stamp; stamps are squares of the right size.
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
        Factor from the unit of the list to that of the sky.

    Raises
    ------
    ObservationError
        If there is none.
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
    image : ImageFile
    table : Catalogue or None
        Star list, or the stars that were found in the image.
    layers : Layers
        The image with its sky, which shows the origin of a list that does not say it.
    is_cube : bool
        The image is a cube of stamps.

    Returns
    -------
    stars : ListedStars
    positions : ndarray or None, shape (n, 2)
        None for a cube whose list has no pixels.
    remarks : list of str
        Sentences on the list's origin, and on rows of the same star.

    Raises
    ------
    ObservationError
        If the list does not fit the image, or a column that is stated is missing.
    """
    # Without a list, stars are numbered and have no place.
    remarks: list[str] = []
    positions = None
    count = len(table) if table is not None else image.shape[0] if len(image.shape) == 3 else 1
    identifiers = np.arange(count, dtype=np.int64)
    flags = np.zeros(count, dtype=np.uint16)
    if table is not None:
        # Position columns of the list, with the origin of pixels that is stated, or by custom.
        columns = table.positions()
        if source.origin is not None:
            columns = replace(columns, origin=source.origin)
        # Where neither the user nor the list says the origin of its pixels, the stars show it.
        if columns.origin is None and not (columns.sky or is_cube):
            columns, remarks = with_origin(table, columns, layers)
        positions = positions_in_image(image, table, columns, is_cube)
        identifiers, flags = table.identifiers(), table.flags(columns)
        # Rows of a star that is listed already have no light of their own.
        if positions is not None and not is_cube and source.detection_sigma is None:
            is_repeated = repeated_rows(positions)
            raise_flag(flags, StarFlag.BLENDED, is_repeated)
            if rows := [str(row + 1) for row in np.flatnonzero(is_repeated)]:
                subject = "row is" if len(rows) == 1 else "rows are"
                remarks.append(
                    f"{table.path}: {len(rows)} {subject} within {SAME_STAR_PX:g} px of an earlier "
                    f"one ({shorten(rows)}): flagged BLENDED, and not learnt from"
                )
    # Columns that are stated; NaN where a list has no number, or none is stated.
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
        selected = on_image(positions, image.shape)
        stars, positions = stars.select(selected), positions[selected]
    return stars, positions, remarks
