"""Images of a night, in parts of a few images for each job."""

from __future__ import annotations

import hashlib
import os
from functools import cache
from pathlib import Path

from psfdae.base.files import as_csv, write_text
from psfdae.base.settings import ConfigError
from psfdae_paper.workflow.run import Run, exit_in_one_line

IMAGES_PER_JOB = 10
"""Images of a job: its first fit and its imports serve all of them."""


@cache
@exit_in_one_line()
def split_night(run: Run) -> list[list[dict[str, str]]]:
    """Return the rows of the list of images, in one list for each job."""
    if not run.images:
        raise ConfigError("night: --config images='night/*.fits', or a CSV list of images")
    # Only a night needs these modules, and every job reads this file.
    from psfdae.telescope.settings import read_telescope
    from psfdae_paper.stages.night import list_images

    rows = list_images(run.images)
    if run.telescope:
        # A wrong key stops before any job.
        read_telescope(Path(run.telescope))
        rows = [{"telescope_file": run.telescope, **row} for row in rows]
    starts = range(0, len(rows), IMAGES_PER_JOB)
    return [rows[start : start + IMAGES_PER_JOB] for start in starts]


@cache
def rows_file(run: Run, part: str) -> str:
    """Return the file with the rows of a job, and write it unless the run is dry.

    Its name is a hash of the rows: another name repeats the job.
    """
    text = as_csv(split_night(run)[int(part)])
    name = hashlib.sha256(text.encode()).hexdigest()[:16]
    path = Path(run.results, "night", ".rows", f"{name}.csv")
    if not (run.is_dry() or path.is_file()):
        write_text(path, text)
    return str(path)


def image_files(run: Run, part: str) -> list[str]:
    """Return the files of the images of a job; a missing file is a row with a reason."""
    columns = ("image", "catalogue", "mask", "reference", "telescope_file")
    files = [row.get(c) for row in split_night(run)[int(part)] for c in columns]
    return [file for file in dict.fromkeys(files) if file and os.path.isfile(file)]  # noqa: PTH113


def part_tables(run: Run) -> list[str]:
    """Return the tables of all parts."""
    folder = f"{run.results}/night/rows"
    return [f"{folder}/{part}.csv" for part in range(len(split_night(run)))]
