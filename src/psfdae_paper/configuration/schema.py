"""Every configuration key with its type, unit, range and meaning.

A class is a group of `config/`, and a field of it one key; files hold only values other than the
defaults here. `Config` has all groups, and checks the values of each group against other groups.

Lengths are in metres and angles in the unit that their name carries; the science code receives SI
units (`Telescope.pixel_scale` is in radians).
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import BeforeValidator, Field, create_model, field_validator, model_validator

from psfdae.base.settings import (
    CalibrationStars,
    Count,
    Evaluation,
    Group,
    Name,
    Noise,
    Parts,
    Positive,
    Reference,
    Seed,
    SplitKind,
    Stamp,
)
from psfdae.methods import MethodNames
from psfdae.methods.interface import Method
from psfdae.methods.networks.settings import DaeSettings, Train
from psfdae.telescope.aberrations import Prescription, Seidel
from psfdae.telescope.settings import AnyTelescope
from psfdae_paper.configuration.alignment import Alignment, Cnn, Fit, NetworkTrain, Perceptron
from psfdae_paper.configuration.base import SearchDistance, get_search_distance
from psfdae_paper.configuration.consistency import Consistent
from psfdae_paper.configuration.estimators import list_trained_networks
from psfdae_paper.configuration.methods import list_methods
from psfdae_paper.configuration.wavefront import OfTelescope, VonKarman


class Grid(Group):
    """A square grid of field points: the directions in which static PSFs are computed.

    Every star lies at one of them. Angles are from the optical axis.
    """

    # Null values are derived in `consistency`.
    points: Count
    """Field points along a side."""
    spacing_deg: Positive
    """Distance of neighbouring field points; null: the outermost lie at edge_deg."""
    edge_deg: Positive
    """Field angle at which the relative field H is 1; null: the edge of the telescope's field."""


class Scene(Group):
    """A family of static PSFs with one cause of the telescope's aberrations."""

    name: Literal["seidel", "turbulence", "telescope"]
    """Module that makes its wavefronts."""
    experiment: Name
    """The paper's scene, and the MLflow experiment."""


class Stars(Group):
    """A set of noise-free stars, shared by all datasets that only differ in noise.

    A star has the aberrations of its field, each times 1 + `aberration_fraction` · N(0, 1).
    """

    name: Name
    """Names the file of the stars."""
    # Stars of all splits together.
    count: Count
    """Number of stars."""
    # The paper's 10 and 50 %; 0 makes every star its template.
    aberration_fraction: Annotated[float, Field(ge=0, le=10)]
    """Relative standard deviation of every aberration term."""
    search_px: Annotated[int, Field(ge=4, le=512)]
    """Search distance for the brightest pixel of a star; null: search_lambda_d."""
    search_lambda_d: SearchDistance = get_search_distance()
    """The same in λ/D of whatever telescope, if search_px is null."""


class Framing(Stamp):
    """Stamps of simulated stars: their brightest pixel is in the middle, up to a centring error.

    Side, centring error and sub-pixel position are keys of `Stamp`, which own images have, too.
    """

    search_px: Annotated[int, Field(ge=4, le=512)]
    """A template's brightest pixel is searched within ± this of the chief ray; null:
    search_lambda_d."""
    search_lambda_d: SearchDistance = get_search_distance()
    """The same in λ/D of whatever telescope, if search_px is null."""
    # Mirror-symmetric PSFs have equal maxima, between which rounding would choose.
    tie: Annotated[float, Field(ge=0, lt=0.1)]
    """Pixels within this fraction of the maximum count as equally bright."""


class WholePeriodOptics(Group):
    """Numerical settings of the propagation by the whole period of the image, of scene 3.

    A pupil of N samples gives an image that repeats after N λ/D. Results depend on precision and
    number of samples, and by rounding on batch and threads.
    """

    pupil_samples: Annotated[list[Annotated[int, Field(ge=16, le=8192)]], Field(min_length=1)]
    """Grid sizes N, ascending; each wavefront takes the first that suffices."""
    precision: Literal["complex64", "complex128"]
    """Precision of the propagation."""
    # More per batch need more memory.
    batch: Count
    """Wavefronts per batch."""
    threads: Count
    """Batches in parallel, each with one thread of linear algebra."""

    @field_validator("pupil_samples")
    @classmethod
    def check_order(cls, grid_sizes: list[int]) -> list[int]:
        """Require ascending grid sizes, so that the first that suffices is the smallest one.

        Raises
        ------
        ValueError
            With the list that is not ascending, or has a size twice.
        """
        if sorted(set(grid_sizes)) != grid_sizes:
            raise ValueError(f"{grid_sizes} must be ascending")
        return grid_sizes


class Optics(WholePeriodOptics):
    """Numerical settings of the propagation by matrix products, which computes stamps only."""

    # Both give the same results but for rounding.
    backend: Literal["numpy", "torch"]
    """Library of the matrix products."""


def check_optics(tree: object) -> object:
    """Check settings of the optics by the class that has their keys.

    Scene 3 propagates the whole period of the image, without a choice of the backend.

    Parameters
    ----------
    tree : object
        The group `optics` as YAML has it.

    Returns
    -------
    Optics or WholePeriodOptics
        Checked settings; anything but a mapping is returned unchanged, and rejected by its type.
    """
    if not isinstance(tree, Mapping):
        return tree
    return (Optics if "backend" in tree else WholePeriodOptics).model_validate(tree)


if TYPE_CHECKING:
    # Every dataset with a scene has it (`Consistent`); scene 3 reads the base class only.
    AnyOptics = Optics
else:
    AnyOptics = Annotated[WholePeriodOptics | Optics, BeforeValidator(check_optics)]


class Dataset(Group):
    """A dataset of the paper: stars, a noise band, splits and references.

    It has the name of its file. Every split and reference has its own trainings and tables.
    """

    name: Name
    """Names folders, tables and figures."""
    # Each combination of split and reference is a training.
    splits: Annotated[list[SplitKind], Field(min_length=1)]
    """Test stars of all fields, or of fields never seen in training."""
    references: Annotated[list[Reference], Field(min_length=1)]
    """The truth: the star's own noise-free image, or the PSF of its field."""
    shown_levels: Annotated[list[Positive], Field(min_length=1)]
    """Noise levels λ of the figure of restored stars; extremes if none is in band."""


class Calibration(Group):
    """Scan of parameters that the paper does not give: pixel scale, r0, range of the SSIM.

    Stage `scan` computes the SSIM of noisy stars on this grid, and `calibrate` fits it to the rows
    of the paper's tables that depend on no method.
    """

    stars: Count
    """Stars simulated per point of the scan."""
    pixel_scales_arcsec: Annotated[list[Positive], Field(min_length=2)]
    """Pixel scales scanned, ascending."""
    r0_m: Annotated[list[Positive], Field(min_length=1)]
    """Fried parameters scanned (of scene 2 only)."""
    # The SSIM has constants in proportion to the square of the dynamic range.
    data_ranges: Annotated[list[Positive], Field(min_length=2)]
    """SSIM dynamic ranges scanned, ascending."""


class Benchmark(Group):
    """Run time against error; needs a quiet machine."""

    # A machine is never quite without other work.
    repeats: Count
    """Timings of every point; the median is reported."""
    stamps: Count
    """Stamps per timing of a kernel."""
    peers: bool
    """Time POPPY beside our kernels."""
    # From these the growth of the costs is read.
    star_counts: Annotated[list[Count], Field(min_length=2)]
    """Numbers of stars at which time, memory and disk are measured, ascending."""
    stamp_sizes: Annotated[
        list[Annotated[int, Field(ge=8, le=256, multiple_of=2)]], Field(min_length=2)
    ]
    """Stamp sides at which cost is measured, ascending."""
    threads: Count
    """Largest number of threads timed."""


class Bounds(Group):
    """Lower bounds of the error of any estimate: sizes of the banks of simulated stars.

    A larger bank has stars more like a test star, and takes more time and memory.
    """

    # Accuracy of the bounds against time and memory.
    bank_stars: Count
    """Fresh draws of the simulator in the bank."""
    # Stars of one field are few in a bank for all fields.
    position_stars: Count
    """Further draws, which only the bound uses that is given the field."""
    star_draws: Annotated[int, Field(ge=20)]
    """Draws around the best matches of a star that few stars of the bank resemble."""
    test_stars: Count
    """Test stars that are bounded, the first of the part."""
    threads: Count
    """Threads of the linear algebra."""


class Workflow(Group):
    """Datasets of the default target of the workflow."""

    datasets: Annotated[list[Name], Field(min_length=1)]
    """Options of the group dataset."""


class Config(Consistent):
    """The whole configuration of one dataset.

    Stages get a model with the groups that they read, and annotate it as `Config`, too. Scene 3
    reads the groups that `compose.validate_tree` lists. `build_config_class` adds methods' groups.
    """

    if TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any: ...

    seed: Seed = Field(description="Seed of every random draw")
    workflow: Workflow
    methods: MethodNames = Field(
        description="Methods that are fitted, measured and drawn, in the order of tables"
    )
    scene: Scene
    telescope: AnyTelescope
    grid: Grid
    wavefront: Annotated[Seidel | VonKarman | OfTelescope, Field(discriminator="kind")]
    stars: Stars
    framing: Framing
    optics: AnyOptics
    noise: Noise
    parts: Parts
    dataset: Dataset
    evaluation: Evaluation
    calibration: Calibration
    benchmark: Benchmark
    bounds: Bounds
    calibration_stars: CalibrationStars
    prescription: Prescription
    alignment: Alignment
    dae: DaeSettings
    dae_train: Train
    cnn: Cnn
    perceptron: Perceptron
    fit: Fit

    @model_validator(mode="after")
    def check_groups(self) -> Config:
        """Reject values that contradict the values of other groups.

        Raises
        ------
        ValueError
            With the keys of both groups and their values.
        """
        # Parts for training (with validation) and test do not share stars.
        part_stars = self.parts.train_stars + self.parts.test_stars
        if part_stars > self.stars.count:
            raise ValueError(
                f"parts.train_stars + parts.test_stars = {part_stars}: "
                f"must be at most stars.count = {self.stars.count}"
            )
        # A star with a sub-pixel position differs from its template by a shift, too.
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
        # Settings of a method against settings of the data.
        for method in list_methods():
            method.check(self)
        return self


def build_config_class() -> type[Config]:
    """Return `Config` with the settings of all methods, and of the trainings of scene 3.

    Methods that are plugged in add groups, so that the class is made when it is first used.

    Returns
    -------
    type of Config
        The class that `compose.load` checks a dataset by, with a field for each group.
    """
    return _add_settings(list_methods())


@cache
def _add_settings(methods: tuple[type[Method], ...]) -> type[Config]:
    """Return the model with the settings of some methods; it is made only once."""
    # Settings of methods and of the networks of scene 3; none has a default of its own.
    groups: dict[str, Any] = {
        name: (group, ...) for method in methods for name, group in method.groups.items()
    }
    groups |= {f"train_{name}": (NetworkTrain, ...) for name in list_trained_networks()}
    return create_model("Config", __base__=Config, **groups)
