"""Hash of the code of a stage, by which a workflow detects that it has changed; commit, machine.

The hash covers commands, modules or programs, and all code of the packages that they import. A rule
of the workflow has it among its parameters, so that a job runs again when the hash has changed.
"""

from __future__ import annotations

import ast
import hashlib
import os
import platform
import subprocess
from collections.abc import Iterator
from functools import cache
from pathlib import Path

from psfdae.commands.cli import command_modules, full_name

SOURCES = Path(__file__).resolve().parents[1]
"""Folder of the packages."""


def source_hash(*names: str) -> str:
    """Return the hash of modules and of all modules of the packages on which they depend.

    These are the modules that they import, the modules that these import, and so on. Docstrings,
    comments and formatting are left out, and so are imports that only annotations or decorators
    use. Four kinds of imports cannot be recognised, so that their modules have to be named, too: by
    a computed name, such as the name of the method that is fitted; relative imports; imports of all
    names (`*`); and imports of names that a module re-exports without using them. Packages above a
    module are included only where a name is imported from them: their `__init__.py` computes
    nothing.

    Parameters
    ----------
    *names : str
        Commands, such as "figure templates"; modules; or files of programs, relative to the
        repository, whose imports are also searched in their folder.

    Returns
    -------
    str
        16 hexadecimal digits.

    Raises
    ------
    ValueError
        If a command, module or file does not exist.
    """
    # A command is hashed by the module of its function.
    commands = command_modules()
    queue = [commands.get(full_name(name), (name,))[0] for name in names]
    # Breadth-first search of the imports; the list grows while it is processed.
    digests = dict.fromkeys(queue)
    for name in queue:
        digests[name], imports = module_digest(name)
        queue += [module for module in imports if module not in digests]
        digests |= {module: digests.get(module) for module in imports}
    lines = "\n".join(f"{name} {digest}" for name, digest in sorted(digests.items()))
    return hashlib.sha256(lines.encode()).hexdigest()[:16]


@cache
def module_digest(name: str) -> tuple[str, list[str]]:
    """Return the digest of a module, or of a program's file, and the modules that it imports.

    Raises
    ------
    ValueError
        If the module or file does not exist.
    """
    path = SOURCES.parent / name if name.endswith(".py") else _path(name)
    if path is None or not path.is_file():
        raise ValueError(f"{name}: no such command, module or file")
    # The syntax tree has neither comments nor formatting. Statements that are only a constant, such
    # as docstrings, are taken out.
    tree = ast.parse(path.read_bytes())
    nodes = [*ast.walk(tree)]
    for node in nodes:
        if isinstance(body := getattr(node, "body", None), list):
            is_constant = [isinstance(getattr(s, "value", None), ast.Constant) for s in body]
            node.body = [  # type: ignore[attr-defined]
                s for s, c in zip(body, is_constant, strict=True) if not (c and type(s) is ast.Expr)
            ]
    parts = [ast.dump(tree)]
    # A package may have tables, which its functions read.
    if path.name == "__init__.py":
        data = (p for p in sorted(path.parent.iterdir()) if p.is_file() and p.suffix != ".py")
        parts += [f"{p.name} {hashlib.sha256(p.read_bytes()).hexdigest()}" for p in data]
    program_folder = path.parent if name.endswith(".py") else None
    # Code and tables together.
    digest = hashlib.sha256("\n".join(parts).encode()).hexdigest()
    return digest, [*find_imports(nodes, program_folder)]


def _path(module: str) -> Path | None:
    """Return the file of a module of the packages; None for modules of other packages."""
    path = SOURCES.joinpath(*module.split("."))
    # A module, or a package.
    files = (path.with_suffix(".py"), path / "__init__.py")
    return next((file for file in files if file.is_file()), None)


def find_imports(nodes: list[ast.AST], program_folder: Path | None) -> Iterator[str]:
    """Yield the modules of the packages that a module imports, and files next to a program.

    Parameters
    ----------
    nodes : list of ast.AST
        All nodes of the module's syntax tree. A walk through the tree takes longer than all else
        here, so that there is one for all questions.
    program_folder : Path or None
        Folder of a program, whose files it imports without a package.
    """
    # Nodes below annotations of arguments and variables, return types and decorators: names that
    # only these use are taken not to decide a result.
    ignored_nodes: set[ast.AST] = set()
    for node in nodes:
        if isinstance(node, (ast.arg, ast.AnnAssign)) and node.annotation:
            ignored_nodes.update(ast.walk(node.annotation))
        elif isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)):
            parts = [getattr(node, "returns", None), *node.decorator_list]
            ignored_nodes.update(child for part in parts if part for child in ast.walk(part))
    names = (node for node in nodes if isinstance(node, ast.Name))
    used_names = {node.id for node in names if node not in ignored_nodes}
    for node in nodes:
        # `from a import b` imports the module a.b if there is one, else the module a.
        if isinstance(node, ast.Import):
            candidates = [[alias.name] for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            imports = [a.name for a in node.names if (a.asname or a.name) in used_names]
            candidates = [[f"{node.module}.{name}", f"{node.module}"] for name in imports]
        else:
            continue
        # Modules of other packages are skipped; a program may import files in its folder.
        for modules in candidates:
            yield from [module for module in modules if _path(module)][:1]
            file = program_folder and program_folder / f"{modules[-1]}.py"
            if file and file.is_file():
                yield str(file.relative_to(SOURCES.parent))


def git_commit() -> str:
    """Return the commit of the source tree.

    It ends in "-dirty" if tracked files differ from the commit. It is "unknown" if the source tree
    is not itself the root of a git repository, or git fails.
    """
    try:
        # A package that is installed into an environment inside another repository does not
        # belong to that repository.
        if Path(git("rev-parse", "--show-toplevel")).resolve() != SOURCES.parent:
            return "unknown"
        dirty = "-dirty" if git("status", "--porcelain", "--untracked-files=no") else ""
        return git("rev-parse", "HEAD") + dirty
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def git(*arguments: str) -> str:
    """Return the stripped output of git, run in the root of the repository.

    Raises
    ------
    subprocess.CalledProcessError
        If git fails.
    OSError
        If git is not installed.
    """
    command = ["git", "-C", str(SOURCES.parent), *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


def describe_machine() -> str:
    """Return processor, number of cores and version of Python of this machine."""
    return f"{cpu_model()}, {os.cpu_count()} cores, Python {platform.python_version()}"


def cpu_model() -> str:
    """Return the model of the processor as the operating system names it."""
    # A file of Linux; elsewhere Python asks the system.
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.is_file() else []
    models = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return [*models, platform.processor() or platform.machine()][0]
