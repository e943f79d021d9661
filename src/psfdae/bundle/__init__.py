"""Model bundles: a trained network with everything that it takes to apply it."""

from psfdae.bundle.format import (
    FORMAT_VERSION,
    Architecture,
    Bundle,
    BundleError,
    BundleInfo,
    network,
    read_bundle,
    shipped_path,
    write_bundle,
)
from psfdae.bundle.statistics import at_noise, mahalanobis

__all__ = [
    "FORMAT_VERSION",
    "Architecture",
    "Bundle",
    "BundleError",
    "BundleInfo",
    "at_noise",
    "mahalanobis",
    "network",
    "read_bundle",
    "shipped_path",
    "write_bundle",
]
