"""File of a model, a bundle: a fitted method and all that it takes to apply it.

A bundle is a safetensors file: arrays, and a JSON text that describes them. Reading it executes
nothing. The text holds a SHA-256 of the description and the arrays, so that a damaged file is
refused. The date is not part of it: a model has the same checksum whenever it was made. A checksum
does not tell who wrote a file; therefore sizes and numbers that no training gives are refused as
well, before memory is spent on them.

Only the leading eigenvectors of the flux model's covariance are stored. The variance of the others
is spread evenly over the directions that they span. For stamps of up to `MAX_FULL_BASIS_PX` pixels,
reading completes the basis; any basis of these directions gives the same results. For larger
stamps, whose full basis would take gigabytes, the variance stays one number.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from pydantic import ValidationError

from psfdae.bundle_info import FORMAT_VERSION, BundleInfo
from psfdae.errors import Error, needed_by
from psfdae.files import ProductError, atomic_path
from psfdae.image.errors import one_line
from psfdae.method import Method
from psfdae.methods import method
from psfdae.model.flux_model import FluxModel
from psfdae.model.wings import Wings
from psfdae.networks.weights import digest_of
from psfdae.version import __version__

SUFFIX = ".psf.safetensors"
"""End of the name of a bundle."""

SHIPPED = "wfsat"
"""Name of the bundle that comes with the package."""

KIND = "psfdae bundle"
"""Text in the file that tells a bundle from other safetensors files."""

MAX_FULL_BASIS_PX = 32**2
"""Pixels of the largest stamps whose covariance gets a full basis when it is read."""

SCALES = {"scale68": (2, 3, 2), "scale95": (2, 3, 2), "flux_error_scale": ()}
"""Arrays with factors of errors, which a bundle has all or none of; shape for each noise node."""

OPTIONAL = {"strange_limit": (), **SCALES}
"""Arrays that a bundle may lack; shape for each noise node."""


class BundleError(Error, ValueError):
    """A model bundle is missing, damaged, of a newer format, or no bundle at all; one line."""

    def __init__(self, problem: str) -> None:
        super().__init__(one_line(problem))


class ModelErrors(NamedTuple):
    """Standard errors of measured stars due to errors of the PSF model, at any S/N.

    Attributes
    ----------
    flux : float
        Error of the flux, over the flux, RMS over the field.
    sky : float
        Error of the sky in a pixel, over the flux.
    centre : float
        Error of the centre along each axis, in pixels.
    fitted_flux : float
        Error of the flux over the flux, RMS over the field, where the PSF is fitted on a sky that
        is known from the whole image.
    growth : tuple of 6 floats, or of none
        (x₀, y₀, a, b, c, d): the variance of a flux at the place (x, y) is v = a + b u² + c w² +
        d u² w² times its mean over the field, with u = x − x₀ and w = y − y₀ in pixels. Without
        them, it is the same at all places.
    """

    flux: float = 0.0
    sky: float = 0.0
    centre: float = 0.0
    fitted_flux: float = 0.0
    growth: tuple[float, ...] = ()

    def flux_factor(self, place: np.ndarray) -> np.ndarray:
        """Return √v: errors of fluxes at places (n, 2), x and y, over those of the field, (n,).

        1 where the place is not known (NaN).
        """
        if not self.growth:
            return np.ones(len(place))
        u2, w2 = np.square(place - np.array(self.growth[:2])).T
        terms = np.stack([np.ones(len(place)), u2, w2, u2 * w2])
        return np.where(np.isfinite(u2 + w2), np.sqrt(np.array(self.growth[2:]) @ terms), 1.0)


@dataclass(frozen=True, eq=False)
class Bundle:
    """Fitted method, description of its training, and its errors at S levels of noise.

    Errors are in units of the flux, or of σ where the method gives a σ (`Estimate.sigma`).

    Attributes
    ----------
    info : BundleInfo
    weights : dict of str to ndarray
        Arrays of the method, from `Method.pack`.
    flux_model : FluxModel
        Model of the noise-free training stars; `info.components` of its eigenvectors are measured.
    noise_nodes : ndarray, shape (S,)
        Noise at which the errors were measured, ascending: RMS of the sky in a pixel over the flux.
    error68 : ndarray, shape (S, d, d)
        Half-width that contains 68.27 % of the errors of a pixel.
    rms : ndarray, shape (S, d, d)
        Root mean square of the errors.
    ratio95 : ndarray, shape (S,)
        Factor by which `error68` contains 95 % of the errors.
    distance_limit : float
        99.9 % quantile of the distance of test stars (`mahalanobis`).
    strange_limit : ndarray, shape (S,), optional
        99.9 % quantile of the outlier score of test stars, if the method has a score.
    scale68, scale95 : ndarray, shape (S, 2, 3, 2), optional
        Factors by which 68 % and 95 % half-widths are larger. Axes: noise known or estimated; flux
        and sky known, sky known, or neither; faint or bright pixels (`brightest`).
    flux_error_scale : ndarray, shape (S,), optional
        Scatter of the flux over its stated error.
    """

    info: BundleInfo
    weights: dict[str, np.ndarray]
    flux_model: FluxModel
    noise_nodes: np.ndarray
    error68: np.ndarray
    rms: np.ndarray
    ratio95: np.ndarray
    distance_limit: float
    strange_limit: np.ndarray | None = None
    scale68: np.ndarray | None = None
    scale95: np.ndarray | None = None
    flux_error_scale: np.ndarray | None = None

    @property
    def sha256(self) -> str:
        """Checksum of everything but the date."""
        return _digest(self.info.described(), bundle_arrays(self))

    @property
    def wings(self) -> Wings | None:
        """Light of stars beyond the stamps, if it was measured; BundleError if damaged."""
        tree = self.info.config.get("wings")
        try:
            return None if tree is None else Wings.of_plain(tree)
        except ValueError as error:
            raise BundleError(f"{self.info.name}: damaged ({error})") from None

    @property
    def model_errors(self) -> ModelErrors:
        """Errors of measured stars due to errors of the model; BundleError if damaged."""
        tree = self.info.config.get("model_errors", {})
        try:
            numbers = {name: value for name, value in tree.items() if name != "growth"}
            growth = tuple(float(value) for value in tree.get("growth", ()))
            errors = ModelErrors(**{k: float(v) for k, v in numbers.items()}, growth=growth)
            # Places are pixels; a variance is not below 0.
            sizes = [*errors[:4], *growth[2:]]
            if not (all(0.0 <= size < 1e3 for size in sizes) and len(growth) in (0, 6)):
                raise ValueError("numbers that are no errors")
        except (TypeError, ValueError, AttributeError) as error:
            raise BundleError(f"{self.info.name}: damaged (model_errors: {error})") from None
        return errors

    def scales(self, noise: np.ndarray) -> list[np.ndarray] | None:
        """Interpolate `scale68`, `scale95` and `flux_error_scale` linearly at the noise of stars.

        Parameters
        ----------
        noise : ndarray, shape (n,)

        Returns
        -------
        list of ndarray, shapes (n, 2, 3, 2) twice and (n,)
            None if the bundle has no such factors.
        """
        if self.scale68 is None:
            return None
        # np.interp takes one column at a time: flatten a table to (S, …), and restore its shape.
        scales = []
        for name in SCALES:
            table = getattr(self, name)
            columns = table.reshape(len(table), -1).T
            values = [np.interp(noise, self.noise_nodes, column) for column in columns]
            scales.append(np.stack(values, axis=1).reshape(-1, *table.shape[1:]))
        return scales


def estimator(bundle: Bundle) -> Method:
    """Return the method of a bundle, ready to predict.

    Raises
    ------
    BundleError
        If its arrays do not fit together.
    MissingExtraError
        If it is a network and torch is not installed.
    """
    info = bundle.info
    method_class = method(info.method)
    if info.dae:
        with needed_by(f"the model {info.name!r}"):
            return method_class.unpack(bundle.weights, info)
    # The method knows which arrays it can work with: it states conditions, and restores a stamp.
    blank = np.zeros((1, info.stamp_px, info.stamp_px), np.float32)
    try:
        fitted = method_class.unpack(bundle.weights, info)
        for name, expected, is_fulfilled in fitted.conditions():
            if not np.all(is_fulfilled):
                raise ValueError(f"array {name!r} must have {expected}")
        if fitted.estimate(blank, np.array([info.noise_max])).psf.shape != blank.shape:
            raise ValueError("its PSFs have not the size of stamps")
    except (ValueError, TypeError, LookupError, ArithmeticError) as error:
        raise BundleError(f"{info.name}: damaged ({info.method}: {error})") from None
    return fitted


def at_noise(noise: np.ndarray, nodes: np.ndarray, maps: np.ndarray) -> np.ndarray:
    """Interpolate maps of errors linearly at the noise of each star.

    They are linear in the noise and not in its logarithm: an error is a floor plus a part that
    grows about as fast as the noise. Outside the nodes the nearest one counts.

    Parameters
    ----------
    noise : ndarray, shape (n,)
        RMS of the sky noise in a pixel over the flux, such as `BundleInfo.noise_min`.
    nodes : ndarray, shape (S,)
        Noise at which the maps were measured, ascending.
    maps : ndarray, shape (S, d, d)
        `Bundle.error68` or `Bundle.rms`.

    Returns
    -------
    ndarray, shape (n, d, d)
        Maps in their own unit; NaN where the noise is NaN.
    """
    noise = np.asarray(noise, dtype=np.float64)
    # Position among the nodes: the lower node, and the fraction of the way to the upper one.
    position = np.interp(noise, nodes, np.arange(len(nodes), dtype=np.float64))
    lower = np.where(np.isfinite(position), np.minimum(position, len(nodes) - 1), 0).astype(np.intp)
    upper = np.minimum(lower + 1, len(nodes) - 1)
    fraction = (position - lower).astype(maps.dtype)[:, None, None]
    return np.asarray(maps[lower] * (1 - fraction) + maps[upper] * fraction)


def brightest(psf: np.ndarray) -> np.ndarray:
    """Return a mask of the brightest pixels of each PSF (n, d, d), 20 of 256 (8 %) of its pixels.

    Errors of these pixels, the core, scale in another way than those of the many faint pixels.
    """
    # The threshold is the faintest of the bright pixels; equal pixels count as bright as well.
    flat = psf.reshape(len(psf), -1)
    faint_count = flat.shape[1] - max(1, round(20 / 256 * flat.shape[1]))
    return psf >= np.partition(flat, faint_count, axis=1)[:, faint_count, None, None]


def mahalanobis(
    stamps: np.ndarray, noise: np.ndarray, model: FluxModel, components: int
) -> np.ndarray:
    """Return the distance of stars from the training set, along its leading eigenvectors.

    D² = Σ_k (e_kᵀ(x − m))² / (Λ_k + noise²) over the eigenvectors e_k with the largest eigenvalues
    Λ_k: the distance of Mahalanobis (1936) with the noise of the star as part of the covariance.
    Without it, every faint star would be far from the mean. D² is about `components` for bright and
    for faint stars.

    Parameters
    ----------
    stamps : ndarray, shape (n, d, d)
        Sky-subtracted, repaired, of flux 1, framed as the training stars.
    noise : ndarray, shape (n,)
        RMS of the sky noise in a pixel over the flux.
    model : FluxModel
    components : int
        Number of eigenvectors, `BundleInfo.components`.

    Returns
    -------
    ndarray, shape (n,), float64
    """
    # Scores along the eigenvectors, each over its standard deviation with the star's noise.
    centred = stamps.reshape(len(stamps), -1) - model.mean
    scores = centred @ model.basis[:, -components:]
    variance = model.variance[-components:] + np.asarray(noise, dtype=np.float64)[:, None] ** 2
    return np.asarray(np.sqrt((scores**2 / variance).sum(axis=1)))


# Writing.


def creation_date() -> str:
    """Return today's date in UTC as ISO 8601; SOURCE_DATE_EPOCH (seconds) makes it reproducible."""
    # https://reproducible-builds.org/specs/source-date-epoch
    epoch = os.environ.get("SOURCE_DATE_EPOCH")
    try:
        moment = datetime.now(UTC) if epoch is None else datetime.fromtimestamp(int(epoch), UTC)
    except (ValueError, OverflowError, OSError):
        raise BundleError(f"SOURCE_DATE_EPOCH = {epoch!r}: must be seconds since 1970") from None
    return moment.date().isoformat()


def write_bundle(bundle: Bundle, path: Path) -> None:
    """Write a bundle atomically, if its parts fit together; the same one gives the same bytes."""
    # Checked as it will be when it is read: no file is written that cannot be read.
    arrays = bundle_arrays(bundle)
    _check(bundle.info, arrays, path)
    content = bundle_bytes(bundle.info.described(), arrays)
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)


def bundle_bytes(description: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> bytes:
    """Return the bytes of a bundle file with its checksum, without checks of its contents."""
    from safetensors.numpy import save

    # The checksum is of the description as it stands here, and of all arrays.
    text = {
        "kind": KIND,
        "format_version": description["format_version"],
        "sha256": _digest(description, arrays),
        "info": description,
    }
    # A single key: safetensors writes several in an order that changes from run to run.
    return save(dict(arrays), {"bundle": json.dumps(text, sort_keys=True)})


def _digest(description: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> str:
    """Return the SHA-256 of a description without its date, and of arrays."""
    dateless = {key: value for key, value in description.items() if key != "created"}
    text = json.dumps(dateless, sort_keys=True) + digest_of(arrays)
    return hashlib.sha256(text.encode()).hexdigest()


def bundle_arrays(bundle: Bundle) -> dict[str, np.ndarray]:
    """Return the arrays of the file, the covariance cut to its leading eigenvectors."""
    model, leading = bundle.flux_model, bundle.info.components
    # Variance along each direction that is not stored: the mean of the eigenvalues left out. Those
    # of a model from a file are equal; their mean could differ from them in the last digit.
    trailing = np.array([model.other_variance])
    if model.is_complete:
        trailing = model.variance[: model.variance.size - leading]
    is_even = trailing.size and (trailing == trailing[0]).all()
    arrays = {
        "flux/variance": model.variance[-leading:],
        "flux/rest": trailing[0] if is_even else trailing.sum() / max(trailing.size, 1),
        "flux/mean": model.mean,
        "flux/low": model.low,
        "flux/high": model.high,
        "flux/basis": model.basis[:, -leading:],
    }
    names = ("noise_nodes", "distance_limit", "error68", "rms", "ratio95", *OPTIONAL)
    values = ((name, getattr(bundle, name)) for name in names)
    arrays |= {name: value for name, value in values if value is not None}
    # Arrays of the method keep their types.
    return {name: np.asarray(value, _dtype(name), order="C") for name, value in arrays.items()} | {
        f"{bundle.info.method}/{name}": np.asarray(value, order="C")
        for name, value in bundle.weights.items()
    }


def _dtype(name: str) -> np.dtype:
    """Return the type of an array: float64 for noise, variances, limits and factors of errors."""
    double = {"flux/variance", "flux/rest", "noise_nodes", "distance_limit", "ratio95", *OPTIONAL}
    return np.dtype(np.float64 if name in double else np.float32)


# Reading.


def shipped_path() -> Path:
    """Return the file of the bundle that comes with the package."""
    return Path(str(files("psfdae") / "bundles" / f"{SHIPPED}{SUFFIX}"))


def read_bundle(path: Path | None = None) -> Bundle:
    """Read a bundle, by default the shipped one, and check it, or raise BundleError."""
    path = shipped_path() if path is None else path
    try:
        text, arrays = _load(path)
        info = _read_info(text, arrays, path)
    except RecursionError:
        raise BundleError(f"{path}: damaged (its description is nested too deeply)") from None
    _check(info, arrays, path)
    # Tables keep their names; arrays of the method lose their prefix.
    names = ("noise_nodes", "error68", "rms", "ratio95", *OPTIONAL)
    tables: dict[str, Any] = {name: arrays.get(name) for name in names}
    prefix = f"{info.method}/"
    weights = {k.removeprefix(prefix): v for k, v in arrays.items() if k.startswith(prefix)}
    distance_limit = float(arrays["distance_limit"])
    flux_model = _read_flux_model(arrays)
    return Bundle(info, weights, flux_model, distance_limit=distance_limit, **tables)


def _load(path: Path) -> tuple[Any, dict[str, np.ndarray]]:
    """Return text and arrays of a safetensors file whose format is that of a bundle."""
    from safetensors import SafetensorError, safe_open

    try:
        # A bundle of stamps of 256 × 256 pixels has some 20 MB.
        size, max_size = path.stat().st_size, 2**28
        _require(size <= max_size, path, f"{size} bytes, at most {max_size}")
        with safe_open(path, framework="numpy") as file:
            text = json.loads((file.metadata() or {}).get("bundle", "null"))
            _check_format(text, path)
            names = list(file.keys())
            return text, {name: file.get_tensor(name) for name in names}
    except FileNotFoundError:
        raise BundleError(f"{path}: no such file") from None
    except BundleError:
        raise
    except OSError as error:
        raise BundleError(f"{path}: cannot be read ({error.strerror or error})") from None
    except (SafetensorError, ValueError, LookupError, TypeError, AttributeError) as error:
        raise BundleError(f"{path}: damaged, or not a model bundle ({error})") from None


def _require(condition: ArrayLike, path: Path, problem: str) -> None:
    """Raise BundleError with a problem of a file if not all of a condition is true."""
    if not np.all(condition):
        raise BundleError(f"{path}: {problem}")


def _check_format(text: Any, path: Path) -> None:
    """Check kind and version before anything else: another format may differ in all of it."""
    is_bundle = isinstance(text, dict) and text.get("kind") == KIND
    _require(is_bundle, path, "a safetensors file, but not a psfdae model bundle")
    version = text.get("format_version")
    is_version = isinstance(version, int) and version >= 1
    _require(is_version, path, f"damaged (format version {version!r})")
    reads, remedy = "", "train the model again"
    if version > FORMAT_VERSION:
        reads, remedy = "up to ", "a newer psfdae would do"
    problem = f"format {version}, but psfdae {__version__} reads {reads}format {FORMAT_VERSION}"
    _require(version == FORMAT_VERSION, path, f"{problem}; {remedy}")


def _read_info(text: Mapping[str, Any], arrays: Mapping[str, np.ndarray], path: Path) -> BundleInfo:
    """Return the description of a bundle, whose checksum and fields are right."""
    # The checksum of description and arrays comes first: nothing else is read from a damaged file.
    tree = text.get("info")
    is_intact = isinstance(tree, dict) and text.get("sha256") == _digest(tree, arrays)
    _require(is_intact, path, "damaged (the checksum differs)")
    try:
        info = BundleInfo.model_validate(tree)
    except ValidationError as error:
        first = error.errors(include_input=False)[0]
        key = ".".join(str(part) for part in first["loc"])
        raise BundleError(f"{path}: damaged ({key[:80]}: {first['msg']})") from None
    # Deep nesting passes the validation, but the description could not be written again.
    try:
        info.model_dump(mode="json")
    except ValueError:
        raise BundleError(f"{path}: damaged (its description is nested too deeply)") from None
    return info


def _check(info: BundleInfo, arrays: Mapping[str, np.ndarray], path: Path) -> None:
    """Check that arrays have the shapes that the description asks for, and usable numbers.

    Raises
    ------
    BundleError
        If an array is missing, unknown, or has a wrong type, shape or number.
    """
    # Arrays of every bundle, with d² pixels and S nodes.
    side, pixels, components = info.stamp_px, info.stamp_px**2, info.components
    nodes = arrays["noise_nodes"].size if "noise_nodes" in arrays else 0
    expected: dict[str, tuple[int, ...]] = {
        **dict.fromkeys(("flux/mean", "flux/low", "flux/high"), (pixels,)),
        "flux/variance": (components,),
        "flux/rest": (),
        "flux/basis": (pixels, components),
        "noise_nodes": (nodes,),
        **dict.fromkeys(("error68", "rms"), (nodes, side, side)),
        "ratio95": (nodes,),
        "distance_limit": (),
    }
    # Optional arrays: all factors of errors, or none.
    optional = OPTIONAL.keys() & arrays.keys()
    optional |= SCALES.keys() if SCALES.keys() & optional else set()
    expected |= {name: (nodes, *OPTIONAL[name]) for name in optional}
    # Arrays of the method; a shape that the method leaves open is taken as it is.
    try:
        shapes = method(info.method).shapes(info)
    except ProductError as error:
        raise BundleError(f"{path}: {error}; a newer psfdae would do") from None
    for key, shape in shapes.items():
        name = f"{info.method}/{key}"
        is_open = shape is None and name in arrays
        expected[name] = arrays[name].shape if is_open else shape or ()
    # No array is missing or unknown; then each has the right type, shape and numbers.
    unmatched = arrays.keys() ^ expected.keys()
    name = min(unmatched, default="")
    state = "missing" if name in expected else "unknown"
    _require(not unmatched, path, f"array {name!r} is {state}")
    for name, shape in expected.items():
        array, dtype = arrays[name], _dtype(name)
        # A network is float32; other methods choose the types of their arrays.
        is_chosen = not info.dae and name.startswith(f"{info.method}/")
        dtypes = (dtype, np.float16, np.float64, np.int64) if is_chosen else (dtype,)
        _require(array.dtype in dtypes, path, f"array {name!r} of {array.dtype}, not {dtype}")
        problem = f"array {name!r} has shape {array.shape}, not {shape}"
        _require(array.shape == shape, path, problem)
        _require(np.isfinite(array), path, f"array {name!r} is not finite")
        if name in ("error68", "rms", "ratio95", *SCALES):
            _require(array >= 0, path, f"array {name!r} must have numbers of at least 0")
    _check_flux_model(components, arrays, path)
    noise = arrays["noise_nodes"]
    is_ascending = nodes > 0 and noise[0] > 0 and (np.diff(noise) > 0).all()
    _require(is_ascending, path, "noise_nodes must be positive and ascending")


def _check_flux_model(components: int, arrays: Mapping[str, np.ndarray], path: Path) -> None:
    """Check that the mean PSF has sum 1, and that the rest are eigenvectors of a covariance.

    Sum and orthonormality hold within the rounding of float32, 10⁻³; PSFs of sum 1 have a variance
    far below 10⁶.
    """
    mean, variance, trailing, low, high, basis = (
        arrays[f"flux/{name}"] for name in ("mean", "variance", "rest", "low", "high", "basis")
    )
    basis = basis.astype(np.float64)
    deviation = np.abs(basis.T @ basis - np.eye(components))
    range_text = "numbers from 0 to 1e+06"
    for name, is_fulfilled, expected in (
        ("mean", abs(mean.sum(dtype=np.float64) - 1.0) <= 1e-3, "a sum of 1"),
        ("variance", (variance >= 0) & (variance <= 1e6), range_text),
        ("rest", (trailing >= 0) & (trailing <= 1e6), range_text),
        ("high", low <= high, "at least flux/low"),
        ("basis", components < basis.shape[0], "fewer columns than rows"),
        ("basis", deviation <= 1e-3, "orthonormal columns"),
    ):
        _require(is_fulfilled, path, f"array 'flux/{name}' must have {expected}")


def _read_flux_model(arrays: Mapping[str, np.ndarray]) -> FluxModel:
    """Return the flux model of a file, eigenvalues ascending.

    It has a full basis unless the stamps are large: the directions that are not stored come first,
    with the same variance.
    """
    basis, variance = arrays["flux/basis"].astype(np.float64), arrays["flux/variance"]
    trailing_variance = float(arrays["flux/rest"])
    pixels, components = basis.shape
    if pixels <= MAX_FULL_BASIS_PX:
        # Left singular vectors beyond the rank span the orthogonal complement.
        complement = np.linalg.svd(basis)[0][:, components:]
        basis = np.concatenate([complement, basis], axis=1)
        variance = np.concatenate([np.full(pixels - components, trailing_variance), variance])
    mean, low, high = (arrays[f"flux/{name}"].astype(float) for name in ("mean", "low", "high"))
    return FluxModel(mean, basis, variance, low, high, trailing_variance)
