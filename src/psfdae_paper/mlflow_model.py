"""Models of runs as `mlflow.pyfunc` loads them: a fit, and what its stars say of stars.

A folder holds the files of the fit as they are and `FACTS`, of which loading makes a model
bundle without errors: to measure these takes a minute (`psfdae bundle`), and no PSF depends on
them.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from psfdae import fits
from psfdae.files import Column, Product, read_product, write_product
from psfdae.method import FindsFlux
from psfdae.methods import method
from psfdae.model.bundle import SUFFIX, write_bundle
from psfdae.model.packing import FEW_STARS, HeldOutStars, StarFacts, without_errors
from psfdae.model.photometry import FluxModel
from psfdae.model.psf_model import PsfModel, load_model
from psfdae.noise import NoiseModel
from psfdae_paper.configuration.compose import part
from psfdae_paper.tracking import Fit

FACTS = "stars.h5"
KIND = "facts of stars"
FLUX = {
    "mean": "mean PSF of the training stars",
    "basis": "leading eigenvectors of their covariance",
    "variance": "its eigenvalues",
    "low": "least value of every pixel",
    "high": "greatest value of every pixel",
}
HELD_OUT = {"images": "stars that were held out", "references": "what is to be restored of them"}
READS = ("seed", "noise", "parts")


class Restorer:
    """A model of PSFs as MLflow calls it."""

    def __init__(self, model: PsfModel) -> None:
        self.model = model

    def predict(self, model_input: np.ndarray, params: Mapping[str, Any] | None = None) -> Any:
        """PSFs of stamps (n, d, d), times their fluxes; stamps are in any unit, sky included."""
        return self.model.predict(model_input).psf


def _load_pyfunc(path: str) -> Restorer:
    """What `mlflow.pyfunc.load_model` asks for; raises ProductError if a file is damaged."""
    return Restorer(_model(Path(path)))


def facts_of(stars: Product, described: Mapping[str, Any], reference: str) -> StarFacts:
    """What the stars say of stars of which a fit is, by its resolved configuration."""
    config = part(READS, {group: described[group] for group in READS})
    return StarFacts.of(stars, reference, config, described)


def write_facts(facts: StarFacts, fit: Fit, reference: str, name: str, folder: Path) -> None:
    """Write `FACTS` into a folder with the files of a fit that restores a reference.

    The model will have the given name.
    """
    model, held_out = facts.flux_model, facts.held_out
    kept = {key: getattr(model, key) for key in FLUX}
    for key in ("basis", "variance"):
        kept[key] = kept[key][..., -facts.info["components"] :]
    columns = {key: Column(kept[key], "1", about) for key, about in FLUX.items()}
    # Methods that find the flux need some stars to tell how well they do.
    few = FEW_STARS if issubclass(fit.kind, FindsFlux) else 0
    images, references = held_out.images[:few], held_out.references[:few]
    if reference == "realisation":  # one array under two names is stored once
        references = images
    for (key, about), stars in zip(HELD_OUT.items(), (images, references), strict=True):
        columns[key] = Column(stars, "1", about)
    said = {
        "method": fit.kind.name,
        "place": "" if fits.storage_of(fit.kind).files else fit.place.name,
        "reference": reference,
        "name": name,
        "rest": float(model.variance[0]),
        "kappa": held_out.noise.kappa,
        "background_photons": held_out.noise.background,
        "levels": facts.levels.tolist(),
        "seed": facts.seed,
        "info": dict(facts.info),
    }
    write_product(folder / FACTS, KIND, columns, said)


def _model(folder: Path) -> PsfModel:
    """The model of a folder, as a bundle would give it."""
    product = read_product(folder / FACTS, KIND)
    said = product.config
    images, references = (product[key] for key in HELD_OUT)
    noise, none = NoiseModel(said["kappa"], said["background_photons"]), np.zeros(len(images))
    facts = StarFacts(
        said["info"],
        FluxModel(**{key: product[key] for key in FLUX}, rest=said["rest"]),
        # Simulated stars have no noise of their own, and no grid is asked for.
        HeldOutStars(
            images,
            references,
            noise,
            np.full((len(images), 2), np.nan),
            none,
            np.zeros_like(images),
        ),
        np.array(said["levels"]),
        said["seed"],
    )
    fitted = method(said["method"]).load(folder / said["place"], said["reference"])
    # A file rounds arrays: what is read from it restores as what `psfdae predict` reads.
    with tempfile.TemporaryDirectory() as temporary:
        path = Path(temporary, f"{said['name']}{SUFFIX}")
        bundle = without_errors(fitted, facts, said["reference"], said["name"], "not stated")
        write_bundle(bundle, path)
        return load_model(path)
