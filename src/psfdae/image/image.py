"""`Image`: one opened image with its mask, noise map, camera, WCS and stars.

Pixels are read where they are needed: as a whole for bad pixels and sky, at the stars for stamps.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np

from psfdae.base.errors import keyword
from psfdae.base.progress import task
from psfdae.image.bad_pixels import BadPixels, ClippedSkyError, find_bad_pixels
from psfdae.image.detection import is_on_source
from psfdae.image.errors import ObservationError, silent
from psfdae.image.fits_file import ImageFile, open_pixels
from psfdae.image.layers import NoiseMap
from psfdae.image.observation import Observation
from psfdae.image.positions import find_repeated_rows, is_on_image
from psfdae.image.sky import Sky, sky_around, subtract_sky
from psfdae.image.stamps import Stamps, StarFlag, central_pixel, cut_image, raise_flag
from psfdae.image.trails import add_trails


@dataclass
class PixelCache:
    """Bad pixels and sky of an image, shared by its copies with other stars or another camera.

    Attributes
    ----------
    bad_pixels : BadPixels or None
        The bad pixels, once they are found.
    sky : Sky or None
        The sky, once it is measured; of several images, only the last one's is kept.
    last : list of PixelCache
        The cache that holds a sky, the same list for all caches; empty before the first sky.
    """

    bad_pixels: BadPixels | None = None
    sky: Sky | None = None
    last: ClassVar[list[PixelCache]] = []

    def keep_sky(self, sky: Sky) -> Sky:
        """Keep a sky, and drop the sky of the image before: maps take much memory."""
        for cache in self.last:
            cache.sky = None
        self.sky, self.last[:] = sky, [self]
        return sky


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Image(Observation):
    """Image on which the stars lie.

    Attributes
    ----------
    positions : ndarray, shape (n, 2)
        0-based x and y; NaN where neither list nor WCS has one.
    noise_map : NoiseMap or None
        Map of the noise of the pixels.
    neighbour_light : callable or None
        Function of a slice of the stars, a side and a margin in px; it returns the light of other
        stars in the stamps of these, which is subtracted.
    cache : PixelCache
        Bad pixels and sky, once they are measured.

    The other attributes are explained in `Observation`.
    """

    positions: np.ndarray = field(default_factory=lambda: np.empty((0, 2)))
    noise_map: NoiseMap | None
    neighbour_light: Callable[[slice, int, int], np.ndarray] | None = None
    cache: PixelCache = field(default_factory=PixelCache)

    def camera_in_sky_unit(self) -> tuple[float | None, float]:
        """Return gain and saturation for pixels as `sky` has them; inf without saturation."""
        gain = None if self.gain is None else self.gain / self.unit_factor
        saturate = np.inf if self.saturate is None else self.saturate
        return gain, (saturate - self.data.base_level) * self.unit_factor

    # Bad pixels and sky of the whole image.

    @property
    def bad_pixels(self) -> BadPixels:
        """Pixels of the image that are left out; raises ObservationError if its sky was clipped."""
        return self.cache.bad_pixels or self._find_bad_pixels(*self._read()[:2])

    def _read(self) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
        """Return the image (h, w), its masked pixels, and σ of all pixels if there is a map."""
        # Pixels without a number, of the mask, or without noise in its map are masked. σ has the
        # photons of the stars, whose light is not known before the sky is.
        image, sigma = self.data.read(), None
        bad = ~np.isfinite(image)
        if self.mask is not None:
            bad |= self.mask.read()
        if self.noise_map is not None:
            sigma = replace(self.noise_map, photons=0.0).read_sigma()
            bad |= np.isnan(sigma)
        return image, bad, sigma

    def _find_bad_pixels(self, image: np.ndarray, is_masked: np.ndarray) -> BadPixels:
        """Search for bad pixels, once, in the pixels and the mask that `_read` returns."""
        if self.cache.bad_pixels is None:
            try:
                with silent():
                    # As in the file, which messages name.
                    pixels, headers = self.to_image_unit(image), self.data.headers
                    bad_pixels = find_bad_pixels(pixels, is_masked, headers, self.saturate)
                    saturate = self.camera_in_sky_unit()[1]
                    self.cache.bad_pixels = add_trails(image, bad_pixels, saturate)
            except ClippedSkyError as error:
                raise ObservationError(self.data.path, str(error)) from None
        return self.cache.bad_pixels

    def sky(self) -> Sky:
        """Return the sky and the image without it, in the unit of the image times `unit_factor`.

        Its level is above the `base_level` of `data`.

        Raises
        ------
        ObservationError
            If the sky was clipped, or too few pixels have a value.
        """
        return self.cache.sky or self.cache.keep_sky(self._measure_sky())

    def take_sky(self) -> Sky:
        """Return `sky`, and keep it no longer: of a large image, its maps take much memory."""
        sky = self.sky()
        self.cache.sky = None
        return sky

    def _measure_sky(self) -> Sky:
        """Measure the sky without bad pixels; its noise is a map of σ, scaled, if there is one."""
        image, is_masked, sigma = self._read()
        with task("sky", 2) as advance, silent():
            bad_pixels = self._find_bad_pixels(image, is_masked)
            advance(1, "bad pixels")
            # The sky that was measured to find trails is used here and not kept: it takes much
            # memory.
            self.cache.bad_pixels = replace(bad_pixels, sky=None)
            try:
                least_noise = self.least_noise * self.unit_factor
                sky = subtract_sky(image, bad_pixels.mask, sigma, least_noise, bad_pixels.sky)
            except ValueError:  # nothing to measure the sky on
                problem = "too few pixels of the image have a value that is not masked"
                if self.mask is not None and self.mask.bad_bits is None:
                    problem += (
                        f"; {keyword('bad_bits')} says which bits are bad, "
                        f"{keyword('mask', 'none')} takes no mask"
                    )
                raise ObservationError(self.data.path, problem) from None
        if self.noise_map is None or not self.noise_map.photons:
            return sky
        # σ without the photons of the stars, whose light is known now.
        sigma = sky.noise_scale * self.noise_map.read_sigma(sky.signal)
        # Bad pixels, for which the map lacks σ, keep the noise of the sky around.
        return replace(sky, noise=np.where(np.isfinite(sigma), sigma, sky.noise).astype(np.float32))

    def describe_bad_pixels(self) -> tuple[str, ...]:
        """Return each kind of bad pixels, with the number of pixels."""
        return self.bad_pixels.notes

    # Stars.

    def find_repeated_stars(self) -> np.ndarray:
        """Return True for stars of a list that are the same as an earlier one, shape (n,).

        Their distance is less than a tenth of a pixel (`find_repeated_rows`).
        """
        if self.detections is not None:
            return np.zeros(self.count, dtype=bool)
        return find_repeated_rows(self.positions)

    def check_list(self) -> None:
        """Reject a star list of another image.

        Raises
        ------
        ObservationError
            If fewer than half of its positions are on a source.
        """
        if self.catalogue is None:
            return
        # Known positions that lie on pixels of a source; unknown ones are off the image.
        known_count = int(np.isfinite(self.positions).all(axis=1).sum())
        sky = self.sky()
        with silent():
            column, row = central_pixel(self.positions.T)
            # 2 σ above the sky is a source.
            hits = int(is_on_source(sky, column, row, 2.0).sum())
        if hits < 0.5 * known_count:
            problem = f"{hits} of {known_count} positions are on a source of {self.path}, at least "
            count = np.count_nonzero(is_on_image(self.positions, self.shape))
            if hits >= 0.5 * count > 0:  # those on the image are on its sources
                problem += f"half are expected, and {known_count - count} are off the image: "
                problem += f"{keyword('on_image', True)} leaves these out, such as of other chips"
            else:
                problem += "half are expected: a list of another image, or with stars too faint "
                problem += "for this one?"
            raise ObservationError(self.catalogue, problem)

    def chunks(self, rows: int) -> Iterator[Stamps]:
        """Yield the stars in their order, at most `rows` at a time."""
        noise_map = self.noise_map
        open_noise = open_pixels(noise_map.data, in_pieces=False) if noise_map else nullcontext()
        # Positions in an image are anywhere.
        with open_pixels(self.data, in_pieces=False) as pixels, open_noise as noise:
            for part in self._split(rows):
                yield self._cut(part, pixels, noise)

    def _cut(self, part: slice, pixels: ImageFile, noise: ImageFile | None) -> Stamps:
        """Cut stamps out of the image, and measure the noise of the sky of each.

        Parameters
        ----------
        part : slice
            Stars that are cut.
        pixels, noise : ImageFile
            Pixels of the image, and of its noise map if it has one.
        """
        stamp_px, (x, y) = self.stamp_px, self.positions[part].T
        # The noise of the sky is measured in a ring of at least 8 px around the stamp.
        margin = max(self.margin, 8)
        # All layers are cut at the same positions.
        window = (self.shape, x, y, stamp_px, margin)
        data, inside, is_truncated = cut_image(pixels, *window)
        data = self.to_image_unit(data)
        data[~inside] = 0.0
        # Other stars of a crowded image are subtracted.
        raw = data
        if self.neighbour_light is not None:
            # Saturated pixels are not changed, so that they are flagged.
            limit = np.inf if self.saturate is None else self.saturate
            single_stars = data - self.neighbour_light(part, stamp_px, margin)
            data = np.where(data >= limit, data, single_stars)
        # Pixels that are off the image or masked.
        is_masked = ~inside | (cut_image(self.bad_pixels.mask, *window)[0] != 0)
        # The stamp with its own margin, within the wider cut.
        side = slice(margin - self.margin, margin + stamp_px + self.margin)
        stamp = np.s_[:, side, side]
        if noise is not None and self.noise_map is not None:
            # σ of the sky from the map, without the photons of all stars, also of those that were
            # subtracted.
            light: np.ndarray | float = 0.0
            if self.noise_map.photons:
                level, _ = sky_around(raw, is_masked, stamp_px)
                light = (raw - level[:, None, None]) * self.unit_factor
            sigma = self.noise_map.sigma(cut_image(noise, *window)[0], light) / self.unit_factor
            stamp_sigma = np.ma.array(sigma, mask=is_masked)[stamp]
            sky_noise = np.ma.median(stamp_sigma, axis=(1, 2)).filled(np.nan).astype(float)
            sky_level = np.full(len(data), np.nan)
        else:
            # Noise within the stamp of a bright star would include residuals of the PSF.
            sky_level, sky_noise = sky_around(data, is_masked | ~np.isfinite(data), stamp_px)
            sky_noise = np.where(sky_noise > 0, np.maximum(sky_noise, self.least_noise), np.nan)
        # The level is used where it was measured in the pixels of the stamp with its margin.
        sky_level = np.where(margin == self.margin, sky_level, np.nan)
        centre = np.stack([y - central_pixel(y), x - central_pixel(x)], axis=1)
        stamps = self._build_stamps(
            part, data[stamp], is_masked[stamp], sky_noise, sky_level, centre
        )
        raise_flag(stamps.flags, StarFlag.TRUNCATED, is_truncated)
        # A cosmic ray within a pixel of the position: the source may not be a star.
        cosmic = cut_image(self.bad_pixels.cosmic, self.shape, x, y, 3, 0)[0]
        raise_flag(stamps.flags, StarFlag.SHARP, cosmic.any(axis=(1, 2)))
        return stamps
