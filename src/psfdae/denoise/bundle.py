"""File of a model, a bundle: a fitted method and all that it takes to apply it.

A bundle is a safetensors file: arrays, and a JSON text that describes them. Reading it executes
nothing. Names of arrays begin with `flux/` (the model of the photometry), `errors/` (the calibrated
errors), or the name of the method. The text holds a SHA-256 of the description and the arrays, so
that a damaged file is refused. The date is not part of it: a model has the same checksum whenever
it was made.

Only the leading eigenvectors of the flux model's covariance are stored. The variance of the others
is spread evenly over the directions that they span. For stamps of up to 32 × 32 pixels, reading
completes the basis (`build_flux_model`); any basis of these directions gives the same results. For
larger stamps, whose full basis would take gigabytes, the variance stays one number.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cached_property
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from pydantic import ValidationError

from psfdae.base.errors import Error, no_such_file, require_extra
from psfdae.base.files import ProductError, atomic_path
from psfdae.base.version import __version__
from psfdae.denoise.error_model import ErrorModel
from psfdae.denoise.flux_model import FluxModel
from psfdae.image.errors import ObservationError, one_line, reading
from psfdae.image.fits_file import name_other_format, open_hdus, unpack_file
from psfdae.methods import method
from psfdae.methods.bundle_info import FORMAT_VERSION, BundleInfo
from psfdae.methods.interface import Method
from psfdae.methods.networks.weights import compute_digest
from psfdae.psf.wings import Wings

SUFFIX = ".psf.safetensors"
"""End of the name of a bundle."""


class BundleError(Error, ValueError):
    """A model bundle is missing, damaged, of another format, or no bundle at all; one line."""

    def __init__(self, problem: str) -> None:
        super().__init__(one_line(problem))


@dataclass(frozen=True, eq=False)
class Bundle:
    """Fitted method, description of its training, and its errors.

    Attributes
    ----------
    info : BundleInfo
        Description of the model and of its training.
    weights : dict of str to ndarray
        Arrays of the method, from `Method.pack`.
    flux_model : FluxModel
        Model of the noise-free training stars; `info.components` of its eigenvectors are measured.
    errors : ErrorModel
        Calibrated errors of the method.
    """

    info: BundleInfo
    weights: dict[str, np.ndarray]
    flux_model: FluxModel
    errors: ErrorModel

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle and copy what a file has."""
        return build_bundle, (self.info, bundle_arrays(self))

    @cached_property
    def sha256(self) -> str:
        """Checksum of everything but the date."""
        return _digest(self.info.model_dump(mode="json"), bundle_arrays(self))

    @property
    def wings(self) -> Wings | None:
        """Light of stars beyond the stamps, if it was measured; BundleError if damaged."""
        tree = self.info.config.get("wings")
        try:
            return None if tree is None else Wings.from_plain(tree)
        except ValueError as error:
            raise BundleError(f"{self.info.name}: damaged ({error})") from None


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
        # A network is checked by torch when its weights are loaded.
        with require_extra(f"the model {info.name!r}"):
            return method_class.from_bundle(bundle.weights, info)
    # The method knows which arrays it can work with: it gives conditions, and denoises a stamp.
    blank = np.zeros((1, info.stamp_px, info.stamp_px), np.float32)
    try:
        method_fit = method_class.from_bundle(bundle.weights, info)
        for name, expected_shapes, is_fulfilled in method_fit.conditions():
            if not np.all(is_fulfilled):
                raise ValueError(f"array {name!r} must have {expected_shapes}")
        if method_fit.estimate(blank, np.array([info.noise_max])).psf.shape != blank.shape:
            raise ValueError("its PSFs have not the size of stamps")
    except (ValueError, TypeError, LookupError, ArithmeticError) as error:
        raise BundleError(f"{info.name}: damaged ({info.method}: {error})") from None
    return method_fit


# Writing.


def creation_date() -> str:
    """Return today's date in UTC as ISO 8601; SOURCE_DATE_EPOCH (seconds) makes it reproducible.

    Raises
    ------
    BundleError
        If SOURCE_DATE_EPOCH is not a number of seconds.
    """
    # https://reproducible-builds.org/specs/source-date-epoch
    epoch = os.environ.get("SOURCE_DATE_EPOCH")
    try:
        moment = datetime.now(UTC) if epoch is None else datetime.fromtimestamp(int(epoch), UTC)
    except (ValueError, OverflowError, OSError):
        raise BundleError(f"SOURCE_DATE_EPOCH = {epoch!r}: must be seconds since 1970") from None
    return moment.date().isoformat()


def write_bundle(bundle: Bundle, path: Path) -> None:
    """Write a bundle atomically, if its parts fit together; the same one gives the same bytes.

    Parameters
    ----------
    bundle : Bundle
        Model to write.
    path : Path
        The file, by custom NAME.psf.safetensors; it is replaced if it exists.

    Raises
    ------
    BundleError
        If an array is missing or has a wrong shape or value.
    """
    # Checked as it will be when it is read: no file is written that cannot be read.
    arrays = bundle_arrays(bundle)
    _check(bundle.info, arrays, path)
    content = bundle_bytes(bundle.info, arrays)
    # The file is whole or absent.
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)


def bundle_bytes(info: BundleInfo, arrays: Mapping[str, np.ndarray]) -> bytes:
    """Return the bytes of a bundle file with its checksum, without checks of its contents.

    Parameters
    ----------
    info : BundleInfo
        Description of the model.
    arrays : mapping of str to ndarray
        As `bundle_arrays` returns them.
    """
    from safetensors.numpy import save

    tree = info.model_dump(mode="json")
    # Kind and version, by which a reader knows the file; the checksum; the description.
    text = {
        "kind": "psfdae bundle",
        "format_version": FORMAT_VERSION,
        "sha256": _digest(tree, arrays),
        "info": tree,
    }
    # A single key: safetensors writes several in an order that changes from run to run.
    return save(dict(arrays), {"bundle": json.dumps(text, sort_keys=True)})


def _digest(tree: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> str:
    """Return the SHA-256 of a description without its date, and of arrays."""
    # The same model has the same checksum whenever it was made.
    dateless = {key: value for key, value in tree.items() if key != "created"}
    # Keys in one order: the same description has the same text.
    text = json.dumps(dateless, sort_keys=True) + compute_digest(arrays)
    return hashlib.sha256(text.encode()).hexdigest()


def bundle_arrays(bundle: Bundle) -> dict[str, np.ndarray]:
    """Return the arrays of the file, the covariance cut to its leading eigenvectors.

    Returns
    -------
    dict of str to ndarray
        By group and name: `flux/…` (`flux_arrays`), `errors/…`, and the arrays of the method.
    """
    groups = {
        "flux": flux_arrays(bundle.flux_model, bundle.info.components),
        "errors": bundle.errors.arrays(),
        bundle.info.method: bundle.weights,
    }
    return {
        f"{group}/{name}": np.asarray(array, order="C")
        for group, arrays in groups.items()
        for name, array in arrays.items()
    }


# Reading.


def locate_shipped_model() -> Path:
    """Return the file of the bundle that comes with the package."""
    return Path(str(files("psfdae.denoise") / "bundles" / f"wfsat{SUFFIX}"))


def name_foreign_format(path: Path) -> str:
    """Return the name of the format of a file that is not a bundle, such as "PSFEx"; else "".

    Raises
    ------
    Error
        If the file is missing or cannot be read.
    """
    file, start = unpack_file(path)
    if not start.startswith(b"SIMPLE  ="):
        return name_other_format(start).removeprefix(", but ")
    # By the names of extensions and keys.
    with reading(path), open_hdus(file) as hdus:
        names = {*(hdu.name for hdu in hdus), *hdus[0].header}
    kinds = {"PSF_DATA": "PSFEx", "NXPSFS": "STDPSF", "DET_YX0": "STPSF", "PSF_WCS": "Piff"}
    return next((kind for name, kind in kinds.items() if name in names), "FITS")


def read_bundle(path: Path | None = None) -> Bundle:
    """Read a bundle, by default the shipped one, and check it, or raise BundleError.

    Parameters
    ----------
    path : Path, optional
        A safetensors file of at most 256 MB.

    Raises
    ------
    BundleError
        If the file is missing, damaged, of another format, or holds unusable numbers. Nothing in it
        is executed, and its arrays are used only if their checksum is right.
    """
    from safetensors import SafetensorError, safe_open

    path = locate_shipped_model() if path is None else path
    try:
        # A bundle of stamps of 256 × 256 pixels has some 20 MB.
        size, max_size = path.stat().st_size, 2**28
        # A model of another program is named.
        kind = name_foreign_format(path)
        readers = "; psf and photometry read it" if kind in ("PSFEx", "STDPSF", "STPSF") else ""
        _require(not kind, path, f"of the format {kind}, expected a model of psfdae{readers}")
        _require(size <= max_size, path, f"{size} bytes, at most {max_size}")
        with safe_open(path, framework="numpy") as file:
            text = json.loads((file.metadata() or {}).get("bundle", "null"))
            # Kind and version come first: another format may differ in all else.
            is_bundle = isinstance(text, dict) and text.get("kind") == "psfdae bundle"
            _require(is_bundle, path, "a safetensors file, but not a psfdae model bundle")
            version = text.get("format_version")
            problem = f"format {version}, but psfdae {__version__} reads format {FORMAT_VERSION}"
            remedy = "train the model again, or take the psfdae that wrote it"
            _require(version == FORMAT_VERSION, path, f"{problem}; {remedy}")
            arrays = {name: file.get_tensor(name) for name in list(file.keys())}
        # The checksum of description and arrays: nothing else is read from a damaged file.
        is_intact = text["sha256"] == _digest(text["info"], arrays)
        _require(is_intact, path, "damaged (the checksum differs)")
        info = BundleInfo.model_validate(text["info"])
    except FileNotFoundError:
        raise BundleError(no_such_file(path)) from None
    except ValidationError as error:
        first = error.errors(include_input=False)[0]
        key = ".".join(str(part) for part in first["loc"])
        raise BundleError(f"{path}: damaged ({key[:80]}: {first['msg']})") from None
    except (BundleError, ObservationError):
        raise
    except OSError as error:
        raise BundleError(f"{path}: cannot be read ({error.strerror or error})") from None
    except (SafetensorError, ValueError, LookupError, TypeError, AttributeError) as error:
        raise BundleError(f"{path}: damaged, or not a model bundle ({error})") from None
    except RecursionError:
        raise BundleError(f"{path}: damaged (its description is nested too deeply)") from None
    _check(info, arrays, path)
    return build_bundle(info, arrays)


def build_bundle(info: BundleInfo, arrays: Mapping[str, np.ndarray]) -> Bundle:
    """Return a bundle from its description and the arrays of its file (`bundle_arrays`)."""
    # Groups of arrays, without their prefix, make the parts of the bundle.
    flux, errors, weights = (
        {k.removeprefix(f"{group}/"): v for k, v in arrays.items() if k.startswith(f"{group}/")}
        for group in ("flux", "errors", info.method)
    )
    return Bundle(info, weights, build_flux_model(flux), ErrorModel.from_arrays(errors))


def _require(condition: ArrayLike, path: Path, problem: str) -> None:
    """Raise BundleError with a problem of a file if not all of a condition is true."""
    if not np.all(condition):
        raise BundleError(f"{path}: {problem}")


def _check(info: BundleInfo, arrays: Mapping[str, np.ndarray], path: Path) -> None:
    """Check that arrays have the shapes that the description asks for, and usable numbers.

    Parameters
    ----------
    info : BundleInfo
        Description of the model; it gives method, stamp size and number of components.
    arrays : mapping of str to ndarray
        By group and name, as in the file.
    path : Path
        The file, for messages.

    Raises
    ------
    BundleError
        If an array is missing, unknown, or has a wrong type, shape or number.
    """
    # Arrays of every bundle; limits of an outlier score only of some.
    pixels, components = info.stamp_px**2, info.components
    expected_shapes: dict[str, tuple[int, ...] | None] = {
        **dict.fromkeys(("flux/mean", "flux/low", "flux/high"), (pixels,)),
        "flux/variance": (components,),
        "flux/rest": (),
        "flux/basis": (pixels, components),
    }
    nodes = arrays["errors/noise"].size if "errors/noise" in arrays else 0
    shapes = ErrorModel.shapes(nodes, info.stamp_px)
    expected_shapes |= {f"errors/{name}": shape for name, shape in shapes.items()}
    if "errors/outlier_limit" not in arrays:
        del expected_shapes["errors/outlier_limit"]
    # Arrays of the method; a shape that the method leaves open is taken as it is.
    try:
        method_shapes = method(info.method).shapes(info)
    except ProductError as error:
        raise BundleError(f"{path}: {error}; a newer psfdae would do") from None
    expected_shapes |= {f"{info.method}/{name}": shape for name, shape in method_shapes.items()}
    # No array is missing or unknown; then each has the right shape, and finite numbers.
    unmatched_names = arrays.keys() ^ expected_shapes.keys()
    name = min(unmatched_names, default="")
    state = "missing" if name in expected_shapes else "unknown"
    _require(not unmatched_names, path, f"array {name!r} is {state}")
    for name, shape in expected_shapes.items():
        array = arrays[name]
        is_number = array.dtype in (np.float16, np.float32, np.float64, np.int64)
        _require(is_number, path, f"array {name!r} of {array.dtype}")
        problem = f"array {name!r} has shape {array.shape}, not {shape}"
        _require(shape is None or array.shape == shape, path, problem)
        _require(np.isfinite(array), path, f"array {name!r} is not finite")
        if name.startswith(("errors/half_width", "errors/ratio", "errors/scale", "errors/flux")):
            _require(array >= 0, path, f"array {name!r} must have numbers of at least 0")
    noise = arrays["errors/noise"]
    is_ascending = nodes > 0 and noise[0] > 0 and (np.diff(noise) > 0).all()
    _require(is_ascending, path, "array 'errors/noise' must be positive and ascending")
    # Within the rounding of float32.
    total = arrays["flux/mean"].sum(dtype=np.float64)
    _require(abs(total - 1.0) <= 1e-3, path, "array 'flux/mean' must have a sum of 1")


def flux_arrays(model: FluxModel, components: int) -> dict[str, np.ndarray]:
    """Return the arrays of a flux model with so many leading eigenvectors, for `build_flux_model`.

    Parameters
    ----------
    model : FluxModel
        With a full basis, or of a file of large stamps.
    components : int
        Number k of leading eigenvectors.

    Returns
    -------
    dict of str to ndarray
        Variances (k,) and `rest`, that along each other direction, in double precision; maps of
        the P pixels, `mean`, `low`, `high` (P,) and `basis` (P, k), in single precision.
    """
    # Eigenvalues ascend: the leading ones are the last.
    return {
        "variance": np.asarray(model.variance[-components:], np.float64),
        "rest": np.asarray(model.average_variance_beyond(components), np.float64),
        "mean": np.asarray(model.mean, np.float32),
        "low": np.asarray(model.low, np.float32),
        "high": np.asarray(model.high, np.float32),
        "basis": np.asarray(model.basis[:, -components:], np.float32),
    }


def build_flux_model(arrays: Mapping[str, np.ndarray], full_basis_max_px: int = 32**2) -> FluxModel:
    """Return the flux model of the arrays of a file, eigenvalues ascending.

    Parameters
    ----------
    arrays : mapping of str to ndarray
        As `flux_arrays` returns them.
    full_basis_max_px : int
        Pixels of the largest stamps that get a full basis: the directions that are not stored come
        first, with the same variance.
    """
    # Leading eigenvectors, with their variances; the others share one variance.
    basis, variance = arrays["basis"].astype(np.float64), arrays["variance"]
    trailing_variance = float(arrays["rest"])
    pixels, components = basis.shape
    if pixels <= full_basis_max_px:
        # Left singular vectors beyond the rank span the orthogonal complement.
        complement = np.linalg.svd(basis)[0][:, components:]
        basis = np.concatenate([complement, basis], axis=1)
        variance = np.concatenate([np.full(pixels - components, trailing_variance), variance])
    mean, low, high = (arrays[name].astype(float) for name in ("mean", "low", "high"))
    return FluxModel(mean, basis, variance, low, high, trailing_variance)
