"""What an image of a night costs: processor time, memory and bytes of its files.

    python night_cost.py TABLE SIDE BRIGHT FAINT   # adds a row for eight images of SIDE × SIDE px

Eight exposures of the simulated night, with so many bright and faint stars, are one job of
`psfdae paper night images`. Seconds are those of the processor, of one thread; memory is the peak
of the job, some of whose images are fitted and the others start from these.
"""

from __future__ import annotations

import itertools
import os
import subprocess
import sys
from dataclasses import replace
from datetime import date
from pathlib import Path
from tempfile import TemporaryDirectory

import pandas as pd
from astropy.io import fits

from psfdae_paper.source import git_commit
from psfdae_paper.stages.night import list_images
from psfdae_paper.stars.nights import NightRecipe, simulate_night, simulate_reference_stars

EXPOSURES, SEED = 8, 1  # the ninth of the simulated night is cloudy


def main(table: Path, side_px: int, bright: int, faint: int) -> None:
    """Add a row to a table."""
    recipe = NightRecipe()
    recipe = replace(
        recipe, field=replace(recipe.field, side_px=side_px, bright=bright, faint=faint)
    )
    stars = simulate_reference_stars(recipe, SEED)
    with TemporaryDirectory() as name:
        folder = Path(name)
        exposures = itertools.islice(simulate_night(recipe, stars, SEED), EXPOSURES)
        for number, (counts, cards, _) in enumerate(exposures):
            image = fits.PrimaryHDU(counts, fits.Header(list(cards.items())))
            image.writeto(folder / f"image_{number}.fits")
        rows = folder / "rows.csv"
        pd.DataFrame(list_images(f"{folder}/*.fits")).to_csv(rows, index=False)
        # One thread; the job's processor time and peak of memory are those of the child.
        command = [
            "psfdae",
            "paper",
            "night",
            "images",
            "--rows",
            rows,
            "--folder",
            folder / "images",
        ]
        environment = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        job = subprocess.Popen([*command, "--out", folder / "out.csv"], env=environment)
        _, status, used = os.wait4(job.pid, 0)
        assert status == 0
        night = pd.read_csv(folder / "out.csv")
        row = {"side_px": side_px, "stars": night.stars.median(), "images": len(night)}
        row |= {"bright_stars": night.bright_stars.median(), "started": night.start.count()}
        row |= {"cpu_s": (used.ru_utime + used.ru_stime) / len(night)}
        row |= {"memory_mb": used.ru_maxrss / 1024}
        for kind, suffix in (("model", "safetensors"), ("page", "html"), ("catalogue", "fits")):
            files = [*(folder / "images").glob(f"*.{suffix}")]
            row[f"{kind}_kb"] = sum(path.stat().st_size for path in files) / len(files) / 1000
    row |= {"date": str(date.today()), "commit": git_commit()}
    pd.DataFrame([row]).round(1).to_csv(table, mode="a", header=not table.exists(), index=False)


if __name__ == "__main__":
    main(Path(sys.argv[1]), *map(int, sys.argv[2:]))
