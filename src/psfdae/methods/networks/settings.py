"""Settings of the denoising autoencoder and of its training."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from psfdae.base.settings import CheckpointSeconds, Count, Group
from psfdae.methods.bundle_info import check_layers


class DaeSettings(Group):
    """Settings of the denoising autoencoder: kernels, widths, initial weights, scale."""

    kernels: Annotated[list[Annotated[int, Field(ge=1, le=31)]], Field(min_length=2)] = Field(
        [9, 7, 5, 3, 1, 1, 3, 5, 7, 9]
    )
    """Kernel sizes of the convolutions, encoder then decoder; odd."""
    widths: Annotated[list[Count], Field(min_length=1)] = Field(
        [16, 16, 16, 16, 16, 16, 16, 16, 16]
    )
    """Channels between the convolutions, one fewer than kernels."""
    init: Literal["linear", "he", "default"] = "linear"
    """A linear estimator fitted to the stars, He (2015) or PyTorch's default."""
    scale: Literal["mean", "none"] = "mean"
    """'mean' multiplies images by d² (mean pixel 1), 'none' leaves sum 1."""

    @model_validator(mode="after")
    def check_shape(self) -> DaeSettings:
        """Raise ValueError for even kernels, or a wrong number of widths."""
        check_layers(self.kernels, self.widths)
        return self


class Train(Group):
    """Settings of the optimisation of the denoising autoencoder."""

    epochs: Count = 24
    """Passes over the training stars."""
    batch: Count = 32
    """Stars per step."""
    lr: Annotated[float, Field(gt=0, le=1)] = 6.0e-3
    """Adam's learning rate (its maximum if one-cycle)."""
    optimiser: Literal["adam", "muon"] = "muon"
    """Optimiser of the inner layers' weights; all other weights use Adam."""
    level_weight: Annotated[float, Field(ge=0, le=2)] = 1.0
    """Power p of the weight 1/λ^p of a star's squared error; 0: equal weights."""
    schedule: Literal["onecycle", "constant"] = "onecycle"
    """Course of the learning rate."""
    grad_clip: Annotated[float, Field(ge=0)] = 1.0
    """Maximum norm of the gradient; 0 switches clipping off."""
    threads: Count = 1
    """Threads of one training."""
    validate_every: Count = 2
    """Epochs between validations."""
    validation_draws: Count = 1
    """Noise draws per validation star."""
    dead_check_steps: Count = 50
    """Steps between checks for a dead network."""
    restarts: Annotated[int, Field(ge=0)] = 3
    """Restarts with another seed if the network dies."""
    checkpoint_seconds: CheckpointSeconds = 20.0
    """Minimum time between checkpoints; a new value repeats no job."""
    noise: Literal["fresh", "fixed"] = "fresh"
    """Noise drawn anew every epoch, or once for all epochs."""
    crop_epochs: Annotated[float, Field(ge=0, lt=1)] = 0.0
    """First fraction of the epochs, in which only the middle of stamps is used (two thirds of it
    for templates); 0: none."""
    continued_epochs: Annotated[float, Field(ge=0, le=2)] = 1.0
    """Fine-tuning epochs on templates, as a fraction of the epochs on realisations; 0: as many
    epochs as for realisations, with new initial weights."""
    patience: Annotated[int, Field(ge=0)] = 0
    """Stop after this many validations without a better one; 0 never stops."""


def image_scale(scale: Literal["mean", "none"], stamp_px: int) -> float:
    """Return the factor from images of sum 1 to inputs of the network.

    "mean" is d² for stamps of d × d pixels, which makes their mean 1; "none" is 1.
    """
    return float(stamp_px**2) if scale == "mean" else 1.0
