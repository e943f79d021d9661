"""Stage `from_stars`: from an image and its star list to a model of its own, in one go."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from psfdae.configuration.compose import as_overrides, part
from psfdae.configuration.schema import Noise
from psfdae.estimators.dae import Dae
from psfdae.estimators.pca_som import PcaSom
from psfdae.files import write_product, write_text
from psfdae.own_stars.bundle import SUFFIX
from psfdae.own_stars.errors import ObservationError
from psfdae.own_stars.observation import Observation, Source
from psfdae.own_stars.photometry import noise_equivalent_px, signal_to_noise
from psfdae.own_stars.selection import collect
from psfdae.own_stars.training_images import star_grid, training_columns
from psfdae.reading import read_table
from psfdae.rng import stream
from psfdae.stages import bundle
from psfdae.stages.common import check_outputs
from psfdae.stages.evaluate import Models, evaluate
from psfdae.stages.fit import baseline, train
from psfdae.stars.splits import held_out_fields

LOCK = ".from_stars.lock"

SPLIT, REFERENCE = "held_out", "realisation"

SHOWN_SNR = 10.0
"""The figure shows stars at the S/N nearest to this."""

SHOWN_STARS = 6


class FolderError(RuntimeError):
    """The folder holds a model already, or another process is making one there."""


@dataclass(frozen=True)
class Folder:
    """Files that the stage leaves."""

    path: Path
    name: str

    def written(self) -> list[Path]:
        """Files of the folder itself."""
        names = ("selection.csv", "overrides.txt", "evaluation.csv", "per_star.parquet")
        more = ("report.csv", "report.png")
        return [self.stars, self.pca_som, self.bundle, *(self.path / n for n in (*names, *more))]

    @property
    def stars(self) -> Path:
        return self.path / "stars.h5"

    @property
    def pca_som(self) -> Path:
        return self.path / "pca_som.h5"

    @property
    def dae(self) -> Path:
        return self.path / "dae"

    @property
    def bundle(self) -> Path:
        return self.path / f"{self.name}{SUFFIX}"


def run(
    config: Any,
    exposure: Source,
    out: Path,
    *,
    name: str,
    licence: str = "not stated",
    overwrite: bool = False,
    say: Callable[[str], object] = lambda line: None,
) -> None:
    """Train a network on the bright stars of an exposure, test it, and pack it.

    Parameters
    ----------
    config : stage config (seed, calibration_stars, framing, noise, parts, dae, train,
        baseline, evaluation); the noise levels follow from the stars
    exposure : Source
    out : folder that receives

        - `NAME.psf.safetensors`, the model bundle,
        - `report.csv` (columns snr, noise, method, mse, mse_stderr, ssim, images, stars,
          truth_mse) and `report.png`,
        - `selection.csv` with every star of the catalogue and why it was not used,
        - `stars.h5`, `pca_som.h5`, `dae/`, `evaluation.csv`, `per_star.parquet`, as the
          stages leave them, and `overrides.txt`, with which they can be run again.
    name, licence : what the bundle says of itself
    overwrite : whether a model in the folder may be replaced
    say : called with a line of progress

    Raises
    ------
    ObservationError, CalibrationStarsError, BundleError, TrainingError, OutputError
    FolderError
        If the folder holds a model that may not be replaced, or another process is
        making one there.
    """
    files = Folder(out, name)
    check_outputs(files.written(), (exposure.path, exposure.catalogue, exposure.mask))
    with _alone(out):
        finished = sorted(out.glob(f"*{SUFFIX}"))
        if finished and not overwrite:
            raise FolderError(f"{finished[0]}: a model is there already; --overwrite replaces it")
        _run(config, exposure, files, licence, say)


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Refuse a folder in which another process works; its lock ends with the process.

    A folder that is left empty is removed again.
    """
    import fcntl

    folder.mkdir(parents=True, exist_ok=True)
    path = folder / LOCK
    try:
        with path.open("a") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                # That of a process which has just ended may be removed, and made anew by a third.
                mine = os.path.samestat(os.fstat(lock.fileno()), path.stat())
            except (BlockingIOError, FileNotFoundError):
                mine = False
            if not mine:
                raise FolderError(f"{folder}: another psfdae from-stars works there")
            try:
                yield
            finally:
                path.unlink(missing_ok=True)
    finally:
        with suppress(OSError):
            folder.rmdir()


def _run(
    config: Any, exposure: Source, files: Folder, licence: str, say: Callable[[str], object]
) -> None:
    framing, wanted = config.framing, config.calibration_stars
    observation = exposure.open(framing.stamp_px, wanted.margin_px, larger=True)
    if observation.pixel_scale_arcsec is None:
        raise ObservationError(
            exposure.path, "the pixel scale is neither in the header nor given (--pixel-scale)"
        )
    found = collect(observation, wanted, framing)
    grid = star_grid(found.bright.position)
    held_out = held_out_fields(grid)
    say(f"{len(found.verdict)} stars: {found.count()}")
    say(f"{int((~held_out).sum())} to learn from, {int(held_out.sum())} held out")
    selection = found.table(held_out).to_csv(index=False, float_format="%.6g")
    write_text(files.path / "selection.csv", selection)
    rng = stream(config.seed, "own stars")
    columns = training_columns(
        found.bright, grid, held_out, wanted.bins, framing, config.parts, rng
    )
    write_product(files.stars, "stars", columns, _described(config, observation))
    images = columns["realisation"].values[~held_out[columns["field_index"].values]]
    sky = found.bright.sky_photons(observation.gain, config.noise.background_photons)
    settings = {**config.model_dump(), "noise": _noise(config, images, sky)}
    write_text(files.path / "overrides.txt", _overrides(settings))
    for line, work in _steps(settings, files, licence):
        say(line)
        work()
    report(settings, files)


def _described(config: Any, observation: Observation) -> dict[str, Any]:
    """Configuration of the product: what `stages.bundle` wants to know of its stars."""
    kept = config.model_dump(include={"seed", "calibration_stars", "framing", "parts"})
    return {
        **kept,
        "source": "stars",
        "image": observation.path.name,
        "telescope": {"pixel_scale_arcsec": observation.pixel_scale_arcsec},
    }


def _noise(config: Any, images: np.ndarray, background: float) -> dict[str, Any]:
    """Config group `noise` with the levels of the S/N asked for, of noise-free stars."""
    area, kappa = noise_equivalent_px(images.mean(axis=0, dtype=np.float64)), config.noise.kappa
    levels = [1.0 / (snr * np.sqrt(area) * kappa) for snr in config.calibration_stars.snr_levels]
    noise = Noise(
        name=config.noise.name,
        levels=[float(f"{level:.9g}") for level in reversed(levels)],
        kappa=kappa,
        background_photons=background,
    )
    return noise.model_dump()


def _part(stage: str, settings: dict[str, Any]) -> Any:
    """Checked configuration of another stage."""
    return part(stage, settings)


def _overrides(settings: dict[str, Any]) -> str:
    tree = {key: value for key, value in settings.items() if key != "calibration_stars"}
    return "\n".join(["dataset=from_stars", *as_overrides(tree)]) + "\n"


def _steps(
    settings: dict[str, Any], files: Folder, licence: str
) -> list[tuple[str, Callable[[], None]]]:
    stars = files.stars
    return [
        (
            "fitting PCA and SOM",
            lambda: baseline(_part("baseline", settings), stars, SPLIT, out=files.pca_som),
        ),
        (
            "training the DAE",
            lambda: train(_part("train", settings), stars, SPLIT, REFERENCE, out=files.dae),
        ),
        (
            "testing on the stars held out",
            lambda: evaluate(
                *(_part("evaluate", settings), files.name, stars),
                *(Models(pca_som=files.pca_som, dae=files.dae), SPLIT, REFERENCE),
                per_star=files.path / "per_star.parquet",
                out=files.path / "evaluation.csv",
            ),
        ),
        (
            "packing the model",
            lambda: bundle.run(
                *(_part("bundle", settings), stars, files.dae, SPLIT, files.name),
                *(licence, files.bundle),
            ),
        ),
    ]


def report(settings: dict[str, Any], files: Folder) -> None:
    """Table and figure of the errors on the stars held out."""
    import pandas as pd

    from psfdae.stages.common import read_stars, split_stars

    config = _part("evaluate", settings)
    product = read_stars(files.stars, REFERENCE)
    parts = split_stars(product, SPLIT, config)
    images = product["realisation"]
    area = noise_equivalent_px(images[parts.train].mean(axis=0, dtype=np.float64))
    rows = read_table(files.path / "evaluation.csv")
    wide = rows.pivot(index=["noise_level", "method"], columns="metric", values=["value", "stderr"])
    table = pd.DataFrame(
        {
            "mse": wide["value", "mse"],
            "mse_stderr": wide["stderr", "mse"],
            "ssim": wide["value", "ssim_peak"],
        }
    ).reset_index()
    noise = config.noise.kappa * table.pop("noise_level")
    table.insert(0, "noise", noise)
    table.insert(0, "snr", [signal_to_noise(level, area) for level in noise])
    table["images"] = parts.test.size
    table["stars"] = np.unique(product["field_index"][parts.test]).size
    table["truth_mse"] = _noise_of_truth(files.stars, parts.test, config.noise.background_photons)
    order = {method: place for place, method in enumerate(("noisy", "pca_som", "lmmse", "dae"))}
    table = table.sort_values(["snr", "method"], key=lambda c: c.map(order).fillna(c))
    write_text(files.path / "report.csv", table.to_csv(index=False, float_format="%.6g"))
    _draw(config, files, images[parts.test], product["field_index"][parts.test], area)


def _noise_of_truth(stars: Path, test: np.ndarray, sky: float) -> float:
    """Mean variance of the pixels of the stars held out: their own noise, in every MSE.

    Sky noise σ and the star's photons F, F = √B / σ: σ² + p/F with the mean p = 1/P.
    """
    from psfdae.files import read_product

    product = read_product(stars, "stars", ("realisation", "field_index", "noise"))
    noise = product["noise"][product["field_index"][test]]
    pixels = product["realisation"][0].size
    return float((noise**2 + noise / np.sqrt(sky) / pixels).mean())


def _draw(config: Any, files: Folder, images: np.ndarray, star: np.ndarray, area: float) -> None:
    """Strip of stars held out, made faint, and what the methods make of them."""
    from psfdae.evaluation.figures import StripRow, restoration_strip
    from psfdae.evaluation.metrics import mse
    from psfdae.files import read_product
    from psfdae.stages.common import noisy_test_images
    from psfdae.stages.figures import write_png

    levels = np.asarray(config.noise.levels)
    snr = 1.0 / (config.noise.kappa * levels * np.sqrt(area))
    level = float(levels[np.abs(np.log(snr / SHOWN_SNR)).argmin()])
    noisy = noisy_test_images(config, images, level)
    product = read_product(files.stars, "stars", ("position", "snr"))
    shown = _shown(star, product["position"])
    truth = images[shown]
    estimates = {
        "noisy": noisy[shown],
        "PCA+SOM": PcaSom.load(files.pca_som).predict(noisy)[shown],
        "DAE": Dae.load(files.dae, evaluation=config.evaluation).predict(noisy)[shown],
    }
    rows = [StripRow("bright\nstar", truth)]
    for label, stamps in estimates.items():
        rows.append(StripRow(label, stamps, mse(stamps, truth), own_scale=label == "noisy"))
    found = signal_to_noise(config.noise.kappa * level, area)
    columns = [f"S/N {value:.0f}" for value in product["snr"][star[shown]]]
    title = f"Bright stars that no training saw, made faint: S/N {found:.3g}"
    write_png(restoration_strip(rows, columns, title), files.path / "report.png")


def _shown(star: np.ndarray, position: np.ndarray) -> np.ndarray:
    """An image each of stars that lie evenly over the field."""
    from psfdae.evaluation.figures import spread_stars

    stars, first = np.unique(star, return_index=True)
    if not np.isfinite(position[stars]).all():
        return first[:SHOWN_STARS]
    return first[spread_stars(position[stars], SHOWN_STARS)]
