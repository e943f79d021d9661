"""Commands whose settings are groups of the configuration that Hydra composes.

A command has a name and the groups that it reads. Its function receives them, checked, as `config`:
from a file that the workflow has written, or from overrides of the command line.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, TypeVar

from psfdae.base.settings import ConfigError
from psfdae.commands import cli
from psfdae_paper.configuration.compose import load_settings, load_stage
from psfdae_paper.configuration.schema import Config

Function = TypeVar("Function", bound=Callable[..., None])


@dataclass(frozen=True)
class Groups:
    """Reader of the groups of the configuration that a command needs.

    Attributes
    ----------
    reads : tuple of str, or callable
        Names of the groups, or a function of the command's options that returns them.
    choice : tuple of str
        Overrides that precede the command line's, such as the dataset of the command.
    foreign_options : mapping
        Options of Hydra's own programs, with their equivalent here.
    """

    reads: tuple[str, ...] | Callable[..., tuple[str, ...]]
    choice: tuple[str, ...] = ()
    foreign_options: ClassVar[Mapping[str, str]] = {
        **dict.fromkeys(
            ("-m", "--multirun"),
            "several values are a sweep: give them a NAME in a file of config/sweep, then "
            "snakemake sweep --config sweep=NAME (docs/sweeps.md)",
        ),
        "--cfg": "psfdae paper config OVERRIDES prints the composed configuration",
    }

    def names(self, options: Mapping[str, Any]) -> tuple[str, ...]:
        """Return the names of the groups that a command with these options reads.

        Parameters
        ----------
        options : mapping
            Values of the command's options by name, such as `{"name": "gmm"}` of `fit`.
        """
        return self.reads(**options) if callable(self.reads) else self.reads

    def __call__(
        self, options: Mapping[str, Any], file: Path | None, words: Sequence[str]
    ) -> Config:
        """Return the checked groups, from a file of the workflow, or from overrides `words`.

        Parameters
        ----------
        options : mapping
            Values of the command's options by name.
        file : Path, optional
            File of `compose.write_settings`, which `--config` names.
        words : sequence of str
            Overrides such as noise.kappa=4.98, used if `file` is None.

        Raises
        ------
        ConfigError
            With each wrong key, its value and the allowed range.
        """
        # The workflow passes one file; a user writes words such as noise.kappa=4.98.
        # Some commands read other groups with other options, such as `fit METHOD`.
        reads = self.names(options)
        if file is not None:
            return load_settings(file, reads)
        return load_stage(reads, self.prepend_choice(words))

    def prepend_choice(self, words: Sequence[str]) -> tuple[str, ...]:
        """Return the command's choice, then overrides; ConfigError if one changes the choice."""
        # A command of scene 3 has its dataset; another one would have other groups.
        for word in words if self.choice else ():
            if word.startswith("dataset="):
                raise ConfigError(f"{word}: this command is for {', '.join(self.choice)} only")
        return (*self.choice, *words)


def command(
    name: str, reads: tuple[str, ...] | Callable[..., tuple[str, ...]] = ()
) -> Callable[[Function], Function]:
    """Make a function the command `name`; its `config` has groups of the configuration.

    See `psfdae.commands.cli.command`, and `Groups` for `reads`. Commands "paper alignment …" are
    for scene 3 only, and choose its dataset.

    Parameters
    ----------
    name : str
        Up to four words, such as "paper alignment figure stamps".
    reads : tuple of str, or callable
        Groups that the function receives as `config`; empty if it lacks this parameter.
    """
    choice = ("dataset=alignment",) if name.startswith("paper alignment ") else ()
    # The command line calls `Groups` with the options, the file and the words that are left.
    return cli.command(name, Groups(reads, choice))
