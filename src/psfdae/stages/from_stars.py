"""Stage `from-stars`: from an image and its star list to a model of its own, in one go."""

from __future__ import annotations

import os
import shlex
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np

from psfdae.cli import File, Folder, command
from psfdae.configuration.base import ConfigError
from psfdae.configuration.compose import as_overrides, part
from psfdae.configuration.schema import Config, Noise
from psfdae.estimators import Method, all_groups, groups_of, method
from psfdae.files import (
    Product,
    atomic_path,
    interrupted,
    write_csv,
    write_product,
    write_text,
)
from psfdae.own_stars.advice import advice
from psfdae.own_stars.bundle import SUFFIX
from psfdae.own_stars.observation import Observation, Source, list_offset
from psfdae.own_stars.photometry import signal_to_noise
from psfdae.own_stars.report import MEAN_PSF, fitted_mean, standing
from psfdae.own_stars.selection import BrightStars, collect
from psfdae.own_stars.training_images import single_psf, star_grid, training_columns
from psfdae.reading import read_table
from psfdae.rng import stream
from psfdae.stages.bundle import bundle
from psfdae.stages.common import check_outputs
from psfdae.stages.evaluate import READS, Models, estimators, evaluate
from psfdae.stages.fit import fit, fit_apart, training_set
from psfdae.stages.mosaic import each, images_of, with_name
from psfdae.stages.predict import Stated, write_list
from psfdae.stages.quality import told
from psfdae.stars.fields import held_out_fields

if TYPE_CHECKING:
    import pandas as pd

LOCK = ".from_stars.lock"

SPLIT, REFERENCE = "held_out", "realisation"

SHOWN_SNR = 10.0
"""The figure shows stars at the S/N nearest to this."""

SHOWN_STARS = 6

LONGEST_NAME = 255
"""Bytes of a file's name."""


class FolderError(RuntimeError):
    """The folder holds a model already, or another process is making one there."""


@dataclass(frozen=True)
class Made:
    """Files that the stage leaves in a folder."""

    path: Path
    name: str
    kinds: tuple[type[Method], ...]

    @property
    def stars(self) -> Path:
        return self.path / "stars.h5"

    @property
    def list(self) -> Path:
        return self.path / "stars.csv"

    def fit(self, kind: type[Method]) -> Path:
        return self.path / (kind.name if kind.files else f"{kind.name}.h5")

    @property
    def bundle(self) -> Path:
        return self.path / f"{self.name}{SUFFIX}"

    def models(self) -> Any:
        """What the stage `evaluate` takes."""
        return Models(**{kind.name: self.fit(kind) for kind in self.kinds})

    def written(self) -> list[Path]:
        """Files of the folder itself."""
        names = ("selection.csv", "overrides.txt", "evaluation.csv", "per_star.parquet")
        own = [self.path / name for name in (*names, "report.csv", "report.png")]
        for kind in self.kinds:
            own += kind.outputs(self.fit(kind))
        return [self.stars, self.bundle, *own]


@command(
    "from-stars",
    start=("dataset=from_stars",),
    reads=(
        *("seed", "calibration_stars", "framing", "noise", "parts"),
        *(*all_groups(), "evaluation", "methods"),
    ),
)
def from_stars(
    config: Config,
    image: Annotated[File, {"argument": True}],
    stated: Stated,
    name: Annotated[str | None, "Name of the model.  [default: the image's]"] = None,
    licence: Annotated[str, "Of the model."] = "not stated",
    taken: Annotated[
        str | None,
        {"flag": "--method"},
        "Method of the model.  [default: that which errs least on validation stars]",
    ] = None,
    *,
    out: Annotated[Folder, "Folder for the model, its report and what they are made of."],
    page: Annotated[
        File | None, {"flag": "--report"}, "HTML page that shows whether to trust the model."
    ] = None,
    overwrite: Annotated[bool, "Replace a model that the folder holds."] = False,
) -> None:
    """Train a model on the bright stars of IMAGE.

    IMAGE is a FITS image with --catalogue or --detect, or a FITS cube of stamps. Some stars choose
    the method of the model; others are held out and made faint to test it.
    """
    job = dict(locals())
    stem = _stem(image, name)
    if not stated.all_extensions:
        print(trained(**job))
    else:
        jobs = {
            extension: {
                **job,
                "config": config.model_dump(),
                "stated": of_image,
                "name": f"{stem}_{extension}",
                "out": out / extension,
                "page": with_name(page, extension),
            }
            for extension, of_image in images_of(image, stated).items()
        }
        each(trained, jobs, image)
    print(f"next: {shlex.join(_next(image, stated, out, name))}")


def trained(
    config: Any,
    image: Path,
    stated: Stated,
    name: str | None,
    licence: str,
    taken: str | None,
    out: Path,
    page: Path | None,
    overwrite: bool,
) -> str:
    """Train a model on the stars of one image; how good it is, in a sentence.

    `config` is what `from_stars` receives, or its tree.
    """
    config = part(from_stars.stage.reads, config)  # type: ignore[attr-defined]
    exposure = stated.source(image)
    # Those that are told a place on the grid of a simulation know none of an image.
    methods = [n for n in config.methods if method(n).bundled or not method(n).told_position]
    if taken is not None and taken not in methods:
        methods.append(method(taken).name)
    config = config.model_copy(update={"methods": methods})
    kinds = tuple(kind for kind in map(method, methods) if kind.stored)
    files = Made(out, _stem(image, name), kinds)
    allowed = {kind.name: kind for kind in kinds if kind.bundled}
    if not allowed or taken not in {None, *allowed}:
        known = ", ".join(allowed) or "none, for no method of the list makes a model"
        raise ConfigError(f"methods = {config.methods}: --method takes one of these: {known}")
    made = [*files.written(), *([files.list] if exposure.detect is not None else []), page]
    check_outputs(made, exposure.files())
    if page is not None and page.exists() and not (overwrite or interrupted(files.bundle)):
        raise FolderError(f"{page}: exists already; --overwrite replaces it")
    with _alone(out):
        finished = sorted(out.glob(f"*{SUFFIX}"))
        if finished and not overwrite:
            raise FolderError(f"{finished[0]}: a model is there already; --overwrite replaces it")
        tried = [allowed[taken]] if taken else [*allowed.values()]
        return _make(config, exposure, files, licence, tried, page)


def _stem(image: Path, name: str | None) -> str:
    """The name of a model, with which names of its files start; FolderError if they cannot."""
    name = name or image.name.split(".")[0] or "model"
    if "/" in name or len(f"{name}{SUFFIX}".encode()) > LONGEST_NAME:
        said = f"at most {LONGEST_NAME - len(SUFFIX)} bytes, and no folder"
        raise FolderError(f"--name {name}: expected the start of a file's name, {said}")
    return name


def _next(image: Path, stated: Stated, out: Path, name: str | None) -> list[str]:
    """The command that applies the models to all stars of their image."""
    name = _stem(image, name)
    model = out if stated.all_extensions else Made(out, name, ()).bundle
    where = ["--model", str(model), "--out", str(out / f"{name}_psf.fits")]
    return ["psfdae", "predict", str(image), *stated.words(), *where]


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


def _make(
    config: Config,
    exposure: Source,
    files: Made,
    licence: str,
    allowed: list[type[Method]],
    page: Path | None,
) -> str:
    """Make all files; how good the model is, in a sentence."""
    # The noise levels follow from the stars.
    framing, wanted = config.framing, config.calibration_stars
    observation = exposure.open(framing.stamp_px, wanted.margin_px).assuming()
    found = collect(observation, wanted, framing)
    off = (found.bright.centre - found.bright.listed)[:, ::-1]
    notes = [observation.said(), list_offset(exposure.catalogue, off, exposure.accept_offset)]
    notes = [*filter(None, notes), *advice(found, observation, framing.stamp_px)]
    print(*notes, sep="\n")
    grid = star_grid(found.bright.position)
    held_out = held_out_fields(grid)
    print(f"{len(found.verdict)} stars: {found.count()}")
    print(f"{int((~held_out).sum())} to learn from, {int(held_out.sum())} held out")
    if exposure.detect is not None:
        write_list(observation, files.list)
    write_csv(files.path / "selection.csv", found.table(held_out), digits=6)
    rng = stream(config.seed, "own stars")
    columns = training_columns(
        found.bright, grid, held_out, wanted.bins, framing, config.parts, rng
    )
    write_product(files.stars, "stars", columns, _described(config, observation))
    sky = found.bright.sky_photons(observation.gain, config.noise.background_photons)
    settings = {**config.model_dump(), "noise": _noise(config, found.bright, sky)}
    write_text(files.path / "overrides.txt", _overrides(settings))
    for kind in files.kinds:
        print(f"fitting {kind.label}")
        own = part(groups_of(kind.name), settings)
        fit(own, kind.name, files.stars, SPLIT, REFERENCE, out=files.fit(kind))
    print("testing on the stars held out")
    checked = part(READS, settings)
    evaluate(
        *(checked, files.name, files.stars, files.models(), SPLIT, REFERENCE),
        per_star=files.path / "per_star.parquet",
        out=files.path / "evaluation.csv",
    )
    taken = allowed[0] if len(allowed) == 1 else best(settings, files, allowed)
    print(f"packing {taken.label}")
    own = part(bundle.stage.reads, settings)  # type: ignore[attr-defined]
    models = Models(**{taken.name: files.fit(taken)})
    # Its name is the last one to be there: it says that all is done.
    with atomic_path(files.bundle) as model:
        bundle(own, files.stars, models, SPLIT, REFERENCE, files.name, licence, out=model)
        fitted = taken.load(files.fit(taken), REFERENCE, checked.evaluation)
        print("".join(f"{taken.label}: {fact}\n" for fact in fitted.facts().values()), end="")
        mean = single_psf(found.bright, held_out)
        restored = tested(checked, files, fitted, mean, framing.jitter_px)
        errors = report(checked, files, restored)
        if page is not None:
            print(f"writing {page}")
            tables = (errors, restored, found.table(held_out))
            write_text(page, told(exposure, files, model, taken, tables, notes))
    return standing(errors, taken.name, taken.label)


def best(settings: Any, files: Made, kinds: Iterable[type[Method]]) -> type[Method]:
    """The method that errs least on validation stars, which no fit that is asked has seen.

    Every S/N counts alike: the geometric mean of the errors decides.
    """
    from psfdae.stages.common import noise_model, read_stars, split_stars

    errors = {}
    for kind in kinds:
        config = part((*groups_of(kind.name), "evaluation"), settings)
        product = read_stars(files.stars, "template")
        data = training_set(config, kind, product, SPLIT, REFERENCE)
        star, judges = product["field_index"], split_stars(product, SPLIT, config).validation
        fitted = kind.load(files.fit(kind), REFERENCE, config.evaluation)
        if not kind.validates:
            fitted = fit_apart(kind, data, star, config)
        truth, rng = product["realisation"][judges], stream(config.seed, "noise", "own stars")
        noisy = [noise_model(config).draw(truth, level, rng) for level in data.levels]
        where = data.positions[judges]
        free = fitted.free_flux()  # as of the stars that the model is for
        logs = []
        for images, level in zip(noisy, data.levels, strict=True):
            psf = free.restore(images, level, where)
            psf = psf / psf.sum(axis=(1, 2), keepdims=True)
            logs.append(np.log(np.square(psf - truth).mean()))
        errors[kind] = float(np.mean(logs))
        print(f"{kind.label}: MSE {np.exp(errors[kind]):.3g} on validation stars")
    return min(errors, key=errors.__getitem__)


def _described(config: Any, observation: Observation) -> dict[str, Any]:
    """Configuration of the product: what `stages.bundle` wants to know of its stars."""
    kept = config.model_dump(include={"seed", "calibration_stars", "framing", "parts"})
    return {
        **kept,
        "source": "stars",
        "image": observation.path.name,
        **({"image_px": [*reversed(observation.shape)]} if observation.shape else {}),
        "telescope": {
            "pixel_scale_arcsec": observation.pixel_scale_arcsec,
            **({"assumed": True} if observation.scale_assumed else {}),
        },
    }


def _noise(config: Any, bright: BrightStars, background: float) -> dict[str, Any]:
    """Config group `noise` with the levels of the S/N asked for, of noise-free stars."""
    area, kappa = float(np.median(bright.area())), config.noise.kappa
    levels = [1.0 / (snr * np.sqrt(area) * kappa) for snr in config.calibration_stars.degraded()]
    noise = Noise(
        name=config.noise.name,
        levels=[float(f"{level:.9g}") for level in reversed(levels)],
        kappa=kappa,
        background_photons=background,
    )
    return noise.model_dump()


def _overrides(settings: dict[str, Any]) -> str:
    tree = {key: value for key, value in settings.items() if key != "calibration_stars"}
    return "\n".join(["dataset=from_stars", *as_overrides(tree)]) + "\n"


def tested(
    config: Any, files: Made, fitted: Method, mean: np.ndarray, jitter_px: int
) -> dict[float, dict[str, np.ndarray]]:
    """By noise level λ: stars held out, and what the model and one mean PSF make of them faint."""
    from psfdae.stages.common import (
        field_positions,
        noisy_test_images,
        read_stars,
        split_stars,
    )

    product = read_stars(files.stars, REFERENCE)
    test = split_stars(product, SPLIT, config).test
    place = field_positions(product)[test]
    restored = {}
    for level in config.noise.levels:
        noisy = noisy_test_images(config, product, test, level)
        restored[level] = {
            "truth": product["realisation"][test],
            "model": fitted.estimate(noisy, level, place).psf,
            MEAN_PSF: fitted_mean(noisy, mean, jitter_px + 1.0),
        }
    return restored


def report(config: Any, files: Made, restored: dict[float, dict[str, np.ndarray]]) -> pd.DataFrame:
    """Table and figure of the errors on the stars held out; the table."""
    import pandas as pd

    from psfdae.evaluation.metrics import all_metrics, clustered_mean
    from psfdae.stages.common import read_stars, split_stars, star_area

    product = read_stars(files.stars, REFERENCE)
    parts = split_stars(product, SPLIT, config)
    area = star_area(product, parts.train)
    rows = [read_table(files.path / "evaluation.csv")]
    star = product["field_index"][parts.test]
    for level, found in restored.items():
        metrics = all_metrics(found[MEAN_PSF], found["truth"], config.evaluation.data_range)
        means = {name: clustered_mean(values, star) for name, values in metrics.items()}
        mean = pd.DataFrame(means.values(), columns=["value", "stderr"])
        rows.append(mean.assign(noise_level=level, method=MEAN_PSF, metric=[*means]))
    rows = pd.concat(rows)
    # A table keeps eight digits of a level.
    rows["noise_level"] = [float(f"{level:.8g}") for level in rows["noise_level"]]
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
    table["stars"] = np.unique(star).size
    table["truth_mse"] = _noise_of_truth(files.stars, parts.test, config.noise.background_photons)
    order = {name: place for place, name in enumerate([*config.methods, MEAN_PSF])}
    table = table.sort_values(["snr", "method"], key=lambda c: c.map(order).fillna(c))
    write_csv(files.path / "report.csv", table, digits=6)
    _draw(config, files, product, parts.test, area)
    return table


def _noise_of_truth(stars: Path, test: np.ndarray, sky: float) -> float:
    """Mean variance of the pixels of the stars held out: their own noise, in every MSE.

    Sky noise σ and the star's photons F, F = √B / σ: σ² + p/F with the mean p = 1/P.
    """
    from psfdae.files import read_product

    product = read_product(stars, "stars", ("realisation", "field_index", "noise"))
    noise = product["noise"][product["field_index"][test]]
    pixels = product["realisation"][0].size
    return float((noise**2 + noise / np.sqrt(sky) / pixels).mean())


def _draw(config: Any, files: Made, stars: Product, test: np.ndarray, area: float) -> None:
    """Strip of stars held out, made faint, and what the methods make of them."""
    from psfdae.evaluation.figures import StripRow, restoration_strip
    from psfdae.evaluation.metrics import mse
    from psfdae.files import read_product
    from psfdae.stages.common import field_positions, noisy_test_images
    from psfdae.stages.figures import write_png

    levels = np.asarray(config.noise.levels)
    snr = 1.0 / (config.noise.kappa * levels * np.sqrt(area))
    level = float(levels[np.abs(np.log(snr / SHOWN_SNR)).argmin()])
    images, star = stars["realisation"][test], stars["field_index"][test]
    noisy = noisy_test_images(config, stars, test, level)
    product = read_product(files.stars, "stars", ("position", "snr"))
    shown = _shown(star, product["position"])
    truth = images[shown]
    rows = [StripRow("bright\nstar", truth)]
    methods = estimators(config, stars, vars(files.models()), SPLIT, REFERENCE, only_drawn=True)
    for kind in methods.values():
        stamps = kind.restore(noisy, level, field_positions(stars)[test])[shown]
        rows.append(StripRow(kind.label, stamps, mse(stamps, truth), own_scale=not kind.restores))
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
