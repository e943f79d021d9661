"""Stage `verify`: files of a run that are not what was written are set aside, to be built anew."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

from psfdae.files import ProductError
from psfdae.models.weights import load_weights

ASIDE = ".damaged"
"""Suffix that a damaged file gets; it is overwritten by the next one of its name."""

SKIPPED = {"reference", "mlartifacts"}
"""Folders that no rule's output lies in."""


def run(results: Path) -> list[tuple[Path, str]]:
    """Rename every damaged file, so that the workflow builds it again.

    Looked at are data products (a checksum per chunk of HDF5), weights (SHA-256) and
    tables per star (a checksum per page of Parquet). Files are written under another
    name and renamed, hence an interrupted run leaves nothing to find here: damage
    comes from the disk, or from a program that is not ours.

    Parameters
    ----------
    results : folder of a run; a folder that is not there holds no damage

    Returns
    -------
    list of (path before renaming, what is wrong)
    """
    found = list(damaged(results))
    for path, _ in found:
        path.replace(path.with_name(path.name + ASIDE))
    return found


def missing(results: Path) -> list[Path]:
    """Files that were set aside, now or earlier, and have not been built again, sorted."""
    whole = (path.with_name(path.name.removesuffix(ASIDE)) for path in results.rglob(f"*{ASIDE}"))
    return sorted(path for path in whole if not path.exists())


def damaged(results: Path) -> Iterator[tuple[Path, str]]:
    """Damaged files below a folder, sorted by path, with the reason."""
    for path in sorted(results.rglob("*")):
        check = CHECKS.get("".join(path.suffixes[-2:]), CHECKS.get(path.suffix))
        inside = path.relative_to(results).parts
        if check is None or SKIPPED & set(inside) or path.name.startswith(".") or path.is_dir():
            continue
        try:
            check(path)
        except (ProductError, OSError, ValueError, RuntimeError, KeyError) as error:
            reason = " ".join(str(error).split()).removeprefix(f"{path}: ")
            yield path, reason.removesuffix("; delete it and run again")


def _check_product(path: Path) -> None:
    import h5py

    with h5py.File(path, "r") as file:
        for data in file.values():
            if data.chunks is None:
                data[()]
            else:
                for chunk in data.iter_chunks():
                    data[chunk]


def _check_table(path: Path) -> None:
    from pyarrow import parquet

    with parquet.ParquetFile(path, page_checksum_verification=True) as table:
        for _ in table.iter_batches():
            pass


def _check_bundle(path: Path) -> None:
    from psfdae.bundle import read_bundle

    read_bundle(path)


CHECKS: dict[str, Callable[[Path], object]] = {
    ".h5": _check_product,
    ".safetensors": load_weights,
    ".psf.safetensors": _check_bundle,
    ".parquet": _check_table,
}
"""What reads a file so thoroughly that damage shows, by one or two suffixes."""
