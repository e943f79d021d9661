"""`StampCube`: a cube of stamps, of which each plane has a star in its middle."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from psfdae.image.errors import ObservationError
from psfdae.image.fits_file import ImageFile, open_pixels
from psfdae.image.observation import Observation
from psfdae.image.stamps import Stamps, cut
from psfdae.stars.moments import robust_scatter


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class StampCube(Observation):
    """Cube (n, s, s) with a stamp of each star, or one stamp (s, s).

    Its attributes are explained in `Observation`. Planes may be larger than `stamp_px` and its
    margin: the middle of each is cut out.
    """

    def replace_margin(self, margin: int) -> Self:
        """Return the cube with stamps of another margin in px, at most its own."""
        return replace(self, margin=min(margin, self.margin))

    def check_planes(self) -> None:
        """Reject a cube whose planes show the same stars, also outside the stamps in their middle.

        Raises
        ------
        ObservationError
            If it is a time series of a field, and no list gives a star for each plane.
        """
        if self.star_list is not None or self.count < 4:
            return
        # At most 64 planes, spread over the cube.
        step = -(-self.count // 64)
        parts = [slice(row, row + 1) for row in range(0, self.count, step)]
        with open_pixels(self.data, in_pieces=True) as pixels:
            planes = np.concatenate([pixels[part] for part in parts]).astype(float)
        # What is masked, such as a hot pixel, is in all planes, but is no star.
        if self.mask is not None:
            with open_pixels(self.mask.data, in_pieces=True, dtype=np.float64) as mask:
                is_shared = len(mask.shape) == 2
                masks = [mask[:][None]] if is_shared else [mask[part] for part in parts]
            is_masked = self.mask.is_bad(np.concatenate(masks))
            planes[np.broadcast_to(is_masked, planes.shape)] = np.nan
        if has_common_stars(planes, self.stamp_px):
            raise ObservationError(
                self.path,
                "a time series: its planes show the same stars, also away from the middle, where "
                "the star of a stamp is: write one plane to a file of its own, or take all as "
                "exposures, such as psfdae.Stars.from_image([*cube], detect=True)",
            )

    def chunks(self, rows: int) -> Iterator[Stamps]:
        """Yield the stars in their order, at most `rows` at a time, whose pixels alone are read."""
        mask = self.mask
        open_mask = (
            open_pixels(mask.data, in_pieces=True, dtype=np.float64) if mask else nullcontext()
        )
        with open_pixels(self.data, in_pieces=True) as pixels, open_mask as mask_pixels:
            for part in self._split(rows):
                data = self.to_image_unit(self._cut(pixels, part))
                is_masked = np.zeros(data.shape, dtype=bool)
                if mask is not None and mask_pixels is not None:
                    is_masked |= mask.is_bad(self._cut(mask_pixels, part))
                # Without a noise map the noise is to be estimated, and a position of the list is in
                # an image that is not given: it says nothing of the centre in the stamp.
                unknown, centre = np.full(len(data), np.nan), np.full((len(data), 2), np.nan)
                yield self._build_stamps(part, data, is_masked, unknown, unknown, centre)

    def _cut(self, pixels: ImageFile, part: slice) -> np.ndarray:
        """Return stamps (n, s, s) with their margin out of the middle of some planes."""
        # A 2-d image counts as a cube of one stamp, a 2-d mask is shared by all stamps.
        planes = pixels[part] if len(pixels.shape) == 3 else pixels[:][None]
        return cut(planes, self.stamp_px + 2 * self.margin)


def has_common_stars(planes: np.ndarray, stamp_px: int) -> bool:
    """Return True if planes (n, h, w) share a star outside the stamp in their middle.

    Different stars of an image have different neighbours. Light of the star itself, such as spikes
    or the ring of a star out of focus, lies on both sides of the middle, or all around it.
    """
    from scipy import ndimage

    # Pixels without a value get the median of their plane: they are no light, whatever the sky is.
    is_finite = np.isfinite(planes)
    median = np.ma.median(np.ma.array(planes, mask=~is_finite), axis=(1, 2)).filled(0.0)
    filled_planes = np.where(is_finite, planes, median[:, None, None])
    # Means of 3 × 3 pixels above the sky, and their noise. Over the planes, their median, and what
    # nine of ten planes exceed: a star that a few planes lack, such as by a bad pixel, is common.
    smooth = ndimage.uniform_filter(filled_planes, (0, 3, 3))
    smooth -= np.median(smooth, axis=(1, 2), keepdims=True)
    noise = np.median(robust_scatter(smooth.reshape(len(planes), -1).T))
    light, common = np.median(smooth, axis=0), np.percentile(smooth, 10, axis=0, method="lower")
    # Distance from the middle. The star itself has at most the median of the light at this
    # distance, or the light on the opposite side if it is more.
    offset = np.indices(light.shape) - (np.array(light.shape).reshape(2, 1, 1) - 1) / 2.0
    radius = np.hypot(*offset).astype(int)
    own_light = ndimage.median(light, radius, np.arange(radius.max() + 1))[radius]
    own_light = np.maximum(own_light, light[::-1, ::-1])
    # Other stars are peaks outside the stamp, above 5 σ, at least a tenth as high as the highest,
    # and more than 2.5 times as high as the star itself may be there.
    is_star = (np.abs(offset).max(axis=0) > stamp_px / 2) & (common > 5.0 * noise)
    is_star &= light >= np.maximum(ndimage.maximum_filter(light, 5), 0.1 * light.max())
    is_star &= own_light < 0.4 * light
    return bool(is_star.any())
