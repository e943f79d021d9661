"""Configuration of scene 3, the alignment of a secondary mirror (`dataset=alignment`).

Groups of the telescope's states, of the networks that estimate them and of the maximum-likelihood
fit, and the keys that decide which products belong together.
"""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field, model_validator

from psfdae.base.settings import CheckpointSeconds, Count, Group, Positive


class Alignment(Group):
    """States of misalignment, fields, stamps and sets of states.

    A state has four numbers: decentre x, y and tilt x, y of the secondary mirror, in units of their
    ranges from −1 to 1.

    Attributes
    ----------
    choice : tuple of str
        Override that chooses scene 3 among the datasets.
    state_groups : tuple of str
        Groups of the configuration that decide the stamps of states.
    wavefront_keys, stamp_keys : tuple of str
        Keys that decide the wavefront of a state, and its stamps. Products that differ in one of
        them do not belong together.
    """

    choice: ClassVar = ("dataset=alignment",)
    state_groups: ClassVar = ("seed", "telescope", "prescription", "alignment", "optics")
    wavefront_keys: ClassVar = (
        *("telescope.diameter_m", "telescope.obscuration", "telescope.wavelength_m"),
        *("prescription", "alignment.decenter_range_m", "alignment.tilt_range_deg"),
        *("alignment.defocus_m", "alignment.field_radius_deg", "alignment.field_points"),
        "alignment.highest_zernike",
    )
    stamp_keys: ClassVar = (*wavefront_keys, "telescope.pixel_scale_arcsec", "alignment.stamp_px")

    # The paper's ranges (section 3.3).
    decenter_range_m: Annotated[float, Field(gt=0, le=0.01)] = 1e-3
    """Decentre of the secondary in x and y: ± this."""
    tilt_range_deg: Annotated[float, Field(gt=0, le=1)] = 0.1
    """Tilt of the secondary about x and y: ± this."""
    # In focus an astigmatic image is nearly the same for opposite signs of the astigmatism, so a
    # tilt and its opposite, each with a matching decentre, give nearly the same nine stamps; a
    # known defocus (0.3 waves RMS) separates them. The paper only says that the CCD stays in a
    # fixed position.
    defocus_m: Annotated[float, Field(ge=-0.01, le=0.01)] = 2e-4
    """Fixed distance of the CCD beyond best focus."""
    field_radius_deg: Annotated[float, Field(gt=0, le=5)] = 0.5
    """Radius of the circle of field points; one more is in the centre."""
    field_points: Annotated[int, Field(ge=1, le=64)] = 8
    """Field points on the circle."""
    # Terms of higher order are small in this telescope; few terms make the model fast.
    highest_zernike: Annotated[int, Field(ge=11, le=28)] = 22
    """Highest Noll index of the wavefront."""
    model_tolerance_waves: Positive = 5e-4
    """Largest RMS by which the quadratic model may differ from ray tracing."""
    # Stamps are centred on the centroid and not jittered, so that no shift has to be estimated.
    stamp_px: Annotated[int, Field(ge=8, le=64, multiple_of=2)] = 16
    """Side d of a stamp, centred on the image's centroid."""
    least_energy: Annotated[float, Field(gt=0, lt=1)] = 0.9
    """A stamp with less than this part of the light is rejected."""
    # 5 levels in each of 4 degrees of freedom: the paper's 625 states.
    grid_levels: Annotated[int, Field(ge=2, le=9)] = 5
    """Levels per degree of freedom of the grid of states."""
    # As many states as the grid has, but drawn at random.
    test_states: Count = 625
    """Uniform states of the independent test set."""
    train_states: Count = 12000
    """Uniform states of the large training set."""

    @property
    def unit(self) -> np.ndarray:
        """Ranges of decentre x, y in metres and tilt x, y in radians, shape (4,).

        States times this are the decentres and tilts of the mirror in SI units.
        """
        # Both axes have the same ranges.
        tilt = np.deg2rad(self.tilt_range_deg)
        return np.array([self.decenter_range_m, self.decenter_range_m, tilt, tilt])


class Cnn(Group):
    """Convolutions and a linear layer, the paper's network (section 3.3)."""

    # The paper does not give them; with these its training takes less than a minute.
    widths: Annotated[list[Count], Field(min_length=1)] = Field([64, 64, 128, 128, 128])
    """Channels after every convolution."""
    kernels: Annotated[list[Annotated[int, Field(ge=1, le=15)]], Field(min_length=1)] = Field(
        [5, 3, 3, 3, 3]
    )
    """Kernel sizes of the convolutions; odd."""
    strides: Annotated[list[Annotated[int, Field(ge=1, le=4)]], Field(min_length=1)] = Field(
        [2, 1, 2, 1, 2]
    )
    """Strides of the convolutions."""
    # A neuron that is never active would not be trained otherwise.
    leak: Annotated[float, Field(ge=0, lt=1)] = 0.01
    """Slope of the leaky ReLU below 0."""

    @model_validator(mode="after")
    def check_layers(self) -> Cnn:
        """Require odd kernels, and as many kernels and strides as widths.

        Raises
        ------
        ValueError
            With the list that is wrong.
        """
        # An even kernel would shift the image by half a pixel.
        if any(side % 2 == 0 for side in self.kernels):
            raise ValueError(f"kernels = {self.kernels}: must be odd")
        # Each convolution has a width, a kernel and a stride.
        for name in ("kernels", "strides"):
            values = getattr(self, name)
            # A list that is too short would drop layers.
            if len(values) != len(self.widths):
                raise ValueError(
                    f"{name} = {values}: {len(self.widths)} widths need as many {name}, "
                    f"not {len(values)}"
                )
        return self


class Perceptron(Group):
    """Fully connected layers after the stamps' leading principal components; not in the paper."""

    # Fewer inputs than pixels, so that layers may be fully connected.
    components: Count = 128
    """Principal components of all stamps of a state together."""
    widths: Annotated[list[Count], Field(min_length=1)] = Field([512, 256])
    """Neurons of every inner layer."""


NETWORKS: dict[str, type[Cnn] | type[Perceptron]] = {"cnn": Cnn, "perceptron": Perceptron}
"""Groups of the configuration that are the settings of a network."""


class NetworkTrain(Group):
    """Optimisation of one network by Adam; the loss is the mean squared error of the states.

    The defaults are the paper's, lr = 1e-3 × 0.1^⌊epoch/30⌋.
    """

    # Network and length of the training.
    network: Literal["cnn", "perceptron"] = "cnn"
    """Network that is trained."""
    epochs: Count = 100
    """Passes over the training states."""
    batch: Annotated[int, Field(ge=2)] = 10
    """States per step."""
    # Course of the optimisation.
    lr: Annotated[float, Field(gt=0, le=1)] = 1e-3
    """Adam's learning rate (its maximum if one-cycle)."""
    schedule: Literal["steps", "onecycle"] = "steps"
    """Course of the learning rate."""
    decay: Annotated[float, Field(gt=0, le=1)] = 0.1
    """Factor of the learning rate at each step of the schedule."""
    decay_epochs: Count = 30
    """Epochs between steps of the schedule."""
    # Augmentation of the training states.
    mirrors: bool = False
    """Train on the telescope's mirror images and average estimates over them."""
    noise_draws: Count = 1
    """Draws of each field's noise for a training on the DAE's output, whose computation takes long;
    noisy stamps get new noise in every epoch."""
    # These change no result but by rounding.
    threads: Count = 1
    """Threads of the training."""
    checkpoint_seconds: CheckpointSeconds = 20.0
    """Least time between checkpoints; repeats nothing."""


class Fit(Group):
    """Maximum-likelihood fit of a state: Levenberg steps to the maximum of the likelihood.

    Stamps of a trial state are interpolated between computed ones, but for the last step.
    """

    # With more states the fit is slower, and closer to the exact optics.
    neighbours: Annotated[int, Field(ge=5, le=1000)] = 60
    """Computed states that a stamp is interpolated from, in all but the last step."""
    # Without these states, estimates at the edge of the range would be less accurate.
    outer_states: Count = 400
    """States beyond the range that are computed for it."""
    # A fit ends by its tolerance, or here.
    iterations: Count = 12
    """Most steps of a fit."""
    # After a step of 0.3 standard errors, a few hundredths remain to the maximum.
    tolerance: Positive = 0.3
    """A step of this many standard errors or fewer is the last."""
    # Relative to the diagonal of the information matrix.
    damping: Positive = 1e-3
    """Levenberg damping of the first step."""
    limit: Annotated[float, Field(ge=1, le=2)] = 1.25
    """States are kept within ± this, in units of the range."""
