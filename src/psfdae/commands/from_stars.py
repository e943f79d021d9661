"""Stage `from-stars`: from images and their star list to models of their own, in one go."""

from __future__ import annotations

import os
import shlex
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from inspect import signature
from pathlib import Path
from typing import Annotated, Any

from psfdae import fits
from psfdae.cli import command
from psfdae.commands.mosaic import each, images_of, with_name
from psfdae.commands.predict import Stated, write_list
from psfdae.errors import Error
from psfdae.files import (
    atomic_path,
    check_outputs,
    interrupted,
    write_bytes,
    write_columns,
    write_product,
    write_text,
)
from psfdae.image.errors import ObservationError
from psfdae.image.observation import Source
from psfdae.image.tables import write_table
from psfdae.method import Method, facts_of
from psfdae.methods import method
from psfdae.model.bundle import SUFFIX
from psfdae.model.exposures import for_exposures
from psfdae.model.fitting import (
    choose_method,
    described,
    fitted_to,
    makes_models,
    pack_model,
    worth_trying,
)
from psfdae.model.settings import (
    DATASET_CHOICE,
    IMAGE_GROUPS,
    Settings,
    SettingsReader,
    of_config,
    with_keywords,
)
from psfdae.model.stars import ALL, Stars
from psfdae.model.validation import validate
from psfdae.options import File, Folder
from psfdae.settings import ConfigError, as_overrides

LOCK = ".from_stars.lock"

LONGEST_NAME = 255
"""Bytes of a file's name."""


class FolderError(Error, RuntimeError):
    """The folder holds a model already, or another process is making one there."""


@dataclass(frozen=True)
class Made:
    """Files that the stage leaves in a folder."""

    path: Path
    name: str
    kinds: tuple[type[Method], ...]
    exposures: Sequence[str] = ()

    @property
    def stars(self) -> Path:
        return self.path / "stars.h5"

    def star_list(self, exposure: str) -> Path:
        return self.path / (f"{exposure}_stars.csv" if self.exposures else "stars.csv")

    def fit(self, kind: type[Method]) -> Path:
        return self.path / fits.named(kind, kind.name)

    @property
    def bundle(self) -> Path:
        return self.bundle_of(self.name)

    def bundle_of(self, exposure: str) -> Path:
        return self.path / f"{exposure}{SUFFIX}"

    def written(self) -> list[Path]:
        """Files of the folder itself."""
        names = ("selection.csv", "overrides.txt", "evaluation.csv", "per_star.csv")
        own = [self.path / name for name in (*names, "report.csv", "found.csv", "report.png")]
        for kind in self.kinds:
            own += fits.outputs(kind, self.fit(kind))
        own += map(self.bundle_of, self.exposures)
        return [self.stars, self.bundle, *own]


@command("from-stars", SettingsReader())
def from_stars(
    config: Settings,
    image: Annotated[tuple[File, ...], {"argument": True, "metavar": "IMAGE... [OVERRIDES]..."}],
    stated: Stated,
    name: Annotated[str | None, "Name of the model.  [default: the image's; all]"] = None,
    licence: Annotated[str, "Of the model."] = "not stated",
    taken: Annotated[
        str | None,
        {"flag": "--method"},
        "Method of the model.  [default: that which errs least on validation stars; of several "
        "images field]",
    ] = None,
    *,
    out: Annotated[Folder, "Folder for the model, its report and what they are made of."],
    page: Annotated[
        File | None, {"flag": "--report"}, "HTML page that shows whether to trust the model."
    ] = None,
    overwrite: Annotated[bool, "Replace a model that the folder holds."] = False,
    snr_min: Annotated[
        float | None, "Least S/N of a star that is learnt from.  [default: 100, less if few]"
    ] = None,
    stars_min: Annotated[int | None, "Fewest stars to learn from.  [default: 1]"] = None,
    stamp_px: Annotated[
        int | None, "Side of the stamps, even.  [default: 16, more if stars are larger]"
    ] = None,
) -> None:
    """Train a model on the bright stars of IMAGE.

    IMAGE is a FITS image with --catalogue or --detect, or a FITS cube of stamps. Some stars choose
    the method of the model; others are held out and degraded to low S/N to test it. Several images
    are exposures of one camera; all share a model, and each gets its own by the stars that it has.
    """
    sizes = {"snr_min": snr_min, "stars_min": stars_min, "stamp_px": stamp_px}
    stated_sizes: dict[str, object] = {k: v for k, v in sizes.items() if v is not None}
    if stamp_px is not None:
        stated_sizes["light_min"] = 0.0  # no light asks for other stamps
    config = with_keywords(of_config(config), IMAGE_GROUPS, stated_sizes)
    job = {key: value for key, value in locals().items() if key in signature(trained).parameters}
    stem = _stem(image, name)
    if not stated.all_extensions:
        print(trained(**job))
    elif len(image) > 1:
        raise ObservationError(image[1], "--all-extensions takes one file with images")
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
            for extension, of_image in images_of(image[0], stated).items()
        }
        each(trained, jobs, image[0])
    print(f"next: {shlex.join(_next(image, stated, out, name))}")


def trained(
    config: Settings | Mapping[str, Any],
    image: tuple[Path, ...],
    stated: Stated,
    name: str | None,
    licence: str,
    taken: str | None,
    out: Path,
    page: Path | None,
    overwrite: bool,
) -> str:
    """Train a model on the stars of one image, or of exposures; how good it is, in a sentence.

    `config` is what `from_stars` receives, or its tree.
    """
    sources, settings = stated.source(image[0]).of_each(image), of_config(config)
    exposures = [_stem((one,), None) for one in image] if len(image) > 1 else []
    if exposures and taken is None and "field" in settings.methods:
        taken = "field"  # validation stars would judge the field of all, not those of exposures
    settings, kinds, tried = _methods(settings, taken)
    files = Made(out, _stem(image, name), kinds, exposures)
    if files.name in exposures:
        raise FolderError(f"{files.bundle}: of an image and of all; --name changes the latter")
    lists = [files.star_list(source.name) for source in sources] if stated.detect else []
    check_outputs([*files.written(), *lists, page], [f for s in sources for f in s.files()])
    if page is not None and page.exists() and not (overwrite or interrupted(files.bundle)):
        raise FolderError(f"{page}: exists already; --overwrite replaces it")
    with _alone(out):
        finished = sorted(out.glob(f"*{SUFFIX}"))
        if finished and not (overwrite or _unfinished(files.bundle)):
            raise FolderError(f"{finished[0]}: a model is there already; --overwrite replaces it")
        return _make(settings, sources, files, licence, tried, page)


def _unfinished(bundle: Path) -> bool:
    """Whether a killed run has left models of exposures, but not that of all."""
    return not bundle.exists() and interrupted(bundle)


def _methods(
    settings: Settings, taken: str | None
) -> tuple[Settings, tuple[type[Method], ...], list[type[Method]]]:
    """Settings whose methods are those that are measured; the fits, and who may be the model."""
    # Those that are given a place on the grid of a simulation know none of an image.
    names = [n for n in settings.methods if method(n).packing or not method(n).needs.position]
    if taken is not None:
        names = [n for n in names if method(n).storage is None and n != taken]
        names.append(method(taken).name)
    kinds = tuple(kind for kind in map(method, names) if kind.storage is not None)
    tried = [kind for kind in kinds if makes_models(kind.name)]
    if not tried:
        known = ", ".join(n for n in settings.methods if makes_models(n)) or "none of the list"
        raise ConfigError(f"methods = {settings.methods}: --method takes one of these: {known}")
    return settings.model_copy(update={"methods": names}), kinds, tried


def _stem(image: tuple[Path, ...], name: str | None) -> str:
    """The name of a model, with which names of its files start; FolderError if they cannot."""
    name = name or (ALL if len(image) > 1 else Source(image[0]).name)
    if "/" in name or len(f"{name}{SUFFIX}".encode()) > LONGEST_NAME:
        said = f"at most {LONGEST_NAME - len(SUFFIX)} bytes, and no folder"
        raise FolderError(f"--name {name}: expected the start of a file's name, {said}")
    return name


def _next(image: tuple[Path, ...], stated: Stated, out: Path, name: str | None) -> list[str]:
    """The command that applies the models to all stars of their image, or of the first one."""
    several = len(image) > 1
    name = _stem(image[:1], None if several else name)
    stated = replace(stated, on_image=True) if several and stated.catalogue else stated
    model = out if stated.all_extensions or several else Made(out, name, ()).bundle
    where = ["--model", str(model), "--out", str(out / f"{name}_psf.fits")]
    return ["psfdae", "predict", str(image[0]), *stated.words(), *where]


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
    settings: Settings,
    sources: list[Source],
    files: Made,
    licence: str,
    tried: list[type[Method]],
    page: Path | None,
) -> str:
    """Make all files; how good the model is, in a sentence."""
    stars = Stars.of(sources, settings)
    print(*stars.notes, stars.summary(), sep="\n")
    for part in stars.images:
        if part.observation.found is not None:
            write_list(part.observation, files.star_list(part.name))
    write_table(files.path / "selection.csv", stars.table)
    write_product(files.stars, "stars", stars.columns, stars.described())
    write_text(files.path / "overrides.txt", _overrides(stars.settings))
    taking = worth_trying(stars, tried)
    fitted = _fits(stars, files, [k for k in files.kinds if k in taking or k not in tried])
    taken = taking[0]
    if len(taking) > 1:
        name, errors = choose_method(stars, {kind.name: fitted[kind.name] for kind in taking})
        taken = method(name)
        for other, error in errors.items():
            print(f"{method(other).look.label}: MSE {error:.3g} on validation stars")
    print(f"packing {taken.look.label}")
    model = pack_model(stars, fitted[taken.name], files.name, licence)
    for fact in facts_of(fitted[taken.name]):
        print(f"{taken.look.label}: {fact}")
    if model.wings is not None:
        print(f"light beyond the stamps: {model.wings}")
    # Its name is the last one to be there: it says that all is done.
    with ExitStack() as stack:
        model.save(stack.enter_context(atomic_path(files.bundle)))
        own = for_exposures(model, stars)
        for part in stars.exposures:
            count, made = len(part), own[part.name]
            made.save(stack.enter_context(atomic_path(files.bundle_of(part.name))))
            said = "get the model of all" if made is model else "change the field of all"
            print(f"{part.name}: {count} stars {said}")
        print("testing on the stars held out")
        report = validate(model, stars, fitted)
        write_columns(files.path / "evaluation.csv", report.evaluation.columns)
        write_columns(files.path / "per_star.csv", report.per_star.columns)
        write_columns(files.path / "report.csv", report.table.columns, digits=6)
        write_columns(files.path / "found.csv", report.found.columns, digits=6)
        write_bytes(files.path / "report.png", report.strip_png)
        if page is not None:
            print(f"writing {page}")
            report.save(page)
    return str(report)


def _fits(stars: Stars, files: Made, kinds: Sequence[type[Method]]) -> dict[str, Method]:
    """Fit methods to the stars, each to a file, by their names."""
    fitted: dict[str, Method] = {}
    for kind in kinds:
        print(f"fitting {kind.look.label}")
        place = files.fit(kind)
        checkpoint = fits.beside(kind, place, "checkpoint.pt")
        fitted[kind.name] = fitted_to(stars, kind, checkpoint)
        fits.store(fitted[kind.name], place, described(stars, kind), stars.product)
        checkpoint.unlink(missing_ok=True)
    return fitted


def _overrides(settings: Settings) -> str:
    """The settings as words of a command line that chooses files of the configuration, too."""
    overrides = as_overrides(settings.model_dump(exclude={"calibration_stars"}))
    return "\n".join([DATASET_CHOICE, *overrides]) + "\n"
