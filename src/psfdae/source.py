"""What code a stage consists of, and which commit it is: a workflow reruns what changed."""

from __future__ import annotations

import ast
import gc
import hashlib
import re
import subprocess
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from fnmatch import filter as matching
from functools import cache, cached_property
from itertools import chain
from pathlib import Path
from typing import Any

PACKAGE = "psfdae"
ROOT = Path(__file__).resolve().parent

COMMAND = f"{PACKAGE}.cli:command"
"""Decorator of stages. It names the groups of settings that a stage reads."""

SETTINGS = {
    "config": f"{PACKAGE}.configuration.schema:Config",
    "alignment": f"{PACKAGE}.configuration.alignment:AlignmentConfig",
}
"""Models of the settings, by `root` of the decorator."""

NOT_FOLLOWED = {*SETTINGS.values(), f"{PACKAGE}.configuration.schema:whole_config"}
"""All settings: code that mentions them does not depend on each."""


def source_hash(*functions: str, chosen: Iterable[str] = ()) -> str:
    """Hash of functions and of all code of the package that they reach.

    They reach functions, whole classes and constants by name, through imports anywhere and
    attributes of modules; the classes of the settings that a stage reads; and modules whose
    name stands in a string, or fits an f-string. A registry that its entries fill themselves
    is not seen: list them in a constant, or import them by name.

    Names of modules, imports, comments, docstrings, formatting and annotations of functions
    do not count: moving or rewording never retrains a network.

    Parameters
    ----------
    *functions : str
        Commands, such as "figure templates"; "module:name", or "module" for all of it; or
        "file.py:name" of a program, whose imports are looked for beside it, too.
    chosen : iterable of str
        Where a name decides at run time between modules, or between entries of a constant,
        all are taken unless some of them, their modules or what is in them are among these.

    Raises
    ------
    ValueError
        If something named does not exist, or is chosen but not reached.
    """
    return _source_hash(functions, tuple(chosen))


@cache
def _source_hash(functions: tuple[str, ...], chosen: tuple[str, ...]) -> str:
    collecting = gc.isenabled()
    gc.disable()  # Looking for cycles among syntax trees doubles the time.
    try:
        return code_below(ROOT).hash(functions, chosen)
    finally:
        if collecting:
            gc.enable()


@dataclass(frozen=True)
class Definition:
    """Digest of code, what it refers to, and groups of which a name chooses at run time.

    A constant that is written as a table has its entries apart.
    """

    digest: str
    references: list[str]
    options: list[list[str]]
    entries: tuple[Definition, ...] = ()

    @property
    def every(self) -> list[str]:
        """All keys that it may reach."""
        return [*self.references, *chain(*self.options)]


class Module:
    """Top-level statements by the names that they make, "" if they do more; what names mean."""

    def __init__(self, name: str, tree: ast.Module) -> None:
        self.statements: dict[str, list[ast.stmt]] = {}
        self.names: dict[str, str] = {}
        for statement in tree.body:
            made = _made(statement)
            self.names |= {n: f"{name}.{n}" for n in made} | _imported(statement)
            for n in made:
                self.statements.setdefault(n, []).append(statement)
                if f"{name}:{n}" in SETTINGS.values() and isinstance(statement, ast.ClassDef):
                    fields = (s for s in statement.body if isinstance(s, ast.AnnAssign))
                    self.statements |= {f"{n}.{ast.unparse(f.target)}": [f] for f in fields}


class Code:
    """The code below a folder. A key is "module:name", or "module" for all of it."""

    def __init__(self, root: Path) -> None:
        self.root, self.paths = root, _modules(root, (PACKAGE,))
        self.module, self.definition = cache(self._module), cache(self._definition)
        self.resolve = cache(self._resolve)

    def hash(self, functions: Iterable[str], chosen: Iterable[str] = ()) -> str:
        """As `source_hash`; a definition goes by the place at which it was met, not by its key."""
        chosen = frozenset(self.commands.get(choice, choice) for choice in chosen)
        queue = [*dict.fromkeys(self.key(name) for name in functions)]
        places = {key: place for place, key in enumerate(queue)}
        digest = hashlib.sha256()
        for key in queue:
            text, references = self.reached(key, chosen)
            for reference in references:
                if reference not in places:
                    places[reference] = len(queue)
                    queue.append(reference)
            digest.update(f"{text}{[places[r] for r in references]}\n".encode())
        for choice in chosen - {*places, *(key.partition(":")[0] for key in places)}:
            raise ValueError(f"{choice}: nothing in {functions} chooses it")
        return digest.hexdigest()[:16]

    def key(self, name: str) -> str:
        """Key of a command, or of what is in a program; the modules beside it are then known."""
        file, *function = name.split(":")
        if not file.endswith(".py"):
            return self.commands.get(name, name)
        path = Path(self.root.parents[1], file)
        above = next(folder for folder in path.parents if not (folder / "__init__.py").exists())
        beside = _modules(path.parent, path.parent.relative_to(above).parts)
        self.paths = {**beside, **self.paths}
        own = next((n for n, found in self.paths.items() if found == path), None)
        if own is None or any(self.paths[n] != found for n, found in beside.items()):
            raise ValueError(f"{path}: missing, or a module beside it has the name of another one")
        return ":".join((own, *function))

    def reached(self, key: str, chosen: frozenset[str]) -> tuple[str, list[str]]:
        """Digest of a definition and what it reaches; of options and entries only those chosen."""

        def wanted(keys: Iterable[str]) -> list[str]:
            inside = {k: sorted(c for c in chosen if c.startswith(f"{k}:")) for k in keys}
            own = {k for k in inside if k in chosen or k.partition(":")[0] in chosen}
            return [c for k, cs in inside.items() for c in ([k] if k in own else cs)]

        found = self.definition(key)
        if not (found.entries or found.options):
            return found.digest, found.references
        # Entries that name functions, classes or modules; numbers and texts all count.
        choice = [e for e in found.entries if any(map(self.is_code, e.every))]
        taken = [e for e in choice if wanted(e.every)] or choice
        parts = [found, *(e for e in found.entries if e not in choice or e in taken)]
        reached = [k for p in parts for k in p.references]
        reached += [k for p in parts for o in p.options for k in wanted(o) or o]
        return " ".join(part.digest for part in parts), reached

    def is_code(self, key: str) -> bool:
        """Whether a key is a module, a class or a function."""
        return ":" not in key or any(isinstance(s, NAMED) for s in self.statements(key))

    def _module(self, name: str) -> Module:
        if name not in self.paths:
            raise ValueError(f"no module {name!r}")
        return Module(name, ast.parse(self.paths[name].read_bytes()))

    def statements(self, key: str) -> list[ast.stmt]:
        """Statements that make what a key means."""
        module, _, name = key.partition(":")
        return self.module(module).statements.get(name, []) if module in self.paths else []

    def _resolve(self, dotted: str) -> tuple[str, list[str]]:
        """Key of what a dotted name means, and the attributes left; a foreign name as it is."""
        module, *names = dotted.split(".")
        while module in self.paths and names:
            content, name, inner = self.module(module), names[0], f"{module}.{names[0]}"
            if name in content.statements:
                return f"{module}:{name}", names[1:]
            if inner in self.paths:
                module, names = inner, names[1:]
            elif name in content.names:
                return self.resolve(".".join((content.names[name], *names[1:])))
            elif "__getattr__" in content.statements:
                return f"{module}:__getattr__", names
            else:
                raise ValueError(f"{module} has no {name!r}")
        return (module, []) if module in self.paths else (dotted, [])

    def _definition(self, key: str) -> Definition:
        module, colon, name = key.partition(":")
        statements = self.statements(key)
        if colon and not statements:
            raise ValueError(f"no {name!r} in {module}")
        reader, own = Reader(self, module, statements), self.module(module).statements
        for part in () if colon else sorted(own):
            reader.refer(f"{key}:{part}")
        if name and "" in own:
            reader.refer(f"{module}:")
        frame, entries = _table(statements)
        apart = tuple(Reader(self, module).written(entry) for entry in entries)
        return replace(reader.written(frame), entries=apart)

    @cached_property
    def commands(self) -> dict[str, str]:
        """Keys of the functions that are commands, by the words of these."""
        found: dict[str, str] = {}
        for module in [m for m in self.paths if m.split(".")[0] == PACKAGE]:
            reader = Reader(self, module)
            for name, (node, *_) in reader.module.statements.items():
                for mark in getattr(node, "decorator_list", ()):
                    if reader.meaning(getattr(mark, "func", mark)) == (COMMAND, []):
                        found[ast.literal_eval(mark.args[0])] = f"{module}:{name}"
        return found


code_below = cache(Code)


class Reader:
    """Writes down code without what does not count; collects its references and options."""

    def __init__(self, code: Code, module: str, statements: Iterable[ast.stmt] = ()) -> None:
        self.code, self.module, self.path = code, code.module(module), code.paths[module]
        imported = {n: t for statement in statements for n, t in _imported(statement).items()}
        self.names, self.imported = self.module.names | imported, set(imported)
        self.parts: list[str] = []
        self.references: list[str] = []
        self.options: list[list[str]] = []

    def written(self, node: Any) -> Definition:
        """What a node is."""
        self.write(node)
        digest = hashlib.sha256("\n".join(self.parts).encode()).hexdigest()
        return Definition(digest, self.references, self.options)

    def write(self, node: Any) -> None:
        """Write a syntax tree, a list of them or a value."""
        if isinstance(node, list):
            for item in node:
                if not _is_text(item):
                    self.write(item)
        elif isinstance(node, ast.AST):
            SPECIAL.get(type(node), Reader.plain)(self, node)
        else:
            self.parts.append(repr(node))

    def plain(self, node: ast.AST, *, decorated: bool = True) -> None:
        """Write a node by its fields."""
        self.parts.append(type(node).__name__)
        for name in node._fields:
            value = getattr(node, name, None)
            written = decorated if name == "decorator_list" else name not in NOT_WRITTEN
            if written and value is not None and value != []:
                self.parts.append(name)
                self.write(value)
        self.parts.append(";")

    def refer(self, key: str) -> None:
        """Write a mark for a key; a foreign name, or one not to be followed, as it is."""
        if key.partition(":")[0] in self.code.paths and key not in NOT_FOLLOWED:
            self.references.append(key)
            key = "*"
        self.parts.append(key.rpartition(":")[2])

    def meaning(self, node: ast.AST) -> tuple[str, list[str]] | None:
        """Key or foreign name of a dotted name, and the attributes left; None for a value."""
        names: list[str] = []
        while isinstance(node, ast.Attribute):
            names.insert(0, node.attr)
            node = node.value
        target = self.names.get(node.id) if isinstance(node, ast.Name) else None
        return self.code.resolve(".".join((target, *names))) if target else None

    def name(self, node: ast.Name | ast.Attribute) -> None:
        """A name or an attribute: what it means, or itself."""
        if meant := self.meaning(node):
            self.refer(meant[0])
            self.parts += meant[1]
        elif isinstance(node, ast.Attribute):
            self.plain(node)
        else:
            self.parts.append(node.id)
            if node.id == "__package__":
                self.parts += _data(self.path.parent)

    def function(self, node: ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda) -> None:
        """A function, whose variables hide other names but from its defaults and decorators."""
        self.write([*node.args.defaults, *node.args.kw_defaults])
        for mark in getattr(node, "decorator_list", ()):
            if self.meaning(getattr(mark, "func", mark)) == (COMMAND, []):
                self.command(mark, node.args)
            else:
                self.write(mark)
        own = _assigned(node.body) - self.imported if isinstance(node.body, list) else set()
        own |= {part.arg for part in ast.walk(node.args) if isinstance(part, ast.arg)}
        self.inside(own, node)

    def comprehension(self, node: Any) -> None:
        """A comprehension, whose variables hide other names but from its first iterable."""
        self.write(node.generators[0].iter)
        targets = (name for part in node.generators for name in ast.walk(part.target))
        self.inside({name.id for name in targets if isinstance(name, ast.Name)}, node)

    def inside(self, own: set[str], node: ast.AST) -> None:
        """Write a node that has names of its own."""
        names = self.names
        self.names = {name: target for name, target in names.items() if name not in own}
        self.plain(node, decorated=False)
        self.names = names

    def command(self, mark: ast.Call, parameters: ast.arguments) -> None:
        """Of a command: the settings that it reads and the classes of its parameters."""
        said = self.strings([*mark.args[1:], *mark.keywords], (ast.Assign, ast.FunctionDef))
        model = SETTINGS["alignment" if "alignment" in said else "config"]
        hints = (n for n in ast.walk(parameters) if isinstance(n, ast.Name | ast.Attribute))
        named = [meant[0] for hint in hints if (meant := self.meaning(hint))]
        for key in (*(f"{model}.{word}" for word in said), *named):
            if {type(s) for s in self.code.statements(key)} & {ast.ClassDef, ast.AnnAssign}:
                self.refer(key)

    def strings(self, nodes: Iterable[ast.AST], followed: tuple[type, ...]) -> list[str]:
        """Texts in code, and in definitions of some kinds that it names."""
        found: list[str] = []
        for node in chain(*map(ast.walk, nodes)):
            key = (self.meaning(node) or ("", []))[0]
            if isinstance(node, ast.Constant):
                found.append(str(node.value))
            elif isinstance(getattr(node, "ctx", None), ast.Load):
                made = [s for s in self.code.statements(key) if isinstance(s, followed)]
                inner = Reader(self.code, key.partition(":")[0]) if made else self
                found += inner.strings(made, (ast.Assign,))
        return found

    def call(self, node: ast.Call) -> None:
        """A call; what describes a field is prose."""
        of_field = self.meaning(node.func) == ("pydantic.Field", [])
        keywords = [k for k in node.keywords if not (of_field and k.arg == "description")]
        self.write([node.func, "(", node.args, keywords, ")"])

    def text(self, node: ast.Constant | ast.JoinedStr) -> None:
        """A constant or an f-string, or the modules that it names."""
        inner = node.values if isinstance(node, ast.JoinedStr) else [node]
        pattern = "".join(str(p.value) if isinstance(p, ast.Constant) else "*" for p in inner)
        is_name = re.fullmatch(rf"{PACKAGE}(\.[\w*]+)+", pattern)
        named = matching(self.code.paths, pattern) if is_name else []
        for part in inner:
            if not isinstance(part, ast.Constant):
                self.write(part)
            elif not named:
                self.parts.append(repr(part.value))
        self.options += [named] if named else []


# Of annotations those of variables count: among them are the fields of dataclasses and settings.
NOT_WRITTEN = {"ctx", "kind", "type_comment", "type_params", "returns"}
SPECIAL: dict[type, Callable[..., None]] = {
    **dict.fromkeys((ast.Import, ast.ImportFrom, ast.Pass), lambda reader, node: None),
    **dict.fromkeys((ast.Name, ast.Attribute), Reader.name),
    **dict.fromkeys((ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda), Reader.function),
    **dict.fromkeys((ast.ListComp, ast.SetComp, ast.DictComp), Reader.comprehension),
    **dict.fromkeys((ast.Constant, ast.JoinedStr), Reader.text),
    ast.GeneratorExp: Reader.comprehension,
    ast.Call: Reader.call,
    ast.arg: lambda reader, node: reader.parts.append(node.arg),
}
TARGETS = ("targets", "target", "annotation")
NAMED = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)


def _is_text(node: Any) -> bool:
    """Whether a statement is a text, such as a docstring."""
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)


def _modules(folder: Path, above: tuple[str, ...]) -> dict[str, Path]:
    """Files of the modules in and below a folder, which lies in a package or not."""
    files = {
        path: path.relative_to(folder).with_suffix("") for path in sorted(folder.rglob("*.py"))
    }
    return {".".join((*above, *f.parts)).removesuffix(".__init__"): p for p, f in files.items()}


def _table(statements: list[ast.stmt]) -> tuple[list[Any], list[Any]]:
    """What makes a constant, without its entries if it is written as a table; these."""
    value = getattr(statements[0], "value", None) if len(statements) == 1 else None
    if isinstance(value, ast.Dict):
        entries: list[Any] = [list(pair) for pair in zip(value.keys, value.values, strict=True)]
    elif isinstance(value, ast.List | ast.Tuple | ast.Set):
        entries = value.elts
    else:
        return statements, []
    node = statements[0]
    return [type(value).__name__, *(getattr(node, name, None) for name in TARGETS)], entries


def _data(folder: Path) -> list[str]:
    """Names and digests of the files of a package that are no code."""
    files = [path for path in sorted(folder.iterdir()) if path.is_file() and path.suffix != ".py"]
    return [f"{path.name} {hashlib.sha256(path.read_bytes()).hexdigest()}" for path in files]


def _inner(nodes: Iterable[Any], *, functions: bool) -> list[Any]:
    """Statements and all inside them, inside functions and classes if asked for."""
    found = []
    for node in nodes:
        found.append(node)
        if functions or not isinstance(node, NAMED):
            for block in ("body", "orelse", "finalbody", "handlers", "cases"):
                found += _inner(getattr(node, block, ()), functions=functions)
    return found


def _assigned(statements: Iterable[ast.stmt]) -> set[str]:
    """Names that statements bind, but not by imports."""
    found, elsewhere = set(), set()
    for node in _inner(statements, functions=False):
        if isinstance(node, NAMED):
            found.add(node.name)
        elif isinstance(node, ast.Global):
            elsewhere.update(node.names)
        targets = [*getattr(node, "targets", ()), getattr(node, "target", None)]
        targets += [item.optional_vars for item in getattr(node, "items", ())]
        stored = (n for target in targets if target for n in ast.walk(target))
        found |= {n.id for n in stored if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)}
    return found - elsewhere


def _made(statement: ast.stmt) -> set[str]:
    """Names that a statement of the top level makes; "" among them if it does more than that."""
    if isinstance(statement, ast.If) and "__name__" in ast.unparse(statement.test):
        return set()  # of a program that is run
    inner = _inner([statement], functions=False)
    if all(isinstance(s, ast.Import | ast.ImportFrom | ast.If) or _is_text(s) for s in inner):
        return set()
    names = _assigned([statement])
    simple = isinstance(statement, (*NAMED, ast.Assign, ast.AugAssign, ast.AnnAssign))
    return names if names and simple else names | {""}


def _imported(statement: ast.stmt) -> dict[str, str]:
    """Names that imports in a statement bind, with the dotted names of what they are."""
    found: dict[str, str] = {}
    for node in _inner([statement], functions=True):
        pairs = []
        if isinstance(node, ast.Import):
            tops = ((a, a.name.split(".")[0]) for a in node.names)
            pairs = [(a.asname or top, a.name if a.asname else top) for a, top in tops]
        elif isinstance(node, ast.ImportFrom):
            if node.level or node.names[0].name == "*":
                raise ValueError(f"{ast.unparse(node)}: name the module and what is imported")
            pairs = [(a.asname or a.name, f"{node.module}.{a.name}") for a in node.names]
        for name, target in pairs:
            if found.setdefault(name, target) != target:
                raise ValueError(f"{name}: imported as {found[name]} and as {target}")
    return found


def git_commit() -> str:
    """Commit of the source tree; "-dirty" if it differs from it, "unknown" outside git."""
    root = ROOT.parents[1]
    try:
        # Installed into an environment inside somebody else's repository, it is not ours.
        if Path(git("rev-parse", "--show-toplevel")).resolve() != root:
            return "unknown"
        dirty = "-dirty" if git("status", "--porcelain", "--untracked-files=no") else ""
        return git("rev-parse", "HEAD") + dirty
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def git(*arguments: str) -> str:
    """What git says of the folder that the package lies in; CalledProcessError, OSError."""
    command = ["git", "-C", str(ROOT.parents[1]), *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
