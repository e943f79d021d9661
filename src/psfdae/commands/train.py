"""Command `train`: train a PSF model on the bright stars of an image, in one call."""

from __future__ import annotations

import os
import shlex
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

from psfdae.base.errors import Error
from psfdae.base.files import (
    check_outputs,
    is_cut_off,
    rename_together,
    write_bytes,
    write_columns,
    write_product,
    write_text,
)
from psfdae.base.options import File, Folder
from psfdae.base.settings import ConfigError, as_overrides
from psfdae.commands.cli import command, format_as_words
from psfdae.commands.mosaic import name_image_path, options_by_image, run_for_images
from psfdae.commands.predict import write_list
from psfdae.denoise.bundle import SUFFIX
from psfdae.image.errors import ObservationError
from psfdae.image.image_input import ImageInput, ImageOptions
from psfdae.image.tables import write_table
from psfdae.methods import fit_files as fits
from psfdae.methods import method
from psfdae.methods.interface import Method
from psfdae.report.validation import validate
from psfdae.training.exposures import adapt_to_exposures
from psfdae.training.fitting import (
    choose_method,
    describe_settings,
    fit_method,
    makes_models,
    pack_model,
    worth_trying,
)
from psfdae.training.from_image import collect_stars
from psfdae.training.settings import (
    DATASET_CHOICE,
    Settings,
    SettingsReader,
    apply_keywords,
    make_settings,
)
from psfdae.training.stars import ImageStars


class FolderError(Error, RuntimeError):
    """The folder holds a model already, or another process is making one there."""


@dataclass(frozen=True)
class ModelFiles:
    """Paths of the files that the command writes to a folder.

    Attributes
    ----------
    path : Path
        The folder.
    name : str
        Name of the model.
    methods : tuple of type of Method
        Methods that are fitted, each with files of its own.
    exposures : sequence of str
        Names of the exposures if there are several, each with a model of its own.
    """

    path: Path
    name: str
    methods: tuple[type[Method], ...]
    exposures: Sequence[str] = ()

    @property
    def stars(self) -> Path:
        """Product with the stamps of the training stars."""
        return self.path / "stars.h5"

    def star_list(self, exposure: str) -> Path:
        """Return the path of the list of stars that were detected in an image."""
        return self.path / (f"{exposure}_stars.csv" if self.exposures else "stars.csv")

    def fit(self, method_class: type[Method]) -> Path:
        """Return the path of the fit of a method."""
        return self.path / fits.add_suffix(method_class, method_class.name)

    @property
    def bundle(self) -> Path:
        """Bundle of the model, for all images together if there are several."""
        return self.locate_bundle(self.name)

    def locate_bundle(self, exposure: str) -> Path:
        """Return the path of the bundle of one exposure."""
        return self.path / f"{exposure}{SUFFIX}"

    def paths(self) -> list[Path]:
        """Return the paths of all files but the star lists and the page."""
        names = ("selection.csv", "overrides.txt", "report.csv", "found.csv", "report.png")
        paths = [self.path / name for name in names]
        for method_class in self.methods:
            paths += fits.outputs(method_class, self.fit(method_class))
        return [self.stars, self.bundle, *paths, *map(self.locate_bundle, self.exposures)]


@command("train", SettingsReader())
def train_command(
    config: Settings | Mapping[str, Any],
    options: ImageOptions,
    image: Annotated[
        tuple[File, ...], {"argument": True, "metavar": "IMAGE... [OVERRIDES]..."}
    ] = (),
    telescope: File | None = None,
    all_extensions: bool = False,
    name: str | None = None,
    licence: str = "not stated",
    method_name: Annotated[str | None, {"flag": "--method"}] = None,
    *,
    out: Folder,
    page: Annotated[File | None, {"flag": "--report"}] = None,
    overwrite: bool = False,
    snr_min: float | None = None,
    stars_min: int | None = None,
    stamp_px: int | None = None,
) -> str:
    """Train a model on the bright stars of IMAGE.

    IMAGE is a FITS image with --catalogue or --detect, or a FITS cube of stamps. Some stars choose
    the method of the model; others are held out and degraded to low S/N to test it. Several images
    are exposures of one camera; all share a model, and each gets its own by the stars that it has.
    With --telescope in place of IMAGE, stars of a telescope that a file describes are simulated.

    Parameters
    ----------
    config : Settings or mapping
        Settings of the training, from overrides or a file.
    options : ImageOptions
        Options of the image, and its star list.
    image : sequence of Path
        FITS images of one camera, or one FITS cube of stamps.
    telescope : Path, optional
        YAML file of a telescope, as in config/telescope, whose stars are simulated.
    all_extensions : bool
        All images of the file, each by itself and in parallel; OUT gets their names.
    name : str, optional
        Name of the model. [default: the image's; all]
    licence : str
        Licence of the model.
    method_name : str, optional
        Method of the model. [default: the one with the smallest error on validation stars; of
        several images field]
    out : Path
        Folder for the model, its report and what they are made of.
    page : Path, optional
        HTML page that shows whether to trust the model.
    overwrite : bool
        Replace a model that the folder holds.
    snr_min : float, optional
        Minimum S/N of training stars. [default: 100, less if few]
    stars_min : int, optional
        Minimum number of training stars. [default: 1]
    stamp_px : int, optional
        Side of the stamps, even. [default: 16, more if stars are larger]
    """
    arguments = dict(locals())
    # The three options of the selection are settings of the configuration by shorter names.
    sizes = {"snr_min": snr_min, "stars_min": stars_min, "stamp_px": stamp_px}
    size_settings: dict[str, object] = {k: v for k, v in sizes.items() if v is not None}
    if stamp_px is not None:
        # A given size is used even if stars have light beyond it.
        size_settings["light_min"] = 0.0
    settings = apply_keywords(make_settings(config), Settings.image_groups, size_settings)
    if (telescope is None) != bool(image):
        raise ConfigError("psfdae train takes images or --telescope, one of them")
    if telescope is not None:
        if all_extensions or options != ImageOptions():
            raise ConfigError("--telescope takes no options of an image")
        return train_on_telescope(
            settings, telescope, name, licence, method_name, out, page, overwrite
        )
    stem, sentence = model_name(image, name), ""
    if all_extensions and len(image) > 1:
        raise ObservationError(image[1], "--all-extensions takes one file with images")
    if all_extensions:
        # Each image of the file gets a model in a folder of its own, by a process of its own, which
        # receives the settings as a tree.
        jobs = {}
        arguments |= {"config": settings.model_dump(), "all_extensions": False}
        for extension, image_options in options_by_image(image[0], options).items():
            outputs = {"out": out / extension, "page": name_image_path(page, extension)}
            names = {"name": f"{stem}_{extension}", "options": image_options}
            jobs[extension] = {**arguments, **names, **outputs}
        run_for_images(train_command, jobs, image[0])
    else:
        # One image, or exposures that share a model; options are the same for all.
        sources = ImageInput(image[0], **vars(options)).repeat_for(image)
        exposures = [model_name((path,), None) for path in image] if len(image) > 1 else []
        if exposures and method_name is None and "field" in settings.methods:
            # Validation stars would judge the field of all exposures, but each gets its own.
            method_name = "field"
        settings, methods, candidates = select_methods(settings, method_name)
        files = ModelFiles(out, stem, methods, exposures)
        with reserve_folder(files, sources, page, overwrite):
            sentence = write_model(settings, sources, files, licence, candidates, page)
        print(sentence)
    print(f"next: {next_command(image, options, all_extensions, name, out)}")
    return sentence


def train_on_telescope(
    settings: Settings,
    telescope_path: Path,
    name: str | None,
    licence: str,
    method_name: str | None,
    out: Path,
    page: Path | None,
    overwrite: bool,
) -> str:
    """Train a model on simulated stars of a telescope, and return a sentence on its error.

    Parameters are as for `train_command`.

    Raises
    ------
    ConfigError
        If the method learns positions in an image, or the file does not describe a telescope.
    """
    # Optics, which images do not need.
    from psfdae.telescope.settings import read_telescope
    from psfdae.training.telescope_stars import simulate_stars

    if method_name is not None and method(method_name).knows_field:
        raise ConfigError(f"--method {method_name}: learns positions in an image; not --telescope")
    telescope = read_telescope(telescope_path)
    names = [n for n in settings.methods if not method(n).knows_field]
    settings = settings.model_copy(update={"methods": names})
    settings, methods, candidates = select_methods(settings, method_name)
    files = ModelFiles(out, model_name((), name or telescope.name), methods)
    with reserve_folder(files, [ImageInput(telescope_path)], page, overwrite):
        source = simulate_stars(telescope, telescope_path, settings)
        sentence = write_model(settings, [source], files, licence, candidates, page)
    print(sentence)
    words = ["psfdae", "predict", "IMAGE", "--detect", "--model", str(files.bundle)]
    print(f"next: {shlex.join([*words, '--out', str(out / 'psf.fits')])}")
    return sentence


def next_command(
    image: tuple[Path, ...],
    options: ImageOptions,
    all_extensions: bool,
    name: str | None,
    out: Path,
) -> str:
    """Return the command that applies the model to all stars of the image, or first exposure.

    Parameters are as for `train_command`.
    """
    # A list for several images has stars of all of them: those off the image are left out.
    several = len(image) > 1
    if several and options.catalogue:
        options = replace(options, on_image=True)
    stem = model_name(image[:1], None if several else name)
    model = out if several or all_extensions else ModelFiles(out, stem, ()).bundle
    words = ["psfdae", "predict", str(image[0]), *format_as_words(options)]
    words += ["--all-extensions"] * all_extensions
    words += ["--model", str(model), "--out", str(out / f"{stem}_psf.fits")]
    return shlex.join(words)


def select_methods(
    settings: Settings, method_name: str | None
) -> tuple[Settings, tuple[type[Method], ...], list[type[Method]]]:
    """Choose the methods that are compared, that are fitted, and that may become the model.

    Parameters
    ----------
    settings : Settings
        Its list `methods` names the methods to choose from.
    method_name : str or None
        Method of the model, if the user names one. Then only methods without a fit, such as the
        noisy stamps themselves, are compared with it.

    Returns
    -------
    settings : Settings
        The same with the list of the methods that are compared.
    storable : tuple of type of Method
        Methods of this list that leave a fit.
    candidates : list of type of Method
        Methods of these that make models.
    """
    # Methods that need the field position on the grid of a simulation cannot use an image.
    names = [n for n in settings.methods if method(n).packing or not method(n).needs.position]
    # A method that the user names replaces all others that are fitted.
    if method_name is not None:
        names = [n for n in names if method(n).storage is None and n != method_name]
        names.append(method(method_name).name)
    # Some methods with a fit make no models: they are only compared.
    storable = tuple(m for m in map(method, names) if m.storage is not None)
    candidates = [m for m in storable if makes_models(m.name)]
    if not candidates:
        makers = ", ".join(n for n in settings.methods if makes_models(n)) or "none of the list"
        raise ConfigError(f"methods = {settings.methods}: --method takes one of these: {makers}")
    return settings.model_copy(update={"methods": names}), storable, candidates


def model_name(image: tuple[Path, ...], name: str | None) -> str:
    """Return the name of a model, with which the names of its files begin.

    Raises
    ------
    FolderError
        If no file can have such a name.
    """
    name = name or ("all" if len(image) > 1 else ImageInput(image[0]).name)
    # Linux allows 255 bytes in the name of a file.
    longest = 255 - len(SUFFIX)
    if "/" in name or len(name.encode()) > longest:
        raise FolderError(
            f"--name {name}: expected the start of a file's name, at most {longest} bytes, and no "
            "folder"
        )
    return name


@contextmanager
def reserve_folder(
    files: ModelFiles, sources: Sequence[ImageInput], page: Path | None, overwrite: bool
) -> Iterator[None]:
    """Refuse outputs that are inputs or exist, and hold the folder, before anything is computed.

    Outputs of a run that Ctrl-C interrupts are removed.

    Raises
    ------
    OutputError, FolderError
        If a path is an input, the folder holds a model, or another process works there.
    """
    # The model of all images and the model of one would have the same file.
    if files.name in files.exposures:
        raise FolderError(f"{files.bundle}: of an image and of all; --name changes the latter")
    # No output may be an input, such as the star list of an earlier run.
    lists = [files.star_list(source.name) for source in sources if source.detect]
    inputs = [path for source in sources for path in source.files()]
    check_outputs([*files.paths(), *lists, page], inputs)
    # A run that was killed after it named some of its outputs may be repeated.
    overwrite = overwrite or is_cut_off(files.bundle)
    if page is not None and page.exists() and not overwrite:
        raise FolderError(f"{page}: exists already; --overwrite replaces it")
    # Models are looked for under the lock, so that no other process writes one meanwhile.
    with lock_folder(files.path):
        bundles = sorted(files.path.glob(f"*{SUFFIX}"))
        if bundles and not overwrite:
            raise FolderError(f"{bundles[0]}: a model is there already; --overwrite replaces it")
        outputs = [path for path in (*files.paths(), *lists, page) if path is not None]
        new_outputs = [path for path in outputs if not path.exists()]
        try:
            yield
        except KeyboardInterrupt:
            # Ctrl-C leaves nothing but the state of a network, from which its training goes on.
            for path in new_outputs:
                path.unlink(missing_ok=True)
            raise


@contextmanager
def lock_folder(folder: Path) -> Iterator[None]:
    """Refuse a folder in which another process works; the lock ends with the process.

    A folder that is left empty is removed again.

    Raises
    ------
    FolderError
        If another process holds the lock.
    """
    import fcntl

    folder.mkdir(parents=True, exist_ok=True)
    # The folder itself is locked, so that no lock file is left.
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise FolderError(f"{folder}: another psfdae train works there") from None
        yield
    finally:
        # A folder with files in it stays.
        os.close(descriptor)
        with suppress(OSError):
            folder.rmdir()


def write_model(
    settings: Settings,
    sources: list[ImageInput],
    files: ModelFiles,
    licence: str,
    candidates: list[type[Method]],
    page: Path | None,
) -> str:
    """Select stars, fit the methods, test the best one, and write all files.

    Returns
    -------
    str
        A sentence on the error of the model.
    """
    # Choose bright stars without neighbours, and cut them out.
    stars = collect_stars(sources, settings)
    print(*stars.notes, stars.summary(), sep="\n")
    # What the stars are, and why others are not used: lists, and the product of all later steps.
    for image_stars in stars.images:
        if image_stars.observation.detections is not None:
            write_list(image_stars.observation, files.star_list(image_stars.name))
    write_table(files.path / "selection.csv", stars.table)
    write_product(files.stars, "stars", stars.columns, stars.described())
    # The settings as words of a command line that repeats this run.
    overrides = as_overrides(stars.settings.model_dump(exclude={"calibration_stars"}))
    write_text(files.path / "overrides.txt", "\n".join([DATASET_CHOICE, *overrides]) + "\n")
    # Fit the candidates, and the other methods that the report compares with them. With few
    # stars only one candidate is tried.
    tried_methods = worth_trying(stars, candidates)
    all_fits = fit_methods(
        stars, files, [m for m in files.methods if m in tried_methods or m not in candidates]
    )
    # The method with the smallest MSE on validation stars becomes the model.
    model_method = tried_methods[0]
    if len(tried_methods) > 1:
        best_name, errors = choose_method(stars, {m.name: all_fits[m.name] for m in tried_methods})
        model_method = method(best_name)
        for name, error in errors.items():
            print(f"{method(name).look.title}: MSE {error:.3g} on validation stars")
    # The fit with all that predictions need: photometry, and errors from stars held out.
    print(f"measuring the errors of the {model_method.look.title} on stars held out")
    model = pack_model(stars, all_fits[model_method.name], files.name, licence)
    for fact in all_fits[model_method.name].facts().values():
        print(f"{model_method.look.title}: {fact}")
    if model.wings is not None:
        print(f"light beyond the stamps: {model.wings}")
    # The bundle gets its name after all others: if it exists, everything is done.
    with rename_together(files.bundle):
        model.save(files.bundle)
        # The field of each exposure, by its own stars.
        exposure_models = adapt_to_exposures(model, stars)
        for exposure in stars.exposures:
            exposure_model = exposure_models[exposure.name]
            exposure_model.save(files.locate_bundle(exposure.name))
            is_adapted = exposure_model is not model
            change = "change the field of all" if is_adapted else "get the model of all"
            print(f"{exposure.name}: {len(exposure)} stars {change}")
        # Stars that no fit has seen, degraded to low S/N, test the model.
        print("testing on the stars held out")
        report = validate(model, stars, all_fits)
        write_columns(files.path / "report.csv", report.table.columns, digits=6)
        write_columns(files.path / "found.csv", report.photometry.columns, digits=6)
        picture = files.path / "report.png"
        if page is not None:
            print(f"writing {page}")
            write_bytes(picture, report.strip_png)
            report.save(page)
    # A picture that an earlier run left would show another model.
    if page is None:
        picture.unlink(missing_ok=True)
    return str(report)


def fit_methods(
    stars: ImageStars, files: ModelFiles, methods: Sequence[type[Method]]
) -> dict[str, Method]:
    """Fit methods to the training stars, write each fit to its file, and return them by name."""
    all_fits: dict[str, Method] = {}
    for method_class in methods:
        print(f"fitting the {method_class.look.title}")
        path = files.fit(method_class)
        # A network keeps its state here while it trains, for the case that it is killed.
        checkpoint = fits.path_beside(method_class, path, "checkpoint.pt")
        fit = fit_method(stars, method_class, checkpoint)
        # The checkpoint goes when the fit is stored; until then, a killed run goes on from it.
        fits.store(fit, path, describe_settings(stars, method_class), stars.product)
        fits.delete_checkpoints(checkpoint)
        all_fits[method_class.name] = fit
    return all_fits
