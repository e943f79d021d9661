"""What the quality page of a model of one's own tells, gathered from its files."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from psfdae.estimators import Method
from psfdae.evaluation.figures import spread_stars
from psfdae.own_stars.model import load_model
from psfdae.own_stars.observation import Source
from psfdae.own_stars.photometry import signal_to_noise
from psfdae.own_stars.plot import map_of_file
from psfdae.own_stars.report import SHOWN_STARS, Quality, quality_page
from psfdae.stages.predict import MARGIN_PX, write_prediction

if TYPE_CHECKING:
    import pandas as pd


def told(
    exposure: Source,
    files: Any,
    bundle: Path,
    kind: type[Method],
    found: tuple[pd.DataFrame, dict[float, dict[str, np.ndarray]], pd.DataFrame],
    notes: Sequence[str],
) -> str:
    """The page of a model, a bundle, that a method made of an exposure with other `files`.

    `found` are `report.csv`, held-out stars restored by noise level λ, and `selection.csv`.
    """
    from astropy.io import fits

    errors, restored, selection = found
    if exposure.detect is not None:
        exposure = replace(exposure, detect=None, catalogue=files.list)
    model = load_model(bundle)
    info = model.info
    exposure = replace(exposure, accept_offset=True)  # as far as the training did
    observation = exposure.open(info.stamp_px, MARGIN_PX).assuming()
    held = np.flatnonzero(selection.part == "held out")
    place = selection[["x", "y"]].to_numpy()[held]
    shown = held[spread_stars(place, SHOWN_STARS)] if np.isfinite(place).all() else held
    shown = shown[:SHOWN_STARS]
    with tempfile.TemporaryDirectory(prefix="psfdae-") as folder:
        predicted = Path(folder) / "psf.fits"
        write_prediction(model, exposure, observation, predicted, 1)
        field = None if observation.positions is None else map_of_file(predicted)
        with fits.open(predicted) as hdus:
            table = hdus["STARS"].data
            stars = {name: np.array(table[name], dtype=float) for name in table.names[1:]}
            psf, residual = (np.array(hdus[name].data[shown]) for name in ("PSF", "RESIDUAL"))
    stars["flags"] = stars["flags"].astype(int)
    columns = {name: selection[name].to_numpy() for name in ("verdict", "part")}
    area = info.noise_equivalent_px
    return quality_page(
        Quality(
            name=info.name,
            image=exposure.path.name,
            method=kind.name,
            label=kind.label,
            notes=notes,
            errors=errors,
            coverage={row["snr"]: row["coverage68"] for row in info.metrics if "coverage68" in row},
            faint={signal_to_noise(info.kappa * level, area): of for level, of in restored.items()},
            stars=stars | columns,
            residual=residual / stars["noise"][shown, None, None],
            bright=psf + residual,
            strip=(files.path / "report.png").read_bytes(),
            field=field,
            facts=[*model.engine.estimator.facts().values()],
        )
    )
