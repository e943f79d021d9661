"""All images of a FITS file in one call, such as the chips of a mosaic camera.

Each image is worked on by itself, in a process of its own.
"""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import replace
from pathlib import Path
from typing import Any

from psfdae.base.errors import Error, use_command_words
from psfdae.base.threads import available_cores
from psfdae.commands.cli import refusal
from psfdae.image.catalogue import require_sky
from psfdae.image.errors import ObservationError
from psfdae.image.fits_file import science_images
from psfdae.image.image_input import ImageOptions


class MosaicError(Error, RuntimeError):
    """Failure for some images of a file; the others are done."""


def options_by_image(path: Path, options: ImageOptions) -> dict[str, ImageOptions]:
    """Return the options of each image of a file by the image's name (`science_images`).

    A star list is for all images: each image takes the stars that are on it.

    Raises
    ------
    ObservationError
        If an option belongs to one image only, or the star list has no sky coordinates.
    """
    # An extension name, the origin of a list in pixels, or a map of the pixels' noise is
    # right for one image, and cannot be given for several.
    one_image_options = ("extension", "origin", "mask", "weight", "variance", "error")
    clashes = [f"--{name}" for name in one_image_options if getattr(options, name) is not None]
    if clashes:
        raise ObservationError(path, f"--all-extensions excludes {' and '.join(clashes)}")
    # Pixel positions of a list are for one image.
    if options.catalogue is not None:
        require_sky(options.catalogue, "--all-extensions")
    # An image is named by its number, since names of extensions may repeat.
    one_image = replace(options, on_image=options.catalogue is not None)
    return {name: replace(one_image, extension=n) for name, n in science_images(path).items()}


def name_image_path(path: Path | None, name: str) -> Path | None:
    """Return the output file of one image: the stem of `path` gets the name of the image."""
    return path and path.with_name(f"{path.stem}_{name}{path.suffix}")


def run_for_images(
    work: Callable[..., str], jobs: Mapping[str, Mapping[str, Any]], path: Path
) -> None:
    """Run a function for each image of a file in parallel, and print how each run ended.

    Parameters
    ----------
    work : callable
        Does the work for one image and returns a sentence about it.
    jobs : mapping
        Keyword arguments of `work` by the name of the image.
    path : Path
        The file, for messages.

    Raises
    ------
    MosaicError
        At the end, if some images failed; the others are done.
    """
    print(f"{path}: {len(jobs)} images: {', '.join(jobs)}")

    def run(job: Mapping[str, Any]) -> tuple[bool, str]:
        # "spawn": a copy of a process that has threads, as numpy's and torch's, may hang.
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as process:
            try:
                return process.submit(_run_quietly, work, job).result()
            except BrokenProcessPool:
                return False, "its process was killed, perhaps for lack of memory"

    # A thread waits for each process; one that is killed stops no other.
    failed_images = []
    with ThreadPoolExecutor(min(len(jobs), available_cores())) as threads:
        for name, (is_done, message) in zip(jobs, threads.map(run, jobs.values()), strict=True):
            failed_images += [] if is_done else [name]
            print(f"{name}: {message}", flush=True)
    if failed_images:
        raise MosaicError(
            f"{path}: {len(failed_images)} of {len(jobs)} images failed: {', '.join(failed_images)}"
        )


def _run_quietly(work: Callable[..., str], job: Mapping[str, Any]) -> tuple[bool, str]:
    """Run `work` without its output; return True and its sentence, or False and the refusal.

    Errors other than wrong input, that is, bugs, are raised again.
    """
    with Path(os.devnull).open("w") as null, redirect_stdout(null), redirect_stderr(null):
        try:
            with use_command_words():
                return True, work(**job)
        except Exception as error:
            message = refusal(error)
            if message is None:
                raise
            return False, message
