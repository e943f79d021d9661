"""Run the cells of a notebook in an empty folder, and keep what they show.

    python docs/notebook.py docs/first_session.ipynb               # renew what it shows
    python docs/notebook.py docs/first_session.ipynb trial.ipynb   # in another file

The cells are what Jupyter takes: Python, and lines of the shell that begin with an exclamation
mark. No package beyond those of psfdae is needed, so that a test runs them in a plain installation.
The same code gives the same file: it has no times, and no addresses of objects.
"""

from __future__ import annotations

import ast
import base64
import io
import json
import os
import re
import subprocess
import sys
import tempfile
from contextlib import chdir, redirect_stdout
from pathlib import Path
from typing import Any

RANDOM_ID = re.compile(r' id="table\d+"')
"""Attribute of the tables of astropy that differs from run to run."""


def run(cells: list[dict[str, Any]]) -> None:
    """Run code cells one after the other in the folder, and put in what each shows."""
    names: dict[str, Any] = {"__name__": "__main__"}
    code_cells = (cell for cell in cells if cell["cell_type"] == "code")
    for count, cell in enumerate(code_cells, start=1):
        outputs: list[dict[str, Any]] = []
        # A line of the shell is one of Python for what follows.
        source = re.sub(r"^!(.*)", r"shell(r'''\1''')", "".join(cell["source"]), flags=re.M)
        names["shell"] = shell
        # The last line is shown if it is an expression without a semicolon.
        *lines, last = ast.parse(source).body
        value, printed = None, io.StringIO()
        with redirect_stdout(printed):
            exec(compile(ast.Module(lines, []), "cell", "exec"), names)
            if isinstance(last, ast.Expr) and not source.rstrip().endswith(";"):
                value = eval(compile(ast.Expression(last.value), "cell", "eval"), names)
            else:
                exec(compile(ast.Module([last], []), "cell", "exec"), names)
        if printed.getvalue():
            text = printed.getvalue().splitlines(keepends=True)
            outputs.append({"output_type": "stream", "name": "stdout", "text": text})
        if value is not None:
            data = {"execution_count": count, "data": shown(value), "metadata": {}}
            outputs.append({"output_type": "execute_result", **data})
        outputs += figures()
        cell["outputs"], cell["execution_count"] = outputs, count


def shell(line: str) -> None:
    """Run a line in a shell that has the programs of this Python, and print what it prints."""
    programs = str(Path(sys.executable).parent)
    path = os.pathsep.join([programs, os.environ["PATH"]])
    environment = {**os.environ, "PATH": path}
    process = subprocess.run(
        line, shell=True, env=environment, text=True, stdout=subprocess.PIPE, check=True
    )
    print(process.stdout, end="")


def shown(value: object) -> dict[str, list[str]]:
    """Return the text of a value, and its HTML if it has any, as lines."""
    forms = {"text/plain": repr(value)}
    if hasattr(value, "_repr_html_"):
        forms["text/html"] = RANDOM_ID.sub("", value._repr_html_())
    return {name: text.splitlines(keepends=True) for name, text in forms.items()}


def figures() -> list[dict[str, Any]]:
    """Return the open figures of pyplot as outputs, and close them."""
    outputs: list[dict[str, Any]] = []
    if "matplotlib.pyplot" in sys.modules:
        from matplotlib import pyplot

        for number in pyplot.get_fignums():
            content, figure = io.BytesIO(), pyplot.figure(number)
            figure.savefig(content, dpi=72, bbox_inches="tight", metadata={"Software": None})
            png = base64.b64encode(content.getvalue()).decode()
            data = {"data": {"image/png": png}, "metadata": {}}
            outputs.append({"output_type": "display_data", **data})
        pyplot.close("all")
    return outputs


def main() -> None:
    """Run the notebook that the command line names, and write it."""
    os.environ["MPLBACKEND"] = "agg"  # figures are files, not windows
    source, out = Path(sys.argv[1]), Path(sys.argv[-1]).resolve()
    notebook = json.loads(source.read_text(encoding="utf-8"))
    with tempfile.TemporaryDirectory() as folder, chdir(folder):
        run(notebook["cells"])
    text = json.dumps(notebook, ensure_ascii=False, indent=1)
    out.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
