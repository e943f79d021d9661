"""Commands whose settings are groups of the configuration that Hydra composes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from psfdae import cli
from psfdae.settings import ConfigError

if TYPE_CHECKING:
    from psfdae_paper.configuration.schema import Config

Function = TypeVar("Function", bound=Callable[..., None])


@dataclass(frozen=True)
class Groups:
    """Reads groups of the configuration; which may depend on a command's options.

    `choice` are words before those of the command line, such as the dataset that it is about.
    """

    reads: tuple[str, ...] | Callable[..., tuple[str, ...]]
    choice: tuple[str, ...] = ()

    def of(self, options: Mapping[str, Any]) -> tuple[str, ...]:
        """Names of the groups that a command with these options reads."""
        return self.reads(**options) if callable(self.reads) else self.reads

    def __call__(
        self, options: Mapping[str, Any], file: Path | None, words: Sequence[str]
    ) -> Config:
        """The checked groups, from a file that the workflow has written, or from overrides."""
        from psfdae_paper.configuration.compose import load_settings, load_stage

        reads = self.of(options)
        if file is not None:
            return load_settings(file, reads)
        return load_stage(reads, self.chosen(words))

    def chosen(self, words: Sequence[str]) -> tuple[str, ...]:
        """Words of a command line behind its choice, which none of them may change."""
        for word in words if self.choice else ():
            if word.startswith("dataset="):
                raise ConfigError(f"{word}: this command is about {', '.join(self.choice)}")
        return (*self.choice, *words)


def command(
    name: str,
    reads: tuple[str, ...] | Callable[..., tuple[str, ...]] = (),
    choice: tuple[str, ...] = (),
) -> Callable[[Function], Function]:
    """`psfdae.cli.command`, whose `config` has groups of the configuration as attributes."""
    return cli.command(name, Groups(reads, choice))
