"""Count how a folder of Python reads, and refuse what reads worse than before.

    python workflow/house.py            # exit code 1 if a number is worse than in tests/house.csv
    python workflow/house.py --renew    # write the numbers as they are

A row of tests/house.csv is a folder. Code lines are those that are neither blank nor a comment or
docstring. A vague name is a bare participle, pronoun or adjective, which says nothing of what the
value is. A docstring without a subject begins with a preposition or with Which, Where, What or
That. Constants are names in capitals at the top of a module.
"""

import ast
import csv
import re
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
TABLE = ROOT / "tests/house.csv"
VAGUE = re.compile(
    "(said|told|found|made|known|seen|given|taken|tried|kept|left|lost|placed|wanted|asked|allowed"
    "|chosen|drawn|done|gone|met|moved|spoken|written|meant|held|some|each|others?|both|own|whole"
    "|same|such|many|more|most|less|least|few|near|nearer|far|further|wide|wider|widest|better|best"
    "|worse|right|wrong|strange|usual|alike|before|after|beside|beyond|within|without|inner|outer"
    "|rest|ones?|these|this|those|that|there|here|where|when|like|unlike|even|odd|ours|mine|theirs"
    "|it|them|they|much|little|free|apart|together|alone|again|what|which|who|whose|why|how)"
)
OPENING = re.compile(
    r"(Of|By|As|Likewise|In|From|With|Without|Under|At|On|For|To|Beyond|Where|Which|What|That)\s"
)
DEFINITIONS = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)


def bound_names(tree):
    """Yield all names that a module binds: variables, arguments, attributes, functions, classes."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Name | ast.Attribute) and isinstance(node.ctx, ast.Store):
            yield getattr(node, "id", None) or node.attr
        elif isinstance(node, ast.arg):
            yield node.arg
        elif isinstance(node, DEFINITIONS):
            yield node.name


def text_nodes(tree):
    """Yield the docstrings of a module, its classes and functions, and those below variables."""
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if not isinstance(node, (ast.Module, *DEFINITIONS)) or not body:
            continue
        for above, below in zip([None, *body], body, strict=False):
            value = isinstance(below, ast.Expr) and getattr(below.value, "value", None)
            if isinstance(value, str) and isinstance(above, None | ast.Assign | ast.AnnAssign):
                yield below, value


def measured(folder):
    """Return the counts of a folder and all below it."""
    count = dict.fromkeys(("code", "comments", "vague", "no_subject", "constants"), 0)
    for path in sorted((ROOT / folder).rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        tree = ast.parse(text)
        texts = list(text_nodes(tree))
        docstring_lines = {i for node, _ in texts for i in range(node.lineno, node.end_lineno + 1)}
        for number, line in enumerate(text.splitlines(), 1):
            bare = line.strip()
            is_code = bool(bare) and not bare.startswith("#") and number not in docstring_lines
            count["code"] += is_code
            count["comments"] += bare.startswith("#") or (is_code and "  # " in line)
        count["vague"] += sum(
            bool(VAGUE.fullmatch(name.strip("_").lower())) for name in bound_names(tree)
        )
        count["no_subject"] += sum(bool(OPENING.match(value.lstrip())) for _, value in texts)
        count["constants"] += sum(
            isinstance(name, ast.Name) and name.id.isupper()
            for node in tree.body
            if isinstance(node, ast.Assign)
            for target in node.targets
            for name in ast.walk(target)
        )
    return count


def main():
    """Compare all folders with the table, or renew it."""
    with TABLE.open(newline="", encoding="utf-8") as file:
        table = {row.pop("folder"): row for row in csv.DictReader(file)}
    current = {folder: measured(folder) for folder in table}
    if "--renew" in sys.argv:
        with TABLE.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(["folder", *next(iter(current.values()))])
            writer.writerows([folder, *count.values()] for folder, count in current.items())
        return 0
    regressions = [
        f"{folder}: {name} {value}, {table[folder][name]} before"
        for folder, count in current.items()
        for name, value in count.items()
        # Of comments there are to be more.
        if (value - int(table[folder][name])) * (-1 if name == "comments" else 1) > 0
    ]
    if regressions:
        print("Reads worse than tests/house.csv says:", *regressions, sep="\n  ")
        print("Lower another number by as much, then: python workflow/house.py --renew")
    return bool(regressions)


if __name__ == "__main__":
    sys.exit(main())
