"""An observation: the stars of one FITS file, described and ready to be streamed as stamps.

| input | stamps | positions |
|---|---|---|
| cube (n, s, s), or one stamp (s, s) | their middle | from the catalogue, row by row, or NaN |
| image (h, w) and a catalogue | cut at the rounded position | of the catalogue |
| image (h, w) to be searched | the same | of the stars found (`detection`) |

Faults of a file raise `ObservationError`, with one line that names the file.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import ClassVar, NamedTuple

import numpy as np

from psfdae.base.types import WCS, Table
from psfdae.image.camera import CameraValue
from psfdae.image.catalogue import Catalogue
from psfdae.image.detection import Sky
from psfdae.image.detector_frame import detector_frames
from psfdae.image.errors import ObservationError, reading, shorten, silent
from psfdae.image.fits_file import Card, Pixels, open_pixels, pixel_to_sky
from psfdae.image.layers import Layers
from psfdae.image.positions import find_repeated_rows
from psfdae.image.stamps import (
    Stamps,
    StarFlag,
    central_pixel,
    cut,
    cut_image,
    raise_flag,
    sky_around,
)
from psfdae.stars.moments import robust_scatter


class ListedStars(NamedTuple):
    """Columns of n stars; NaN where the list gives no number.

    Attributes
    ----------
    id : ndarray, shape (n,), int64 or str
        Identifiers from the list, or numbers from 0.
    row : ndarray of int, shape (n,)
        Row of the list.
    flux, background, colour : ndarray, shape (n,)
        Flux inside the stamp, sky per pixel, and colour, from the columns that the user names.
    flags : ndarray, shape (n,), uint16
        `StarFlag`s from the list.
    """

    id: np.ndarray
    row: np.ndarray
    flux: np.ndarray
    background: np.ndarray
    colour: np.ndarray
    flags: np.ndarray

    def select(self, stars: np.ndarray | slice) -> ListedStars:
        """Return copies of the columns for some of the stars."""
        return ListedStars(*(np.array(column[stars]) for column in self))


@dataclass(frozen=True)
class Observation:
    """Stars of one FITS file, returned by `ImageInput.open`.

    Attributes
    ----------
    path : Path
        The file, for messages.
    stamp_px, margin : int
        Side of the stamps, and pixels around each.
    shape : tuple of int or None
        Rows and columns of the image; None for a cube of stamps.
    camera : dict of str to CameraValue
        Pixel scale, gain, read noise and saturation, in this order.
    positions : ndarray or None, shape (n, 2)
        0-based x and y; NaN where neither list nor WCS has one.
    stars : ListedStars
        Columns of the stars, one value for each.
    header_cards : list of Card
        Provenance, copied into the products.
    catalogue : Path or None
        The star list.
    detections : Catalogue or None
        The list of detected stars, used in place of a star list.
    colour_column : str or None
        Column of the star list with colours.
    remarks : tuple of str
        Warnings about the file and the list: values that are used or ignored.
    noise_correlation : float
        Noise of sums of pixels over the noise of sums of independent pixels, at least 1.
    neighbour_light : callable or None
        Returns the light of other stars in the stamps of a part of the list, for a side and a
        margin in px; it is subtracted.
    """

    path: Path
    stamp_px: int
    margin: int
    shape: tuple[int, ...] | None
    camera: dict[str, CameraValue]
    positions: np.ndarray | None
    stars: ListedStars
    header_cards: list[Card]
    catalogue: Path | None
    detections: Catalogue | None
    colour_column: str | None
    remarks: tuple[str, ...]
    noise_correlation: float
    # All of the list, also stars that are off the image.
    _list: Catalogue | None
    _layers: Layers
    neighbour_light: Callable[[slice, int, int], np.ndarray] | None = None
    assumed_scale_arcsec: ClassVar[float] = 1.0
    """Pixel scale that is assumed if neither header nor user gives one."""

    def __repr__(self) -> str:
        return f"Observation({str(self.path)!r}, {self.count} stars)"

    @property
    def count(self) -> int:
        """Number of stars, flagged ones included."""
        return len(self.stars.id)

    @property
    def pixel_scale_arcsec(self) -> float | None:
        """Arcseconds per pixel."""
        return self.camera["pixel scale"].value

    @property
    def gain(self) -> float | None:
        """Electrons per count."""
        return self.camera["gain"].value

    @property
    def saturate(self) -> float | None:
        """Counts from which a pixel is saturated."""
        return self.camera["saturation"].value

    @property
    def instrument(self) -> dict[str, str]:
        """Telescope, camera and filter, by the key of the header that names them."""
        # PSFs change with each of the three.
        keys = ("TELESCOP", "INSTRUME", "FILTER")
        return {key: str(value) for key, value, _ in self.header_cards if key in keys}

    @property
    def unit(self) -> str:
        """Unit of the image's pixels from its header; "" if the header gives none."""
        return self._layers.image.unit

    @property
    def least_noise(self) -> float:
        """Read noise in counts; 0 where it or the gain is not known."""
        return self._layers.least_noise / self.unit_factor

    @property
    def scale_assumed(self) -> bool:
        """True if neither header nor user gives the pixel scale."""
        return self.camera["pixel scale"].origin == "assumed"

    def assume_scale(self) -> Observation:
        """Return the observation with `assumed_scale_arcsec` if the scale is unknown."""
        if self.pixel_scale_arcsec is not None:
            return self
        # The origin shows that the scale is an assumption.
        scale = CameraValue(self.assumed_scale_arcsec, "assumed")
        return replace(self, camera=self.camera | {"pixel scale": scale})

    @property
    def detector_frames(self) -> dict[str, list[float]]:
        """Positions of the image's pixels on the detector, if the header gives them."""
        return detector_frames(self._layers.image)

    def sky(self) -> Sky:
        """Return the whole image with its sky, in the unit of the image times `unit_factor`.

        Raises ObservationError if no sky can be measured.
        """
        return self._layers.sky()

    @property
    def unit_factor(self) -> float:
        """Factor from the unit of the image, which stamps have, to the unit of `sky`."""
        return self._layers.image.unit_factor

    def to_sky_unit(self) -> Observation:
        """Return the observation with gain and saturation for pixels in the unit of `sky`."""
        gain = self.camera["gain"].times(1.0 / self.unit_factor)
        saturation = self.camera["saturation"].times(self.unit_factor)
        return replace(self, camera=self.camera | {"gain": gain, "saturation": saturation})

    def to_image_unit(self, values: np.ndarray) -> np.ndarray:
        """Return values in the unit of the image, in double precision if the sky has another."""
        return values if self.unit_factor == 1.0 else values / np.float64(self.unit_factor)

    @property
    def wcs(self) -> WCS | None:
        """Celestial WCS of the image; None without one, and of a cube of stamps."""
        return None if self.shape is None else self._layers.image.wcs

    def sky_columns(self, x: np.ndarray, y: np.ndarray) -> dict[str, np.ndarray]:
        """Return ICRS coordinates in degrees of 0-based pixels (n,).

        Empty without a celestial WCS, and for a cube of stamps.

        Parameters
        ----------
        x, y : ndarray, shape (n,)
            Positions in the image, 0-based.

        Returns
        -------
        dict of str to ndarray
            Right ascension `ra` and declination `dec`, shape (n,) each.
        """
        if (wcs := self.wcs) is None:
            return {}
        with reading(self.path):
            coordinates = pixel_to_sky(wcs, x, y)
        return {"ra": coordinates.ra.deg, "dec": coordinates.dec.deg}

    def summary(self) -> str:
        """Return lines: camera values with their origins, remarks, pixels and rows left out."""
        # The camera: number and unit with their origin, or why the number is not known.
        units = ("arcsec", "electrons per count", "electrons", "counts")
        words = [
            f"{name} {origin if value is None else f'{value:.6g} {unit} ({origin})'}"
            for (name, (value, origin)), unit in zip(self.camera.items(), units, strict=True)
        ]
        lines = [f"{self.path}: {', '.join(words)}", *self.remarks]
        # Pixels of the image that are bad, and rows of the list without a position.
        if self.shape is not None and (notes := self._layers.bad_pixels.notes):
            lines.append(f"{self.path}: left out: {', '.join(notes)}")
        if (no_position := self.lacks_position()).any():
            rows = shorten([str(row + 1) for row in np.flatnonzero(no_position)])
            lines.append(
                f"{self.catalogue}: no position in row {rows}: flagged, and not learnt from"
            )
        return "\n".join(lines)

    def lacks_position(self) -> np.ndarray:
        """Return True for stars without a position in a list that has others, shape (n,).

        Detected stars all have one, and a cube need not have any.
        """
        if self.positions is None or self.detections is not None:
            return np.zeros(self.count, dtype=bool)
        return np.asarray(~np.isfinite(self.positions).all(axis=1))

    def find_repeated_stars(self) -> np.ndarray:
        """Return True for stars of a list that are the same as an earlier one, shape (n,).

        Their distance is less than a tenth of a pixel (`find_repeated_rows`).
        """
        if self.positions is None or self.detections is not None or self.shape is None:
            return np.zeros(self.count, dtype=bool)
        return find_repeated_rows(self.positions)

    @cached_property
    def list_columns(self) -> Table | None:
        """Further columns of the star list, with a row for each star; None without a list."""
        return None if self._list is None else self._list.columns(self.stars.row)

    def select(self, stars: np.ndarray) -> Observation:
        """Return the observation with the stars for which a mask of shape (n,) is True."""
        assert self.positions is not None
        return replace(self, positions=self.positions[stars], stars=self.stars.select(stars))

    def check_list(self) -> None:
        """Reject a star list of another image.

        Raises
        ------
        ObservationError
            If fewer than half of its positions are on a source.
        """
        if self.shape is None or self.catalogue is None or self.positions is None:
            return
        # Known positions that lie on pixels of a source.
        indices = np.flatnonzero(np.isfinite(self.positions).all(axis=1))
        sky = self._layers.sky()
        with silent():
            column, row = central_pixel(self.positions.T)
            # 2 σ above the sky is a source.
            hits = int(sky.is_on_source(column, row, 2.0).sum())
        if hits < 0.5 * indices.size:
            raise ObservationError(
                self.catalogue,
                f"{hits} of {indices.size} positions are on a source of {self.path}, at least half "
                "are expected: a list of another image, or with stars too faint for this one?",
            )

    def check_planes(self) -> None:
        """Reject a cube whose planes show the same stars, also outside the stamps in their middle.

        Raises
        ------
        ObservationError
            If it is a time series of a field, and no list gives a star for each plane.
        """
        if self.shape is not None or self._list is not None or self.count < 4:
            return
        # At most 64 planes, spread over the cube.
        step, image = -(-self.count // 64), self._layers.image
        with open_pixels(image, in_pieces=True) as pixels:
            planes = [pixels[slice(row, row + 1)] for row in range(0, self.count, step)]
        if has_common_stars(np.concatenate(planes), self.stamp_px):
            raise ObservationError(
                self.path,
                "a time series: its planes show the same stars, also away from the middle, where "
                "the star of a stamp is: write one plane to a file of its own, or take all as "
                "exposures, such as psfdae.Stars.from_image([*cube], detect=True)",
            )

    def sha256(self) -> str:
        """Return SHA-256 of all pixels of the image or cube, as float32.

        It does not depend on how the file is compressed or scaled, nor on its header.
        """
        # 256 rows of an image, or stamps of a cube, are in memory at a time.
        digest, rows = hashlib.sha256(), 256
        with open_pixels(self._layers.image, in_pieces=True) as pixels:
            for start in range(0, pixels.image.shape[0], rows):
                values = self.to_image_unit(pixels[slice(start, start + rows)])
                digest.update(values.astype(np.float32, copy=False).tobytes())
        return digest.hexdigest()

    def replace_margin(self, margin: int) -> Observation:
        """Return the observation with stamps of another margin in px; a cube limits it."""
        return replace(self, margin=margin if self.shape else min(margin, self.margin))

    def chunks(self, rows: int) -> Iterator[Stamps]:
        """Yield the stars in their order, at most `rows` at a time.

        Of a cube, only the pixels of a chunk are read.
        """
        if rows < 1:
            raise ValueError(f"rows is {rows}, expected at least 1")
        # A cube is read piece by piece; positions in an image are anywhere.
        with self._layers.open(in_pieces=self.shape is None) as (pixels, mask, noise):
            for start in range(0, self.count, rows):
                part = slice(start, min(start + rows, self.count))
                if self.shape is None:
                    yield _build_stamps(self, part, *_cut_from_cube(self, part, pixels, mask))
                else:
                    yield _build_stamps(self, part, *_cut_from_image(self, part, pixels, noise))


def has_common_stars(planes: np.ndarray, stamp_px: int) -> bool:
    """Return True if planes (n, h, w) share a star outside the stamp in their middle.

    Different stars of an image have different neighbours. Light of the star itself, such as spikes
    or the ring of a star out of focus, lies on both sides of the middle, or all around it.
    """
    from scipy import ndimage

    # Means of 3 × 3 pixels above the sky, their noise, and their 10th percentile over the planes.
    smooth = ndimage.uniform_filter(np.nan_to_num(planes), (0, 3, 3))
    smooth -= np.median(smooth, axis=(1, 2), keepdims=True)
    noise = np.median(robust_scatter(smooth.reshape(len(planes), -1).T))
    light, common = np.median(smooth, axis=0), np.percentile(smooth, 10, axis=0, method="lower")
    # Distance from the middle, and the light at this distance, or opposite if it is more.
    offset = np.indices(light.shape) - (np.array(light.shape).reshape(2, 1, 1) - 1) / 2.0
    radius = np.hypot(*offset).astype(int)
    own_light = ndimage.median(light, radius, np.arange(radius.max() + 1))[radius]
    own_light = np.maximum(own_light, light[::-1, ::-1])
    # Peaks outside the stamp, at least a tenth as high as the highest, are other stars.
    is_star = (np.abs(offset).max(axis=0) > stamp_px / 2) & (common > 5.0 * noise)
    is_star &= light >= np.maximum(ndimage.maximum_filter(light, 5), 0.1 * light.max())
    is_star &= own_light < 0.4 * light
    return bool(is_star.any())


def _cut_from_cube(
    observation: Observation, part: slice, pixels: Pixels, mask: Pixels | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Cut stamps out of the middle of the planes of a cube.

    Parameters
    ----------
    observation : Observation
        The cube, with side and margin of the stamps.
    part : slice
        Stars that are cut.
    pixels, mask : Pixels
        Pixels of the cube, and of its mask if it has one.

    Returns
    -------
    data, is_masked : ndarray, shape (n, s, s)
        Pixels, and which of them are bad in the mask.
    is_truncated : ndarray of bool, shape (n,)
        Stars of which a part is off the image: always False.
    noise : ndarray, shape (n,)
        σ of the sky, NaN: it is to be estimated.
    """

    def read_stamps(pixels: Pixels, rows: slice) -> np.ndarray:
        # A 2-d image counts as a cube of one stamp.
        is_cube = len(pixels.image.shape) == 3
        return cut(pixels[rows] if is_cube else pixels[slice(None)][None], side)

    # The star is in the middle of a larger stamp, too.
    side, count = observation.stamp_px + 2 * observation.margin, part.stop - part.start
    data = observation.to_image_unit(read_stamps(pixels, part))
    is_masked = np.zeros(data.shape, dtype=bool)
    if mask is not None:
        # All stamps may share one mask.
        mask_rows = part if len(mask.image.shape) == 3 else slice(0, 1)
        is_masked |= observation._layers.is_bad(read_stamps(mask, mask_rows))
    return data, is_masked, np.zeros(count, dtype=bool), np.full(count, np.nan)


def _cut_from_image(
    observation: Observation, part: slice, pixels: Pixels, noise: Pixels | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Cut stamps out of an image, and measure the noise of the sky of each.

    Parameters
    ----------
    observation : Observation
        The image, with positions of stars, and side and margin of the stamps.
    part : slice
        Stars that are cut.
    pixels, noise : Pixels
        Pixels of the image, and of its noise map if it has one.

    Returns
    -------
    data, is_masked, is_truncated, noise
        As returned by `_cut_from_cube`; noise is NaN where it cannot be measured.
    """
    shape, layers, stamp_px = observation.shape, observation._layers, observation.stamp_px
    assert shape is not None and observation.positions is not None
    x, y = observation.positions[part].T
    # The noise of the sky is measured in a ring of at least 8 px around the stamp.
    margin = max(observation.margin, 8)
    # All layers are cut at the same positions.
    window = (shape, x, y, stamp_px, margin)
    data, inside, is_truncated = cut_image(pixels, *window)
    data = observation.to_image_unit(data)
    # Other stars of a crowded image are subtracted.
    raw = data
    if observation.neighbour_light is not None:
        # Saturated pixels are not changed, so that they are flagged.
        full = np.inf if observation.saturate is None else observation.saturate
        single_stars = data - observation.neighbour_light(part, stamp_px, margin)
        data = np.where(data >= full, data, single_stars)
    # Pixels that are off the image or masked.
    is_masked = ~inside | (cut_image(layers.bad_pixels.mask, *window)[0] != 0)
    # The stamp with its own margin, within the wider window.
    stamp = slice(margin - observation.margin, margin + stamp_px + observation.margin)
    if noise is not None and layers.noise is not None:
        # σ of the sky from the map, without the photons of the star.
        light: np.ndarray | float = 0.0
        if layers.noise.photons:
            level, _ = sky_around(raw, is_masked, stamp_px)
            light = (raw - level[:, None, None]) * observation.unit_factor
        sigma = layers.noise.sigma(cut_image(noise, *window)[0], light) / observation.unit_factor
        stamp_sigma = np.ma.array(sigma, mask=is_masked)[:, stamp, stamp]
        sky_noise = np.ma.median(stamp_sigma, axis=(1, 2)).filled(np.nan).astype(float)
    else:
        # Noise within the stamp of a bright star would include residuals of the PSF.
        _, sky_noise = sky_around(data, is_masked | ~np.isfinite(data), stamp_px)
        least_noise = observation.least_noise
        sky_noise = np.where(sky_noise > 0, np.maximum(sky_noise, least_noise), np.nan)
    return data[:, stamp, stamp], is_masked[:, stamp, stamp], is_truncated, sky_noise


def _build_stamps(
    observation: Observation,
    part: slice,
    data: np.ndarray,
    is_masked: np.ndarray,
    is_truncated: np.ndarray,
    noise: np.ndarray,
) -> Stamps:
    """Return stamps (n, s, s) of some of the stars, with flags, positions and columns.

    Parameters
    ----------
    observation : Observation
        The stars, with camera and bad pixels.
    part : slice
        Stars of the stamps.
    data : ndarray, shape (n, s, s)
        Counts, changed here: pixels without a number become 0.
    is_masked : ndarray of bool, shape (n, s, s)
        Pixels that are ignored; pixels without a number are added here.
    is_truncated : ndarray of bool, shape (n,)
        Stars of which a part is off the image.
    noise : ndarray, shape (n,)
        σ of the sky, NaN where it is to be estimated.
    """
    # A pixel of +inf is saturated, one of NaN is not.
    level = observation.saturate
    is_saturated = np.zeros(data.shape, dtype=bool) if level is None else data >= level
    # Pixels without a number are masked, and 0.
    finite = np.isfinite(data)
    if not finite.all():
        data[~finite] = 0.0
        is_masked |= ~finite
    # Positions in the image; and in an image, centres from the middle of the central pixel.
    unknown, stars = np.full(len(data), np.nan), observation.stars.select(part)
    x, y = (unknown, unknown) if observation.positions is None else observation.positions[part].T
    centre = np.full((len(data), 2), np.nan)
    raise_flag(stars.flags, StarFlag.TRUNCATED, is_truncated)
    if observation.shape is not None:
        centre = np.stack([y - central_pixel(y), x - central_pixel(x)], axis=1)
        # A cosmic ray within a pixel of the position: the source may not be a star.
        cosmic = cut_image(observation._layers.bad_pixels.cosmic, observation.shape, x, y, 3, 0)[0]
        raise_flag(stars.flags, StarFlag.SHARP, cosmic.any(axis=(1, 2)))
    return Stamps(
        data,
        bad=is_masked,
        saturated=is_saturated,
        flags=stars.flags,
        id=stars.id,
        x=x,
        y=y,
        flux=stars.flux,
        background=stars.background,
        noise=noise,
        noise_correlation=np.full(len(data), observation.noise_correlation),
        gain=unknown if observation.gain is None else np.full(len(data), observation.gain),
        magnitude=unknown,
        colour=stars.colour,
        listed=centre,
    )
