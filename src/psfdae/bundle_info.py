"""Description of a bundle: the text beside its arrays."""

from __future__ import annotations

from itertools import pairwise
from math import isfinite
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

FORMAT_VERSION = 3
"""Version of the format, raised when an older psfdae could not read what a newer one writes."""

NETWORK_KEYS = ("dae", "image_scale")
"""Keys that only the description of a network has."""

METHOD_KEYS = ("method", "reference")
"""Keys that only the description of another method has."""

Positive = Annotated[float, Field(gt=0)]

Count = Annotated[int, Field(ge=1)]

Kernel = Annotated[int, Field(ge=1, le=31)]

Width = Annotated[int, Field(ge=1, le=1024)]


class _Described(BaseModel):
    """Part of the description: immutable, and without unknown keys or infinite numbers."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Architecture(_Described):
    """Shape of the network: kernel sizes of its layers, and channels between them."""

    kernels: Annotated[tuple[Kernel, ...], Field(min_length=2, max_length=100)]
    widths: Annotated[tuple[Width, ...], Field(min_length=1)]

    @model_validator(mode="after")
    def _shape(self) -> Architecture:
        """Refuse even kernels, and widths that do not fit between kernels."""
        if any(kernel % 2 == 0 for kernel in self.kernels):
            raise ValueError(f"kernels {self.kernels}: must be odd")
        if len(self.widths) != len(self.kernels) - 1:
            raise ValueError(f"{len(self.kernels)} kernels, but {len(self.widths)} widths")
        return self

    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Return the shape of every array of weights by its name in the network."""
        shapes: dict[str, tuple[int, ...]] = {}
        layers = zip(pairwise((1, *self.widths, 1)), self.kernels, strict=True)
        for index, ((inputs, outputs), kernel) in enumerate(layers):
            shapes[f"layers.{index}.weight"] = (outputs, inputs, kernel, kernel)
            shapes[f"layers.{index}.bias"] = (outputs,)
        return shapes


class BundleInfo(_Described):
    """Description of a bundle: what its model was trained on, and how well it restores stars.

    Noise is the RMS of the sky noise in a pixel divided by the flux of the star
    inside its stamp, κλ in the words of the simulation. The signal to noise ratio is
    that of a filter matched to the star, 1 / (noise · √A), with the noise-equivalent
    area A (King 1983, PASP 95, 163) of the typical star of the training.
    """

    format_version: Count = FORMAT_VERSION
    psfdae_version: str
    name: Annotated[str, Field(min_length=1, max_length=255)]
    licence: str
    created: Annotated[str, Field(pattern=r"^[0-9]{4}-[0-9]{2}-[0-9]{2}$")]
    stamp_px: Annotated[int, Field(ge=8, le=256, multiple_of=2)]
    pixel_scale_arcsec: Positive
    pixel_lambda_d: Positive | None = Field(description="None where the optics are unknown")
    normalisation: Literal["flux"] = Field("flux", description="stamps have the flux 1")
    image_scale: Positive | None = Field(
        None, description="factor from normalised stamps to the network's"
    )
    # 0-based (row, column) in stamps of side d, without jitter.
    framing: str = "brightest pixel at (d/2, d/2)"
    jitter_px: Annotated[int, Field(ge=0)]
    subpixel: bool = Field(description="stars lay anywhere in their pixels")
    noise_min: Positive
    noise_max: Positive
    snr_min: Positive
    snr_max: Positive
    noise_equivalent_px: Positive = Field(description="A = 1 / ΣPSF² of the typical star")
    components: Annotated[int, Field(ge=1, le=1024)] = Field(
        description="leading eigenvectors: stored, and in the distance"
    )
    training_sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
    training_stars: Count
    source: Literal["simulated", "stars"]
    dae: Architecture | None = None
    method: Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*$", max_length=40)] = "dae"
    reference: Literal["realisation", "template"] | None = Field(
        None, description="What is restored, if the method serves both"
    )
    misfit: Annotated[float, Field(ge=0, allow_inf_nan=False)] = Field(
        0.0, description="what the method takes for noise besides where it finds the flux"
    )
    config: dict[str, Any] = Field(description="resolved configuration of all stages; wings")
    metrics: list[dict[str, float]] = Field(description="errors of the test stars by noise level")

    @model_validator(mode="after")
    def _of_its_format(self) -> BundleInfo:
        """Refuse keys of a network for another method and the reverse, and a missing κ."""
        needed = NETWORK_KEYS if self.dae or self.method == "dae" else METHOD_KEYS
        stated = {*NETWORK_KEYS, *METHOD_KEYS} & self.model_fields_set
        if stated != {*needed} or any(getattr(self, key) is None for key in needed):
            raise ValueError(f"a model of {self.method} has {' and '.join(needed)}")
        if not (self.dae or (self.kappa > 0 and isfinite(self.kappa))):
            raise ValueError("config.train.noise.kappa: must be above 0, methods are given λ by it")
        return self

    @property
    def kappa(self) -> float:
        """Noise at the noise level λ = 1 of the training.

        Where it is not stated: 1 for a network, which needs no λ, and 0, which is refused, for
        other methods.
        """
        try:
            return float(self.config["train"]["noise"]["kappa"])
        except (LookupError, TypeError, ValueError):
            return 1.0 if self.dae else 0.0

    @property
    def adapted(self) -> str | None:
        """Exposure to which the model was adapted after its training, and number of stars used."""
        try:
            stars = self.config["stars"]
            return f"{stars['image']}, by {int(stars['adapted']['stars'])} of its stars"
        except (KeyError, TypeError, ValueError):
            return None

    @property
    def scale_assumed(self) -> bool:
        """True if the pixel scale was assumed, because the training image did not state it."""
        try:
            return bool(self.config["stars"]["telescope"]["assumed"])
        except (LookupError, TypeError):
            return False

    def described(self) -> dict[str, Any]:
        """Return the description as a file of this format has it."""
        absent = {*(METHOD_KEYS if self.dae else NETWORK_KEYS)}
        return self.model_dump(mode="json", exclude=absent if self.misfit else absent | {"misfit"})
