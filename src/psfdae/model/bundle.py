"""The file of a model: a fitted method and all that it takes to apply it.

A bundle is a safetensors file: arrays, and a JSON text that describes them. Reading
it executes nothing. The text holds a SHA-256 of the description and the arrays, so a
damaged file is refused; the date alone is outside, for the same model has the same
checksum whenever it was made. A checksum says nothing of who wrote it: sizes and
numbers that no training leaves are refused as well, before memory is spent on them.

Only the leading eigenvectors of the flux model's covariance are stored. The variance
of the others is spread evenly over the directions that they span. For stamps of up to
`COMPLETED_PX` pixels reading completes the basis, and which basis it takes does not
matter; for larger ones, whose whole basis would take gigabytes, they stay one number.
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
from pydantic import ValidationError

from psfdae.bundle_info import FORMAT_VERSION, BundleInfo
from psfdae.errors import Error, needed_by
from psfdae.files import ProductError, atomic_path
from psfdae.image.errors import one_line
from psfdae.method import HasConditions, Method
from psfdae.methods import method
from psfdae.model.photometry import FluxModel
from psfdae.model.wings import Wings
from psfdae.networks.weights import digest_of
from psfdae.version import __version__

SUFFIX = ".psf.safetensors"
SHIPPED = "wfsat"  # name of the bundle that comes with the package
KIND = "psfdae bundle"

COMPLETED_PX = 32**2  # pixels of the largest stamps whose covariance gets a whole basis
LARGEST = 2**28  # bytes; a bundle of stamps of 256 × 256 pixels has some 20 MB
BRIGHT = 20 / 256  # part of the pixels that counts as bright
TOLERANCE = 1e-3  # by which the mean PSF may miss the sum 1, and eigenvectors orthonormality
VARIANCE = 1e6  # largest variance of images of sum 1 that is no nonsense
# Arrays of S nodes that a bundle may lack, and the shape of their rows.
SCALES = {"scale68": (2, 3, 2), "scale95": (2, 3, 2), "flux_error_scale": ()}
OPTIONAL = {"strange_limit": (), **SCALES}
NEVER_NEGATIVE = {"error68", "rms", "ratio95", *SCALES}
# Arrays of float64; the others are float32.
DOUBLE = {"flux/variance", "flux/rest", "noise_nodes", "distance_limit", "ratio95", *OPTIONAL}


class BundleError(Error, ValueError):
    """A model bundle is missing, damaged, of a newer format, or no bundle at all; one line."""

    def __init__(self, problem: str) -> None:
        super().__init__(one_line(problem))


class ModelErrors(NamedTuple):
    """Standard errors of measured stars that the model of the PSF makes, whatever their S/N.

    Attributes
    ----------
    flux : float
        Over the flux.
    sky : float
        In a pixel, over the flux.
    centre : float
        In pixels, along each axis.
    fitted_flux : float
        Over the flux, where the PSF is fitted on a sky that is known from the whole image.
    """

    flux: float = 0.0
    sky: float = 0.0
    centre: float = 0.0
    fitted_flux: float = 0.0


@dataclass(frozen=True, eq=False)
class Bundle:
    """A fitted method, what it was fitted to, and how well it does."""

    info: BundleInfo
    weights: dict[str, np.ndarray]  # what `Method.pack` gives
    flux_model: FluxModel  # of the noise-free training stars; `info.components` are measured
    noise_nodes: np.ndarray  # (S,), noise at which the errors were measured, ascending
    # Of errors in units of the flux, or of σ if the method says it (`Estimate.sigma`):
    error68: np.ndarray  # (S, d, d), half-width of 68.27 %
    rms: np.ndarray  # (S, d, d), root mean square
    ratio95: np.ndarray  # (S,), error68 times this holds 95 %
    distance_limit: float  # 99.9 % quantile of the distance of test stars (`mahalanobis`)
    # (S,), 99.9 % quantile of the outlier score, if the method has one
    strange_limit: np.ndarray | None = None
    # (S, 2, 3, 2), by how much 68 % and 95 % of the errors are wider than that: where the noise is
    # known or estimated; where flux and sky are known, the sky is, or neither; and in faint or in
    # bright pixels (`brightest`)
    scale68: np.ndarray | None = None
    scale95: np.ndarray | None = None
    flux_error_scale: np.ndarray | None = None  # (S,), scatter of the flux over its error

    @property
    def sha256(self) -> str:
        """Checksum of everything but the date."""
        return _digest(self.info.described(), _tensors(self))

    @property
    def wings(self) -> Wings | None:
        """Light of stars beyond the stamps, if the bundle says any; BundleError if damaged."""
        said = self.info.config.get("wings")
        try:
            return None if said is None else Wings.of_plain(said)
        except ValueError as error:
            raise BundleError(f"{self.info.name}: damaged ({error})") from None

    @property
    def model_errors(self) -> ModelErrors:
        """Errors of measured stars by the model's own; BundleError if damaged."""
        said = self.info.config.get("model_errors", {})
        try:
            errors = ModelErrors(**{name: float(value) for name, value in said.items()})
            if not all(0.0 <= error < 1e3 for error in errors):
                raise ValueError("numbers that are no errors")
        except (TypeError, ValueError, AttributeError) as error:
            raise BundleError(f"{self.info.name}: damaged (model_errors: {error})") from None
        return errors

    def scales(self, noise: np.ndarray) -> list[np.ndarray] | None:
        """`scale68`, `scale95` and `flux_error_scale` at the noise of stars (n,).

        They are interpolated linearly: (n, 2, 3, 2) twice, and (n,); None if there are none.
        """

        def at(table: np.ndarray) -> np.ndarray:
            columns = table.reshape(len(table), -1).T
            found = [np.interp(noise, self.noise_nodes, column) for column in columns]
            return np.stack(found, axis=1).reshape(-1, *table.shape[1:])

        return None if self.scale68 is None else [at(getattr(self, name)) for name in SCALES]


def estimator(bundle: Bundle) -> Method:
    """The method of a bundle, ready to predict.

    Raises
    ------
    BundleError
        If its arrays do not fit together.
    MissingExtraError
        If it is a network and torch is not installed.
    """
    info = bundle.info
    found = method(info.method)
    if info.dae:
        with needed_by(f"the model {info.name!r}"):
            return found.unpack(bundle.weights, info)
    # Their shapes are the method's own affair: it must be able to work with them.
    blank = np.zeros((1, info.stamp_px, info.stamp_px), np.float32)
    try:
        fitted = found.unpack(bundle.weights, info)
        conditions = fitted.conditions() if isinstance(fitted, HasConditions) else ()
        for name, wanted, right in conditions:
            if not np.all(right):
                raise ValueError(f"array {name!r} must have {wanted}")
        if fitted.estimate(blank, np.array([info.noise_max])).psf.shape != blank.shape:
            raise ValueError("its PSFs have not the size of stamps")
    except (ValueError, TypeError, LookupError, ArithmeticError) as error:
        raise BundleError(f"{info.name}: damaged ({info.method}: {error})") from None
    return fitted


def at_noise(noise: np.ndarray, nodes: np.ndarray, maps: np.ndarray) -> np.ndarray:
    """Maps of errors at the noise of each star, interpolated linearly in the noise.

    Linear in the noise and not in its logarithm: an error is a floor plus something
    that grows about as fast as the noise. Outside the nodes the nearest one counts.

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
        In the unit of the maps; NaN where the noise is NaN.
    """
    noise = np.asarray(noise, dtype=np.float64)
    place = np.interp(noise, nodes, np.arange(len(nodes), dtype=np.float64))
    lower = np.where(np.isfinite(place), np.minimum(place, len(nodes) - 1), 0).astype(np.intp)
    upper = np.minimum(lower + 1, len(nodes) - 1)
    share = (place - lower).astype(maps.dtype)[:, None, None]
    return np.asarray(maps[lower] * (1 - share) + maps[upper] * share)


def brightest(psf: np.ndarray) -> np.ndarray:
    """The brightest pixels of stars (n, d, d), `BRIGHT` of them each, as a mask."""
    flat = psf.reshape(len(psf), -1)
    dimmer = flat.shape[1] - max(1, round(BRIGHT * flat.shape[1]))
    return psf >= np.partition(flat, dimmer, axis=1)[:, dimmer, None, None]


def mahalanobis(
    stamps: np.ndarray, noise: np.ndarray, model: FluxModel, components: int
) -> np.ndarray:
    """Distance of stars from the training set, in the space of its leading eigenvectors.

    D² = Σ_k (e_kᵀ(x − m))² / (Λ_k + noise²) over the eigenvectors e_k with the largest
    eigenvalues Λ_k: the distance of Mahalanobis (1936) with the noise of the star as
    part of the covariance. Faint stars are unlike the mean by their noise, which says
    nothing; D² of either kind of star is about `components`.

    Parameters
    ----------
    stamps : ndarray, shape (n, d, d)
        Sky-subtracted, repaired, of flux 1, framed as the training stars.
    noise : ndarray, shape (n,)
        RMS of the sky noise in a pixel over the flux.
    model : FluxModel
    components : int
        Eigenvectors that count, `BundleInfo.components`.

    Returns
    -------
    ndarray, shape (n,), float64
    """
    centred = stamps.reshape(len(stamps), -1) - model.mean
    scores = centred @ model.basis[:, -components:]
    variance = model.variance[-components:] + np.asarray(noise, dtype=np.float64)[:, None] ** 2
    return np.asarray(np.sqrt((scores**2 / variance).sum(axis=1)))


# Writing.


def creation_date() -> str:
    """Today in UTC as ISO 8601; SOURCE_DATE_EPOCH (seconds) makes it reproducible."""
    epoch = os.environ.get("SOURCE_DATE_EPOCH")
    try:
        moment = datetime.now(UTC) if epoch is None else datetime.fromtimestamp(int(epoch), UTC)
    except (ValueError, OverflowError, OSError):
        raise BundleError(f"SOURCE_DATE_EPOCH = {epoch!r}: must be seconds since 1970") from None
    return moment.date().isoformat()


def write_bundle(bundle: Bundle, path: Path) -> None:
    """Write a bundle atomically, if its parts fit together; the same one gives the same bytes."""
    tensors = _tensors(bundle)
    _check(bundle.info, tensors, path)
    content = packed(bundle.info.described(), tensors)
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)


def packed(described: Mapping[str, Any], tensors: Mapping[str, np.ndarray]) -> bytes:
    """Bytes of a bundle file, signed but not checked."""
    from safetensors.numpy import save

    text = {
        "kind": KIND,
        "format_version": described["format_version"],
        "sha256": _digest(described, tensors),
        "info": described,
    }
    # A single key: safetensors writes several in an order that changes from run to run.
    return save(dict(tensors), {"bundle": json.dumps(text, sort_keys=True)})


def _digest(described: Mapping[str, Any], tensors: Mapping[str, np.ndarray]) -> str:
    """SHA-256 of a description without its date, and of arrays."""
    kept = {key: value for key, value in described.items() if key != "created"}
    text = json.dumps(kept, sort_keys=True) + digest_of(tensors)
    return hashlib.sha256(text.encode()).hexdigest()


def _tensors(bundle: Bundle) -> dict[str, np.ndarray]:
    """Arrays of the file, the covariance cut to its leading eigenvectors."""
    model, kept = bundle.flux_model, bundle.info.components
    rest = model.variance[: model.variance.size - kept] if model.whole else np.array([model.rest])
    # A model that was read has equal ones; their mean could differ in the last digit.
    even = rest[0] if rest.size and (rest == rest[0]).all() else rest.sum() / max(rest.size, 1)
    arrays = {
        "flux/variance": model.variance[-kept:],
        "flux/rest": np.array(even),
        "noise_nodes": bundle.noise_nodes,
        "distance_limit": np.array(bundle.distance_limit),
        "flux/mean": model.mean,
        "flux/low": model.low,
        "flux/high": model.high,
        "flux/basis": model.basis[:, -kept:],
        "error68": bundle.error68,
        "rms": bundle.rms,
        "ratio95": bundle.ratio95,
    }
    optional = {name: getattr(bundle, name) for name in OPTIONAL}
    arrays |= {name: values for name, values in optional.items() if values is not None}
    ours = {name: np.asarray(value, _dtype(name), order="C") for name, value in arrays.items()}
    # The method's own are as they are.
    own = {name: np.asarray(value, order="C") for name, value in bundle.weights.items()}
    return ours | {f"{bundle.info.method}/{name}": value for name, value in own.items()}


def _dtype(name: str) -> np.dtype:
    return np.dtype(np.float64 if name in DOUBLE else np.float32)


# Reading.


def shipped_path() -> Path:
    """File of the bundle that comes with the package."""
    return Path(str(files("psfdae") / "bundles" / f"{SHIPPED}{SUFFIX}"))


def read_bundle(path: Path | None = None) -> Bundle:
    """Read a bundle, by default the shipped one, and check it, or raise BundleError."""
    path = shipped_path() if path is None else path
    try:
        text, tensors = _load(path)
        info = _described(text, tensors, path)
    except RecursionError:
        raise BundleError(f"{path}: damaged (its description is nested too deeply)") from None
    _check(info, tensors, path)
    optional: dict[str, Any] = {name: tensors.get(name) for name in OPTIONAL}
    return Bundle(
        info=info,
        weights={
            name.partition("/")[2]: value
            for name, value in tensors.items()
            if name.startswith(f"{info.method}/")
        },
        flux_model=_completed(tensors),
        **{name: tensors[name] for name in ("noise_nodes", "error68", "rms", "ratio95")},
        distance_limit=float(tensors["distance_limit"]),
        **optional,
    )


def _load(path: Path) -> tuple[Any, dict[str, np.ndarray]]:
    """Text and arrays of a safetensors file."""
    from safetensors import SafetensorError, safe_open

    try:
        if path.stat().st_size > LARGEST:
            raise BundleError(f"{path}: {path.stat().st_size} bytes, at most {LARGEST}")
        with safe_open(path, framework="numpy") as file:
            text = (file.metadata() or {}).get("bundle")
            if text is None:
                raise BundleError(f"{path}: a safetensors file, but not a psfdae model bundle")
            parsed = json.loads(text)
            _check_format(parsed, path)
            names = list(file.keys())
            return parsed, {name: file.get_tensor(name) for name in names}
    except FileNotFoundError:
        raise BundleError(f"{path}: no such file") from None
    except BundleError:
        raise
    except OSError as error:
        raise BundleError(f"{path}: cannot be read ({error.strerror or error})") from None
    except (SafetensorError, ValueError, LookupError, TypeError, AttributeError) as error:
        raise BundleError(f"{path}: damaged, or not a model bundle ({error})") from None


def _check_format(text: Any, path: Path) -> None:
    """Before anything else is looked at: another format may differ in all of it."""
    if not isinstance(text, dict) or text.get("kind") != KIND:
        raise BundleError(f"{path}: a safetensors file, but not a psfdae model bundle")
    version = text.get("format_version")
    if not isinstance(version, int) or version < 1:
        raise BundleError(f"{path}: damaged (format version {version!r})")
    if version > FORMAT_VERSION:
        raise BundleError(
            f"{path}: format {version}, but psfdae {__version__} reads up to "
            f"format {FORMAT_VERSION}; a newer psfdae would do"
        )
    if version < FORMAT_VERSION:
        raise BundleError(
            f"{path}: format {version}, but psfdae {__version__} reads format {FORMAT_VERSION}; "
            "train the model again"
        )


def _described(text: Mapping[str, Any], tensors: dict[str, np.ndarray], path: Path) -> BundleInfo:
    described = text.get("info")
    if not isinstance(described, dict) or text.get("sha256") != _digest(described, tensors):
        raise BundleError(f"{path}: damaged (the checksum differs)")
    try:
        info = BundleInfo.model_validate(described)
    except ValidationError as error:
        first = error.errors(include_input=False)[0]
        where = ".".join(str(part) for part in first["loc"])
        raise BundleError(f"{path}: damaged ({where[:80]}: {first['msg']})") from None
    try:
        info.model_dump(mode="json")
    except ValueError:
        raise BundleError(f"{path}: damaged (its description is nested too deeply)") from None
    return info


def _check(info: BundleInfo, tensors: Mapping[str, np.ndarray], path: Path) -> None:
    """Whether arrays have the shapes that the description asks for, and are finite."""
    pixels, nodes = info.stamp_px**2, tensors["noise_nodes"].size if "noise_nodes" in tensors else 0
    expected: dict[str, tuple[int, ...]] = {
        **dict.fromkeys(("flux/mean", "flux/low", "flux/high"), (pixels,)),
        "flux/variance": (info.components,),
        "flux/rest": (),
        "flux/basis": (pixels, info.components),
        "noise_nodes": (nodes,),
        **dict.fromkeys(("error68", "rms"), (nodes, info.stamp_px, info.stamp_px)),
        "ratio95": (nodes,),
        "distance_limit": (),
    }
    known = {"strange_limit", *SCALES} & set(tensors)
    known |= set(SCALES if set(SCALES) & known else ())  # all of them or none
    expected |= {name: (nodes, *OPTIONAL[name]) for name in known}
    expected |= _of_method(info, tensors, path)
    if set(tensors) != set(expected):
        name = min(set(tensors) ^ set(expected))
        state = "missing" if name in expected else "unknown"
        raise BundleError(f"{path}: array {name!r} is {state}")
    for name, shape in expected.items():
        array, dtype = tensors[name], _dtype(name)
        free = not info.dae and name.startswith(f"{info.method}/")
        if array.dtype != dtype and not (
            free and array.dtype in (np.float16, np.float64, np.int64)
        ):
            raise BundleError(f"{path}: array {name!r} of {array.dtype}, not {dtype}")
        if array.shape != shape:
            raise BundleError(f"{path}: array {name!r} has shape {array.shape}, not {shape}")
        if not np.isfinite(array).all():
            raise BundleError(f"{path}: array {name!r} is not finite")
        if name in NEVER_NEGATIVE and (array < 0).any():
            raise BundleError(f"{path}: array {name!r} must have numbers of at least 0")
    _check_flux_model(info, tensors, path)
    if nodes < 1 or tensors["noise_nodes"][0] <= 0 or (np.diff(tensors["noise_nodes"]) <= 0).any():
        raise BundleError(f"{path}: noise_nodes must be positive and ascending")


def _of_method(
    info: BundleInfo, tensors: Mapping[str, np.ndarray], path: Path
) -> dict[str, tuple[int, ...]]:
    """Shapes of the method's arrays; those that are free are as they are."""
    try:
        shapes = method(info.method).shapes(info)
    except ProductError as error:
        raise BundleError(f"{path}: {error}; a newer psfdae would do") from None
    named = {f"{info.method}/{name}": shape for name, shape in shapes.items()}
    return {
        name: tensors[name].shape if shape is None and name in tensors else shape or ()
        for name, shape in named.items()
    }


def _check_flux_model(info: BundleInfo, tensors: Mapping[str, np.ndarray], path: Path) -> None:
    """Whether the flux model is one: a mean of sum 1 and the eigenvectors of a covariance."""
    mean, variance, rest, low, high, basis = (
        tensors[f"flux/{name}"] for name in ("mean", "variance", "rest", "low", "high", "basis")
    )
    basis = basis.astype(np.float64)
    product, variances = basis.T @ basis, f"numbers from 0 to {VARIANCE:g}"
    for name, right, wanted in (
        ("mean", abs(mean.sum(dtype=np.float64) - 1.0) <= TOLERANCE, "a sum of 1"),
        ("variance", (variance >= 0) & (variance <= VARIANCE), variances),
        ("rest", (rest >= 0) & (rest <= VARIANCE), variances),
        ("high", low <= high, "at least flux/low"),
        ("basis", info.components < basis.shape[0], "fewer columns than rows"),
        ("basis", np.abs(product - np.eye(len(product))) <= TOLERANCE, "orthonormal columns"),
    ):
        if not np.all(right):
            raise BundleError(f"{path}: array 'flux/{name}' must have {wanted}")


def _completed(tensors: Mapping[str, np.ndarray]) -> FluxModel:
    """Flux model, eigenvalues ascending, with a whole basis unless it would be large."""
    basis, variance = tensors["flux/basis"].astype(np.float64), tensors["flux/variance"]
    rest = float(tensors["flux/rest"])
    pixels, kept = basis.shape
    if pixels <= COMPLETED_PX:
        others = np.linalg.svd(basis)[0][:, kept:]
        basis = np.concatenate([others, basis], axis=1)
        variance = np.concatenate([np.full(pixels - kept, rest), variance])
    mean, low, high = (tensors[f"flux/{name}"].astype(float) for name in ("mean", "low", "high"))
    return FluxModel(mean, basis, variance, low, high, rest)
