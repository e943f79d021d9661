"""What stages share: scene, threads, stars, their parts and their noise."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from psfdae.errors import Error
from psfdae.evaluation.figure_style import as_png
from psfdae.files import Column, write_bytes


class OutputError(Error, ValueError):
    """A result would take the place of what it is made of."""


def check_outputs(outputs: Iterable[Path | None], inputs: Iterable[Any]) -> None:
    """Refuse outputs that are inputs, too; what is no path of a file is passed over.

    Raises
    ------
    OutputError
    """
    given = {Path(name).resolve() for name in inputs if isinstance(name, str | Path)}
    for out in outputs:
        if out is not None and out.resolve() in given:
            raise OutputError(f"{out}: is an input, too; choose another name")


def write_png(figure: Any, out: Path) -> None:
    """Write a matplotlib figure atomically; the same figure gives the same bytes."""
    write_bytes(out, as_png(figure))


def scene_of(config: Any) -> Any:
    """The scene of a stage's config."""
    from psfdae.stars.scenes import SCENES

    return SCENES[config.scene.name](config.grid, config.telescope, config.wavefront)


def template_wavefronts(config: Any) -> Any:
    """Static wavefronts of all fields of a stage's scene."""
    return scene_of(config).templates()


def star_wavefronts(config: Any, star_field: np.ndarray) -> Any:
    """Wavefronts of stars with random aberrations, `star_field` the field of each."""
    return scene_of(config).stars(config.stars, star_field, config.seed)


def drawn_columns(source: Any) -> dict[str, Column]:
    """What the stars' random aberrations were, as products keep it."""
    return {name: Column(values, "wave", about) for name, (values, about) in source.drawn.items()}


def limit_threads(threads: int) -> None:
    """Use this many threads for linear algebra, whatever the environment says.

    Results depend on it in the last digits, so it comes from the config.
    """
    from threadpoolctl import threadpool_limits

    threadpool_limits(threads)
