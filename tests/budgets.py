"""How large the project is, beside what it may be: `python tests/budgets.py`."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

from psfdae.method import Method

ROOT = Path(__file__).resolve().parents[1]
PARTS = ("src", "tests", "workflow", "config", "docs")
TEXTS = {".py", ".smk", ".sh", ".md", ".yaml", ".csv", ".rst", ".css"}
CLASS, FUNCTION = 300, 80  # lines
CONSTANTS = 12  # numbers with a name, per module


def lines(folder: str, *suffixes: str) -> int:
    files = (path for path in (ROOT / folder).rglob("*") if path.suffix in (suffixes or TEXTS))
    return sum(len(path.read_text(encoding="utf-8").splitlines()) for path in files)


def modules(package: str) -> dict[Path, ast.Module]:
    paths = sorted((ROOT / "src" / package).rglob("*.py"))
    return {path: ast.parse(path.read_text(encoding="utf-8")) for path in paths}


def docstrings(tree: ast.Module) -> int:
    texts = [n for n in ast.walk(tree) if isinstance(n, ast.Expr)]
    texts = [
        n for n in texts if isinstance(n.value, ast.Constant) and isinstance(n.value.value, str)
    ]
    return sum(node.end_lineno - node.lineno + 1 for node in texts)


def longer(tree: ast.Module, kinds: type | tuple[type, ...], most: int) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, kinds) and (size := node.end_lineno - node.lineno + 1) > most:
            yield f"{node.name} {size}"


def constants(tree: ast.Module) -> int:
    """Names of numbers at module level."""
    numbers = [n for n in tree.body if isinstance(n, ast.Assign) and not calls(n.value)]
    return sum(any(is_number(v) for v in ast.walk(n.value)) for n in numbers)


def calls(node: ast.AST) -> bool:
    return any(isinstance(inner, ast.Call | ast.Lambda) for inner in ast.walk(node))


def is_number(node: ast.AST) -> bool:
    return isinstance(node, ast.Constant) and type(node.value) in (int, float)


def main() -> None:
    both = {name: modules(name) for name in ("psfdae", "psfdae_paper")}
    sizes = {part: lines(part) for part in PARTS}
    source = sum(lines(f"src/{name}", ".py") for name in both)
    rows = [
        (f"{name}: {what}", found, most)
        for name, budget in (("psfdae", (11_000, 50)), ("psfdae_paper", (14_000, 65)))
        for what, found, most in zip(
            ("lines", "files"), (lines(f"src/{name}", ".py"), len(both[name])), budget, strict=True
        )
    ]
    texts = sum(docstrings(tree) for trees in both.values() for tree in trees.values())
    rows += [
        ("tests over source", sizes["tests"] / source, 0.65),
        ("lines of docs", sizes["docs"], 3000),
        ("all lines", sum(sizes.values()), 50_000),
        ("lines of studies without tables", lines("studies", ".py", ".md", ".sh"), 1200),
        ("docstrings over source (at least)", texts / source, 0.2),
        ("members of Method", sum(not n.startswith("_") for n in vars(Method)), 20),
    ]
    for what, found, most in rows:
        print(f"{what:36} {found:10.4g} {most:10.4g}")
    for path, tree in (item for trees in both.values() for item in trees.items()):
        long = [*longer(tree, ast.ClassDef, CLASS), *longer(tree, ast.FunctionDef, FUNCTION)]
        many = [f"{constants(tree)} constants"] if constants(tree) > CONSTANTS else []
        if found := ", ".join([*long, *many]):
            print(f"{path.relative_to(ROOT)}: {found}")


if __name__ == "__main__":
    main()
