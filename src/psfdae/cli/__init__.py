"""Command line: one command per stage.

Only click is imported at the top; each command imports its stage when it runs.
"""

from psfdae.cli import (
    alignment,
    alignment_methods,
    benchmark_propagation,
    benchmark_timing,
    bounds,
    figures,
    knee,
    reporting,
    science,
    stability,
)
from psfdae.cli.base import main

__all__ = [
    "alignment",
    "alignment_methods",
    "benchmark_propagation",
    "benchmark_timing",
    "bounds",
    "figures",
    "knee",
    "main",
    "reporting",
    "science",
    "stability",
]
