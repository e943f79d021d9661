"""Stages `night images`, `night table`, `night page`, `night count`: many images of a telescope.

Input: a list of images. Outputs: for each image a model, a catalogue and a report page, and for the
night one table and one page. An image that cannot be used is a row with a reason.
"""

from __future__ import annotations

import glob
import itertools
import math
import os
import traceback
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import numpy as np
import pandas as pd

from psfdae.base.errors import Error
from psfdae.base.files import write_csv, write_text
from psfdae.base.options import File, Folder
from psfdae.base.reading import read_table
from psfdae.commands.cli import parse_options, refusal
from psfdae.commands.wavefront import check_scale, field_angles
from psfdae.denoise.bundle import SUFFIX
from psfdae.denoise.star_model import StarModel
from psfdae.image.image_input import ImageInput, ImageOptions
from psfdae.image.tables import write_table
from psfdae.methods.field import FieldMixture
from psfdae.photometry.image_photometry import measure_all_stars
from psfdae.report.validation import validate
from psfdae.sensing.results import wavefront
from psfdae.stars.moments import measure_shapes
from psfdae.telescope.settings import read_telescope
from psfdae.training.exposures import adapt_to_stars
from psfdae.training.fitting import fit_method, pack_model
from psfdae.training.from_image import collect_stars
from psfdae.training.settings import apply_keywords, settings_model
from psfdae.training.star_choice import MIN_STARS_WITH_ERROR
from psfdae.training.stars import ImageStars
from psfdae_paper.configuration.command import command
from psfdae_paper.evaluation.night import (
    TABLE_COLUMNS,
    VERDICTS,
    add_verdicts,
    night_page,
    read_night,
)
from psfdae_paper.stars.nights import locate_places, measure_places

Row = dict[str, object]


class NightError(Error, ValueError):
    """A list without images, or a night without a usable image."""


def list_images(text: str) -> list[dict[str, str]]:
    """Return a row for each image of a pattern such as night/*.fits, or of a CSV list.

    Parameters
    ----------
    text : str
        Pattern, or CSV list with the column `image`. Further columns with the name of a field of
        `ImageOptions` are options of the image; all columns are kept.

    Returns
    -------
    list of dict of str to str
        Cells by column; `name` begins the names of the image's files, `reason` says why it cannot
        be used.

    Raises
    ------
    NightError
        If no image is found.
    """
    # Images of a pattern are in the order of their names, usually the order of time.
    rows = [{"image": path} for path in sorted(glob.glob(text))]  # noqa: PTH207  # any folder
    if text.endswith(".csv"):
        # A column of the list whose name is also in the table of the night gets another name.
        rows = [
            {f"{name}_list" if name in TABLE_COLUMNS else name: cell for name, cell in row.items()}
            for row in read_text_rows(Path(text), "image")
        ]
    if not rows:
        raise NightError(f"images = {text}: no image, expected night/*.fits or a CSV list")
    # Names of files in different folders may be the same; the same image twice is an error.
    names, images = set[str](), set[tuple[str, str]]()
    for row in rows:
        stem = ImageInput(Path(row["image"])).name
        stems = itertools.chain([stem], (f"{stem}_{number}" for number in itertools.count(2)))
        row["name"] = next(name for name in stems if name not in names)
        image = str(Path(row["image"]).absolute()), row.get("extension", "")
        row["reason"] = "listed twice" if image in images else ""
        names.add(row["name"])
        images.add(image)
    return rows


def read_text_rows(path: Path, *columns: str) -> list[dict[str, str]]:
    """Return the rows of a CSV file with some required columns, every cell as text."""
    table = read_table(path, *columns, dtype=str, keep_default_na=False)
    return [{str(name): text for name, text in row.items()} for row in table.to_dict("records")]


@command("paper night images")
def night_images(rows: File, folder: Folder, out: File) -> None:
    """Model images that follow each other in time, and measure all of their stars.

    The most typical image of each camera is fitted; the others start from the model of the image
    with the most similar stars, or are fitted as well if none is similar. An image that cannot be
    used is a row with its reason.

    Parameters
    ----------
    rows : Path
        CSV with a row for each image.
    folder : Path
        Folder for models, catalogues and report pages.
    out : Path
        CSV with a row for each image and its measurements.
    """
    listed_rows = read_text_rows(rows, "image", "name", "reason")
    results: dict[str, Row] = {row["name"]: {**row} for row in listed_rows}
    # Bright stars of the images, by camera, filter and size of stamps, which a model cannot change.
    groups: dict[tuple[object, ...], dict[str, ImageStars]] = {}
    for name, row in results.items():
        try:
            if not row["reason"]:
                stars = bright_stars(row)
                camera = *stars.observation.instrument.items(), stars.observation.shape
                options = row.get("camera"), row.get("filter"), stars.settings.framing.stamp_px
                groups.setdefault((*camera, *options), {})[name] = stars
        except Exception as error:
            row["reason"] = explain_error(error, row)
    for stars_by_name in groups.values():
        sizes = measure_sizes(stars_by_name)
        starts: dict[str, StarModel] = {}
        for name in order_images(stars_by_name, sizes):
            try:
                # Stars take memory: they are removed when their image is done.
                stars = stars_by_name.pop(name)
                # Stars that differ by more than 4 % in size need a fit of their own.
                distance = {start: np.abs(sizes[start] - sizes[name]).max() for start in starts}
                nearest = min(distance, key=distance.__getitem__, default="")
                start = starts[nearest] if nearest and distance[nearest] < 0.04 else None
                model = fit_image(stars, start)
                results[name] |= measure_image(results[name], stars, model, folder)
                # Where the optics are known, one image of each group gives the telescope's state.
                if not starts and (telescope := results[name].get("telescope_file")):
                    results[name] |= fit_telescope(stars, Path(str(telescope)))
                results[name]["start"] = nearest if model.info.adapted else ""
                starts |= {} if model.info.adapted else {name: model}
            except Exception as error:
                results[name]["reason"] = explain_error(error, results[name])
            print(name, results[name]["reason"] or "done", flush=True)
    write_csv(out, pd.DataFrame(list(results.values())))


@command("paper night table")
def night_table(parts: Annotated[tuple[File, ...], {"argument": True}], out: File) -> None:
    """Join the images of a night in one table, with a verdict on each.

    Parameters
    ----------
    parts : sequence of Path
        Tables of `night images`, in the order of time.
    out : Path
        CSV of the night; an ECSV with units is written to the same folder.
    """
    from astropy.table import QTable

    # A part without a usable image lacks the columns of measurements.
    tables = [read_night(path, "image", "name", "reason") for path in parts]
    night = pd.concat(tables, ignore_index=True)
    texts = [name for name in night if night[name].dtype.kind == "O"]
    night = add_verdicts(night.fillna(dict.fromkeys(texts, "")))
    write_csv(out, night)
    table = QTable.from_pandas(night)
    units = {"fwhm_px": "pix", "mag_20th": "mag", "zero_point": "mag"}
    for name in table.colnames:
        table[name].info.unit = next((u for key, u in units.items() if key in name), None)
    write_table(out.with_suffix(".ecsv"), table)


@command("paper night page")
def write_night_page(table: File, folder: Folder, out: File) -> None:
    """Draw the page of a night: bad images, and the PSF against time.

    Parameters
    ----------
    table : Path
        CSV of the night.
    folder : Path
        Folder with the models of the images.
    out : Path
        HTML page that needs no other file, but links the images' reports.
    """
    from psfdae.api import load_model

    night = read_night(table, "name", "verdict", "reason")
    # PSFs over the field of the best, the median and the worst image, by the FWHM in the middle.
    psfs = {}
    with_model = night.dropna(subset="fwhm_px_centre").sort_values("fwhm_px_centre")
    for label, number in (("best", 0), ("median", len(with_model) // 2), ("worst", -1)):
        if len(with_model):
            name = str(with_model.name.iloc[number])
            model = load_model(folder / f"{name}{SUFFIX}")
            assert model.image_px is not None  # of a model that was fitted to an image
            psfs[f"{label}\n{name}"] = model.draw_on_pixels(locate_places(model.image_px))
    links = os.path.relpath(folder, out.parent)
    write_text(out, night_page(night, psfs, links))


@command("paper night count")
def night_count(table: Annotated[File, {"argument": True}]) -> None:
    """Print how many images are good, poor and failed; an error if all have failed.

    Parameters
    ----------
    table : Path
        CSV of the night.
    """
    verdicts = Counter(read_table(table, "verdict").verdict)
    sentence = ", ".join(f"{verdicts[verdict]} {verdict}" for verdict in VERDICTS)
    if verdicts["failed"] == verdicts.total():
        raise NightError(f"{table}: {sentence}: no image could be used")
    print(f"{table}: {sentence}")


def explain_error(error: Exception, row: Mapping[str, object]) -> str:
    """Return why an image cannot be used, in one line; a bug is printed with its traceback."""
    message = refusal(error)
    if message is None:
        traceback.print_exception(error)
        message = f"{type(error).__name__}: {error}"
    # The row already names the image.
    return " ".join(message.removeprefix(f"{row['image']}: ").split())


def bright_stars(row: Mapping[str, object]) -> ImageStars:
    """Return the bright stars of an image of the list; without a catalogue they are detected."""
    values = parse_options(ImageOptions, {name: str(text) for name, text in row.items()})
    source = ImageInput(Path(str(row["image"])), **{"detect": "catalogue" not in values, **values})
    return collect_stars([source], settings_model()())


def measure_sizes(stars_by_name: Mapping[str, ImageStars]) -> dict[str, np.ndarray]:
    """Return the logarithms of the FWHM (px) and axis ratio of an image's mean PSF, by its name."""
    shapes = measure_shapes(np.stack([stars.mean_psf for stars in stars_by_name.values()]))
    sizes = np.log([shapes.fwhm_px, 1.0 - shapes.ellipticity]).T
    return dict(zip(stars_by_name, sizes, strict=True))


def order_images(
    stars_by_name: Mapping[str, ImageStars], sizes: Mapping[str, np.ndarray]
) -> list[str]:
    """Return the names of images, the most typical image of the group first.

    It has at least the median number of stars and, of these images, the size and shape of stars
    (`measure_sizes`) nearest to the median: it is neither cloudy nor trailed. The others keep their
    order.
    """
    min_count = np.median([len(stars) for stars in stars_by_name.values()])
    middle = np.median([*sizes.values()], axis=0)
    most_typical = min(
        (name for name, stars in stars_by_name.items() if len(stars) >= min_count),
        key=lambda name: np.abs(sizes[name] - middle).sum(),
    )
    return [most_typical, *(name for name in stars_by_name if name != most_typical)]


def fit_image(stars: ImageStars, start: StarModel | None) -> StarModel:
    """Fit the field model of an image, starting from the model of another image if there is one."""
    # Fewer stars than this cannot show how the field has changed.
    training_stars = np.count_nonzero(~stars.held_out)
    if start is None or training_stars < MIN_STARS_WITH_ERROR:
        method_fit = fit_method(stars, FieldMixture)
        # Where wavefronts grow with the square of the position, as Seidel aberrations do, second
        # moments grow with its fourth power: a curved field gets at least order 4, if there are two
        # stars for each of its 15 terms. Few of the stars that decide the order are in corners.
        if 2 <= method_fit.order < 4 and training_stars >= 30:
            settings = apply_keywords(stars.settings, [*FieldMixture.groups], {"orders": [4, 6]})
            stars = stars.replace_settings(settings)
            method_fit = fit_method(stars, FieldMixture)
        # Errors and wings take most of the time: they are measured once, of the fit that stays.
        return pack_model(stars, method_fit, stars.name, "not stated")
    return adapt_to_stars(start, stars)


def fit_telescope(stars: ImageStars, telescope: Path) -> Row:
    """Fit the numbers of a telescope, with errors, to the brightest stars of an image.

    Parameters
    ----------
    stars : ImageStars
        Bright stars of the image, with their observation.
    telescope : Path
        YAML file of the telescope, as `psfdae wavefront` takes it.

    Returns
    -------
    dict
        Values and errors by names such as `telescope_z4.constant_wave` and
        `telescope_z4.constant_wave_error`; or `telescope_reason`, why they cannot be measured.
    """
    # Thirty stars determine ten numbers, in some seconds.
    bright = stars.candidates.bright.row
    brightest = bright[np.argsort(-stars.candidates.snr[bright])[:30]]
    observation = stars.observation.replace_margin(0).select(brightest)
    # An image is usable without the state of the telescope.
    try:
        optics = read_telescope(telescope)
        check_scale(observation, optics)
        angle_deg = field_angles(observation, None, optics, None)
        stamps = next(observation.chunks(observation.count))
        state = wavefront(stamps, optics, field_deg=angle_deg, joint=True).joint
    except Error as error:
        return {"telescope_reason": str(error)}
    assert state is not None  # a joint fit was asked for
    row: Row = {}
    for name, unit, value, sigma in state.table.iterrows("name", "unit", "value", "error"):
        row |= {f"telescope_{name}_{unit}": value, f"telescope_{name}_{unit}_error": sigma}
    return row


def measure_image(
    row: Mapping[str, object], stars: ImageStars, model: StarModel, folder: Path
) -> Row:
    """Write model, catalogue and report page of an image, and return its row of measurements.

    Parameters
    ----------
    row : mapping
        Row of the list; its `reference` is a star list with magnitudes.
    stars : ImageStars
        Bright stars of the image, with the opened image.
    model : StarModel
        Model of the image.
    folder : Path
        Files begin with the row's name.

    Returns
    -------
    dict
        Time, airmass; FWHM (px) and ellipticity at `PLACES`, order of the field; numbers
        of bright, measured and flagged stars; magnitude of the 20th brightest star without a flag
        in counts, NaN if there are fewer; zero point and its scatter; median χ² of the stars.
    """
    path = folder / str(row["name"])
    reference = Path(str(row["reference"])) if row.get("reference") else None
    photometry = measure_all_stars(
        model, stars.source, reference=reference, opened=stars.observation
    )
    table = photometry.table
    write_table(path.with_name(f"{path.name}.fits"), table)
    validate(model, stars).save(path.with_name(f"{path.name}.html"))
    model.save(path.with_name(f"{path.name}{SUFFIX}"))
    # The flux of the 20th brightest star without a flag distinguishes clouds from few stars.
    cards = {key: value for key, value, _ in stars.observation.header_cards}
    flux, has_flag = np.array(table["flux"], float), np.array(table["flags"]) > 0
    brightest = np.sort(flux[~has_flag & (flux > 0)])[::-1][:20]
    shape = stars.observation.shape
    return {
        "time": cards.get("DATE-OBS", cards.get("MJD-OBS", "")),
        "airmass": cards.get("AIRMASS", math.nan),
        **measure_places(model.draw_on_pixels, (shape[1], shape[0])),
        "order": model.order,
        "bright_stars": len(stars),
        "stars": len(table),
        "flagged": int(has_flag.sum()),
        "mag_20th": -2.5 * math.log10(brightest[-1]) if len(brightest) == 20 else math.nan,
        "zero_point": table.meta.get("ZEROPT", math.nan),
        "zero_point_scatter": table.meta.get("ZEROPTSD", math.nan),
        "chi2": float(np.nanmedian(np.array(table["chi2"], float))),
    }
