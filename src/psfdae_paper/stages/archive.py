"""Stages `manifest`, `archive`, `fetch`: checksums of a finished run, and the run as one file.

SHA256SUMS shows later damage to the files of a run. The archive is a tar file without compression,
because most products are compressed already, and so that a damaged byte belongs to one member. Its
members are named relative to the run's folder; the first one, SHA256SUMS, has the checksums of all
others.
"""

from __future__ import annotations

import errno
import shutil
import tarfile
from io import BytesIO
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from typing import Annotated

from psfdae.base.errors import Error
from psfdae.base.files import ProductError, atomic_path, compute_sha256, write_text
from psfdae.base.options import File, Folder
from psfdae.base.progress import steps
from psfdae_paper.configuration.command import command
from psfdae_paper.source import SOURCES

CHECKSUMS = "SHA256SUMS"
"""File with the checksums of a run."""
CITATION = "CITATION.cff"
RUN_FILES = ("run.yaml", "runtime.csv", "report.html")
"""Files of a run that its checksums leave out: settings, costs and report."""
RunFolder = Annotated[Folder, {"argument": True}]
MAX_CHECKSUMS_B = 2**26
"""Largest size of the list of checksums, in bytes; some 500,000 files."""
MACHINE_ERRORS = {
    *(errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EACCES, errno.EPERM),
    *(errno.ENOENT, errno.EIO, errno.EMFILE, errno.ENFILE, errno.ENOMEM),
}
"""Numbers of errors of disk, permissions and limits, for which no archive is to blame."""


class ArchiveError(Error, RuntimeError):
    """A file that is no archive of a run, is damaged, or would write outside its folder."""


@command("paper manifest")
def manifest(results: RunFolder) -> None:
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


@command("paper archive")
def archive(results: RunFolder, out: File) -> None:
    """Write a finished run as one file: products, models, report, checksums and citation.

    Products are the files of SHA256SUMS; a file that has changed since is an error.

    Parameters
    ----------
    results : Path
        Folder of a run, with its report.
    out : Path
        Tar archive.
    """
    checksums = results / CHECKSUMS
    if not checksums.is_file():
        raise ProductError(f"{checksums}: missing; `psfdae paper manifest` writes it")
    product_sums = read_checksums(checksums.read_text())
    paths = {name: results / name for name in (*RUN_FILES, *product_sums)}
    paths[CITATION] = SOURCES.parent / CITATION
    for name, path in paths.items():
        if not path.is_file():
            raise ProductError(f"{path}: missing; {name} belongs to a run that make has finished")
    # A product that was damaged after the run must not get a new, fitting checksum.
    sums = {}
    for name, path in steps("checksums", paths.items()):
        sums[name] = compute_sha256(path)
        if product_sums.get(name, sums[name]) != sums[name]:
            raise ProductError(f"{path}: differs from its checksum in {checksums}")
    lines = "".join(f"{digest}  {name}\n" for name, digest in sums.items()).encode()
    with (
        atomic_path(out) as temporary,
        # Links, of which `fetch` accepts none, are stored as the files that they lead to.
        tarfile.open(temporary, "w", dereference=True) as tar,
    ):
        # The checksums come first, so that every member is verified when it is read.
        member = tarfile.TarInfo(CHECKSUMS)
        member.size, member.mode = len(lines), 0o644
        tar.addfile(member, BytesIO(lines))
        for name, path in steps("files", paths.items()):
            # Times stay, by which Snakemake knows that products are up to date; owners do not.
            member = tar.gettarinfo(path, name)
            member.uid = member.gid = 0
            member.uname = member.gname = ""
            member.mode = 0o644
            with path.open("rb") as file:
                tar.addfile(member, file)


def read_checksums(text: str) -> dict[str, str]:
    """Return checksums by name from lines as `sha256sum` prints them.

    Raises
    ------
    ArchiveError
        If a line has another form, or a name leads out of the folder.
    """
    sums = {}
    for line in text.splitlines():
        digest, _, name = line.partition("  ")
        path = PurePosixPath(name)
        if len(digest) != 64 or not name or path.is_absolute() or ".." in path.parts:
            raise ArchiveError(f"{CHECKSUMS}: wrong line {line[:80]!r}")
        sums[name] = digest
    return sums


@command("paper fetch")
def fetch(file: Annotated[File, {"argument": True}], results: Folder) -> None:
    """Unpack FILE of the command archive into the folder of a run, and verify it.

    Nothing is written into the folder unless all checksums agree. Members other than plain files
    inside the folder are rejected.

    Parameters
    ----------
    file : Path
        Tar archive.
    results : Path
        Folder of the run; it must not hold any of the archive's files.
    """
    results.parent.mkdir(parents=True, exist_ok=True)
    # Beside the folder, on the same file system, so that complete files are moved into it.
    place = TemporaryDirectory(prefix=".fetch-", dir=results.parent)
    try:
        with place as temporary:
            unpack(file, Path(temporary))
            # The run counts as finished with its record, which comes last.
            entries = sorted(Path(temporary).iterdir(), key=lambda path: path.name == RUN_FILES[0])
            for target in (results / entry.name for entry in entries):
                if target.exists():
                    raise ArchiveError(f"{target}: exists; name a folder without a run (RESULTS=…)")
            results.mkdir(exist_ok=True)
            for entry in entries:
                shutil.move(entry, results / entry.name)
    except (tarfile.TarError, EOFError, UnicodeDecodeError, OSError) as error:
        is_sound = isinstance(error, OSError) and error.errno in MACHINE_ERRORS
        cause = "cannot be unpacked" if is_sound else "truncated, damaged or no archive of a run"
        raise ArchiveError(f"{file}: {cause}: {error}") from None


def unpack(file: Path, folder: Path) -> None:
    """Unpack an archive into an empty folder, and compare every member with its checksum.

    Parameters
    ----------
    file : Path
        Tar archive.
    folder : Path
        Empty folder.

    Raises
    ------
    ArchiveError
        If the archive lacks a file, has another one, or a file differs from its checksum; if a
        member is a link, or lies outside the folder.
    """
    with tarfile.open(file, "r:") as tar:
        # The filter rejects absolute paths, `..` and links once more. Python 3.11.3 lacks it.
        tar.extraction_filter = getattr(tarfile, "data_filter", lambda member, path: member)
        first = tar.next()
        content = tar.extractfile(first) if first and first.name == CHECKSUMS else None
        if first is None or content is None or first.size > MAX_CHECKSUMS_B:
            raise ArchiveError(f"{file}: does not begin with {CHECKSUMS}: no archive of a run")
        text = content.read().decode()
        missing = read_checksums(text)
        (folder / CHECKSUMS).write_text(text)
        for member in steps("files", iter(tar.next, None)):
            if not member.isreg():
                raise ArchiveError(f"{file}: {member.name}: not a plain file")
            # Each file once, and none without a checksum; names of checksums stay in the folder.
            digest = missing.pop(member.name, None)
            if digest is None:
                raise ArchiveError(f"{file}: {member.name}: has no checksum, or appears twice")
            tar.extract(member, folder)
            if compute_sha256(folder / member.name) != digest:
                raise ArchiveError(f"{file}: {member.name}: damaged, differs from its checksum")
    if missing:
        raise ArchiveError(f"{file}: lacks {next(iter(missing))} (truncated?)")
