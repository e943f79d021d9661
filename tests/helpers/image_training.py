"""A small simulated image and what `train` makes of it: one training for all tests."""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest
from click.testing import CliRunner

from psfdae import load_model
from psfdae.commands.cli import main
from psfdae.training import calibration
from psfdae_paper.stages import simulate
from psfdae_paper.stars.example import ExampleField, FieldRecipe, example_field

RECIPE = {"side_px": 700, "bright": 60, "faint": 80, "blended": 6, "saturated": 3}
SEED = 5
SIZES = {"train_stars": 120, "test_stars": 40}
SIZE_WORDS = [f"parts.{name}={value}" for name, value in SIZES.items()]
MIXTURE = {"components": [1, 8], "shrinkage": [30.0, 10.0], "principal": 8}
FIELD = {"orders": [0, 1], "modes": 8, "step_px": 0.5}
WORDS = [
    *SIZE_WORDS,
    *(f"gmm.{name}={value}" for name, value in MIXTURE.items()),
    *(f"field.{name}={value}" for name, value in FIELD.items()),
]


@contextmanager
def few_draws():
    """Errors of models are measured at three levels of noise, on few noisy images."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(calibration, "NODES", 3)
        patch.setattr(calibration.HeldOutStars, "min_images", 40)
        yield


@dataclass(frozen=True)
class Training:
    """Files of a finished training; tests only read them."""

    folder: Path

    @property
    def image(self):
        return self.folder / "image.fits"

    @property
    def catalogue(self):
        return self.folder / "stars.csv"

    @property
    def out(self):
        return self.folder / "model"

    @property
    def bundle(self):
        return self.out / "image.psf.safetensors"

    @property
    def page(self):
        return self.folder / "page.html"

    @property
    def output(self):
        """Lines that the command printed."""
        return (self.folder / "output.txt").read_text(encoding="utf-8")

    @property
    def model(self):
        return load_model(self.bundle)

    @property
    def words(self):
        """The input, as a command takes it."""
        return [str(self.image), "--catalogue", str(self.catalogue)]

    def truth(self) -> ExampleField:
        """The simulated stars, without noise."""
        return example_field(FieldRecipe(**RECIPE), SEED)

    def make(self):
        simulate.write_example(self.image, self.catalogue, seed=SEED, **RECIPE)
        words = [*self.words, "--out", str(self.out), "--report", str(self.page), *WORDS]
        with few_draws(), pytest.MonkeyPatch.context() as patch:
            patch.setenv("SOURCE_DATE_EPOCH", "0")
            result = CliRunner().invoke(main, ["train", *words])
        assert result.exit_code == 0, result.output
        (self.folder / "output.txt").write_text(result.output, encoding="utf-8")
