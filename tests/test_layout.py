"""Each test file stands alone: what several share is in tests/helpers."""

from __future__ import annotations

import ast

from docs_pages import ROOT


def test_no_test_file_imports_another():
    paths = sorted((ROOT / "tests").rglob("test_*.py"))
    names, imports = {path.stem for path in paths}, set()
    for path in paths:
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Import):
                words = {word for name in node.names for word in name.name.split(".")}
            elif isinstance(node, ast.ImportFrom):
                words = {*(node.module or "").split("."), *(name.name for name in node.names)}
            else:
                continue
            imports |= {(path.stem, word) for word in words & names}
    assert len(paths) > 90 and imports == set()
