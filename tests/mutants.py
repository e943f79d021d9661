"""Mutants of the science: do the fast tests notice a wrong sign, factor or limit?

    python tests/mutants.py [WORD …]    apply the mutants whose row holds a word, one by one

`mutants.csv` names every mutant by its function, a fragment of the code and which occurrence of
the fragment in the function it is, so that code may move to another module. Each meets the test
files that name its module first, then the other fast tests, in a copy of the project.
"""

from __future__ import annotations

import ast
import csv
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
LIST = Path(__file__).with_suffix(".csv")
FAST = ["-m", "not slow and not written and not workflow", "--ignore=tests/test_mutants.py"]
FUNCTION = (ast.FunctionDef, ast.AsyncFunctionDef)


@dataclass(frozen=True)
class Mutant:
    """A row of the list; `equivalent` is the reason why no test can notice it, if there is one."""

    function: str
    original: str
    mutated: str
    occurrence: int
    source: str
    equivalent: str


def read_list() -> list[Mutant]:
    with LIST.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    return [Mutant(**{**row, "occurrence": int(row["occurrence"])}) for row in rows]


def named_parts(tree: ast.Module) -> Iterator[tuple[str, ast.AST]]:
    """Functions, methods, classes without their methods, and constants, with their names."""
    for node in tree.body:
        if isinstance(node, FUNCTION):
            yield node.name, node
        elif isinstance(node, ast.ClassDef):
            for part in node.body:
                yield f"{node.name}.{part.name}" if isinstance(part, FUNCTION) else node.name, part
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            target = node.targets[0] if isinstance(node, ast.Assign) else node.target
            yield ast.unparse(target), node


@cache
def parts_below(sources: Path) -> dict[str, list[tuple[Path, ast.AST]]]:
    parts: dict[str, list[tuple[Path, ast.AST]]] = {}
    for path in sorted(sources.rglob("*.py")):
        for name, part in named_parts(ast.parse(path.read_text(encoding="utf-8"))):
            parts.setdefault(name, []).append((path, part))
    return parts


def find(sources: Path, mutant: Mutant) -> tuple[Path, ast.AST]:
    """File and node of a mutant below a folder; LookupError unless there is exactly one."""
    original_node = ast.parse(mutant.original).body[0]
    text = ast.dump(original_node.value if isinstance(original_node, ast.Expr) else original_node)
    equal_nodes: dict[Path, list[ast.AST]] = {}
    for path, part in parts_below(sources).get(mutant.function, ()):
        equal_nodes.setdefault(path, []).extend(n for n in ast.walk(part) if ast.dump(n) == text)
    paths = [path for path, nodes in equal_nodes.items() if len(nodes) > mutant.occurrence]
    if len(paths) != 1:
        raise LookupError(f"{mutant.function}: {mutant.original!r} is in {len(paths)} files, not 1")
    nodes = sorted(equal_nodes[paths[0]], key=lambda node: (node.lineno, node.col_offset))
    return paths[0], nodes[mutant.occurrence]


def mutated(path: Path, node: ast.AST, text: str) -> str:
    """The file with the node replaced."""
    lines = path.read_bytes().splitlines(keepends=True)
    begin = sum(map(len, lines[: node.lineno - 1])) + node.col_offset
    end = sum(map(len, lines[: node.end_lineno - 1])) + node.end_col_offset
    new = text if isinstance(node, ast.stmt) else f"({text})"
    source_bytes = b"".join(lines)
    return (source_bytes[:begin] + new.encode() + source_bytes[end:]).decode()


def main(words: list[str]) -> None:
    selected = [m for m in read_list() if not m.equivalent]
    selected = [m for m in selected if not words or any(word in str(m) for word in words)]
    tracked = subprocess.check_output(["git", "ls-files"], cwd=ROOT, text=True).splitlines()
    for mutant in selected:
        with tempfile.TemporaryDirectory() as folder:
            for name in tracked:
                Path(folder, name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy(ROOT / name, Path(folder, name))
            path, node = find(Path(folder, "src"), mutant)
            path.write_text(mutated(path, node, mutant.mutated), encoding="utf-8")
            module = re.compile(rf"\b{path.stem}\b")
            tests = sorted(Path(folder).glob("tests/test_*.py"))
            by_name = {True: [], False: []}
            for test in tests:
                by_name[bool(module.search(test.read_text(encoding="utf-8")))].append(str(test))
            # Few files are collected quickly; most mutants meet their end there.
            code = 0
            for files in filter(None, (by_name[True], by_name[False])):
                line = [sys.executable, "-m", "pytest", "-qx", *FAST, *files]
                variables = {**os.environ, "PYTHONPATH": "src"}
                code = subprocess.run(line, cwd=folder, env=variables, check=False).returncode
                if code not in (0, 5):  # 5: all tests of these files are slow ones
                    break
        # Other codes of pytest say that no test was tried.
        fate = {0: "alive", 1: "killed"}[code]
        print(f"{fate}  {mutant.function}: {mutant.original} -> {mutant.mutated}", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
