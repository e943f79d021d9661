"""Description of a bundle: the metadata of its arrays."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

FORMAT_VERSION = 2
"""Version of the format, raised when an older psfdae could not read the files of a newer one."""

Positive = Annotated[float, Field(gt=0)]

Count = Annotated[int, Field(ge=1)]

Kernel = Annotated[int, Field(ge=1, le=31)]

Width = Annotated[int, Field(ge=1, le=1024)]


def check_layers(kernels: Sequence[int], widths: Sequence[int]) -> None:
    """Raise ValueError for even kernels of a network, or a wrong number of widths between them."""
    if any(kernel % 2 == 0 for kernel in kernels):
        raise ValueError(f"kernels = {[*kernels]}: must be odd")
    if len(widths) != len(kernels) - 1:
        raise ValueError(
            f"widths = {[*widths]}: {len(kernels)} kernels need {len(kernels) - 1} widths, not "
            f"{len(widths)}"
        )


class _Described(BaseModel):
    """Part of the description: immutable, and without unknown keys or infinite numbers."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Architecture(_Described):
    """Shape of the network: kernel sizes of its layers, and channels between them."""

    kernels: Annotated[tuple[Kernel, ...], Field(min_length=2, max_length=100)]
    widths: Annotated[tuple[Width, ...], Field(min_length=1)]

    @model_validator(mode="after")
    def _check_layers(self) -> Architecture:
        check_layers(self.kernels, self.widths)
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
    """Description of a bundle: training data, range of validity, and errors of test stars.

    Noise is the RMS of the sky noise in a pixel divided by the flux of the star inside its stamp,
    κλ in the notation of the simulation. The S/N for flux 1 is the S/N of a filter matched to the
    star, 1 / (noise · √A), with the noise-equivalent area A (King 1983, PASP 95, 163) of the
    typical star of the training.
    """

    psfdae_version: str
    name: Annotated[str, Field(min_length=1, max_length=255)]
    licence: str
    created: Annotated[str, Field(pattern=r"^[0-9]{4}-[0-9]{2}-[0-9]{2}$")]
    stamp_px: Annotated[int, Field(ge=8, le=256, multiple_of=2)]
    pixel_scale_arcsec: Positive
    pixel_lambda_d: Positive | None
    """Side of a pixel over wavelength / aperture diameter; None where the optics are unknown."""
    image_scale: Positive | None = None
    """Factor by which stamps of flux 1 are multiplied before they enter the network."""
    jitter_px: Annotated[int, Field(ge=0)]
    """The brightest pixel is within this of (d/2, d/2), row and column from 0."""
    subpixel: bool
    """Centres of the training stars lay anywhere in their pixels, not only in the middle."""
    kappa: Positive
    """Noise at the noise level λ = 1 of the training."""
    noise_min: Positive
    """Minimum noise of the training."""
    noise_max: Positive
    """Maximum noise of the training."""
    snr_min: Positive
    """S/N of the typical star at the maximum noise."""
    snr_max: Positive
    """S/N of the typical star at the minimum noise."""
    noise_equivalent_px: Positive
    """A = 1 / ΣPSF² of the typical star."""
    components: Annotated[int, Field(ge=1, le=1024)]
    """Number of stored leading eigenvectors of the training stars, in which the distance of a star
    from the training stars is measured."""
    training_sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
    training_stars: Count
    source: Literal["simulated", "stars"]
    dae: Architecture | None = None
    """Shape of the denoising autoencoder; None for other methods."""
    method: Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*$", max_length=40)]
    reference: Literal["realisation", "template"]
    """Image that is restored."""
    config: dict[str, Any]
    """Resolved configuration of all stages, and the wings in the form of Wings.plain."""
    metrics: list[dict[str, float]]
    """Errors of the test stars by noise level."""

    def __repr_args__(self) -> Iterator[tuple[str, Any]]:
        """Yield the fields that distinguish models, for the text form of a description."""
        # pydantic shows the fields that are yielded here.
        for name in ("name", "method", "stamp_px", "pixel_scale_arcsec", "training_stars"):
            yield name, getattr(self, name)

    @model_validator(mode="after")
    def _is_network_or_not(self) -> BundleInfo:
        """Raise ValueError if a network lacks shape or scale, or another method has one of them."""
        # A network has both, and another method neither.
        is_network = self.method == "dae"
        if {self.dae is not None, self.image_scale is not None} != {is_network}:
            raise ValueError("a network, and no other method, has dae and image_scale")
        return self

    @property
    def adapted(self) -> str | None:
        """Text with the exposure to which the model was adapted, and the number of stars.

        None for a model that was not adapted.
        """
        try:
            stars = self.config["stars"]
            return f"{stars['image']}, by {int(stars['adapted']['stars'])} of its stars"
        except (KeyError, TypeError, ValueError):
            return None

    @property
    def scale_assumed(self) -> bool:
        """True if the pixel scale was assumed, because the training image does not give it."""
        try:
            return bool(self.config["stars"]["telescope"]["assumed"])
        except (LookupError, TypeError):
            return False
