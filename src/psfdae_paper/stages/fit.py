"""Stage `fit`: fit of a method to one dataset and split, for one reference or for both.

Input: the product "stars". Output: the fitted method, as a folder or an HDF5 product, with the
configuration of the fit and of its stars.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import click

from psfdae.base.options import File, Folder
from psfdae.base.settings import Reference, SplitKind
from psfdae.base.threads import limit_threads
from psfdae.methods import fit_files as fits
from psfdae.methods import list_groups, method
from psfdae.training.star_sets import read_stars, training_set
from psfdae_paper.configuration.command import command
from psfdae_paper.configuration.methods import list_method_groups
from psfdae_paper.configuration.schema import Config

Stars = Annotated[File, "Product of the stage stars."]


def groups_read(name: str = "", **options: object) -> tuple[str, ...]:
    """Return the groups of settings that decide a fit of a method, or of any method.

    Parameters
    ----------
    name : str
        Name of a method; empty for the groups of all methods.
    **options
        The other options of the command, which are not used.
    """
    return list_groups(name) if name else ("seed", "noise", "parts", *list_method_groups())


@command("paper fit", reads=groups_read)
def fit(
    config: Config,
    name: Annotated[str, {"argument": True, "metavar": "METHOD"}],
    stars: Stars,
    split: SplitKind = "random",
    reference: Reference = "realisation",
    start: Folder | None = None,
    checkpoint: File | None = None,
    *,
    out: Annotated[Path, click.Path(path_type=Path)],
) -> None:
    """Fit METHOD, a name of the list `methods` in config.yaml.

    It is trained on the training stars of the split, with noise as its settings say. The same
    settings give the same bytes, whether the fit was interrupted or not.

    Settings of the method are groups of the configuration, such as gmm.components=[4]. The fit
    includes its resolved configuration, by which other stages reject a fit to other stars.

    Parameters
    ----------
    config : Config
        Seed, noise, parts, and settings of the method.
    name : str
        Name of the method.
    stars : Path
        Product of the stage stars.
    split : str
        Split whose training stars the method is fitted to.
    reference : str
        Truth: the star's own noise-free image, or the static PSF of its field.
    start : Path, optional
        Fit to the realisations, from which a fit to templates starts.
    checkpoint : Path, optional
        State of an interrupted fit, if it keeps one.
    out : Path
        Folder or HDF5 product.
    """
    # The class of the method, and as many threads as its settings say.
    method_class = method(name)
    limit_threads(method_class.threads(config))
    # Stars of the split with their noise; the training state is saved next to the fit.
    product = read_stars(stars, fits.get_training_reference(method_class, reference))
    checkpoint_path = checkpoint or fits.path_beside(method_class, out, "checkpoint.pt")
    data = training_set(config, method_class, product, split, reference, checkpoint=checkpoint_path)
    # Warm start: a fit to templates begins with the result of a fit to the realisations.
    if start is not None:
        if reference != "template" or not method_class.continues(config):
            raise click.UsageError(
                "--start: only fits to templates by a method with a warm start take it"
            )
        fits.require_fit(method_class, start, product, config, split, "realisation")
        data = replace(data, start=method_class.load(start))
    # Fit, save with its configuration, and delete the state of the training.
    fit_config = fits.describe_fit(method_class, config.model_dump(), split, reference)
    # The same call as for an astronomer's own stars.
    estimator = method_class.fit(data, **method_class.settings(config))
    fits.store(estimator, out, fit_config, product)
    fits.delete_checkpoints(checkpoint_path)
