"""Header values against the pixels: gain, read noise and saturation that cannot be right."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from psfdae.image.errors import ObservationError
from psfdae.image.fits_file import ImageFile, Said, card_value, open_pixels
from psfdae.image.sky_level import noise_correlation

BLOCK = 32  # px, side of the squares in which sky and noise are measured


@dataclass(frozen=True)
class SkySample:
    """Sky of an image from squares spread over it, in the image's unit.

    Attributes
    ----------
    level, noise : float
        Median over the squares of their median and of their scatter, σ by the median deviation
        and, where pixels share their noise, that of sums of pixels.
    highest : float
        Largest pixel of all squares.
    """

    level: float
    noise: float
    highest: float


class CheckedCamera(NamedTuple):
    """Camera values that fit the pixels, and a sentence on each that does not."""

    values: dict[str, Said]
    remarks: list[str]


def sky_sample(image: ImageFile) -> SkySample | None:
    """Measure the sky in squares of at most 32 bands of rows; None if no square shows noise.

    Squares of one value, such as an area without data, do not count.
    """
    rows, columns = image.shape
    starts = np.unique(np.linspace(0, max(rows - BLOCK, 0), min(32, -(-rows // BLOCK))).astype(int))
    levels, noises, highest = [], [], -np.inf
    deviations: list[np.ndarray] = []  # of bands of rows, four rows without values between them
    with open_pixels(image, whole=False, dtype=np.float64) as pixels:
        for start in starts:
            band = np.where(np.isfinite(band := pixels[start : start + BLOCK]), band, np.nan)
            deviation = np.full((BLOCK + 4, columns), np.nan)
            deviations.append(deviation)
            for residual in range(0, columns, BLOCK):
                square = band[:, residual : residual + BLOCK]
                is_good = square[np.isfinite(square)]
                if is_good.size < BLOCK:
                    continue
                highest = max(highest, float(is_good.max()))
                level = float(np.median(is_good))
                noise = 1.4826 * float(np.median(np.abs(is_good - level)))
                if noise > 0:
                    deviation[: len(band), residual : residual + BLOCK] = (square - level) / noise
                    levels.append(level)
                    noises.append(noise)
    if not levels:
        return None
    correlation = noise_correlation(np.concatenate(deviations))
    return SkySample(float(np.median(levels)), correlation * float(np.median(noises)), highest)


def clipped_level(image: ImageFile, sky: SkySample) -> tuple[float, int] | None:
    """Return the largest value of an image, and its pixels, if the image was cut off there.

    Noise gives no five pixels far above the sky exactly the same value; those of saturated stars
    lie together, and those of a value for bad pixels do not. A value that over a hundredth of the
    image has is that of an area without data.
    """
    largest, count, pairs = -np.inf, 0, 0
    with open_pixels(image, whole=False, dtype=np.float64) as pixels:
        for start in range(0, image.shape[0], 8 * BLOCK):
            band = pixels[start : start + 8 * BLOCK]
            top = float(band.max(initial=-np.inf, where=np.isfinite(band)))
            if top > largest:
                largest, count, pairs = top, 0, 0
            full = band == largest
            count += int(np.count_nonzero(full))
            pairs += int(np.count_nonzero(full[:, 1:] & full[:, :-1]))
            pairs += int(np.count_nonzero(full[1:] & full[:-1]))
    sample = 5 <= count <= 0.01 * image.shape[0] * image.shape[1]
    clipped = sample and 2 * pairs >= count and largest > sky.level + 50.0 * sky.noise
    return (largest, count) if clipped else None


def checked_camera(
    image: ImageFile, camera: Mapping[str, Said], sky: SkySample | None
) -> CheckedCamera:
    """Leave out header values that the pixels contradict; those that are given stay, with a word.

    Where the image was cut off at a level below that of its header, that is the saturation.

    Parameters
    ----------
    image : ImageFile
    camera : mapping
        Values with their origin, "given" or a key of the header.
    sky : SkySample or None
        None leaves all as they are.

    Raises
    ------
    ObservationError
        If a saturation that is given is below the sky.
    """
    values = dict(camera)
    remarks: list[str] = []
    if sky is None:
        return CheckedCamera(values, remarks)
    unit = image.unit or "counts"

    # A pixel of the sky cannot be saturated.
    level, origin = values["saturation"]
    if level is not None and level <= sky.level:
        problem = f"saturation at {level:g} {unit} ({origin}) is below the sky of {sky.level:.4g}"
        if origin == "given":
            raise ObservationError(image.path, f"{problem}; --saturate takes that of a pixel")
        values["saturation"] = None, f"not known, {origin} is below the sky"
        remarks.append(f"{image.path}: {problem}: not used, --saturate states another one")
    level, origin = values["saturation"]
    clipped = None if origin == "given" else clipped_level(image, sky)
    if clipped is not None and (level is None or clipped[0] < level):
        values["saturation"] = clipped[0], "the largest value"
        remarks.append(
            f"{image.path}: {clipped[1]} pixels have exactly the largest value, {clipped[0]:g} "
            f"{unit}: taken as saturated, --saturate states another level"
        )

    # Sky photons alone scatter by √(sky/gain), and the electronics by read noise/gain.
    gain, gain_origin = values["gain"]
    read_noise, read_origin = values["read noise"]
    photons = np.sqrt(max(sky.level, 0.0) / gain) if gain else 0.0
    electronics = read_noise / gain if gain and read_noise else 0.0
    least_sigma = max(photons, electronics)
    # A mean of two frames has 0.71 of the noise of one; resampling leaves about 0.8.
    contradicted = sky.noise < 0.75 * least_sigma
    by_unit = bool(gain) and sky.highest <= 1.0 and gain_origin not in ("given", "BUNIT")
    if not (contradicted or by_unit):
        return CheckedCamera(values, remarks)
    if contradicted:
        cause = f"{gain_origin} = {gain:g}"
        if electronics >= photons:
            cause = f"{read_origin} = {read_noise:g} and {cause}"
        problem = (
            f"{cause} mean a noise of the sky of at least {least_sigma:.3g} {unit}, but the pixels "
            f"scatter by {sky.noise:.3g}"
        )
    else:
        problem = f"{gain_origin} = {gain:g} is of counts, but no pixel is above 1"
    if gain_origin == "given":
        remarks.append(f"{image.path}: {problem}: used as stated")
        return CheckedCamera(values, remarks)
    values["gain"] = None, f"not known, {gain_origin} does not fit the pixels"
    remarks.append(
        f"{image.path}: {problem} (a mean of frames, another unit, or a bias that was not "
        "subtracted?): not used, errors come from the pixels; --gain states another one"
    )
    # A scale on which the gain is none cannot have the saturation of the camera, either.
    saturation, origin = values["saturation"]
    if saturation is not None and origin != "given" and sky.highest <= 1.0 < saturation:
        values["saturation"] = None, f"not known, {origin} is of counts"
    return CheckedCamera(values, remarks)


def sky_coordinate_remarks(image: ImageFile) -> list[str]:
    """Return sentences on a WCS that is damaged, or that says two things of its distortion."""
    if not image.headers:
        return []
    header = image.headers[0]
    projection = str(card_value(header, "CTYPE1") or "")
    if image.wcs is None and projection[:4].strip("-") in ("RA", "DEC", "GLON", "GLAT"):
        return [
            f"{image.path}: its WCS (CTYPE1 = {projection}) is damaged and not used: no sky "
            "coordinates, and the pixel scale is that of other keys"
        ]
    distorted = image.wcs is not None and image.wcs.sip is not None
    if distorted and not projection.endswith("-SIP"):
        return [
            f"{image.path}: CTYPE1 = {projection} has no -SIP, but there is a polynomial of "
            "distortion (A_ORDER): it is used; remove its keys if the image was resampled without "
            "distortion"
        ]
    return []


def refuse_mosaic_of_colours(image: ImageFile) -> None:
    """Refuse a frame of a colour camera whose pixels still have the colours of their filters.

    Raises
    ------
    ObservationError
        If BAYERPAT or its like names four colours and the image has one plane.
    """
    for header in image.headers:
        for key in ("BAYERPAT", "COLORTYP", "CFAPAT"):
            pattern = str(card_value(header, key) or "").strip().upper()
            if len(pattern) == 4 and set(pattern) <= set("RGBCMYW") and len(set(pattern)) > 1:
                raise ObservationError(
                    image.path,
                    f"an undebayered colour frame ({key} = {pattern}), neighbouring pixels are of "
                    "different colours: debayer it, or take the pixels of one colour, such as "
                    "data[0::2, 0::2], and write them without this card",
                )
