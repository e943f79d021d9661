"""Options of an image and its stars, once for the command line and for Python.

An option of `psfdae predict`, a keyword of `psfdae.Stars.from_image` and a row of a table on the
pages are fields of `ImageOptions`. `ImageInput` adds the image, which
`psfdae.image.opening.open_observation` opens.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias, TypedDict

import numpy as np

from psfdae.base.arguments import check_values
from psfdae.base.errors import did_you_mean, keyword
from psfdae.base.options import Extension, File
from psfdae.image.camera import HEADER_KEYS
from psfdae.image.catalogue import require_sky
from psfdae.image.containers import as_image, to_unit
from psfdae.image.errors import ObservationError
from psfdae.image.fits_file import PlainFile

if TYPE_CHECKING:
    from astropy.units import Quantity

    from psfdae.image.catalogue import StarList
    from psfdae.image.containers import ImageLike

    Number: TypeAlias = float | Quantity
else:
    # Types of the command line in their place.
    StarList, Number = File, float

Layer: TypeAlias = Extension | Path | np.ndarray
"""Extension of the image's file, another file, or an array as large as the image."""


@dataclass(frozen=True, kw_only=True)
class ImageOptions:
    """Options of an image and its stars; each overrides the FITS header.

    The text after the type of a field is the help of its option, and its meaning in Python. There,
    `catalogue` takes all that `psfdae.image.catalogue.as_catalogue` does, `detect` also the
    threshold itself, a map an array as well, and numbers may have units (`astropy.units`).
    """

    catalogue: Annotated[StarList | None, "Star list of an image, FITS or CSV."] = None
    detect: Annotated[bool | float, "Find the stars of an image; the list is written, too."] = False
    on_image: Annotated[bool, "Leave out stars of the list that are off the image."] = False
    threshold: Annotated[
        float | None,
        "Detection limit of --detect in σ.  [default: 5 above the sky, 4 with photometry's PSF]",
    ] = None
    pixel_scale_arcsec: Annotated[
        Number | None, {"flag": "--pixel-scale"}, "Arcseconds per pixel.  [default: the WCS's]"
    ] = None
    origin: Annotated[Literal[0, 1] | None, "Index of the first pixel's centre."] = None
    extension: Annotated[Extension | None, "Name or number of the extension with the stars."] = None
    mask: Annotated[
        Layer | None,
        "Extension or FITS file; pixels other than 0 are bad.  [default: DQ of the file; none]",
    ] = None
    bad_bits: Annotated[int | None, "Sum of the mask's bits that are bad.  [default: all]"] = None
    weight: Annotated[Layer | None, "Extension or FITS file with 1/variance of the pixels."] = None
    variance: Annotated[Layer | None, "Extension or FITS file with their variance."] = None
    error: Annotated[
        Layer | None, "Extension or FITS file with their σ.  [default: ERR of the file; none]"
    ] = None
    gain: Annotated[Number | None, "Electrons per count.  [default: the header's]"] = None
    read_noise: Annotated[Number | None, "Electrons.  [default: the header's]"] = None
    saturate: Annotated[Number | None, "Counts of a saturated pixel.  [default: the header's]"] = (
        None
    )
    colour_column: Annotated[
        str | None,
        "Colours of the list's stars, with which the PSF may change; empty where unknown.",
    ] = None
    accept_offset: Annotated[bool, "Take a star list that is off by more than a pixel."] = False

    @property
    def given_threshold(self) -> float | None:
        """Threshold of all searches for stars in σ; None where each has its default."""
        # In Python, `detect` may be the threshold itself.
        return self.threshold if isinstance(self.detect, bool) else float(self.detect)

    @property
    def detection_sigma(self) -> float | None:
        """Threshold of the search for stars in σ above the sky; None without a search."""
        if not self.detect:
            return None
        return 5.0 if self.given_threshold is None else self.given_threshold


class PixelKeywords(TypedDict, total=False):
    """Keywords of `psfdae.detect`: `ImageOptions` without star list and search."""

    on_image: bool
    pixel_scale_arcsec: Number | None
    origin: Literal[0, 1] | None
    extension: Extension | None
    mask: Layer | None
    bad_bits: int | None
    weight: Layer | None
    variance: Layer | None
    error: Layer | None
    gain: Number | None
    read_noise: Number | None
    saturate: Number | None
    colour_column: str | None
    accept_offset: bool


class ImageKeywords(PixelKeywords, total=False):
    """Keywords of the public calls on an image: `ImageOptions` without the star list."""

    detect: bool | float
    threshold: float | None


@dataclass(frozen=True)
class ImageInput(ImageOptions):
    """FITS file with stars, or an array, and its options.

    Attributes
    ----------
    image : Path, PlainFile or ndarray
        Image, or cube of stamps, of which a catalogue has a row for each.
    flux_column, background_column : str or None
        Columns of the catalogue with fluxes inside the stamp, and with sky levels per pixel, which
        replace estimates.
    """

    image: Path | PlainFile | np.ndarray
    flux_column: str | None = field(default=None, kw_only=True)
    background_column: str | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        """Check the types of all values."""
        from astropy.units import Quantity

        check_values(type(self).__init__, vars(self), Number=float | Quantity, StarList=Any)

    @classmethod
    def build(cls, image: ImageLike, options: Mapping[str, Any]) -> ImageInput:
        """Build the input from an image as Python hands it over, with its options.

        Parameters
        ----------
        image : path-like, array, NDData, HDU or HDUList
            See `psfdae.image.containers.as_image`.
        options : mapping
            Values by the names of this class's fields.

        Raises
        ------
        ObservationError
            If it is not an image, or an option has another name.
        """
        source = cls(as_image(image))
        names = [attribute.name for attribute in fields(cls) if attribute.name != "image"]
        for name in options:
            if name not in names:
                hint = did_you_mean(name, names)
                raise ObservationError(source.path, f"{name}: not an option of an image{hint}")
        return replace(source, **options)

    @property
    def path(self) -> Path:
        """The image's file, or the name of an array in messages."""
        # A temporary file has the name of the object that was given.
        if isinstance(self.image, PlainFile):
            return self.image.name
        return self.image if isinstance(self.image, Path) else Path("array")

    @property
    def name(self) -> str:
        """Default name of a model of its stars: the file's name without its suffixes."""
        # Suffixes of FITS and of compression, however many.
        suffixes = re.compile(r"(\.(fits|fit|fts|fz|gz|bz2|xz|zip))+$", re.IGNORECASE)
        return suffixes.sub("", self.path.name) or "model"

    def files(self) -> tuple[object, ...]:
        """Return the image, its catalogue and its maps, of any type."""
        return (self.image, self.catalogue, self.mask, self.weight, self.variance, self.error)

    def repeat_for(self, images: Sequence[Path | PlainFile | np.ndarray]) -> list[ImageInput]:
        """Return these options for each image, which takes the stars of a common list on it.

        Raises
        ------
        ObservationError
            If the list of several images lacks sky coordinates.
        """
        # A list of several images has stars of all of them.
        on_image = self.on_image
        if self.catalogue is not None and len(images) > 1:
            require_sky(self.catalogue, "a training on several images")
            on_image = True
        # Every image has the same options.
        return [replace(self, image=image, on_image=on_image) for image in images]

    def camera(self, image_unit: str = "") -> dict[str, float | None]:
        """Return the given values of the camera as plain numbers, None for the others.

        Parameters
        ----------
        image_unit : str
            Unit of the image's pixels, in which the saturation may be.

        Returns
        -------
        dict
            By the names of `psfdae.image.camera.HEADER_KEYS`: arcseconds per pixel, electrons per
            count, electrons, counts.

        Raises
        ------
        ObservationError
            If a value has another unit, or is not a number above 0; likewise the threshold.
        """
        # Values with the units that they may have; the number is in the first one.
        units = {
            "pixel_scale_arcsec": "arcsec/pix arcsec",
            "gain": "electron/adu electron/ct electron/DN",
            "read_noise": "electron",
            "saturate": f"adu ct DN {image_unit.replace(' ', '')}",
        }
        numbers = {k: to_unit(getattr(self, k), unit, k, self.path) for k, unit in units.items()}
        # A count, a scale or a threshold of 0 is meaningless.
        for name, number in {**numbers, "threshold": self.detection_sigma}.items():
            if number is not None and not (math.isfinite(number) and number > 0):
                option_text = keyword(name, number)
                raise ObservationError(self.path, f"{option_text}: expected a number above 0")
        return dict(zip(HEADER_KEYS, numbers.values(), strict=True))
