"""Camera of an image: its pixel scale, gain, read noise and saturation, each with its provenance.

Inputs: a header and the values that the user gives. Output: each value with its provenance,
after a comparison with the pixels; values of the header that cannot be right are left out.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from psfdae.base.errors import keyword, warn
from psfdae.image.errors import ObservationError, reading
from psfdae.image.fits_file import ImageFile, card_value, open_pixels
from psfdae.image.header_units import count_powers, parse_number, parse_unit
from psfdae.image.sky import SkySample, sample_sky

LARGEST_STAMP_PX = 256
"""Side of the largest stamps; planes of a cube that are larger are images."""

HEADER_KEYS: dict[str, tuple[str, ...]] = {
    # Arcseconds; the second is POPPY's.
    "pixel scale": (
        *("PIXSCALE", "PIXELSCL", "SECPIX", "SECPIX1", "PIXSCAL1", "IM_SCALE", "SCALE"),
    ),
    # Electrons per count.
    "gain": (*("EGAIN", "GAIN", "ESO DET OUT1 CONAD", "ATODGAIN", "CCDGAIN", "GAIN1", "GAINA"),),
    # Electrons.
    "read noise": (
        *("RDNOISE", "READNOIS", "READNOISE", "RON", "ENOISE"),
        *("ESO DET OUT1 RON", "CCDNOISE", "RDNOISE1", "RDNOISEA"),
    ),
    # Counts.
    "saturation": ("SATURATE", "SATLEVEL", "SATURATA", "MAXLIN"),
}
"""Keys under which headers have a value of the camera; the first number above 0 is taken."""

HEADER_UNITS = dict(zip(HEADER_KEYS, ("arcsec", "electron/adu", "electron", "adu"), strict=True))
"""Units of these values, as astropy calls them."""


class CameraValue(NamedTuple):
    """Number and its provenance: "given", "WCS" or a key of the header.

    The number is None where it is not known; then this gives the reason.
    """

    value: float | None
    provenance: str


ONE_COLOUR = (
    "neighbouring pixels are of different colours: debayer it, or take the pixels of one colour, "
    "such as data[0::2, 0::2]"
)
"""Problem of an undebayered frame, and advice."""


def camera_values(image: ImageFile, options: Mapping[str, float | None]) -> dict[str, CameraValue]:
    """Return pixel scale, gain, read noise and saturation, each with its provenance.

    Parameters
    ----------
    image : ImageFile
        Image with its headers and WCS.
    options : mapping
        Values by the names of `HEADER_KEYS`, which override WCS and header; None is not given.
    """
    values = {
        "pixel scale": find_pixel_scale(image),
        "gain": find_gain(image),
        "read noise": find_number(image, "read noise"),
        "saturation": find_number(image, "saturation"),
    }
    values |= {name: CameraValue(v, "given") for name, v in options.items() if v is not None}
    return values


def find_number(image: ImageFile, name: str) -> CameraValue:
    """Find the first finite number above 0 under one of the keys of a value of the camera.

    Parameters
    ----------
    image : ImageFile
        Image with its headers.
    name : str
        A key of `HEADER_KEYS`. Cards may have other units than `HEADER_UNITS`, such as "10 mas".

    Returns
    -------
    CameraValue
        Number with the key as provenance; None if it is not in any header.
    """
    # Its own header overrides the file's; a truth value is not a number.
    for key in HEADER_KEYS[name]:
        for header in image.headers:
            number = parse_number(card_value(header, key), HEADER_UNITS[name])
            if number is not None and np.isfinite(number) and number > 0:
                return CameraValue(number, key)
    return CameraValue(None, "not known")


def unread_card_remarks(image: ImageFile) -> list[str]:
    """Return a sentence on each card of the camera whose text is not a number of its unit."""
    return [
        f"{image.path}: {key} = {value!r} is not used: expected a number of {HEADER_UNITS[name]}"
        for name, keys in HEADER_KEYS.items()
        for key in keys
        for value in dict.fromkeys(card_value(header, key) for header in image.headers)
        if isinstance(value, str) and value and parse_number(value, HEADER_UNITS[name]) is None
    ]


def find_pixel_scale(image: ImageFile) -> CameraValue:
    """Find arcseconds per pixel by the WCS, or by other cards of the header.

    Returns
    -------
    CameraValue
        From the WCS if there is one, else from a key for the scale, else from the width of a
        pixel and the focal length.
    """
    if image.wcs is not None:
        from astropy.wcs.utils import proj_plane_pixel_area

        # Side of a square as large as a pixel at the reference point.
        with reading(image.path):
            scale = float(np.sqrt(proj_plane_pixel_area(image.wcs))) * 3600.0
        if math.isfinite(scale) and scale > 0:
            # A WCS in degrees does not have more digits.
            return CameraValue(float(f"{scale:.9g}"), "WCS")
    header_scale = find_number(image, "pixel scale")
    # Amateurs' cameras have the width of a pixel in micrometres, and the focal length in
    # millimetres: angle = width / focal length.
    width_um, focus_mm = (
        next(filter(None, (parse_number(card_value(h, key), unit) for h in image.headers)), 0.0)
        for key, unit in (("XPIXSZ", "um"), ("FOCALLEN", "mm"))
    )
    if header_scale.value is None and width_um > 0 and 0 < focus_mm < np.inf:
        scale = float(np.rad2deg(width_um * 1e-3 / focus_mm)) * 3600.0
        return CameraValue(scale, "XPIXSZ and FOCALLEN")
    return header_scale


def find_gain(image: ImageFile) -> CameraValue:
    """Find electrons per count of the pixels.

    Images in electrons have 1 whatever the camera's gain was. Of images of a rate, that is, counts
    per second, or of a calibrated brightness, the gain of the camera does not apply to the pixels.
    """
    # By the unit of the pixels: electrons and photons, counts, a rate of these, or another one.
    unit = parse_unit(image.unit)
    powers = {} if unit is None else count_powers(unit)
    if unit is not None and powers in ({"electron": 1.0}, {"ph": 1.0}):
        return CameraValue(float(unit.scale), "BUNIT")
    if powers.get("s", 0.0) < 0 and powers.keys() <= {"electron", "ph", "adu", "s"}:
        return CameraValue(None, "not known, the image is a rate")
    is_not_counts = unit is None and re.search("/|jy|erg|mag", image.unit, re.IGNORECASE)
    if is_not_counts or powers not in ({}, {"adu": 1.0}):
        return CameraValue(None, f"not known, the image is in {image.unit}")
    gain = find_number(image, "gain")
    if gain.provenance == "GAIN":
        # A whole number from 20 on without a unit is a setting, as of amateurs' cameras.
        header = next(h for h in image.headers if card_value(h, "GAIN") is not None)
        value, comment = header["GAIN"], str(card_value(header.comments, "GAIN"))
        has_unit = re.search("e-|electron|adu", comment, re.IGNORECASE)
        if isinstance(value, int) and value >= 20 and not has_unit:
            return CameraValue(None, f"not known, GAIN = {gain.value:g} is a setting of the camera")
    return gain


def find_clipped_level(image: ImageFile, sky: SkySample) -> tuple[float, int] | None:
    """Find the largest value of an image, and its pixels, if the image is clipped there.

    Noise does not give five pixels far above the sky exactly the same value. Pixels of saturated
    stars lie together, and bad pixels of one value do not. A value that over a hundredth of the
    image has belongs to an area without data.

    Parameters
    ----------
    image : ImageFile
        Image (h, w) whose pixels are read.
    sky : SkySample
        Sky of the image: the largest value is at least 50 σ above it.

    Returns
    -------
    tuple of float and int, or None
        Value, and number of pixels that have it.
    """
    largest, count, pairs = -np.inf, 0, 0
    with open_pixels(image, in_pieces=True, dtype=np.float64) as pixels:
        # 256 rows at a time, which bounds the memory.
        for start in range(0, image.shape[0], 256):
            band = pixels[start : start + 256]
            # The largest value so far; a larger one starts the count anew.
            top = float(band.max(initial=-np.inf, where=np.isfinite(band)))
            if top > largest:
                largest, count, pairs = top, 0, 0
            # Pixels of the largest value, and pairs of them side by side.
            full = band == largest
            count += int(np.count_nonzero(full))
            pairs += int(np.count_nonzero(full[:, 1:] & full[:, :-1]))
            pairs += int(np.count_nonzero(full[1:] & full[:-1]))
    # Few pixels, most of them in pairs, far above the sky.
    suits_stars = 5 <= count <= 0.01 * image.shape[0] * image.shape[1]
    is_clipped = suits_stars and 2 * pairs >= count and largest > sky.level + 50.0 * sky.noise
    return (largest, count) if is_clipped else None


def check_camera(
    image: ImageFile, camera: Mapping[str, CameraValue]
) -> tuple[dict[str, CameraValue], list[str], float]:
    """Leave out header values that the pixels contradict; given values stay, with a warning.

    Parameters
    ----------
    image : ImageFile
        An image, not a cube of stamps.
    camera : mapping
        Values by the names of `HEADER_KEYS`.

    Returns
    -------
    values : dict of str to CameraValue
        Values that fit the pixels.
    remarks : list of str
        A sentence on each value that does not, on colours, and on noise that pixels share.
    correlation : float
        Ratio of the noise of sums of pixels to the noise of sums of independent ones, at least 1.

    Raises
    ------
    ObservationError
        If a given saturation is below the sky.
    """
    sky, values = sample_sky(image), dict(camera)
    if sky is None:
        return values, [], 1.0
    values["saturation"], remarks = check_saturation(image, sky, camera["saturation"])
    # Noise makes less than 0.1 in 100 × 100 pixels; readout changes levels along rows or columns.
    if abs(sky.checker) > 0.3:
        remarks.append(
            f"{image.path}: the sky of pixels with an even sum of row and column differs from the "
            f"sky of the others by {abs(sky.checker):.2g} times the noise: if it is an undebayered "
            f"colour frame, {ONE_COLOUR}"
        )
        warn(remarks[-1:])
    # One level is subtracted from all pixels before they become single precision, whose steps are
    # up to 2⁻²³ of a value: an eighth of the noise here.
    if sky.level_range > 2.0**20:
        remarks.append(
            f"{image.path}: the sky differs within the image by {sky.level_range:.1g} times its "
            "noise, which single precision rounds: errors are wrong in parts of the image; "
            "subtract the sky first, or mask these parts"
        )
        warn(remarks[-1:])
    if sky.correlation > 1.0:
        remarks.append(describe_shared_noise(image.path, sky.correlation))
    # A gain of the header that cannot be right is not used; a given one is.
    gain, (limit, limit_from) = camera["gain"], values["saturation"]
    problem = check_gain(image, sky, gain, camera["read noise"])
    if problem is not None and gain.provenance == "given":
        remarks.append(f"{image.path}: {problem}: used as given")
    elif problem is not None:
        values["gain"] = CameraValue(None, f"not known, {gain.provenance} does not fit the pixels")
        remarks.append(
            f"{image.path}: {problem} (a mean of frames, another unit, or a bias that was not "
            "subtracted?): not used, errors come from the pixels; "
            f"{keyword('gain')} sets another one"
        )
        # Where the gain does not apply, the saturation of the camera does not, either.
        if limit is not None and limit_from != "given" and sky.highest <= 1.0 < limit:
            values["saturation"] = CameraValue(None, f"not known, {limit_from} is of counts")
    return values, remarks, sky.correlation


def describe_shared_noise(path: Path, correlation: float) -> str:
    """Return a sentence on noise that pixels of an image share, such as resampled ones.

    `correlation` is the ratio of the noise of their sums to the noise of sums of independent ones.
    """
    return (
        f"{path}: pixels share their noise: the noise of their sums is {correlation:.2f} times as "
        "large as of independent pixels, and errors include it"
    )


def check_saturation(
    image: ImageFile, sky: SkySample, saturation: CameraValue
) -> tuple[CameraValue, list[str]]:
    """Return the saturation that fits the pixels, and sentences on a value that does not.

    It is the largest value, if the image is clipped there, below the level of the header.

    Parameters
    ----------
    image : ImageFile
        Image (h, w) whose pixels are read.
    sky : SkySample
        Sky of the image.
    saturation : CameraValue
        Counts from which a pixel is saturated, from the header or given.

    Raises
    ------
    ObservationError
        If a given saturation is below the sky.
    """
    unit, (limit, key), option = image.unit or "counts", saturation, keyword("saturate")
    remarks = []
    # A pixel of the sky cannot be saturated.
    if limit is not None and limit <= sky.level:
        problem = f"saturation at {limit:g} {unit} ({key}) is below the sky of {sky.level:.4g}"
        if key == "given":
            problem += f"; {option} takes the saturation of a pixel"
            raise ObservationError(image.path, problem)
        saturation = CameraValue(None, f"not known, {key} is below the sky")
        remarks.append(f"{image.path}: {problem}: not used, {option} sets another one")
    # A pile-up of the largest value below the level of the header shows a lower saturation.
    pile_up = None if key == "given" else find_clipped_level(image, sky)
    if pile_up is not None and (saturation.value is None or pile_up[0] < saturation.value):
        saturation = CameraValue(pile_up[0], "the largest value")
        remarks.append(
            f"{image.path}: {pile_up[1]} pixels have exactly the largest value, {pile_up[0]:g} "
            f"{unit}: taken as saturated, {option} sets another level"
        )
    return saturation, remarks


def check_gain(
    image: ImageFile, sky: SkySample, gain: CameraValue, read_noise: CameraValue
) -> str | None:
    """Check gain and read noise; return how they contradict the pixels, None if they do not.

    Photons of the sky alone scatter by √(sky / gain), and the electronics by read noise / gain.

    Parameters
    ----------
    image : ImageFile
        Image, for its unit.
    sky : SkySample
        Sky of the image, with the noise of its pixels.
    gain, read_noise : CameraValue
        Electrons per count, and electrons.
    """
    if not gain.value:
        return None
    # σ of Poisson noise: N = level · gain electrons scatter by √N, which are √N / gain counts.
    photons = np.sqrt(max(sky.level, 0.0) / gain.value)
    electronics = read_noise.value / gain.value if read_noise.value else 0.0
    # The larger of the two alone is a lower limit of the noise.
    least_sigma = max(photons, electronics)
    cause = f"{gain.provenance} = {gain.value:g}"
    # A mean of two frames has 0.71 of the noise of one; resampling leaves about 0.8.
    if sky.noise < 0.75 * least_sigma:
        if electronics >= photons:
            cause = f"{read_noise.provenance} = {read_noise.value:g} and {cause}"
        return (
            f"{cause} mean a noise of the sky of at least {least_sigma:.3g} "
            f"{image.unit or 'counts'}, but the pixels scatter by {sky.noise:.3g}"
        )
    # A gain of counts on pixels of another unit, such as an image scaled to 0 … 1.
    if sky.highest <= 1.0 and gain.provenance not in ("given", "BUNIT"):
        return f"{cause} is of counts, but no pixel is above 1"
    return None


def sky_coordinate_remarks(image: ImageFile) -> list[str]:
    """Return sentences on a WCS that is damaged, or whose keys contradict each other on distortion.

    A WCS is damaged if its keys announce coordinates of the sky, but astropy makes none of them.
    """
    projection = str(image.card("CTYPE1") or "")
    names = {str(image.card(f"CTYPE{axis}") or "")[:4].strip("-") for axis in (1, 2, 3)}
    if image.wcs is None and names & {"RA", "DEC", "GLON", "GLAT", "ELON", "ELAT"}:
        return [
            f"{image.path}: its WCS (CTYPE1 = {projection}) is damaged and not used, or its sky "
            "axes are not the axes of the pixels: no sky coordinates, and the pixel scale is read "
            "from other keys"
        ]
    # astropy applies a polynomial that the projection does not announce.
    has_polynomial = image.wcs is not None and image.wcs.sip is not None
    if has_polynomial and not projection.endswith("-SIP"):
        return [
            f"{image.path}: CTYPE1 = {projection} has no -SIP, but there is a polynomial of "
            "distortion (A_ORDER): it is used; remove its keys if the image was resampled without "
            "distortion"
        ]
    return []


def refuse_colours(image: ImageFile) -> None:
    """Raise an error for a frame of a colour camera, debayered or not: a PSF belongs to one colour.

    Raises
    ------
    ObservationError
        If the image has 3 or 4 large planes, the fourth for luminance or transparency; or one plane
        of which BAYERPAT, FILTER or the like names several colours.
    """
    shape = image.shape
    if len(shape) == 3:
        # A few large planes are not stamps of stars, whose side is at most 256 px.
        # Colours are the first axis of most programs, and the last one of programs that write
        # pictures.
        first, last = shape[0] in (3, 4), shape[-1] in (3, 4)
        if last or (first and max(shape[1:]) > LARGEST_STAMP_PX):
            plane, size = ("[0]", shape[1:]) if first else ("[..., 0]", shape[:-1])
            raise ObservationError(
                image.path,
                f"{shape[0] if first else shape[-1]} planes of {size[0]}×{size[1]} pixels, as of a "
                "colour image; a PSF belongs to one colour: write one plane to a file of its own, "
                f"such as astropy.io.fits.getdata(…){plane}, or their sum",
            )
        return
    # The pattern of a colour filter array, four letters.
    for header in image.headers:
        for key in ("BAYERPAT", "COLORTYP", "CFAPAT", "BAYER", "CFA", "FILTER"):
            pattern = str(card_value(header, key) or "").strip().upper()
            if len(pattern) == 4 and set(pattern) <= set("RGBCMYW") and len(set(pattern)) > 1:
                raise ObservationError(
                    image.path,
                    f"an undebayered colour frame ({key} = {pattern}), {ONE_COLOUR}, and write "
                    "them without this card",
                )


def other_instruments(
    training_instrument: Mapping[str, object], image_instrument: Mapping[str, str]
) -> list[tuple[str, str, str]]:
    """Return keys of telescope, camera or filter that differ in two headers, with both values.

    Parameters
    ----------
    training_instrument, image_instrument : mapping
        Values by key of the header (`Observation.instrument`); a key that one of them lacks is left
        out, and so are differences of case.
    """
    return [
        (key, str(value), image_instrument[key])
        for key, value in training_instrument.items()
        if key in image_instrument
        and image_instrument[key].strip().casefold() != str(value).strip().casefold()
    ]
