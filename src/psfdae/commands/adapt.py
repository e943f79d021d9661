"""Command `adapt`: adapt a field model to another exposure by its own bright stars."""

from __future__ import annotations

from typing import Annotated

from psfdae.base.options import File
from psfdae.commands.cli import command
from psfdae.commands.predict import check_targets
from psfdae.denoise.bundle import SUFFIX
from psfdae.denoise.star_model import StarModel
from psfdae.image.image_input import ImageInput, ImageOptions
from psfdae.training.exposures import exposure as adapt_to_exposure


@command("adapt")
def adapt_command(
    image: Annotated[File, {"argument": True}],
    options: ImageOptions,
    overwrite: bool = False,
    *,
    model: File,
    out: File,
) -> None:
    """Adapt MODEL to IMAGE, another exposure of the same camera with few bright stars.

    The stars of IMAGE show how its PSF differs from the PSF of MODEL; ten may be enough.

    Parameters
    ----------
    image : Path
        FITS image.
    options : ImageOptions
        Options of the image, and its star list.
    overwrite : bool
        Replace a file that exists.
    model : Path
        Model of train --method field, of another exposure.
    out : Path
        Model of IMAGE, usually NAME.psf.safetensors.
    """
    # Refuse wrong options and files that exist before anything is computed.
    source = ImageInput(image, **vars(options))
    check_targets((*source.files(), model), out, overwrite=overwrite)
    star_model = StarModel.load(model)

    adapted_model, sentence = adapt_to_exposure(star_model, source, out.name.removesuffix(SUFFIX))
    adapted_model.save(out)
    print(f"{out}: {sentence}")
