"""Configuration of scene 3, the alignment of a secondary mirror (`config/alignment.yaml`).

It is a root of its own: nothing of it exists in a dataset's configuration, and
groups of the same name mean the same in both.
"""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from psfdae.networks.settings import DaeSettings, Train
from psfdae.settings import CheckpointSeconds, Count, Evaluation, Group, Noise, Positive
from psfdae_paper.configuration.base import PupilSamples
from psfdae_paper.configuration.telescope import Telescope
from psfdae_paper.configuration.wavefront import Prescription


class AlignmentOptics(Group):
    """Numerical settings of the propagation by the whole period of the image."""

    pupil_samples: PupilSamples = Field(
        description="Grid sizes N, ascending; each wavefront takes the first that suffices"
    )
    precision: Literal["complex64", "complex128"] = Field(description="Of the propagation")
    batch: Count = Field(description="Wavefronts per batch")
    threads: Count = Field(description="Batches at once")


class Alignment(Group):
    """States of misalignment, fields, stamps and sets of states."""

    decenter_range_m: Annotated[float, Field(gt=0, le=0.01)] = Field(
        description="Decentre of the secondary in x and y: ± this"
    )
    tilt_range_deg: Annotated[float, Field(gt=0, le=1)] = Field(
        description="Tilt of the secondary about x and y: ± this"
    )
    defocus_m: Annotated[float, Field(ge=-0.01, le=0.01)] = Field(
        description="Fixed distance of the CCD beyond best focus"
    )
    field_radius_deg: Annotated[float, Field(gt=0, le=5)] = Field(
        description="Radius of the circle of field points; one more is in the centre"
    )
    field_points: Annotated[int, Field(ge=1, le=64)] = Field(
        description="Field points on the circle"
    )
    highest_zernike: Annotated[int, Field(ge=11, le=28)] = Field(
        description="Highest Noll index of the wavefront"
    )
    model_tolerance_waves: Positive = Field(
        description="Largest RMS by which the quadratic model may differ from ray tracing"
    )
    stamp_px: Annotated[int, Field(ge=8, le=64, multiple_of=2)] = Field(
        description="Side d of a stamp, centred on the image's centroid"
    )
    least_energy: Annotated[float, Field(gt=0, lt=1)] = Field(
        description="A stamp that holds less of the light is refused"
    )
    grid_levels: Annotated[int, Field(ge=2, le=9)] = Field(
        description="Levels per degree of freedom of the grid of states"
    )
    test_states: Count = Field(description="Uniform states of the independent test set")
    train_states: Count = Field(description="Uniform states of the large training set")

    @property
    def unit(self) -> np.ndarray:
        """Ranges of decentre x, y in metres and tilt x, y in radians, shape (4,)."""
        tilt = np.deg2rad(self.tilt_range_deg)
        return np.array([self.decenter_range_m, self.decenter_range_m, tilt, tilt])


class Cnn(Group):
    """Convolutions and a linear layer, the paper's network."""

    widths: Annotated[list[Count], Field(min_length=1)] = Field(
        description="Channels after every convolution"
    )
    kernels: Annotated[list[Annotated[int, Field(ge=1, le=15)]], Field(min_length=1)] = Field(
        description="Kernel sizes of the convolutions; odd"
    )
    strides: Annotated[list[Annotated[int, Field(ge=1, le=4)]], Field(min_length=1)] = Field(
        description="Strides of the convolutions"
    )
    leak: Annotated[float, Field(ge=0, lt=1)] = Field(description="Slope of the leaky ReLU below 0")

    @model_validator(mode="after")
    def _shape(self) -> Cnn:
        if any(k % 2 == 0 for k in self.kernels):
            raise ValueError(f"kernels = {self.kernels}: must be odd")
        for name in ("kernels", "strides"):
            values = getattr(self, name)
            if len(values) != len(self.widths):
                raise ValueError(
                    f"{name} = {values}: {len(self.widths)} widths need as many {name}, "
                    f"not {len(values)}"
                )
        return self


class Perceptron(Group):
    """Fully connected layers behind the stamps' leading principal components."""

    components: Count = Field(description="Principal components of all stamps of a state together")
    widths: Annotated[list[Count], Field(min_length=1)] = Field(
        description="Neurons of every inner layer"
    )


NETWORKS = {"cnn": Cnn, "perceptron": Perceptron}
"""Groups of the configuration that are the settings of a network."""


class NetworkTrain(Group):
    """Optimisation of one network."""

    network: Literal["cnn", "perceptron"] = Field(description="Which one is trained")
    epochs: Count = Field(description="Passes over the training states")
    batch: Annotated[int, Field(ge=2)] = Field(description="States per step")
    lr: Annotated[float, Field(gt=0, le=1)] = Field(
        description="Adam's learning rate (its maximum if one-cycle)"
    )
    schedule: Literal["steps", "onecycle"] = Field(description="Course of the learning rate")
    decay: Annotated[float, Field(gt=0, le=1)] = Field(
        description="Factor of the learning rate at each step of the schedule"
    )
    decay_epochs: Count = Field(description="Epochs between steps of the schedule")
    mirrors: bool = Field(
        description="Train on the telescope's mirror images and average estimates over them"
    )
    noise_draws: Count = Field(
        description="Draws of each field's noise where the DAE's output is learnt, whose "
        "computation takes long; noisy stamps get new noise in every epoch"
    )
    threads: Count = Field(description="Threads of the training")
    checkpoint_seconds: CheckpointSeconds = Field(
        description="Least time between checkpoints; repeats nothing"
    )


class Fit(Group):
    """Maximum-likelihood fit of a state."""

    neighbours: Annotated[int, Field(ge=5, le=1000)] = Field(
        description="Computed states that a stamp is interpolated from, in all but the last step"
    )
    outer_states: Count = Field(description="States beyond the range that are computed for it")
    iterations: Count = Field(description="Most steps of a fit")
    tolerance: Positive = Field(
        description="A step of this many standard errors or fewer is the last"
    )
    damping: Positive = Field(description="Levenberg damping of the first step")
    limit: Annotated[float, Field(ge=1, le=2)] = Field(
        description="States are kept within ± this, in units of the range"
    )


def _misaligned(prescription: Prescription) -> Prescription:
    if prescription.secondary is None:
        raise ValueError("secondary: missing, nothing else can be misaligned")
    return prescription


class AlignmentConfig(Group):
    """The whole configuration of scene 3."""

    seed: Annotated[int, Field(ge=0, lt=2**63)] = Field(description="Of every random draw")
    telescope: Telescope
    prescription: Annotated[Prescription, AfterValidator(_misaligned)]
    alignment: Alignment
    optics: AlignmentOptics
    noise: Noise
    dae: DaeSettings
    dae_train: Train
    cnn: Cnn
    perceptron: Perceptron
    train_original: NetworkTrain
    train_noise_trained: NetworkTrain
    train_dae_retrained: NetworkTrain
    evaluation: Evaluation
    fit: Fit


OF_STATES = ("seed", "telescope", "prescription", "alignment", "optics")
"""Groups that decide the stamps of states."""

DETECTOR = ("telescope.pixel_scale_arcsec", "alignment.stamp_px")
STATES = (
    *("telescope.diameter_m", "telescope.obscuration", "telescope.wavelength_m", "prescription"),
    *("alignment.decenter_range_m", "alignment.tilt_range_deg", "alignment.defocus_m"),
    *("alignment.field_radius_deg", "alignment.field_points", "alignment.highest_zernike"),
)
"""What decides the wavefront of a state of scene 3."""

STATE_STAMPS = (*STATES, *DETECTOR)
"""What decides the stamps of a state of scene 3."""
