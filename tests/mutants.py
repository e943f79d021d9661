"""Mutants of the science: do the fast tests notice a wrong sign, factor or limit?

    python tests/mutants.py run [WORD …]    apply the mutants to a private copy, one by one
    python tests/mutants.py draw            draw the list of random mutants anew

`mutants.csv` names every mutant by its function, a fragment of the code and which
occurrence of the fragment in the function it is, so that code may move to another
module. A fragment that is no longer there is an error that names it; whoever changes
the line writes the mutant's new text into the list.

Each mutant meets the test files that name its module, then the other fast tests. That
takes long; words select mutants whose row holds one of them.
"""

from __future__ import annotations

import ast
import contextlib
import copy
import csv
import os
import random
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
LIST = Path(__file__).with_suffix(".csv")
SEED, DRAWN = 14, 60
SCIENCE = [
    *("alignment", "bounds", "estimators", "optics", "stars"),
    *(f"evaluation/{name}.py" for name in ("calibration", "comparison", "metrics")),
    *(f"own_stars/{name}.py" for name in ("detection", "model", "packing", "photometry")),
    *(f"own_stars/{name}.py" for name in ("prediction", "selection", "shapes", "stamps")),
    "own_stars/training_images.py",
]
LATEST = [
    *("bounds/sampling.py", "bounds/tight.py", "estimators/field.py", "estimators/gmm.py"),
    *("own_stars/detection.py", "own_stars/packing.py", "stars/field_model.py"),
]
"""Where the random mutants were drawn from, half of them from the latest, file by file; no
matter once they are drawn."""

CHOICE = ["-m", "not slow and not written and not workflow", "--ignore=tests/test_mutants.py"]
"""The fast tests but for those of the list, which notice every mutant."""

MEMORY = 8 * 2**30
LIMIT = 3600
"""Seconds after which a mutant counts as killed; without one the tests take some minutes."""

LEAST = 0.9
NOTHING_FAILED = (0, 5)
"""Exit codes of pytest: all passed, no test was chosen."""

INSIDE = (ast.expr, ast.keyword, ast.comprehension, ast.AugAssign)
FUNCTION = (ast.FunctionDef, ast.AsyncFunctionDef)
SWAPPED = {
    **{ast.Add: [ast.Sub], ast.Sub: [ast.Add], ast.Mult: [ast.Div], ast.Div: [ast.Mult]},
    **{ast.FloorDiv: [ast.Mult], ast.Mod: [ast.FloorDiv], ast.Pow: [ast.Mult]},
    **{ast.BitAnd: [ast.BitOr], ast.BitOr: [ast.BitAnd], ast.And: [ast.Or], ast.Or: [ast.And]},
    **{ast.Lt: [ast.LtE, ast.GtE], ast.LtE: [ast.Lt, ast.Gt], ast.Eq: [ast.NotEq]},
    **{ast.Gt: [ast.GtE, ast.LtE], ast.GtE: [ast.Gt, ast.Lt], ast.NotEq: [ast.Eq]},
    **{ast.Is: [ast.IsNot], ast.IsNot: [ast.Is], ast.In: [ast.NotIn], ast.NotIn: [ast.In]},
}
Units = dict[str, dict[Path, list[ast.AST]]]
"""Functions, methods, classes without their methods and constants by name and file."""


@dataclass(frozen=True)
class Mutant:
    """A row of the list; `equivalent` is the reason why no test can notice it, if there is one."""

    function: str
    original: str
    mutated: str
    occurrence: int
    source: str
    equivalent: str


class LostError(LookupError):
    """A mutant's fragment is not in the code."""


def read_list() -> list[Mutant]:
    with LIST.open(encoding="utf-8", newline="") as file:
        return [
            Mutant(**{**row, "occurrence": int(row["occurrence"])}) for row in csv.DictReader(file)
        ]


def named_parts(tree: ast.Module) -> Iterator[tuple[str, ast.AST]]:
    for node in tree.body:
        if isinstance(node, FUNCTION):
            yield node.name, node
        elif isinstance(node, ast.ClassDef):
            for part in node.body:
                method = isinstance(part, FUNCTION)
                yield (f"{node.name}.{part.name}" if method else node.name), part
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            target = node.targets[0] if isinstance(node, ast.Assign) else node.target
            yield ast.unparse(target), node


def units_of(package: Path) -> Units:
    units: Units = {}
    for path in sorted(package.rglob("*.py")):
        for name, part in named_parts(ast.parse(path.read_text(encoding="utf-8"))):
            units.setdefault(name, {}).setdefault(path, []).append(part)
    return units


def matches(parts: list[ast.AST], fragment: str) -> list[ast.AST]:
    """Nodes that read like a fragment, an expression or a statement, in the order of the code."""
    wanted = ast.parse(fragment).body[0]
    text = ast.dump(wanted.value if isinstance(wanted, ast.Expr) else wanted)
    found = [node for part in parts for node in ast.walk(part) if ast.dump(node) == text]
    return sorted(found, key=lambda node: (node.lineno, node.col_offset))


def find(units: Units, mutant: Mutant) -> tuple[Path, ast.AST]:
    """File and node of a mutant."""
    found = [
        (path, nodes[mutant.occurrence])
        for path, parts in units.get(mutant.function, {}).items()
        if len(nodes := matches(parts, mutant.original)) > mutant.occurrence
    ]
    if len(found) != 1:
        where = "nowhere" if not found else f"in {len(found)} files"
        raise LostError(f"{mutant.function}: {mutant.original!r} ({mutant.occurrence}) is {where}")
    return found[0]


def apply(path: Path, node: ast.AST, mutated: str) -> str:
    """The file with the node replaced."""
    lines = path.read_bytes().splitlines(keepends=True)
    begin = sum(map(len, lines[: node.lineno - 1])) + node.col_offset
    end = sum(map(len, lines[: node.end_lineno - 1])) + node.end_col_offset
    new = mutated if isinstance(node, ast.stmt) else f"({mutated})"
    whole = b"".join(lines)
    text = (whole[:begin] + new.encode() + whole[end:]).decode()
    ast.parse(text)
    return text


def changes(node: ast.AST, rng: random.Random) -> ast.AST | None:
    """A node with one operator or number changed; None if it has none of its own."""
    new = copy.deepcopy(node)
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.MatMult):
        new.left, new.right = new.right, new.left
    elif isinstance(node, ast.BinOp | ast.BoolOp | ast.AugAssign) and type(node.op) in SWAPPED:
        new.op = rng.choice(SWAPPED[type(node.op)])()
    elif isinstance(node, ast.Compare):
        new.ops[0] = rng.choice(SWAPPED[type(node.ops[0])])()
    elif isinstance(node, ast.UnaryOp):
        return new.operand
    elif isinstance(node, ast.Constant) and type(node.value) in (int, float):
        step = node.value + rng.choice((-1, 1))
        factor = (node.value or 1.0) * rng.choice((0.5, 2.0))
        new.value = step if isinstance(node.value, int) else factor
    else:
        return None
    return None if ast.dump(new) == ast.dump(node) else new


def places(node: ast.AST, around: ast.AST | None = None) -> Iterator[tuple[ast.AST, ast.AST]]:
    """Nodes of code that computes, each with the expression that tells where it is."""
    telling = (ast.BinOp, ast.Call, ast.Subscript, ast.Compare, ast.BoolOp, ast.AugAssign)
    if isinstance(node, ast.Raise | ast.JoinedStr):
        return
    around = node if isinstance(node, telling) or around is None else around
    yield node, node if isinstance(node, ast.UnaryOp) else around
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list"):
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.AST):
                inside = isinstance(node, INSIDE)
                yield from places(child, around if inside else None)


def write_list(mutants: list[Mutant]) -> None:
    with LIST.open("w", encoding="utf-8", newline="") as file:
        out = csv.DictWriter(file, [field.name for field in fields(Mutant)], lineterminator="\n")
        out.writeheader()
        out.writerows(asdict(mutant) for mutant in mutants)


def draw(known: list[Mutant]) -> list[Mutant]:
    """Random mutants of the science, and for each that is known to be equivalent another one."""
    package = ROOT / "src" / "psfdae"
    units = units_of(package)
    reasons = {replace(mutant, equivalent=""): mutant.equivalent for mutant in known}
    files = [[*changeable(units, [package / name])] for name in LATEST]
    every = [*changeable(units, [package / name for name in SCIENCE])]
    drawn: dict[Mutant, str] = {}
    for number in range(DRAWN):
        rng = random.Random(f"{SEED} {number}")
        able = files[number % len(files)] if number < DRAWN // 2 else every
        while sum(not equivalent for equivalent in drawn.values()) <= number:
            # A fragment of two files, or one that is assigned to, does not say where it is.
            with contextlib.suppress(LostError, ValueError):
                mutant = mutant_at(units, *rng.choice(able), rng)
                drawn[mutant] = reasons.get(mutant, "")
    return [replace(mutant, equivalent=reason) for mutant, reason in drawn.items()]


def changeable(units: Units, folders: list[Path]) -> Iterator[tuple[str, Path, ast.AST, ast.AST]]:
    """Name, file and `places` of all code in some folders that a mutant can change."""
    for name in sorted(units):
        for path, parts in units[name].items():
            if any(path.is_relative_to(folder) for folder in folders):
                for node, around in (place for part in parts for place in places(part)):
                    if changes(node, random.Random(0)):
                        yield name, path, node, around


def mutant_at(
    units: Units, name: str, path: Path, node: ast.AST, around: ast.AST, rng: random.Random
) -> Mutant:
    original = ast.unparse(around)
    occurrence = matches(units[name][path], original).index(around)
    new = Swap([*ast.walk(around)].index(node), changes(node, rng)).of(around)
    mutant = Mutant(name, original, ast.unparse(new), occurrence, "drawn", "")
    find(units, mutant)
    return mutant


class Swap(ast.NodeTransformer):
    """Puts another node in the place of one, known by its number in `ast.walk`."""

    def __init__(self, number: int, new: ast.AST) -> None:
        self.number, self.new = number, new

    def of(self, tree: ast.AST) -> ast.AST:
        tree = copy.deepcopy(tree)
        self.old = [*ast.walk(tree)][self.number]
        return self.visit(tree)

    def visit(self, node: ast.AST) -> ast.AST:
        return self.new if node is self.old else self.generic_visit(node)


def private_copy(folder: Path) -> None:
    """The files of the project, as they are now, in a folder of their own."""
    listed = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    names = subprocess.run(listed, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    for name in filter(None, names.split("\0")):
        if (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, folder / name)


def pytest(folder: Path, arguments: list[str]) -> tuple[int | None, str]:
    """Exit code (None if there is no end) and output of fast tests of a copy."""
    run = subprocess.Popen(
        [sys.executable, "-m", "pytest", "-q", "-x", "-rfE", *CHOICE, *arguments],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(folder / "src"), "OMP_NUM_THREADS": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )
    try:
        output = run.communicate(timeout=LIMIT)[0]
    except subprocess.TimeoutExpired:
        os.killpg(run.pid, signal.SIGKILL)
        return None, run.communicate()[0]
    return run.returncode, output


def near(folder: Path, path: Path) -> list[str]:
    """The test files that name a module."""
    *package, name = path.relative_to(ROOT / "src").with_suffix("").parts
    within = ".".join(package)
    named = re.compile(rf"{within}\.{name}\b|from {within} import (\([^)]*|[^\n(]*)\b{name}\b")
    tests = sorted(folder.glob("tests/test_*.py"))
    found = [test for test in tests if named.search(test.read_text(encoding="utf-8"))]
    return [str(test.relative_to(folder)) for test in found]


def fate(folder: Path, mutant: Mutant, number: int, unfit: list[str]) -> str:
    """What becomes of a mutant: the test that kills it, if one does.

    A test that fails without the mutant, too, goes to `unfit` and is not asked again.
    """
    path, node = find(units_of(ROOT / "src" / "psfdae"), mutant)
    place = folder / path.relative_to(ROOT)
    first = near(folder, path)
    stages = [first] if first else []
    for tests in [*stages, [f"--ignore={test}" for test in first]]:
        while True:
            place.write_text(apply(path, node, mutant.mutated), encoding="utf-8")
            # Compiled code is known by whole seconds and its size.
            os.utime(place, (0, time.time() + 10 * number))
            code, output = pytest(folder, [*tests, *(f"--deselect={test}" for test in unfit)])
            shutil.copy2(path, place)
            if code in NOTHING_FAILED:
                break
            if code is None:
                return f"killed: no end within {LIMIT} s"
            told = re.search(r"^(?:FAILED|ERROR) (.+?)(?: - |$)", output, re.MULTILINE)
            killer = told[1] if told else ""
            # Without the name of a test, what failed is the import of its file or of all.
            whole = [] if "::" in killer else ["--collect-only"]
            if pytest(folder, [*whole, *filter(None, [killer])])[0] == 0:
                return f"killed: {killer or 'no test can be imported'}"
            if whole or killer in unfit:
                raise SystemExit(f"{killer or 'tests'}: fails without a mutant, too")
            print(f"{killer} fails without a mutant, too: not used", flush=True)
            unfit.append(killer)
    return "alive"


def run(words: list[str]) -> int:
    """Apply the mutants one by one and tell what became of them; 1 if too many live."""
    os.nice(10)
    resource.setrlimit(resource.RLIMIT_DATA, (MEMORY, MEMORY))
    chosen = [
        (number, mutant)
        for number, mutant in enumerate(read_list(), 1)
        if not mutant.equivalent and (not words or any(word in str(mutant) for word in words))
    ]
    dead, unfit = 0, []
    with tempfile.TemporaryDirectory() as temporary:
        private_copy(folder := Path(temporary))
        for number, mutant in chosen:
            start = time.monotonic()
            found = fate(folder, mutant, number, unfit)
            dead += found.startswith("killed")
            print(f"{number:3d} {mutant.function}: {mutant.original} -> {mutant.mutated}")
            print(f"    {found} ({time.monotonic() - start:.0f} s)", flush=True)
    print(f"{dead} of {len(chosen)} killed")
    return int(dead < LEAST * len(chosen))


def main() -> int:
    match sys.argv[1:]:
        case ["run", *words]:
            return run(words)
        case ["draw"]:
            known = read_list()
            write_list([*(mutant for mutant in known if mutant.source != "drawn"), *draw(known)])
            return 0
    print(__doc__)
    return 2


if __name__ == "__main__":
    sys.exit(main())
