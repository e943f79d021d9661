"""Settings of the network that estimates posterior means, and of its training."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from psfdae.base.settings import CheckpointSeconds, Count, Group

Width = Annotated[int, Field(ge=8, multiple_of=8)]


class PosteriorNetworkSettings(Group):
    """Sizes of the network that estimates posterior means, and the course of its training."""

    width: Width = 512
    """Features between two blocks, all mirror images together."""
    hidden: Width = 1024
    """Features inside a block."""
    blocks: Count = 4
    """Number of blocks."""
    epochs: Count = 40
    """Epochs; each of them simulates further stars."""
    steps: Count = 100
    """Steps of an epoch."""
    stars: Count = 1000
    """Stars that an epoch simulates in addition to those of earlier epochs."""
    batch: Count = 512
    """Noisy stamps per step."""
    lr: Annotated[float, Field(gt=0, le=1)] = 3.0e-3
    """Maximum of the learning rate."""
    schedule: Literal["onecycle", "constant"] = "onecycle"
    """Course of the learning rate."""
    threads: Count = 1
    """Threads of the training."""
    checkpoint_seconds: CheckpointSeconds = 20.0
    """Minimum time between checkpoints; a new value repeats no job."""
