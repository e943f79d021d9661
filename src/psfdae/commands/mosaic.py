"""All images of a FITS file in one call: each by itself, side by side in processes."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from psfdae.cli import REFUSABLE, refusal
from psfdae.errors import Error
from psfdae.image.errors import ObservationError
from psfdae.image.fits_file import science_images
from psfdae.image.observation import require_sky
from psfdae.threads import available_cores

if TYPE_CHECKING:
    from psfdae.commands.predict import Stated

ALONE = ("extension", "origin", "mask", "weight", "variance", "error")
"""Options that belong to one image, and cannot be given for several."""


class MosaicError(Error, RuntimeError):
    """Some images of a file could not be used."""


def images_of(path: Path, stated: Stated) -> dict[str, Stated]:
    """Return the stated options of each image of a file by its name (`science_images`).

    Stars of the list that is stated belong to the image on which they are.
    """
    given = [f"--{name}" for name in ALONE if getattr(stated, name) is not None]
    if given:
        raise ObservationError(path, f"--all-extensions excludes {' and '.join(given)}")
    if stated.catalogue is not None:
        require_sky(stated.catalogue, "--all-extensions")
    of_each = replace(stated, all_extensions=False, on_image=stated.catalogue is not None)
    return {name: replace(of_each, extension=n) for name, n in science_images(path).items()}


def with_name(path: Path | None, name: str) -> Path | None:
    """The file of one image, beside that of the others."""
    return path and path.with_name(f"{path.stem}_{name}{path.suffix}")


def each(work: Callable[..., str], jobs: Mapping[str, Mapping[str, Any]], path: Path) -> None:
    """Do the work for the images of a file by name; a line for each says how it ended.

    Raises
    ------
    MosaicError
        At the end, if some failed; the others are done.
    """
    failed = []
    print(f"{path}: {len(jobs)} images: {', '.join(jobs)}")
    processes = min(len(jobs), available_cores())
    with _pool(processes) as pool:
        futures = {name: pool.submit(_quietly, work, job) for name, job in jobs.items()}
        for name, future in futures.items():
            try:
                good, said = future.result()
            except BrokenProcessPool:  # with it all that were not done
                good, said = _alone(work, jobs[name])
            failed += [] if good else [name]
            print(f"{name}: {said}", flush=True)
    if failed:
        raise MosaicError(
            f"{path}: {len(failed)} of {len(jobs)} images failed: {', '.join(failed)}"
        )


def _pool(processes: int) -> ProcessPoolExecutor:
    return ProcessPoolExecutor(processes, multiprocessing.get_context("spawn"))


def _alone(work: Callable[..., str], job: Mapping[str, Any]) -> tuple[bool, str]:
    """`_quietly` in a process of its own, with all memory for it."""
    with _pool(1) as pool:
        try:
            return pool.submit(_quietly, work, job).result()
        except BrokenProcessPool:
            return False, "its process was killed, perhaps for lack of memory"


def _quietly(work: Callable[..., str], job: Mapping[str, Any]) -> tuple[bool, str]:
    """Whether it was done, and what is said of it."""
    with Path(os.devnull).open("w") as nowhere, redirect_stdout(nowhere), redirect_stderr(nowhere):
        try:
            return True, work(**job)
        except REFUSABLE as error:
            said = refusal(error)
            if said is None:
                raise
            return False, said
