"""Command line: one command per stage.

Only click is imported at the top; each command imports its stage when it runs.
"""

from psfdae.cli import (
    alignment,
    alignment_methods,
    benchmark_propagation,
    benchmark_timing,
    bounds,
    bundle,
    compare,
    figures,
    from_stars,
    knee,
    predict,
    prediction,
    reporting,
    scaling,
    science,
    simulate,
    stability,
    sweep,
)
from psfdae.cli.base import main

__all__ = [
    "alignment",
    "alignment_methods",
    "benchmark_propagation",
    "benchmark_timing",
    "bounds",
    "bundle",
    "compare",
    "figures",
    "from_stars",
    "knee",
    "main",
    "predict",
    "prediction",
    "reporting",
    "scaling",
    "science",
    "simulate",
    "stability",
    "sweep",
]
