"""Mask and noise map of an image, and its bad pixels, noise and sky computed from them.

Inputs: the options of an image. `find_layers` finds the mask and the noise map that they name, or
the extensions of the image's own file such as DQ and ERR. Output: `Layers`: the image, its bad
pixels, their σ, and the sky.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from psfdae.base.errors import keyword
from psfdae.base.progress import task
from psfdae.image.bad_pixels import BadPixels, ClippedSkyError, find_bad_pixels
from psfdae.image.camera import CameraValue
from psfdae.image.detection import Sky, find_sky
from psfdae.image.errors import ObservationError, reading, silent
from psfdae.image.fits_file import (
    SCIENCE,
    ImageFile,
    Pixels,
    array_image,
    card_value,
    find_image,
    has_pixels,
    is_science,
    map_kind_by_name,
    open_hdus,
    open_pixels,
)
from psfdae.image.image_input import ImageInput
from psfdae.image.trails import add_trails

NOISE_MAPS = {"weight": "a weight map", "variance": "a variance map", "error": "a map of σ"}
"""Words for the kinds of noise maps: 1/σ² but for a factor, σ², σ."""

POWER_OF_SIGMA = {"weight": -2, "variance": 2, "error": 1}
"""Powers of σ that these maps have."""


@dataclass(frozen=True, eq=False)
class NoiseMap:
    """Map of the noise of an image's pixels.

    Attributes
    ----------
    image : ImageFile
        The map itself.
    kind : str
        A key of `NOISE_MAPS`.
    scale : float
        Factor from σ of the map to σ in the image, where the sky shows it.
    photons : float
        Variance of the map for a unit of light above the sky; 0 for a map of the sky alone.
    """

    image: ImageFile
    kind: str
    scale: float = 1.0
    photons: float = 0.0

    def sigma(self, values: np.ndarray, light: np.ndarray | float = 0.0) -> np.ndarray:
        """Return σ of the sky in pixels from their values in the map, NaN where one is missing.

        The photons of stars, `light` above the sky, are taken out of a map that includes them.

        Parameters
        ----------
        values : ndarray
            Pixels of the map.
        light : ndarray or float
            Light of stars in the same pixels, above the sky, in counts.
        """
        # σ² of the sky and of the light of stars: of σᵖ, the power 2/p.
        with np.errstate(all="ignore"):
            variance = values ** (2 // POWER_OF_SIGMA[self.kind])
            has_value = np.isfinite(variance) & (variance > 0)
            # Light is noisy, too; at least a hundredth of the variance is of the sky.
            variance = np.clip(variance - self.photons * light, 0.01 * variance, 2.0 * variance)
        return self.scale * np.sqrt(np.where(has_value, variance, np.nan))


@dataclass(frozen=True, eq=False)
class Layers:
    """Image with its mask and noise map, which it opens and reads.

    Attributes
    ----------
    image : ImageFile
        The image.
    mask : ImageFile or None
        Its mask.
    bad_bits : int or None
        Bits of the mask that are bad; None for all.
    noise : NoiseMap or None
        Its noise map.
    least_noise : float
        Read noise in the unit of the pixels; 0 where it or the gain is not known.
    saturate : float or None
        Counts from which a pixel is saturated, in the unit of the file.
    """

    image: ImageFile
    mask: ImageFile | None = None
    bad_bits: int | None = None
    noise: NoiseMap | None = None
    least_noise: float = 0.0
    saturate: float | None = None
    # The bad pixels, once they are found. Copies with another map of noise share them.
    _bad_pixels: list[BadPixels] = field(default_factory=list, repr=False)

    @contextmanager
    def open(self, in_pieces: bool) -> Iterator[tuple[Pixels, Pixels | None, Pixels | None]]:
        """Yield the pixels of image, mask and noise map, None for a missing one.

        Parameters
        ----------
        in_pieces : bool
            See `psfdae.image.fits_file.open_pixels`.
        """
        with ExitStack() as files:

            def open_layer(image: ImageFile, dtype: type[np.floating] = np.float32) -> Pixels:
                return files.enter_context(open_pixels(image, in_pieces=in_pieces, dtype=dtype))

            pixels = open_layer(self.image)
            # Bits of whole numbers do not fit into the mantissa of a float32.
            mask = None if self.mask is None else open_layer(self.mask, np.float64)
            noise = None if self.noise is None else open_layer(self.noise.image)
            yield pixels, mask, noise

    def is_bad(self, values: np.ndarray) -> np.ndarray:
        """Return True for the values of the mask that are bad; NaN is bad.

        Parameters
        ----------
        values : ndarray
            Pixels of the mask, in double precision, which holds whole numbers up to 2⁵³.
        """
        if self.bad_bits is None:
            return np.asarray(values != 0)
        with np.errstate(invalid="ignore"):  # infinity does not have bits
            return np.asarray((np.nan_to_num(values, nan=-1).astype(np.int64) & self.bad_bits) != 0)

    def sky(self) -> Sky:
        """Return the image as a whole with its sky.

        Raises
        ------
        ObservationError
            If the sky was clipped, or too few pixels have a value.
        """
        return _sky(self)

    @property
    def bad_pixels(self) -> BadPixels:
        """Pixels of the image that are left out; raises ObservationError if its sky was clipped."""
        return self._bad_pixels[0] if self._bad_pixels else self.find_bad(*self.read()[:2])

    def read(self) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
        """Return the image (h, w), its masked pixels, and σ of all pixels if there is a map."""
        sigma = None
        # Pixels without a number, of the mask, or without noise in its map are masked.
        with self.open(in_pieces=False) as (pixels, mask, noise):
            image = pixels[:]
            bad = ~np.isfinite(image)
            if mask is not None:
                bad |= self.is_bad(mask[:])
            if noise is not None and self.noise is not None:
                sigma = replace(self.noise, photons=0.0).sigma(noise[:])
                bad |= np.isnan(sigma)
        return image, bad, sigma

    def find_bad(self, image: np.ndarray, bad: np.ndarray) -> BadPixels:
        """Search for bad pixels, once, in the image and the mask that `read` returns.

        Raises
        ------
        ObservationError
            If the sky of the image is clipped at its minimum value.
        """
        if not self._bad_pixels:
            try:
                with silent():
                    # In the unit of the file, which messages have.
                    unit, saturate = self.image.unit_factor, self.saturate
                    bad_pixels = find_bad_pixels(image / unit, bad, self.image.headers, saturate)
                    limit = None if saturate is None else saturate * unit
                    self._bad_pixels.append(add_trails(image, bad_pixels, limit))
            except ClippedSkyError as error:
                raise ObservationError(self.image.path, str(error)) from None
        return self._bad_pixels[0]


@lru_cache(maxsize=1)
def _sky(layers: Layers) -> Sky:
    """Return the image of layers with its sky; the last one is kept for more calls."""
    # The sky is measured without bad pixels, in units of the map of σ if there is one.
    image, bad, sigma = layers.read()
    with task("sky", 2) as advance, silent():
        bad_pixels = layers.find_bad(image, bad)
        advance(1, "bad pixels")
        # A sky that was measured to find trails is used once: it takes much memory.
        layers._bad_pixels[:] = [replace(bad_pixels, sky=None)]
        try:
            sky = find_sky(image, bad_pixels.mask, sigma, layers.least_noise, bad_pixels.sky)
        except ValueError:  # nothing to measure the sky on
            problem = "too few pixels of the image have a value that is not masked"
            if layers.mask is not None and layers.bad_bits is None:
                problem += (
                    f"; {keyword('bad_bits')} says which bits are bad, "
                    f"{keyword('mask', 'none')} takes no mask"
                )
            raise ObservationError(layers.image.path, problem) from None
    if layers.noise is None or not layers.noise.photons:
        return sky
    # σ without the photons of the stars, whose light is known now.
    with layers.open(in_pieces=False) as (_, _, noise):
        assert noise is not None
        sigma = sky.noise_scale * layers.noise.sigma(noise[:], sky.flat)
    # Bad pixels, for which the map lacks σ, keep the noise of the sky around.
    return replace(sky, noise=np.where(np.isfinite(sigma), sigma, sky.noise).astype(np.float32))


def find_layers(
    source: ImageInput, image: ImageFile, is_cube: bool, camera: dict[str, CameraValue]
) -> tuple[Layers, list[str]]:
    """Find mask and noise map of an image: the given ones, or the layers of its own file.

    Parameters
    ----------
    source : ImageInput
        Options of the image, which may name the layers.
    image : ImageFile
        The image.
    is_cube : bool
        The image is a cube of stamps, of which the file's other extensions are not used.
    camera : dict of str to CameraValue
        Values of the camera, by the names of `HEADER_KEYS`.

    Returns
    -------
    layers : Layers
        Image, mask and noise map.
    remarks : list of str
        Sentences on the layers of the image's own file that are used.

    Raises
    ------
    ObservationError
        If a layer cannot be found, or is not as large as the image; or if options exclude each
        other.
    """
    # The mask, and the noise of the electronics in counts: read noise / gain.
    factor = image.unit_factor
    layers_of_file = {} if is_cube else find_file_layers(image)
    mask, bad_bits, remarks = find_mask(source, image, layers_of_file.get("mask"))
    gain, read_noise = camera["gain"].value, camera["read noise"].value
    least_noise = factor * read_noise / gain if read_noise and gain else 0.0
    saturate = camera["saturation"].value
    layers = Layers(image, mask, bad_bits, least_noise=least_noise, saturate=saturate)
    # The noise map: the given one; else, if none is given, the file's own.
    maps = {kind: getattr(source, kind) for kind in NOISE_MAPS}
    given_maps = {k: v for k, v in maps.items() if v is not None and not _is_none(v)}
    if len(given_maps) > 1 or (given_maps and is_cube):
        raise ObservationError(
            source.path,
            "an image takes one map of weight, variance or error, a cube of stamps none",
        )
    notes = [f"{mask.label} as mask"] if mask is not None and source.mask is None else []
    for kind, place in given_maps.items():
        noise = _find_layer(image, place, NOISE_MAPS[kind]).times(factor ** POWER_OF_SIGMA[kind])
        # A pixel of σ or weight 0 is without data; the map is checked at the same time.
        if zeros := count_zeros(noise, kind):
            remarks.append(f"{noise.path}: {kind} 0, bad pixels: {zeros}")
        layers = replace(layers, noise=NoiseMap(noise, kind))
    # Without an option, the map of the image's own file.
    if all(place is None for place in maps.values()):
        for kind in layers_of_file.keys() & NOISE_MAPS.keys():
            file_map = layers_of_file[kind].times(factor ** POWER_OF_SIGMA[kind])
            noise_map, note = check_noise_map(file_map, kind)
            layers, notes = replace(layers, noise=noise_map), [note, *notes]
    if notes:
        line = f"{source.path}: uses {' and '.join(notes)}"
        if mask is not None and source.mask is None:
            # A bit may mark pixels that are fine; then good stars would be lost.
            with open_pixels(mask, in_pieces=False, dtype=np.float64) as pixels:
                share = float(np.mean(layers.is_bad(pixels[:])))
            if share > 0.2:
                line += (
                    f"; {100 * share:.0f} % of the pixels have a bit of {mask.label}: "
                    f"state {keyword('bad_bits')}, or {keyword('mask', 'none')}"
                )
        remarks.insert(0, line)
    return layers, remarks


def check_noise_map(noise: ImageFile, kind: str) -> tuple[NoiseMap | None, str]:
    """Check the noise map of the image's own file; return it, and words on its use.

    Its bad pixels are 0. None if it has values for fewer than half of the pixels.

    Returns
    -------
    noise_map : NoiseMap or None
        The map, if it is used.
    words : str
        Use of the map, or the reason why it is not used.
    """
    # Fraction of the pixels that have a σ or σ² above 0.
    with open_pixels(noise, in_pieces=False) as pixels:
        has_value = np.nan_to_num(pixels[:], posinf=0.0) > 0
    share, bad_count = float(has_value.mean()), int(np.count_nonzero(~has_value))
    if share < 0.5:
        return None, f"not {noise.label} ({100 * share:.0f} % of its pixels are above 0)"
    words = f"{noise.label} as {'σ' if kind == 'error' else 'σ²'}"
    return NoiseMap(noise, kind), words + (f" (bad pixels: {bad_count})" if bad_count else "")


def find_mask(
    source: ImageInput, image: ImageFile, mask: ImageFile | None
) -> tuple[ImageFile | None, int | None, list[str]]:
    """Find the given mask, else the mask of the image's file, its bad bits, and remarks.

    Parameters
    ----------
    source : ImageInput
        Options of the image; its `mask` may be "none".
    image : ImageFile
        The image.
    mask : ImageFile or None
        Mask in the image's own file.

    Raises
    ------
    ObservationError
        If bits are given without a mask.
    """
    if source.mask is not None:
        mask = None if _is_none(source.mask) else _find_layer(image, source.mask, "a mask")
    if mask is None and source.bad_bits is not None:
        raise ObservationError(source.path, f"{keyword('bad_bits')} needs a mask that has bits")
    # Given bits override the header's.
    bits_of_header = None if mask is None else find_bad_bits(mask)
    if mask is None or source.bad_bits is not None or bits_of_header is None:
        return mask, source.bad_bits, []
    bits, planes = bits_of_header
    note = f"{source.path}: bad pixels by {mask.label}: {planes} (bits {bits})"
    return mask, bits, [note]


def _is_none(place: object) -> bool:
    """Return True for the word "none", which excludes all layers, the image file's own included."""
    return isinstance(place, str) and place.strip().lower() == "none"


def _find_layer(image: ImageFile, place: Any, role: str) -> ImageFile:
    """Find a given layer, with a pixel for every one of the image, or of its stamps.

    Parameters
    ----------
    image : ImageFile
        The image.
    place : str, int, Path or ndarray
        Extension of the image's file, another file, or an array.
    role : str
        Words for the layer, for messages.

    Raises
    ------
    ObservationError
        If the layer cannot be found, or is not as large as the image.
    """
    # An array, the path of a file, or else an extension; a text may be either of these two.
    is_array = isinstance(place, np.ndarray)
    # A name that is not a file is an extension's; a pipe is rejected when it is opened.
    is_name = isinstance(place, str) and (Path(place).is_dir() or not Path(place).exists())
    is_file = isinstance(place, str | Path) and not is_name
    if image.values is not None and not (is_array or is_file):
        raise ObservationError(image.path, f"{role} of an array is an array, too, or a file")
    if is_array:
        layer = array_image(np.asarray(place, dtype=np.float64), role)
    else:
        layer = find_image(Path(place)) if is_file else find_image(image.file, place)
    # It has the shape of the image.
    shape = image.shape
    if len(layer.shape) == 3 and layer.shape[0] == 1 and len(shape) == 2:
        layer = layer.one_plane()
    # All stamps of a cube may share the mask of one.
    if layer.shape != shape and not (len(shape) == 3 and layer.shape == shape[1:]):
        size, expected_size = ("×".join(map(str, s)) for s in (layer.shape, shape))
        raise ObservationError(layer.path, f"{role} of {size} pixels, expected {expected_size}")
    return layer


def count_zeros(noise: ImageFile, kind: str) -> int:
    """Return the number of pixels in which a noise map of the user is 0, which means no data.

    Raises
    ------
    ObservationError
        If its name means another kind, or it has values that no map of its kind has.
    """
    # A map under the name of another kind would give wrong errors without a word.
    kind_by_name = map_kind(noise)
    if kind_by_name in NOISE_MAPS and kind_by_name != kind:
        raise ObservationError(
            noise.path,
            f"extension {noise.label} is {NOISE_MAPS[kind_by_name]}, not {NOISE_MAPS[kind]}: "
            f"{keyword(kind_by_name, noise.label)}",
        )
    with open_pixels(noise, in_pieces=False) as pixels:
        values = pixels[:]
    # Values that no σ², 1/σ² or σ has.
    negative, zeros = int(np.count_nonzero(values < 0)), int(np.count_nonzero(values == 0))
    # SWarp and SExtractor write 0 where data are missing; other programs NaN or infinity.
    if negative:
        raise ObservationError(
            noise.path,
            f"{NOISE_MAPS[kind]} of which {negative} of {values.size} pixels are below 0; 0 or NaN "
            "is for bad pixels, or a mask",
        )
    if not (np.isfinite(values) & (values > 0)).any():
        raise ObservationError(
            noise.path, f"{NOISE_MAPS[kind]} without a finite value above 0, expected one per pixel"
        )
    return zeros


def add_photon_noise(
    layers: Layers, camera: dict[str, CameraValue], sky: Sky
) -> tuple[Layers, dict[str, CameraValue], list[str]]:
    """Add the growth of the noise map with the light of stars to layers.

    Where photons dominate the noise, variance = variance of the sky + light / gain. A map of the
    sky alone does not grow, and nothing changes.

    Parameters
    ----------
    layers : Layers
        Layers with a noise map.
    camera : dict of str to CameraValue
        Values of the camera, by the names of `HEADER_KEYS`.
    sky : Sky
        The image without its sky.

    Returns
    -------
    layers : Layers
        Layers whose noise map has `photons`, if it grows.
    camera : dict of str to CameraValue
        Values of the camera, with the gain that the map shows, if it is not known otherwise.
    remarks : list of str
        A sentence on this gain.
    """
    assert layers.noise is not None
    with layers.open(in_pieces=False) as (_, _, noise):
        assert noise is not None
        sigma = layers.noise.sigma(noise[:])
    # Pixels of stars in which photons of the star are a large part of the variance, if any are;
    # and pixels of the sky.
    good = ~sky.bad & np.isfinite(sigma)
    variance, snr = sigma**2, sky.flat / np.where(sky.noise > 0, sky.noise, np.inf)
    bright = good & (sky.flat > 0)
    bright &= snr >= np.quantile(snr[bright], 0.9) if bright.any() else False
    faint = good & (np.abs(snr) < 1.0)
    if np.count_nonzero(bright) < 50 or not faint.any():
        return layers, camera, []
    # Slope of the variance with the light, and its scatter: 1.48 median deviations.
    # (σ² − σ²_sky) / light = 1 / gain, at each bright pixel.
    growth = (variance[bright] - np.median(variance[faint])) / sky.flat[bright]
    slope = float(np.median(growth))
    spread = 1.48 * float(np.median(np.abs(growth - slope)))
    if not (slope > 0 and spread < 0.3 * slope):
        return layers, camera, []
    # σ is scaled by the measured noise of the sky, and so is the slope of its square.
    noise_map = replace(layers.noise, photons=slope / layers.noise.scale**2)
    layers = replace(layers, noise=noise_map)
    if camera["gain"].value is not None:
        return layers, camera, []
    label = noise_map.image.label
    # In the unit of the file, light / g is its variance.
    gain = layers.image.unit_factor / slope
    words = f"{layers.image.path}: {label} grows with the light of the stars: gain {gain:.4g}"
    return layers, camera | {"gain": CameraValue(gain, label)}, [words]


def find_file_layers(image: ImageFile) -> dict[str, ImageFile]:
    """Find the mask and the noise map that a file has for an image, by their names.

    They have its size. If names repeat, their versions (EXTVER) belong together; in a file with
    several science images that do not, none is taken.

    Returns
    -------
    dict of str to ImageFile
        Under "mask"; under one of "error", "variance".
    """
    if image.values is not None:
        return {}
    with reading(image.path), open_hdus(image.file) as hdus:
        # Layers belong to a science image if it is the only one, or named as in pipelines.
        images = [(k, hdu) for k, hdu in enumerate(hdus) if has_pixels(hdu)]
        science_hdu = hdus[image.index]
        science_count = sum(is_science(hdu.name) for _, hdu in images)
        of_pipeline = science_hdu.name.upper() in SCIENCE
        if not is_science(science_hdu.name) or (science_count > 1 and not of_pipeline):
            return {}
        # Layers of its size and version, whose name does not mean a part, such as VAR_POISSON.
        maps = [(k, hdu) for k, hdu in images if not is_science(hdu.name) and "_" not in hdu.name]
        maps = [(k, hdu) for k, hdu in maps if hdu.ver == science_hdu.ver]
        places = [k for k, hdu in maps if tuple(hdu.shape)[-2:] == image.shape[-2:]]
    # The first layer of each kind.
    layers: dict[str, ImageFile] = {}
    for place in places:
        layer = find_image(image.file, place)
        if len(layer.shape) > len(image.shape):
            layer = layer.one_plane()
        kind = map_kind(layer)
        if layer.shape == image.shape and kind is not None:
            layers.setdefault(kind, layer)
    # A standard deviation overrides a variance; the unit of weights cannot be trusted.
    names = ("mask", "error" if "error" in layers else "variance")
    return {name: layers[name] for name in names if name in layers}


def map_kind(image: ImageFile) -> str | None:
    """Return the kind of map of an extension by its name and UTYPE, None if neither shows it.

    CCDData has its uncertainty in an extension UNCERT, and its kind in UTYPE.
    """
    kind = map_kind_by_name(str(image.card("EXTNAME") or ""))
    if kind != "error":
        return kind
    # CCDData writes the type of its uncertainty as UTYPE.
    types = {"STD": "error", "VAR": "variance", "IVAR": "weight"}
    return types.get(str(image.card("UTYPE") or "STD").strip().upper(), kind)


def find_bad_bits(mask: ImageFile) -> tuple[int, str] | None:
    """Find the sum of the mask's bits that are bad by its header, and their names.

    None if the header does not define them. LSST names its planes (MP_BAD = 0 for bit 0); JWST's
    and Roman's bit 1 is DO_NOT_USE.
    """
    # Planes of LSST of which the pixels show no light of stars; others mark good pixels.
    lsst_planes = ("BAD", "SAT", "INTRP", "CR", "NO_DATA", "UNMASKEDNAN")
    for header in mask.headers:
        planes = {name: card_value(header, f"MP_{name}") for name in lsst_planes}
        bits = {name: bit for name, bit in planes.items() if isinstance(bit, int) and 0 <= bit < 63}
        if bits:
            return sum(1 << bit for bit in set(bits.values())), ", ".join(bits)
        if str(card_value(header, "TELESCOP")).strip().upper() in ("JWST", "ROMAN"):
            return 1, "DO_NOT_USE"
    return None
