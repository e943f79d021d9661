"""Commands whose settings are groups of the configuration that Hydra composes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from psfdae import cli

Root = Literal["config", "alignment"]
"""Root files of the configuration: the datasets', and that of scene 3."""


@dataclass(frozen=True)
class Groups:
    """Reads groups of a root of the configuration; which may depend on a command's options."""

    reads: tuple[str, ...] | Callable[..., tuple[str, ...]]
    root: Root = "config"

    def of(self, options: Mapping[str, Any]) -> tuple[str, ...]:
        """Names of the groups that a command with these options reads."""
        return self.reads(**options) if callable(self.reads) else self.reads

    def __call__(self, options: Mapping[str, Any], file: Path | None, words: Sequence[str]) -> Any:
        """The checked groups, from a file that the workflow has written, or from overrides."""
        from psfdae_paper.configuration.compose import load_settings, load_stage

        reads = self.of(options)
        if file is not None:
            return load_settings(file, reads, self.root)
        return load_stage(reads, words, self.root)


def command(
    name: str,
    reads: tuple[str, ...] | Callable[..., tuple[str, ...]] = (),
    root: Root = "config",
) -> Callable[..., Any]:
    """`psfdae.cli.command`, whose `config` has groups of the configuration as attributes."""
    return cli.command(name, Groups(reads, root))
