"""What code a stage consists of, and which commit it is: a workflow reruns what changed."""

from __future__ import annotations

import ast
import hashlib
import subprocess
from functools import cache
from pathlib import Path

PACKAGE = "psfdae"
ROOT = Path(__file__).resolve().parent

NOT_SCIENCE = (f"{PACKAGE}.configuration",)
"""Left out: configuration reaches a rule through its params, value by value."""


def source_hash(*modules: str) -> str:
    """Hash of modules and of every module of the package that they import.

    Imports inside functions count; comments, docstrings and formatting do not,
    so that rewording never retrains a network.

    Parameters
    ----------
    *modules : str
        Dotted names, for example `psfdae.stages.train`.
    """
    reached: set[str] = set()
    waiting = list(modules)
    while waiting:
        module = waiting.pop()
        if module not in reached:
            reached.add(module)
            waiting += _imports(module)
    digest = hashlib.sha256()
    for module in sorted(reached):
        digest.update(f"{module}\n{_code(module)}\n".encode())
    return digest.hexdigest()[:16]


def _path(module: str) -> Path | None:
    parts = module.split(".")[1:]
    for candidate in (
        ROOT.joinpath(*parts).with_suffix(".py"),
        ROOT.joinpath(*parts, "__init__.py"),
    ):
        if parts and candidate.is_file():
            return candidate
    return None


@cache
def _tree(module: str) -> ast.Module:
    path = _path(module)
    if path is None:
        raise ValueError(f"no module {module!r} in {ROOT}")
    return ast.parse(path.read_text(encoding="utf-8"))


@cache
def imports(module: str) -> tuple[str, ...]:
    """Modules of the package that a module imports, inside functions too; dotted names."""
    names: list[str] = []
    for node in ast.walk(_tree(module)):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names += [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
    return tuple(n for n in names if n.startswith(PACKAGE + ".") and _path(n) is not None)


@cache
def _imports(module: str) -> tuple[str, ...]:
    return tuple(name for name in imports(module) if not name.startswith(NOT_SCIENCE))


@cache
def _code(module: str) -> str:
    tree = ast.parse(ast.unparse(_tree(module)))
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.FunctionDef | ast.ClassDef):
            first = node.body[0] if node.body else None
            if isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant):
                node.body = node.body[1:] or [ast.Pass()]
    return ast.dump(tree)


def git_commit() -> str:
    """Commit of the source tree; "-dirty" if it differs from it, "unknown" outside git."""
    root = ROOT.parents[1]

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(root), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    try:
        # Installed into an environment inside somebody else's repository, it is not ours.
        if Path(git("rev-parse", "--show-toplevel")).resolve() != root:
            return "unknown"
        dirty = "-dirty" if git("status", "--porcelain", "--untracked-files=no") else ""
        return git("rev-parse", "HEAD") + dirty
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
