"""Command `detect`: the stars of an image as a star list."""

from __future__ import annotations

from typing import Annotated

from psfdae.base.errors import Error
from psfdae.base.options import File
from psfdae.commands.cli import command
from psfdae.commands.predict import check_targets
from psfdae.image.detected_stars import find_stars
from psfdae.image.image_input import ImageInput, ImageOptions
from psfdae.image.tables import SUFFIXES, write_table


@command("detect")
def detect_command(
    image: Annotated[File, {"argument": True}],
    options: ImageOptions,
    overwrite: bool = False,
    *,
    out: File,
) -> None:
    """Find the stars of IMAGE, and write a star list that all commands take.

    Parameters
    ----------
    image : Path
        FITS image.
    options : ImageOptions
        Options of the image, and its star list.
    overwrite : bool
        Replace a file that exists.
    out : Path
        Table of the stars: .fits, .ecsv or .csv.
    """
    if options.catalogue is not None:
        raise Error("--catalogue: this command makes the star list")
    if out.suffix.lower() not in SUFFIXES:
        raise Error(f"{out}: expected a name that ends in {', '.join(SUFFIXES)}")
    source = ImageInput(image, **vars(options) | {"detect": True})
    check_targets(source.files(), out, overwrite=overwrite)
    stars = find_stars(source)
    write_table(out, stars)
    print(f"{out}: {len(stars)} stars")
