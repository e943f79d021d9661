"""What code a stage consists of, and which commit it is: a workflow reruns what changed."""

from __future__ import annotations

import ast
import hashlib
import subprocess
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path

from psfdae.cli import found

SOURCES = Path(__file__).resolve().parents[1]
"""Folder of the packages."""


def source_hash(*names: str, chosen: Iterable[str] = ()) -> str:
    """Hash of modules and of all modules of the packages that they import, and these, and so on.

    Docstrings, comments and formatting do not count, nor do imports that only annotations or
    decorators use. What is imported by a computed name is not seen: it is `chosen`.

    Parameters
    ----------
    *names : str
        Commands, such as "figure templates"; modules; or files of programs, relative to the
        repository, whose imports are looked for beside them, too.
    chosen : iterable of str
        Further modules, such as that of the method that is fitted.

    Raises
    ------
    ValueError
        If there is no such command, module or file.
    """
    commands = found()
    queue = [commands[name][0] if name in commands else name for name in (*names, *chosen)]
    reached = dict.fromkeys(queue)
    for name in queue:
        reached[name], imported = _module(name)
        queue += [other for other in imported if other not in reached]
        reached |= {other: reached.get(other) for other in imported}
    listed = "\n".join(f"{name} {digest}" for name, digest in sorted(reached.items()))
    return hashlib.sha256(listed.encode()).hexdigest()[:16]


@cache
def _module(name: str) -> tuple[str, list[str]]:
    """Digest of a module, or of a program's file, and the modules that it imports."""
    path = SOURCES.parent / name if name.endswith(".py") else _path(name)
    if path is None or not path.is_file():
        raise ValueError(f"{name}: no such command, module or file")
    tree = ast.parse(path.read_bytes())
    parts = [ast.dump(_without_docstrings(tree))]
    if path.name == "__init__.py":  # its package may have tables
        data = (p for p in sorted(path.parent.iterdir()) if p.is_file() and p.suffix != ".py")
        parts += [f"{p.name} {hashlib.sha256(p.read_bytes()).hexdigest()}" for p in data]
    beside = path.parent if name.endswith(".py") else None
    return hashlib.sha256("\n".join(parts).encode()).hexdigest(), [*_imported(tree, beside)]


def _path(module: str) -> Path | None:
    """File of a module of the packages; None for those of others."""
    path = SOURCES.joinpath(*module.split("."))
    files = (path.with_suffix(".py"), path / "__init__.py")
    return next((file for file in files if file.is_file()), None)


def _imported(tree: ast.Module, beside: Path | None) -> Iterator[str]:
    used = _used(tree)
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            candidates = [[alias.name] for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names = [a.name for a in node.names if (a.asname or a.name) in used]
            candidates = [[f"{node.module}.{name}", f"{node.module}"] for name in names]
        else:
            continue
        for modules in candidates:
            yield from [module for module in modules if _path(module)][:1]
            file = beside and beside / f"{modules[-1]}.py"
            if file and file.is_file():
                yield str(file.relative_to(SOURCES.parent))


def _used(tree: ast.Module) -> set[str]:
    """Names that code uses, but for annotations and decorators."""
    unused = set()
    for node in ast.walk(tree):
        parts = [getattr(node, name, None) for name in ("annotation", "returns")]
        for part in [*parts, *getattr(node, "decorator_list", ())]:
            unused |= {id(inner) for inner in ast.walk(part)} if part else set()
    names = (node for node in ast.walk(tree) if isinstance(node, ast.Name))
    return {node.id for node in names if id(node) not in unused}


def _without_docstrings(tree: ast.Module) -> ast.Module:
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list):
            node.body = [s for s in body if not _is_text(s)]  # type: ignore[attr-defined]
    return tree


def _is_text(statement: ast.stmt) -> bool:
    return isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant)


def git_commit() -> str:
    """Commit of the source tree; "-dirty" if it differs from it, "unknown" outside git."""
    try:
        # Installed into an environment inside somebody else's repository, it is not ours.
        if Path(git("rev-parse", "--show-toplevel")).resolve() != SOURCES.parent:
            return "unknown"
        dirty = "-dirty" if git("status", "--porcelain", "--untracked-files=no") else ""
        return git("rev-parse", "HEAD") + dirty
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def git(*arguments: str) -> str:
    """What git says of the folder that the package lies in; CalledProcessError, OSError."""
    command = ["git", "-C", str(SOURCES.parent), *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
