"""Mask and noise map of an image, found and checked.

Inputs: an image and its options. Outputs: the mask with its bad bits and the noise map that the
options name, or the extensions of the image's own file such as DQ and ERR.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from psfdae.base.errors import keyword
from psfdae.image.containers import split_array
from psfdae.image.errors import ObservationError, reading
from psfdae.image.fits_file import (
    SCIENCE,
    ImageFile,
    array_image,
    card_value,
    find_image,
    has_pixels,
    is_science,
    map_kind_by_name,
    open_hdus,
)
from psfdae.image.image_input import ImageInput
from psfdae.image.sky import Sky

NOISE_MAPS = {"weight": "a weight map", "variance": "a variance map", "error": "a map of σ"}
"""Words for the kinds of noise maps: 1/σ² but for a factor, σ², σ."""

POWER_OF_SIGMA = {"weight": -2, "variance": 2, "error": 1}
"""Powers of σ that these maps have."""


@dataclass(frozen=True, eq=False)
class NoiseMap:
    """Map of the noise of an image's pixels.

    Attributes
    ----------
    data : ImageFile
        The map itself.
    kind : str
        A key of `NOISE_MAPS`.
    scale : float
        Factor from σ of the map to σ in the image, where the sky shows it.
    photons : float
        Variance of the map for a unit of light above the sky; 0 for a map of the sky alone.
    """

    data: ImageFile
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

    def read_sigma(self, light: np.ndarray | float = 0.0) -> np.ndarray:
        """Return `sigma` of all pixels (h, w)."""
        return self.sigma(self.data.read(), light)


@dataclass(frozen=True, eq=False)
class Mask:
    """Mask of an image, or of the stamps of a cube.

    Attributes
    ----------
    data : ImageFile
        The mask itself; its values are read in double precision, which holds 2⁵³.
    bad_bits : int or None
        Sum of the bits that are bad; None for all.
    """

    data: ImageFile
    bad_bits: int | None = None

    def is_bad(self, values: np.ndarray) -> np.ndarray:
        """Return True for pixels that are bad, from their values in the mask; NaN is bad."""
        if self.bad_bits is None:
            return np.asarray(values != 0)
        with np.errstate(invalid="ignore"):  # infinity does not have bits
            return np.asarray((np.nan_to_num(values, nan=-1).astype(np.int64) & self.bad_bits) != 0)

    def read(self) -> np.ndarray:
        """Return `is_bad` of all pixels."""
        return self.is_bad(self.data.read(np.float64))


def find_layers(
    source: ImageInput, image: ImageFile, is_cube: bool
) -> tuple[Mask | None, NoiseMap | None, list[str]]:
    """Find mask and noise map of an image: the given ones, or the layers of its own file.

    Parameters
    ----------
    source : ImageInput
        Options of the image, which may name the layers.
    image : ImageFile
        The image.
    is_cube : bool
        The image is a cube of stamps, of which the file's other extensions are not used.

    Returns
    -------
    mask : Mask or None
    noise_map : NoiseMap or None
    remarks : list of str
        Sentences on the layers of the image's own file that are used.

    Raises
    ------
    ObservationError
        If a layer cannot be found, or is not as large as the image; or if options exclude each
        other.
    """
    layers_of_file = {} if is_cube else find_file_layers(image)
    mask, remarks = find_mask(source, image, layers_of_file.get("mask"))
    # The noise map: the given one; else, if none is given, the file's own.
    options = {k: option for k in NOISE_MAPS if (option := getattr(source, k)) is not None}
    given_maps = {kind: option for kind, option in options.items() if not _is_none(option)}
    if len(given_maps) > 1 or (given_maps and is_cube):
        raise ObservationError(
            source.path,
            "an image takes one map of weight, variance or error, a cube of stamps none",
        )
    file_mask, noise_map = mask if source.mask is None else None, None
    notes = [] if file_mask is None else [f"{file_mask.data.label} as mask"]
    factors = {kind: image.unit_factor**power for kind, power in POWER_OF_SIGMA.items()}
    for kind, option in given_maps.items():
        noise = _find_layer(image, option, NOISE_MAPS[kind]).times(factors[kind])
        # A pixel of σ or weight 0 is without data; the map is checked at the same time.
        if zeros := count_zeros(noise, kind):
            remarks.append(f"{noise.path}: {kind} 0, bad pixels: {zeros}")
        noise_map = NoiseMap(noise, kind)
    # Without an option, the map of the image's own file.
    for kind in () if options else layers_of_file.keys() & NOISE_MAPS.keys():
        noise_map, note = check_noise_map(layers_of_file[kind].times(factors[kind]), kind)
        notes.insert(0, note)
    if notes:
        line = f"{source.path}: uses {' and '.join(notes)}"
        # A bit may mark pixels that are fine; then good stars would be lost.
        if file_mask is not None and (bad_fraction := float(np.mean(file_mask.read()))) > 0.2:
            line += (
                f"; {100 * bad_fraction:.0f} % of the pixels have a bit of {file_mask.data.label}: "
                f"set {keyword('bad_bits')}, or {keyword('mask', 'none')}"
            )
        remarks.insert(0, line)
    return mask, noise_map, remarks


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
    has_value = np.nan_to_num(noise.read(), posinf=0.0) > 0
    fraction, bad_count = float(has_value.mean()), int(np.count_nonzero(~has_value))
    if fraction < 0.5:
        return None, f"not {noise.label} ({100 * fraction:.0f} % of its pixels are above 0)"
    words = f"{noise.label} as {'σ' if kind == 'error' else 'σ²'}"
    return NoiseMap(noise, kind), words + (f" (bad pixels: {bad_count})" if bad_count else "")


def find_mask(
    source: ImageInput, image: ImageFile, mask: ImageFile | None
) -> tuple[Mask | None, list[str]]:
    """Find the given mask, else the mask of the image's file, with its bad bits, and remarks.

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
    if mask is None:
        return None, []
    # Given bits override the header's.
    bits_of_header = find_bad_bits(mask)
    if source.bad_bits is not None or bits_of_header is None:
        return Mask(mask, source.bad_bits), []
    bits, planes = bits_of_header
    note = f"{source.path}: bad pixels by {mask.label}: {planes} (bits {bits})"
    return Mask(mask, bits), [note]


def _is_none(option: object) -> bool:
    """Return True for the word "none", which excludes all layers, the image file's own included."""
    return isinstance(option, str) and option.strip().lower() == "none"


def _find_layer(image: ImageFile, option: Any, role: str) -> ImageFile:
    """Find a given layer, with a pixel for every one of the image, or of its stamps.

    Parameters
    ----------
    image : ImageFile
        The image.
    option : str, int, Path or ndarray
        Extension of the image's file, another file, or an array, whose masked values are NaN.
    role : str
        Words for the layer, for messages.

    Raises
    ------
    ObservationError
        If the layer cannot be found, or is not as large as the image.
    """
    # An array, the path of a file, or else an extension; a text may be either of these two.
    is_array = isinstance(option, np.ndarray)
    # A name that is not a file is an extension's; a pipe is rejected when it is opened.
    is_name = isinstance(option, str) and (Path(option).is_dir() or not Path(option).exists())
    is_file = isinstance(option, str | Path) and not is_name
    if image.raw is not None and not (is_array or is_file):
        raise ObservationError(image.path, f"{role} of an array is an array, too, or a file")
    if is_array:
        # A masked value is missing, as NaN: its pixel is bad, whatever the number below the mask.
        values, is_masked, _ = split_array(option)
        missing = np.where(False if is_masked is None else is_masked, np.nan, 0.0)
        layer = array_image(values + missing, role)
    else:
        layer = find_image(Path(option)) if is_file else find_image(image.file, option)
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
    values = noise.read()
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


def measure_photons(noise_map: NoiseMap, sky: Sky) -> float:
    """Return the growth of the variance of a noise map with the light of stars, 0 without one.

    Where photons dominate the noise, variance = variance of the sky + light / gain. A map of the
    sky alone does not grow.

    Parameters
    ----------
    noise_map : NoiseMap
        Noise map with the scale that `sky` shows.
    sky : Sky
        The image without its sky.
    """
    sigma = noise_map.read_sigma()
    # Pixels of stars in which photons of the star are a large part of the variance, if any are;
    # and pixels of the sky.
    is_good = ~sky.bad & np.isfinite(sigma)
    variance, snr = sigma**2, sky.signal / np.where(sky.noise > 0, sky.noise, np.inf)
    bright = is_good & (sky.signal > 0)
    bright &= snr >= np.quantile(snr[bright], 0.9) if bright.any() else False
    faint = is_good & (np.abs(snr) < 1.0)
    if np.count_nonzero(bright) < 50 or not faint.any():
        return 0.0
    # Slope of the variance with the light, and its scatter: 1.48 median deviations.
    # (σ² − σ²_sky) / light = 1 / gain, at each bright pixel.
    growth = (variance[bright] - np.median(variance[faint])) / sky.signal[bright]
    slope = float(np.median(growth))
    spread = 1.48 * float(np.median(np.abs(growth - slope)))
    return slope if slope > 0 and spread < 0.3 * slope else 0.0


def find_file_layers(image: ImageFile) -> dict[str, ImageFile]:
    """Find the mask and the noise map that a file has for an image, by their names.

    They have its size. If names repeat, their versions (EXTVER) belong together; in a file with
    several science images that do not, none is taken.

    Returns
    -------
    dict of str to ImageFile
        Under "mask"; under one of "error", "variance".
    """
    if image.raw is not None:
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
        indices = [k for k, hdu in maps if tuple(hdu.shape)[-2:] == image.shape[-2:]]
    # The first layer of each kind.
    layers: dict[str, ImageFile] = {}
    for index in indices:
        layer = find_image(image.file, index)
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
