"""Stage `manifest`: the checksums of a finished run, which show later damage to its files."""

from __future__ import annotations

from typing import Annotated

from psfdae.base.files import compute_sha256, write_text
from psfdae.base.options import Folder
from psfdae_paper.configuration.command import command

CHECKSUMS = "SHA256SUMS"
"""File with the checksums of a run."""


@command("paper manifest")
def manifest(results: Annotated[Folder, {"argument": True}]) -> None:
    """Write the checksums of a run to SHA256SUMS.

    `sha256sum --check --quiet SHA256SUMS` in the folder then names the files that are damaged.
    Products are listed; logs, costs and MLflow's copies are not, nor are other runs in folders of
    this one. SHA256SUMS has the form that `sha256sum` reads.

    Parameters
    ----------
    results : Path
        Folder of a run.
    """
    # Other runs, each with its settings, and the run of record may lie in folders of this one.
    other_runs = {path.parent for path in results.glob("*/**/.settings")} | {results / "reference"}
    no_products = {"logs", "benchmarks", "benchmarks_on_request", "checkpoints", "mlartifacts"}
    # Lines as `sha256sum` prints them, in the order of the names.
    lines = []
    for path in sorted(results.glob("*/**/*")):
        # Names relative to the run, so that it may be moved.
        name = path.relative_to(results)
        is_hidden = any(part.startswith(".") for part in name.parts)
        is_product = not is_hidden and name.parts[0] not in no_products
        if path.is_file() and is_product and other_runs.isdisjoint(path.parents):
            lines.append(f"{compute_sha256(path)}  {name.as_posix()}\n")
    write_text(results / CHECKSUMS, "".join(lines))
