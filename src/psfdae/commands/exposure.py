"""Stage `exposure`: a field model for another exposure, by its own bright stars."""

from __future__ import annotations

from typing import Annotated

from psfdae.cli import command
from psfdae.commands.predict import Stated, check_targets
from psfdae.files import check_outputs
from psfdae.model.bundle import SUFFIX
from psfdae.model.field_psfs import PredictionError
from psfdae.model.psf_model import load_model
from psfdae.options import File


@command("exposure")
def exposure(
    image: Annotated[File, {"argument": True}],
    stated: Stated,
    overwrite: Annotated[bool, "Replace a file that exists."] = False,
    *,
    model: Annotated[File, "Bundle of from-stars --method field, of another exposure."],
    out: Annotated[File, "Bundle of IMAGE, by custom NAME.psf.safetensors."],
) -> None:
    """Adapt MODEL to IMAGE, another exposure of the same camera with few bright stars.

    The stars of IMAGE show how its PSF differs from that of MODEL; ten may be enough.
    """
    source = stated.source(image)
    check_outputs((out,), (*source.files(), model))
    check_targets(out, None, None, overwrite)
    if stated.all_extensions:
        raise PredictionError(f"{image}: exposure takes one image, not --all-extensions")
    loaded = load_model(model)

    from psfdae.model.exposures import exposure as adapted

    made, said = adapted(loaded, source, out.name.removesuffix(SUFFIX))
    made.save(out)
    print(f"{out}: {said}")
