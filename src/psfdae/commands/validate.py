"""Command `validate`: errors of a model on stars of an image that its training has not seen."""

from __future__ import annotations

from typing import Annotated

from psfdae.base.options import File
from psfdae.commands.cli import command
from psfdae.commands.predict import check_targets
from psfdae.denoise.star_model import StarModel
from psfdae.image.image_input import ImageInput, ImageOptions
from psfdae.report.validation import validate
from psfdae.training.exposures import read_training_settings
from psfdae.training.from_image import collect_stars


@command("validate")
def validate_command(
    image: Annotated[File, {"argument": True}],
    options: ImageOptions,
    overwrite: bool = False,
    *,
    model: File,
    out: File,
) -> None:
    """Test MODEL on stars of IMAGE that its training has not seen, degraded to low S/N.

    IMAGE is another image of the same camera, or the image of the training, of which the same stars
    are held out. Stars are chosen with the settings of the training.

    Parameters
    ----------
    image : Path
        FITS image, or FITS cube of stamps.
    options : ImageOptions
        Options of the image, and its star list.
    overwrite : bool
        Replace a file that exists.
    model : Path
        Model of train.
    out : Path
        HTML page with checks, errors, photometry and figures.
    """
    source = ImageInput(image, **vars(options))
    check_targets((*source.files(), model), out, overwrite=overwrite)
    loaded_model = StarModel.load(model)
    # Stars chosen as for the training, in stamps as large as the model's.
    settings = read_training_settings(loaded_model)
    calibration = settings.calibration_stars.model_copy(update={"light_min": 0.0})
    settings = settings.model_copy(update={"calibration_stars": calibration})
    stars = collect_stars([source], settings)
    print(*stars.notes, stars.summary(), sep="\n")
    report = validate(loaded_model, stars)
    report.save(out)
    print(report)
