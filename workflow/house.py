"""Compare how the Python code reads with an earlier commit, and print what got worse.

    python workflow/house.py [COMMIT]      # default: the merge base with origin/main, or the parent

Counted for each folder:

code             lines that are neither blank, comment nor docstring
names            variables, arguments and attributes called by a bare participle, pronoun or
                 preposition (`measured`, `those`, `beyond`), which says nothing of the value
functions        functions whose name is not a verb: it begins with a participle or a preposition,
                 or has `_of`
bare entries     entries under Parameters with a type and no description
phrases          "that of", "those of", "told", "stated" in docstrings and comments
"""

import ast
import io
import re
import subprocess
import sys
import tarfile
import tempfile
import tokenize
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("src/psfdae", "src/psfdae_paper", "tests", "workflow")
VAGUE = re.compile(
    "said|told|found|made|known|seen|given|taken|tried|kept|left|lost|placed|wanted|asked|allowed"
    "|chosen|drawn|done|gone|met|moved|spoken|written|meant|held|learnt|some|each|others?|both|own"
    "|whole|same|such|many|more|most|less|least|few|near|far|further|best|worse|usual|before|after"
    "|beside|beyond|within|without|rest|ones?|these|this|those|that|there|here|where|when|like"
    "|unlike|it|them|they|much|little|free|alone|again|what|which|who|whose|why|how|[a-z]{2,}[^e]ed"
)
NO_VERB = re.compile(
    r"(of|by|as|in|from|with|without|under|at|on|for|beyond|where|which|what|that|[a-z]+[^e]ed)(_|$)"
    r"|.*_of(_|$)"
)
PHRASES = re.compile(r"\b((that|those) of|told|stated?)\b")
BARE_ENTRY = re.compile(r"^( *)\w[\w, ]* : [^\n]+\n(?=\1\w[\w, ]* : |\s*\n|\Z)", re.MULTILINE)


def count_file(text):
    """Return the counts of a file as a dictionary."""
    tree = ast.parse(text)
    names = [
        getattr(node, "id", None) or getattr(node, "attr", None) or node.arg
        for node in ast.walk(tree)
        if (isinstance(node, ast.Name | ast.Attribute) and isinstance(node.ctx, ast.Store))
        or isinstance(node, ast.arg)
    ]
    functions = [n.name for n in ast.walk(tree) if isinstance(n, ast.FunctionDef)]
    # Docstrings, and strings below variables.
    strings = [
        node
        for node in ast.walk(tree)
        if isinstance(node, ast.Expr) and isinstance(getattr(node.value, "value", None), str)
    ]
    docstring_lines = {i for node in strings for i in range(node.lineno, node.end_lineno + 1)}
    comments = [
        token.string
        for token in tokenize.generate_tokens(io.StringIO(text).readline)
        if token.type == tokenize.COMMENT
    ]
    code_lines = [
        line
        for number, line in enumerate(text.splitlines(), 1)
        if line.strip() and not line.strip().startswith("#") and number not in docstring_lines
    ]
    docstrings = [ast.literal_eval(node.value) for node in strings]
    sections = [doc.partition("Parameters\n")[2].partition("\n\n")[0] for doc in docstrings]
    return {
        "code": len(code_lines),
        "names": sum(bool(VAGUE.fullmatch(name.strip("_"))) for name in names),
        "functions": sum(bool(NO_VERB.match(name.strip("_"))) for name in functions),
        "bare entries": sum(len(BARE_ENTRY.findall(section + "\n")) for section in sections),
        "phrases": sum(len(PHRASES.findall(doc)) for doc in [*docstrings, *comments]),
    }


def count_folder(folder):
    """Return the sums of the counts of all files below a folder."""
    counts = [count_file(path.read_text("utf-8")) for path in sorted(folder.rglob("*.py"))]
    return {name: sum(count[name] for count in counts) for name in counts[0]} if counts else {}


def git(*words):
    """Return the output of git, or b"" if it fails."""
    run = subprocess.run(["git", *words], cwd=ROOT, capture_output=True, check=False)
    return run.stdout if run.returncode == 0 else b""


def main():
    """Print each count that is larger than at the earlier commit."""
    base = sys.argv[1] if len(sys.argv) > 1 else git("merge-base", "HEAD", "origin/main").decode()
    head = git("rev-parse", "HEAD").decode()
    base = base.strip() if base.strip() not in ("", head.strip()) else "HEAD^"
    archive = git("archive", base, *FOLDERS)
    if not archive:
        print(f"{base}: no such commit here, nothing to compare with")
        return
    with tempfile.TemporaryDirectory() as earlier:
        with tarfile.open(fileobj=io.BytesIO(archive)) as tar:
            tar.extractall(earlier, filter="data")
        for folder in FOLDERS:
            before, after = (count_folder(root / folder) for root in (Path(earlier), ROOT))
            for name, count in after.items():
                if count > before.get(name, 0):
                    print(f"{folder}: {name} {before.get(name, 0)} → {count} since {base[:10]}")


if __name__ == "__main__":
    main()
