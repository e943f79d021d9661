"""What the rerun hash of a rule depends on, and what not: edits of a copy of the package."""

from __future__ import annotations

import ast
import re
import shutil
from functools import cache
from textwrap import dedent

import pytest

from psfdae_paper.configuration.methods import registered
from psfdae_paper.source import ROOT, Code, Reader, source_hash

REPOSITORY = ROOT.parents[1]
OPTIONS = {
    "scene": ("seidel", "turbulence", "telescope"),
    "method": ("dae", "pca_som"),
    "_figure": ("predicted", "errors", "correlation"),
    "_command": ("bounds", "efficiency", "bank-growth"),
}
METHODS = [kind.__module__ for kind in registered()]
EXEMPT = {
    "psfdae.cli": "the module of the command that runs",
}


@cache
def rules():
    """Functions and chosen modules of every rule; of one for several scenes or methods, each."""
    found = {}
    for path in sorted(REPOSITORY.glob("workflow/rules/*.smk")):
        text = path.read_text()
        for rule, body in re.findall(r"(?ms)^ *(?:use )?rule\b([^:]*):\n(.*?)(?=^\S|\Z)", text):
            call = re.search(r"(?s)(\w+)_(hash|source)\((?:[^()]|\([^()]*\))*\)", body)
            if call is None or call[1] == "sweep":
                continue
            kind = next((k for k in OPTIONS if re.search(rf"\{{[^}}]*{k}[^}}]*\}}", call[0])), "")
            for option in OPTIONS.get(kind, ("",)):
                said = re.sub(r"\{[^}]*\.title\(\)\}", option.title(), call[0])
                node = ast.parse(re.sub(r"\{[^}]*\}", option, said).replace('f"', '"')).body[0]
                functions = [a.value for a in node.value.args if isinstance(a, ast.Constant)]
                words = {k.arg: k.value for k in node.value.keywords}
                named = words.get("chosen", ast.List([]))
                chosen = ast.literal_eval(named) if isinstance(named, ast.List) else [*METHODS]
                chosen += METHODS if call[1] == "estimators" else []
                name = " ".join(
                    [*re.findall(r"\w+", rule.replace(" with", ""))[-1:], option]
                ).strip()
                found[name] = (tuple(functions), frozenset(chosen))
    return found


def hashes(root):
    code = Code(root)
    return {rule: code.hash(*arguments) for rule, arguments in rules().items()}


@pytest.fixture(scope="module")
def before():
    return hashes(ROOT)


@pytest.fixture
def changed(tmp_path, before):
    """Rules whose hash differs after a text of a module is replaced."""

    def edit(module, *replaced):
        for folder in ("src/psfdae", "workflow/benchmarks", "tests/stress"):
            ignored = shutil.ignore_patterns("__pycache__")
            shutil.copytree(REPOSITORY / folder, tmp_path / folder, ignore=ignored)
        path = tmp_path / "src/psfdae" / module
        text = path.read_text()
        for old, new in replaced:
            assert old in text
            text = text.replace(old, new)
        path.write_text(text)
        after = hashes(tmp_path / "src/psfdae")
        return {rule for rule in before if before[rule] != after[rule]}

    return edit


def test_every_rule_has_a_hash(before):
    assert {"templates seidel", "stars turbulence", "dae", "evaluate"} <= before.keys()
    assert len(before) > 60


def test_formula_of_the_settings(changed):
    """The pixel in λ/D is computed, in no file: what is made with it is made again."""
    found = changed(
        "configuration/telescope.py", ("return pixel_width", "return 1.0 * pixel_width")
    )
    assert {"templates seidel", "templates turbulence", "bank", "dataset_bounds"} <= found
    assert not {"dae", "pca_som", "evaluate", "calibrate", "track"} & found


def test_scene(changed):
    """Data of that scene, and of no other."""
    found = changed("stars/scenes.py", ("SLOPE_MARGIN * slopes", "slopes * SLOPE_MARGIN"))
    assert {"templates turbulence", "stars turbulence"} <= found
    for name in ("templates seidel", "stars seidel", "telescope_stars", "bank", "dae"):
        assert name not in found


def test_method(changed):
    """The fits of one method, and what applies all of them."""
    found = changed("estimators/pca_som.py", ("@ self.components", "@ (1 * self.components)"))
    assert {"pca_som", "evaluate", "figure_strip"} <= found
    assert not {"templates seidel", "stars seidel", "dae", "knee_train", "alignment_dae"} & found


def test_words(changed):
    """Comments, docstrings, formatting, annotations and descriptions of settings."""
    found = changed(
        *("configuration/schema.py", ('description="', 'description="Namely: '), ('"""', '"""  ')),
        ("from __future__", "# A comment.\nfrom __future__"),
    )
    assert found == set()


@pytest.fixture
def small(tmp_path):
    """Hash of `main:run` in a package of the given modules."""

    def hashed(*functions, chosen=(), **modules):
        root = tmp_path / str(len(list(tmp_path.iterdir()))) / "src" / "psfdae"
        for name, text in {"__init__": "", "configuration/__init__": "", **modules}.items():
            path = root / f"{name}.py"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(dedent(text))
        return Code(root).hash(functions or ["psfdae.main:run"], chosen)

    return hashed


MAIN = """
import numpy as np
from psfdae.shapes import Square, side

LIMIT = 3

class Frame(Square):
    width: int = 2

def run(level, side_px=LIMIT):
    from psfdae.noise import draw
    return draw(Frame().area(side), level) * np.linalg.norm([side_px])
"""
SHAPES = """
FACTOR = 2

class Shape:
    def area(self, side):
        return FACTOR * side**2

class Square(Shape):
    pass

side = 5

def unused():
    return 1
"""
NOISE = """
def draw(image, level):
    return image + level

def other():
    return LIST

LIST = [1]
"""


@pytest.mark.parametrize(
    ("module", "old", "new"),
    [
        ("main", "LIMIT = 3", "LIMIT = 4"),
        ("main", "width: int = 2", "width: int = 3"),
        ("main", "width: int", "width: float"),
        ("main", "np.linalg.norm", "np.sum"),
        ("main", "def run(level, side_px=LIMIT)", "def run(level, side_px=4)"),
        ("shapes", "FACTOR = 2", "FACTOR = 3"),
        ("shapes", "FACTOR * side**2", "side**2 * FACTOR"),
        ("shapes", "side = 5", "side = 6"),
        ("shapes", "side = 5", "side = 5\n\nside += 1"),
        ("shapes", "class Square(Shape)", "class Square"),
        ("noise", "image + level", "image - level"),
        ("noise", "def draw", "import psfdae.shapes\npsfdae.shapes.FACTOR = 3\n\ndef draw"),
        ("noise", "def draw", "@cache\ndef draw"),
    ],
)
def test_what_counts(small, module, old, new):
    modules = {"main": MAIN, "shapes": SHAPES, "noise": NOISE}
    before = small(**modules)
    assert old in modules[module]
    assert small(**{**modules, module: modules[module].replace(old, new)}) != before


@pytest.mark.parametrize(
    ("module", "old", "new"),
    [
        ("main", "def run(level", "# A comment.\ndef run(level"),
        ("main", "    from psfdae", '    """Draw."""\n    from psfdae'),
        (
            "main",
            "def run(level, side_px=LIMIT)",
            "def run(level: float, side_px: int=LIMIT) -> int",
        ),
        ("main", "import numpy as np", "import numpy as np\nimport scipy"),
        ("main", "np", "numpy"),
        ("main", "class Frame", "def unreached():\n    return LIMIT\n\nclass Frame"),
        ("shapes", "    return 1", "    return 2"),
        ("shapes", "    pass", '    """A square."""'),
        ("noise", "LIST = [1]", "LIST = [2]"),
    ],
)
def test_what_does_not_count(small, module, old, new):
    modules = {"main": MAIN, "shapes": SHAPES, "noise": NOISE}
    before = small(**modules)
    assert old in modules[module]
    new = new.replace("import numpy as numpy", "import numpy")
    assert small(**{**modules, module: modules[module].replace(old, new)}) == before


def test_moved_code_is_the_same(small):
    """Another module, another name of a module, a parameter that hides a function."""
    before = small(main=MAIN, shapes=SHAPES, noise=NOISE)
    moved = MAIN.replace("psfdae.noise", "psfdae.main.noises").replace(
        "psfdae.shapes", "psfdae.forms"
    )
    assert small(main=moved.replace("main.noises", "noises"), forms=SHAPES, noises=NOISE) == before
    one = MAIN.replace("from psfdae.shapes import Square, side", SHAPES)
    assert small(main=one, noise=NOISE) == before
    named = "def run(other):\n    return other + 1\n"
    assert small(main=named) == small(main=named + "\ndef other():\n    return 2\n")


def test_same_names_in_two_modules_are_told_apart(small):
    first, second = "def load():\n    return 1\n", "def load():\n    return 2\n"
    main = """
    from psfdae import one, two

    def run():
        return one.load() - two.load()
    """
    assert small(main=main, one=first, two=second) != small(main=main, one=second, two=first)


COLOURS = {"red_scene": "def draw():\n    return 1\n", "blue_scene": "def draw():\n    return 2\n"}
BY_NAME = """
from importlib import import_module

MODULES = {"red": "psfdae.red_scene", "blue": "psfdae.blue_scene"}

def run(name):
    return import_module(f"psfdae.{name}_scene").draw()

def listed(name):
    return import_module(MODULES[name]).draw()
"""


def test_function_of_a_module_chosen_by_name(small):
    """Of the module only that function counts."""
    red = COLOURS["red_scene"]

    def hashed(more):
        modules = {**COLOURS, "red_scene": red + more}
        return small(chosen=["psfdae.red_scene:draw"], main=BY_NAME, **modules)

    before = hashed("")
    assert hashed("\ndef other():\n    return 3\n") == before
    assert hashed("\n@print\ndef draw():\n    return 3\n") != before


CHOSEN = """
BASE = 2
WIDEST = 3 * BASE
SIDES = (WIDEST, 7)

def draw():
    return sum(SIDES)
"""


@pytest.mark.parametrize("old", ["= 2", "= 3", ", 7"])
def test_constants_of_a_chosen_module(small, old):
    """Those that are made of other ones, too: no choice is made between them."""
    modules = {**COLOURS, "main": BY_NAME, "red_scene": CHOSEN}
    before = small(chosen=["psfdae.red_scene"], **modules)
    modules["red_scene"] = CHOSEN.replace(old, old.replace(old[-1], "5"))
    assert small(chosen=["psfdae.red_scene"], **modules) != before


@pytest.mark.parametrize("function", ["psfdae.main:run", "psfdae.main:listed"])
def test_modules_chosen_by_name(small, function):
    """All of them count, unless the rule says which."""
    changed = {**COLOURS, "blue_scene": "def draw():\n    return 3\n"}
    for chosen, same in (((), False), (["psfdae.blue_scene"], False), (["psfdae.red_scene"], True)):
        found = [small(function, chosen=chosen, main=BY_NAME, **m) for m in (COLOURS, changed)]
        assert (found[0] == found[1]) == same
    more = {**COLOURS, "green_scene": "def draw():\n    return 4\n"}
    longer = BY_NAME.replace('"blue":', '"green": "psfdae.green_scene", "blue":')
    red = {"chosen": ["psfdae.red_scene"]}
    assert small(function, **red, main=longer, **more) == small(
        function, **red, main=BY_NAME, **COLOURS
    )


def test_entries_of_a_constant(small):
    """Who looks something up depends on all that is listed, or on what the rule chooses."""
    main = """
    from psfdae import means, medians

    KNOWN = {"mean": means.Mean, "median": medians.Median}

    def run(name):
        return KNOWN[name]().fit()
    """
    mean = "class Mean:\n    def fit(self):\n        return 1\n"
    medians = [f"class Median:\n    def fit(self):\n        return {n}\n" for n in (2, 3)]
    for chosen, same in (
        ((), False),
        (["psfdae.means:Mean"], True),
        (["psfdae.means"], True),
        (["psfdae.medians"], False),
    ):
        found = [small(chosen=chosen, main=main, means=mean, medians=m) for m in medians]
        assert (found[0] == found[1]) == same


def test_settings_that_a_command_reads(small):
    """The decorator names them; a class of options is made from its annotation."""
    schema = """
    from pydantic import BaseModel, Field

    class Noise(BaseModel):
        level: float = Field(ge=0, description="Level")

        @property
        def twice(self):
            return 2 * self.level

    class Stars(BaseModel):
        count: int

    class Config(BaseModel):
        noise: Noise
        stars: Stars
    """
    main = """
    from psfdae.cli import command
    from psfdae.schema import Config

    READS = ("noise",)

    class Options:
        def path(self):
            return 1

    @command("run it", reads=READS)
    def run(config: Config, options: Options):
        return config.noise.twice
    """
    modules = {
        "main": main,
        "configuration/schema": schema,
        "cli": "def command(*a, **k):\n    ...",
    }
    modules["main"] = main.replace("psfdae.schema", "psfdae_paper.configuration.schema")

    def after(module, old, new):
        assert old in modules[module]
        return small("run it", **{**modules, module: modules[module].replace(old, new)})

    before = small("run it", **modules)
    assert after("configuration/schema", "2 * self.level", "3 * self.level") != before
    assert after("main", "return 1", "return 2") != before
    assert after("configuration/schema", "count: int", "count: float") == before
    assert after("configuration/schema", '"Level"', '"Level of the noise"') == before
    assert after("cli", "...", "pass  # other ways to a command") == before


def test_program_beside_the_package(small, tmp_path):
    """A file of a folder of its own and the modules there are followed into the package."""
    folder = tmp_path / "0" / "workflow"
    folder.mkdir(parents=True)
    (folder / "clock.py").write_text("TICK = 1\n")
    program = "from clock import TICK\nfrom psfdae.main import run\n\ndef timed():\n    run(TICK)\n"
    (folder / "speed.py").write_text(program + "\nif __name__ == '__main__':\n    timed()\n")
    root = tmp_path / "0" / "src" / "psfdae"
    root.mkdir(parents=True)
    (root / "__init__.py").write_text("")

    def hashed(main="def run(x):\n    return x\n"):
        (root / "main.py").write_text(main)
        return Code(root).hash(["workflow/speed.py:timed"])

    before = hashed()
    assert hashed() == before
    assert hashed("def run(x):\n    return -x\n") != before
    (folder / "clock.py").write_text("TICK = 2\n")
    assert hashed() != before


@pytest.mark.parametrize(
    ("functions", "chosen", "main"),
    [
        (["psfdae.main:walk"], (), "def run(): ..."),
        (["psfdae.other"], (), "def run(): ..."),
        (["psfdae.main:run"], ["psfdae.main:walk"], "def run(): ...\ndef walk(): ..."),
        (["psfdae.main:run"], (), "from psfdae import main\ndef run(): main.walk()"),
        (["psfdae.main:run"], (), "from psfdae.main import *\ndef run(): ..."),
        (["workflow/none.py:run"], (), "def run(): ..."),
    ],
)
def test_what_is_not_found_is_an_error(small, functions, chosen, main):
    with pytest.raises(ValueError):
        small(*functions, chosen=chosen, main=main)


def test_no_module_is_chosen_unseen():
    """What `import_module` is given is a text of a module's name, or a constant that has it."""
    code = Code(ROOT)
    for name, path in code.paths.items():
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call) and ast.unparse(node.func).endswith("import_module"):
                given = (
                    node.args[0].value if isinstance(node.args[0], ast.Subscript) else node.args[0]
                )
                reader = Reader(code, name)
                reader.write(given)
                known = [code.definition(key) for key in reader.references]
                groups = [part.options for d in known for part in (d, *d.entries)]
                assert reader.options or any(groups) or name in EXEMPT, ast.unparse(node)


def test_the_same_question_is_answered_once(monkeypatch):
    asked = []
    monkeypatch.setattr(Code, "hash", lambda self, *words: asked.append(words) or "hash")
    words = {"chosen": ["psfdae.methods.gmm", "nobody_else"]}
    assert {source_hash("evaluate", **words) for _ in range(20)} == {"hash"}
    assert len(asked) == 1
