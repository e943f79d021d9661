"""Methods of the paper and of its studies, in addition to the methods of the library."""

from __future__ import annotations

from psfdae.base.settings import Config
from psfdae.methods.interface import Method


class PhotonMethod(Method):
    """Base class of methods whose likelihood is the Poisson distribution of photon counts."""

    assumes_independent_pixels = True

    @classmethod
    def check(cls, config: Config) -> None:
        """Raise ConfigError if it is used with other noise than Poisson noise."""
        if cls.name in config.methods:
            config.noise.require_poisson(f"methods: {cls.name} is")
