"""Every configuration key with its type, unit, range and meaning.

Lengths are in metres and angles in the unit that their name carries; the
science code receives SI units (`Telescope.pixel_scale` is in radians).
"""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

ARCSEC = np.pi / 180.0 / 3600.0

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Fraction = Annotated[float, Field(ge=0, lt=1)]
Count = Annotated[int, Field(ge=1)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9_]+$")]
Reference = Literal["realisation", "template"]
SplitKind = Literal["random", "held_out"]


class Group(BaseModel):
    """A config group: immutable, and no key beyond those declared."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class Telescope(Group):
    """Aperture, band and detector."""

    name: Name
    diameter_m: Positive = Field(description="Outer diameter of the aperture")
    obscuration: Fraction = Field(description="Linear central obscuration")
    wavelength_m: Annotated[float, Field(gt=1e-8, lt=1e-3)] = Field(
        description="Monochromatic wavelength"
    )
    pixel_scale_arcsec: Positive = Field(description="Width of a pixel on the sky")

    @property
    def pixel(self) -> float:
        """Pixel width in units of λ/D."""
        return self.pixel_scale_arcsec * ARCSEC * self.diameter_m / self.wavelength_m


class Grid(Group):
    """A square grid of field points."""

    points: Count = Field(description="Field points along a side")
    spacing_deg: Positive = Field(description="Distance of neighbouring field points")
    edge_deg: Positive = Field(description="Field angle at which the relative field H is 1")


class Seidel(Group):
    """Static third-order aberrations in waves at H = 1."""

    kind: Literal["seidel"]
    spherical: Finite
    coma: Finite
    astigmatism: Finite
    field_curvature: Finite
    distortion: Finite

    @property
    def coefficients(self) -> np.ndarray:
        """W040, W131, W222, W220, W311 in waves, shape (5,)."""
        return np.array(
            [
                self.spherical,
                self.coma,
                self.astigmatism,
                self.field_curvature,
                self.distortion,
            ]
        )


class VonKarman(Group):
    """Static atmospheric turbulence in layers."""

    kind: Literal["von_karman"]
    seed: Annotated[int, Field(ge=0, lt=2**63)]
    r0_m: Positive = Field(description="Fried parameter of all layers at the telescope's band")
    outer_scale_m: Positive = Field(description="Outer scale L0")
    layer_heights_m: Annotated[list[Annotated[float, Field(ge=0)]], Field(min_length=1)]
    layer_strengths: Annotated[list[Positive], Field(min_length=1)] = Field(
        description="Fraction of the turbulence in each layer"
    )
    waves: Annotated[int, Field(ge=16, multiple_of=8)] = Field(description="Plane waves per layer")
    remove_tilt: bool = Field(description="Remove tip and tilt over the lit pupil")

    @model_validator(mode="after")
    def _layers(self) -> VonKarman:
        if len(self.layer_heights_m) != len(self.layer_strengths):
            raise ValueError(
                f"layer_strengths = {self.layer_strengths}: one for each of the "
                f"{len(self.layer_heights_m)} layer_heights_m"
            )
        if abs(sum(self.layer_strengths) - 1.0) > 1e-6:
            raise ValueError(f"layer_strengths = {self.layer_strengths}: must add up to 1")
        return self


class Scene(Group):
    """A family of static PSFs."""

    name: Literal["seidel", "turbulence"]
    experiment: Name = Field(description="The paper's scene, and the MLflow experiment")


class Stars(Group):
    """A set of noise-free stars, shared by all datasets that only differ in noise."""

    name: Name
    count: Count = Field(description="Number of stars")
    aberration_fraction: Annotated[float, Field(ge=0, le=10)] = Field(
        description="Relative standard deviation of every aberration term"
    )
    search_px: Annotated[int, Field(ge=4, le=512)] = Field(
        description="Search distance for the brightest pixel of a star, as in framing"
    )


class Framing(Group):
    """Stamp size and centring."""

    stamp_px: Annotated[int, Field(ge=8, le=256, multiple_of=2)] = Field(
        description="Side d of a stamp"
    )
    search_px: Annotated[int, Field(ge=4, le=512)] = Field(
        description="A template's brightest pixel is searched within ± this of the chief ray"
    )
    jitter_px: Annotated[int, Field(ge=0, le=8)] = Field(
        description="Centring error, uniform in ± this many whole pixels per axis"
    )
    tie: Annotated[float, Field(ge=0, lt=0.1)] = Field(
        description="Pixels within this fraction of the maximum count as equally bright"
    )
    subpixel: bool = Field(
        description="Pixel grid of every realisation anywhere within ± ½ pixel, as for real stars"
    )


class Optics(Group):
    """Numerical settings of the propagation."""

    pupil_samples: Annotated[list[Annotated[int, Field(ge=16, le=8192)]], Field(min_length=1)] = (
        Field(description="Ladder of grid sizes N; each wavefront takes the first that suffices")
    )
    nodes: Annotated[int, Field(ge=1, le=32)] = Field(
        description="Gauss-Legendre nodes per pixel and axis"
    )
    precision: Literal["complex64", "complex128"]
    backend: Literal["numpy", "torch"]
    batch: Count = Field(description="Wavefronts per batch")
    threads: Count = Field(description="Threads of the linear algebra")

    @model_validator(mode="after")
    def _ascending(self) -> Optics:
        if sorted(set(self.pupil_samples)) != self.pupil_samples:
            raise ValueError(f"pupil_samples = {self.pupil_samples}: must be ascending")
        return self


class Noise(Group):
    """A noise band: the levels λ that one dataset mixes."""

    name: Name
    levels: Annotated[list[Positive], Field(min_length=1)] = Field(
        description="Noise levels λ of the paper"
    )
    kappa: Positive = Field(description="Pixel RMS of the normalised image per unit of λ")
    background_photons: Annotated[float, Field(gt=0, le=1e12)] = Field(
        description="Sky photons per pixel"
    )


class Parts(Group):
    """Sizes of the training, validation and test parts."""

    train_stars: Count = Field(description="Training stars, validation included")
    test_stars: Count = Field(description="Test stars of the random split")
    validation_fraction: Annotated[float, Field(gt=0, le=0.5)] = Field(
        description="Part of the training stars that selects the best state"
    )


class Dataset(Group):
    """A dataset of the paper: stars, a noise band, splits and references."""

    name: Name
    splits: Annotated[list[SplitKind], Field(min_length=1)]
    references: Annotated[list[Reference], Field(min_length=1)]
    shown_levels: Annotated[list[Positive], Field(min_length=1)] = Field(
        description="Noise levels λ of the figure of restored stars; extremes if none is in band"
    )


class Dae(Group):
    """The denoising autoencoder."""

    kernels: Annotated[list[Annotated[int, Field(ge=1, le=31)]], Field(min_length=2)] = Field(
        description="Kernel sizes of the convolutions, encoder then decoder; odd"
    )
    widths: Annotated[list[Count], Field(min_length=1)] = Field(
        description="Channels between the convolutions, one fewer than kernels"
    )
    init: Literal["he", "default"] = Field(description="He (2015) or PyTorch's default")
    scale: Literal["mean", "none"] = Field(
        description="'mean' multiplies images by d² (mean pixel 1), 'none' leaves sum 1"
    )

    @model_validator(mode="after")
    def _shape(self) -> Dae:
        if any(k % 2 == 0 for k in self.kernels):
            raise ValueError(f"kernels = {self.kernels}: must be odd")
        if len(self.widths) != len(self.kernels) - 1:
            raise ValueError(
                f"widths = {self.widths}: {len(self.kernels)} kernels need "
                f"{len(self.kernels) - 1} widths, not {len(self.widths)}"
            )
        return self


class Train(Group):
    """Optimisation of the denoising autoencoder."""

    epochs: Count
    batch: Count = Field(description="Stars per step")
    lr: Annotated[float, Field(gt=0, le=1)] = Field(
        description="Adam's learning rate (its maximum if one-cycle)"
    )
    schedule: Literal["onecycle", "constant"]
    grad_clip: Annotated[float, Field(ge=0)] = Field(
        description="Maximum norm of the gradient; 0 switches clipping off"
    )
    threads: Count = Field(description="Threads of one training")
    validate_every: Count = Field(description="Epochs between validations")
    validation_draws: Count = Field(description="Noise draws per validation star")
    dead_check_steps: Count = Field(description="Steps between looks for a dead network")
    restarts: Annotated[int, Field(ge=0)] = Field(
        description="New starts from another seed if the network dies"
    )
    checkpoint_seconds: Annotated[float, Field(ge=0)] = Field(
        description="Least time between checkpoints"
    )
    noise: Literal["fresh", "fixed"] = Field(
        description="Noise drawn anew every epoch, or once for all epochs"
    )
    patience: Annotated[int, Field(ge=0)] = Field(
        description="Stop after this many validations without a better one; 0 never stops"
    )


class Baseline(Group):
    """PCA features clustered by a self-organising map."""

    components: Count = Field(description="Principal components K")
    rows: Count = Field(description="Rows of the map")
    columns: Count = Field(description="Columns of the map")
    epochs: Count = Field(description="Passes over the training stars, t_max")
    sigma: Positive = Field(description="Initial neighbourhood radius in map nodes")
    learning_rate: Annotated[float, Field(gt=0, le=1)] = Field(
        description="Initial learning rate of the map"
    )
    threads: Count = Field(description="Threads of the linear algebra")


class Evaluation(Group):
    """Image metrics."""

    data_range: Positive = Field(description="SSIM dynamic range fitted to the paper's rows")
    batch: Count = Field(description="Stars per forward pass")
    threads: Count = Field(description="Threads of the linear algebra")


class Calibration(Group):
    """Scan of what the paper leaves open."""

    stars: Count = Field(description="Stars simulated per point of the scan")
    pixel_scales_arcsec: Annotated[list[Positive], Field(min_length=2)] = Field(
        description="Pixel scales scanned, ascending"
    )
    r0_m: Annotated[list[Positive], Field(min_length=1)] = Field(
        description="Fried parameters scanned (scene 2; scene 1 has none)"
    )
    data_ranges: Annotated[list[Positive], Field(min_length=2)] = Field(
        description="SSIM dynamic ranges scanned, ascending"
    )


class Benchmark(Group):
    """Run time against error; needs a quiet machine."""

    repeats: Count = Field(description="Timings of every point; the median is reported")
    stamps: Count = Field(description="Stamps per timing of a kernel")
    peers: bool = Field(description="Time POPPY beside our kernels")
    star_counts: Annotated[list[Count], Field(min_length=2)] = Field(
        description="Numbers of stars at which time, memory and disk are measured, ascending"
    )
    stamp_sizes: Annotated[
        list[Annotated[int, Field(ge=8, le=256, multiple_of=2)]], Field(min_length=2)
    ] = Field(description="Stamp sides at which cost is measured, ascending")
    threads: Count = Field(description="Largest number of threads timed")


class Stability(Group):
    """Stress tests of the whole chain."""

    stars: Count = Field(description="Stars simulated for the tests")
    seeds: Annotated[int, Field(ge=2)] = Field(description="Short trainings from other seeds")
    epochs: Count = Field(description="Epochs of a short training")
    threads: Count = Field(description="Threads of the linear algebra")


class Bounds(Group):
    """Best possible estimates."""

    bank_stars: Count = Field(description="Fresh draws of the simulator in the bank")
    test_stars: Count = Field(description="Test stars that are bounded, the first of the part")
    threads: Count = Field(description="Threads of the linear algebra")


class Workflow(Group):
    """What the default target of the workflow builds."""

    datasets: Annotated[list[Name], Field(min_length=1)]


class Config(Group):
    """The whole configuration of one dataset."""

    seed: Annotated[int, Field(ge=0, lt=2**63)]
    workflow: Workflow
    scene: Scene
    telescope: Telescope
    grid: Grid
    wavefront: Annotated[Seidel | VonKarman, Field(discriminator="kind")]
    stars: Stars
    framing: Framing
    optics: Optics
    noise: Noise
    parts: Parts
    dataset: Dataset
    dae: Dae
    train: Train
    baseline: Baseline
    evaluation: Evaluation
    calibration: Calibration
    benchmark: Benchmark
    stability: Stability
    bounds: Bounds

    @model_validator(mode="after")
    def _consistent(self) -> Config:
        used = self.parts.train_stars + self.parts.test_stars
        if used > self.stars.count:
            raise ValueError(
                f"parts.train_stars + parts.test_stars = {used}: "
                f"must be at most stars.count = {self.stars.count}"
            )
        if self.framing.subpixel and "template" in self.dataset.references:
            raise ValueError(
                "framing.subpixel = true: templates have no sub-pixel phase, "
                "dataset.references must be [realisation]"
            )
        if self.framing.subpixel and self.stars.aberration_fraction == 0:
            raise ValueError(
                "framing.subpixel = true: stars.aberration_fraction must be above 0, "
                "stars without random aberrations are their templates"
            )
        if self.baseline.components > self.framing.stamp_px**2:
            raise ValueError(
                f"baseline.components = {self.baseline.components}: must be at most "
                f"framing.stamp_px² = {self.framing.stamp_px**2}"
            )
        return self
