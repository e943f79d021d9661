"""Numbers of README and docs, from the run of record and the configuration.

A page has a number between two comments, `<!--n:KEY-->…<!--/-->`; `docs/numbers.yaml` says where
the number of each key comes from, and in which form it is written.

Numbers of an earlier record (`kept` in its provenance) or of a study (its columns `date` and
`commit`) get their date and commit beside them: a line below a table; words behind the first
number of a section that has no such table. Files of two commits are not joined.

`python docs/tables.py` fills in all pages; `--check` names what has drifted. Both refuse a key of a
page that the YAML does not have, and one of the YAML that its page does not use.
"""

from __future__ import annotations

import ast
import inspect
import json
import re
import sys
from dataclasses import fields
from functools import cache
from importlib import import_module
from math import fsum
from pathlib import Path
from types import SimpleNamespace

import click
import numpy as np
import pandas as pd
import yaml

from psfdae.commands.cli import as_click, command_modules, sections, stage
from psfdae.image.camera import HEADER_KEYS
from psfdae.image.image_input import ImageOptions
from psfdae.methods import all_methods
from psfdae_paper.configuration import aligners
from psfdae_paper.configuration.alignment import Alignment
from psfdae_paper.configuration.compose import compose
from psfdae_paper.evaluation.comparison import (
    FIT_KEYS,
    SIGNIFICANT,
    add_seed_stderr,
    read_seed_scatter,
)
from psfdae_paper.stars.example import FieldRecipe

ROOT = Path(__file__).resolve().parents[1]
REFERENCE = ROOT / "results/reference"
MARK = re.compile(r"<!--n:(?P<key>\w+)-->(?P<line>\n?)(?P<old>(?:(?!<!--).)*)<!--/-->", re.S)
HEAD = re.compile(r"\|.*\n\|[-|]+\n")

ALIGNERS = {
    name: estimator.look.label
    for name, estimator in aligners.ESTIMATORS.items()
    if name != "cramer_rao_pooled"
}
SCENES = {"seidel": "scene 1", "turbulence": "scene 2"}
PROPAGATORS = {
    "kernel": "our kernel",
    "fft": "zero-padded FFT",
    "fft_pruned": "pruned FFT",
    "poppy_mft": "POPPY, matrix DFT",
    "poppy_fresnel": "POPPY, Fresnel",
    "hcipy": "HCIPy",
}
STATES = ["decenter_x", "decenter_y", "tilt_x", "tilt_y"]
CELL = ["dataset", "reference", "noise_level"]
REAL_SKY = "studies/real_sky/table.csv"
SKY_PACKAGES = {
    "psfdae": "psfdae",
    "piff": "Piff",
    "psfex": "PSFEx",
    "epsf": "EPSFBuilder of photutils",
}


READ: set[str] = set()
"""Files of the run of record that the source in hand has read."""


def number_sources():
    """By page and key: the table of a number, its rows and their order, and the text."""
    entries = yaml.safe_load((ROOT / "docs/numbers.yaml").read_text(encoding="utf-8"))
    return {
        page: {
            key: {"where": None, "by": None, **entry, "text": text}
            for entry in tables
            for key, text in entry["numbers"].items()
        }
        for page, tables in entries.items()
    }


def filled(page, sources, drifted):
    """Text of a page with today's numbers; what has drifted is added to a list."""
    text = page.read_text(encoding="utf-8")
    # Each key of the page is one of its entry in the YAML, and the other way round.
    name = page.relative_to(ROOT).as_posix()
    if odd := {mark["key"] for mark in MARK.finditer(text)} ^ set(sources):
        sys.exit(f"{name}, docs/numbers.yaml: only one of both has {', '.join(sorted(odd))}")
    # The reference of all keys is one mark; headings of its groups, `…`, do not part it.
    sections = re.split(r"^(?=##+ (?!`))", text, flags=re.M)
    return "".join(_section(name, section, sources, drifted) for section in sections)


def _section(page, text, sources, drifted):
    """A section with today's numbers, and marks at what is of an earlier record."""
    marks, new = list(MARK.finditer(text)), []
    for mark in marks:
        READ.clear()
        filled_in = _new(sources[mark["key"]], mark["line"], mark["old"])
        new.append((mark, filled_in, _since(*sorted(READ), where=page)))
    said = {since for mark, _, since in new if mark["line"]}
    for figure in re.findall(r"results/reference/([\w/.-]+\.png)\)", text):
        if (since := _since(figure, where=page)) and since not in said:
            sys.exit(f"{page}: {figure} is of an earlier record, and no table beside it says so")
    parts, end = [], 0
    for mark, filled_in, since in new:
        beside = ""
        if since and mark["line"]:
            beside = f"\n*Recorded {since}, not with the run of record.*\n"
        elif since and since not in said:
            beside = f" (recorded {since})"
            said.add(since)
        if filled_in + beside != mark["old"]:
            drifted.append(f"{page}: {mark['key']}")
        parts += [text[end : mark.start("old")], filled_in, beside, "<!--/-->"]
        end = mark.end()
    return "".join([*parts, text[end:]])


def _since(*names, where):
    """Date and commit of files of an earlier record; nothing of those of the record itself."""
    kept = json.loads(file("provenance.json")).get("kept", {})
    studies = [name for name in names if name.startswith("studies/")]
    kept |= {name: _table(name).iloc[0][["commit", "date"]].to_dict() for name in studies}
    found = {json.dumps(kept.get(name)): kept.get(name) for name in names}
    if len(found) > 1:
        sys.exit(f"{where}: {', '.join(names)} are of two commits, and joined")
    return "".join(f"{of['date']} at commit {of['commit']:.12}" for of in found.values() if of)


def _new(source, line, old):
    """The text of a number, or, where its mark ends a line, a line for each row of its table."""
    name, *words = source["table"].split()
    table = globals()[name](*words) if name in globals() else csv(name)
    if source["where"]:
        table = table.query(source["where"])
    if by := source["by"]:
        table = table.sort_values(by.lstrip("-"), ascending=by[0] != "-", kind="stable")
    text = source["text"]
    if text is None:
        return line and f"{table}\n"
    rows = table.to_dict("records") if isinstance(table, pd.DataFrame) else [table]
    if line:
        head = HEAD.match(old)
        return (head[0] if head else "") + "".join(_written(text, row) + "\n" for row in rows)
    return _written(text, rows[0] if len(rows) == 1 else dict(table.reset_index(drop=True)))


def _written(text, row):
    """An f-string over the columns of a row; what is not there stays empty."""
    return re.sub(r"\+?\bnan( ± nan| %)?", "", eval(f'f"""{text}"""', globals() | row))


def csv(name):
    """A table of the run of record or of a study; names of columns become names in Python."""
    READ.add(name)
    return _table(name)


@cache
def _table(name):
    table = pd.read_csv((ROOT if name.startswith("studies/") else REFERENCE) / name)
    return table.rename(columns=lambda column: re.sub(r"\W", "_", column))


def file(name):
    """A file of the run of record as it is."""
    READ.update({name} - {"provenance.json"})
    return (REFERENCE / name).read_text(encoding="utf-8").strip()


def listed(values, form=""):
    """Values in a sentence."""
    return ", ".join(format(value, form) for value in values)


def _names(tree):
    """A nested mapping by attributes."""
    return vars(json.loads(json.dumps(tree), object_hook=lambda found: SimpleNamespace(**found)))


def config(*overrides):
    """Groups of a configuration of scenes 1 and 2."""
    return _names(compose(overrides))


def field_recipe():
    """What the image of `psfdae example field` shows."""
    return vars(FieldRecipe())


def scene3():
    """Groups of the configuration of scene 3."""
    return _names(compose(Alignment.choice))


def keys():
    """Reference of all keys of the configuration."""
    from keys import reference

    return "\n".join(reference())


def command_line():
    """What `snakemake --config` takes."""
    path = ROOT / "workflow/schemas/command_line.schema.yaml"
    schema = yaml.safe_load(path.read_text(encoding="utf-8"))
    return pd.DataFrame([{"key": key, **about} for key, about in schema["properties"].items()])


def image_statements():
    """What may be stated about an image: option of `predict`, keyword in Python, and meaning."""
    options = {option.name: option for option in as_click(stage("predict")).params}
    return pd.DataFrame(
        {
            "name": field.name,
            "option": options[field.name].opts[0],
            "meaning": options[field.name].help,
        }
        for field in fields(ImageOptions)
    )


def commands():
    """Heading, usage, first sentence and options of each command, in the order of `psfdae --help`.

    Options come with their help, those of the image as a link to their table; the paper's stages
    have the names alone, and stages of two words that begin alike share a row.
    """
    statements, rows = image_statements().set_index("option").meaning.to_dict(), {}
    for heading, words in sections(sorted({name.split()[0] for name in command_modules()})).items():
        for name in sorted(command_modules(), key=lambda name: (*words, name).index(name)):
            if name.split()[0] not in words:
                continue
            first_sentence = command_modules()[name][1].partition(". ")[0].removesuffix(".")
            command = as_click(stage(name))
            # --quiet is an option of all of them, which the page says once.
            options = {
                p.opts[0]: p.help or ""
                for p in command.params
                if isinstance(p, click.Option) and p.name != "quiet"
            }
            # Arguments of the command in capitals, as its help has them.
            arguments = [p for p in command.params if isinstance(p, click.Argument)]
            usage = [f"psfdae {name}", *(p.make_metavar(click.Context(command)) for p in arguments)]
            usage = " ".join(usage).replace("|", r"\|")
            if heading != "The paper's stages":
                described = [
                    f"`{option}`" + f": {' '.join(meaning.split())}" * bool(meaning)
                    for option, meaning in options.items()
                    if statements.get(option) != meaning
                ]
                if statements.items() <= options.items():
                    described.append("[statements on the image](python.md#read-the-stars)")
                rows[name] = [heading, usage, first_sentence, "<br>".join(described)]
                continue
            group, *others = name.split()
            names = ", ".join(f"`{option}`" for option in options)
            text = first_sentence + f" ({names})" * bool(names)
            row = rows.setdefault(
                group, [heading, f"psfdae {group} …" if others else usage, "", ""]
            )
            row[2] += "<br>" * bool(row[2]) + f"`{' '.join(others)}`: " * bool(others) + text
    return pd.DataFrame(rows.values(), columns=["heading", "usage", "sentence", "options"])


def public_names():
    """Calls of the names on the reference page of Python, with the first sentence of each."""
    page, rows = (ROOT / "docs/api.md").read_text(encoding="utf-8"), []
    for path, members in re.findall(r"^::: (\S+)(?: \[(.*)\])?$", page, re.M):
        module, _, name = path.rpartition(".")
        value = getattr(import_module(module), name)
        described = {
            name: value,
            **{f"{name}.{m}": getattr(value, m) for m in filter(None, members.split(", "))},
        }
        for label, thing in described.items():
            first_sentence = re.split(r"[.;:](?: |$)", inspect.getdoc(thing) or "")[0].split(
                "\n\n"
            )[0]
            # Parameters of functions and methods, without what is passed on.
            parameters = ""
            if callable(thing) and not isinstance(thing, type):
                names = [
                    n
                    for n, p in inspect.signature(thing).parameters.items()
                    if p.kind != p.VAR_KEYWORD and p.default is not ...
                ]
                parameters = f"({', '.join(n for n in names if n != 'self')})"
            rows.append([f"{label}{parameters}", " ".join(first_sentence.split())])
    return pd.DataFrame(rows, columns=["call", "sentence"])


def header_keys(name):
    """Keys of headers with a value of the camera, in the order in which they are looked for."""
    return {"keys": ", ".join(f"`{key}`" for key in HEADER_KEYS[name.replace("_", " ")])}


def datasets():
    """Configurations of all datasets."""
    return pd.DataFrame([config(f"dataset={d}") for d in config()["workflow"].datasets])


def library():
    """Modules of the library, as `_modules`."""
    return _modules("psfdae")


def reproduction():
    """Modules of the reproduction, as `_modules`."""
    return _modules("psfdae_paper")


def _modules(name):
    """First sentence of every sub-package and of every module at the top of a package."""
    found = {}
    for path in sorted((ROOT / "src" / name).glob("[!_]*")):
        source = path / "__init__.py" if path.is_dir() else path
        if source.is_file() and source.suffix == ".py":
            about = ast.get_docstring(ast.parse(source.read_text(encoding="utf-8"))) or ""
            found[path.stem] = " ".join(about.split("\n\n", maxsplit=1)[0].split())
    return pd.DataFrame(found.items(), columns=["name", "about"])


def run():
    """How and where the run of record was made."""
    return _names(json.loads(file("provenance.json")))


def poppy(name):
    """Errors on POPPY's stars, with the labels of the methods, which end the bundles' names."""
    table = csv(name)
    ends = table.bundle.str.extract(r"-realisation-(\w+)$", expand=False).fillna(table.method)
    return table.assign(label=ends.map({kind.name: kind.look.label for kind in all_methods()}))


def coverage():
    """Part of the pixels within the uncertainty, by model, S/N and brightness of the pixel."""
    keys = ["bundle", "method", "noise_level", "snr", "stars"]
    wide = poppy("tables/predict_coverage.csv").pivot(
        index=[*keys, "label"], columns="pixels", values=["coverage68", "coverage95"]
    )
    wide.columns = [f"{pixels}_{part[-2:]}" for part, pixels in wide.columns]
    return wide.reset_index().sort_values(["bundle", "noise_level"])


def outliers():
    """Outliers found by either measure, by kind and noise level."""
    table = csv("tables/predict_strange.csv").query("kind != 'usual'")
    wide = table.pivot_table("found", ["kind", "noise_level"], "measure", sort=False)
    return wide.reset_index()


def real_sky():
    """Errors on a real image in 1e-5 by S/N: ours, and each package's at its best setting.

    Those of the packages are by kind of centre, as are the ratios of psfdae's to the least of them
    (`over_`, and `median_` of the median star).
    """
    rows = []
    for _, cell in csv(REAL_SKY).groupby("snr"):
        (ours,) = cell.query("package == 'psfdae'").to_dict("records")
        others = cell.query("package != 'psfdae'")
        row = ours | {"psfdae": _in_1e5(ours)}
        for centre, group in others.groupby("centre"):
            for peer in group.loc[group.groupby("package").mse.idxmin()].to_dict("records"):
                row[f"{peer['package']}_{centre}"] = _in_1e5(peer)
            least = group.loc[group.mse.idxmin()]
            row[f"over_{centre}"] = f"{least.ratio:.2f} ± {least.ratio_stderr:.2f}"
            row[f"median_{centre}"] = f"{least.median_ratio:.2f} ± {least.median_stderr:.2f}"
        rows.append(row)
    return pd.DataFrame(rows)


def real_sky_packages():
    """Each package on the real image, its release and all its settings, as words."""
    rows = []
    for (package, version), group in csv(REAL_SKY).groupby(["package", "version"]):
        orders = group.groupby("sampling_px").order.unique().items()
        settings = [
            f"samples of {px:g} px" + (f", orders {listed(o, '.0f')}" if all(o > 0) else "")
            for px, o in orders
        ]
        said = f"{SKY_PACKAGES[package]} {version}"
        rows.append(said + f" ({'; '.join(settings)})" * bool(settings))
    return pd.DataFrame({"said": rows})


def simulated_sky():
    """Stars of the study of a simulated field, and our error over the least of each package."""
    table = csv("studies/simulated_sky/table.csv")
    least = {
        name.lower(): table[table.package.str.startswith(name)].mse.min()
        for name in ("psfdae", "Piff", "PSFEx")
    }
    over = {f"over_{name}": least["psfdae"] / mse for name, mse in least.items()}
    return pd.DataFrame([{"stars": table.stars[0], "learnt": table.learnt[0], **over}])


def crowded_sky():
    """Scatter of the photometry in crowded fields with each package's PSF, over the images."""
    table = csv("studies/crowded_sky/table.csv")
    names = {"true": "true", "psfdae": "psfdae", "PSFEx, degree 2": "psfex"}
    table = table[table.psf.isin(names)].assign(psf=table.psf.map(names))
    cells = table.pivot(index="image", columns="psf", values="scatter_percent")
    said = {name: " and ".join(f"{v:.2f}" for v in cells[name]) for name in cells}
    return pd.DataFrame([said])


def crowded_found():
    """What `psfdae photometry` finds in crowded fields, over the images."""
    table = csv("studies/crowded_sky/found.csv")
    own, truth = (table[table.catalogue == name] for name in ("psfdae", "truth"))

    def each(values, form):
        return " and ".join(format(v, form) for v in values)

    said = {"completeness": each(100 * own.completeness, ".1f"), "false": each(own.false, "d")}
    said |= {"scatter": each(own.scatter_percent, ".2f"), "bias": each(own.bias_percent, ".2f")}
    said |= {"scatter_of_truth": each(truth.scatter_percent, ".2f")}
    return pd.DataFrame([said | {"coverage": each(100 * own.coverage68, ".0f")}])


def exposures():
    """Error of a field of 10 stars and another exposure over that of 100 stars, over the draws."""
    table = csv("studies/exposures/draws.csv")
    over = table[["10_and_first", "10_and_second"]].div(table.own_100, axis=0)
    alone = table.own_10 / table.own_100
    said = {"median": " and ".join(f"{v:.2f}" for v in over.median()), "draws": len(table)}
    said |= {"above": int((over > 1.15).sum().sum()), "fits": over.size}
    return pd.DataFrame([said | {"most": over.max().max(), "alone": alone.median()}])


def crowded_apertures():
    """RMS error of aperture corrections over places and images, in words."""
    table = csv("studies/crowded_sky/apertures.csv")
    rms = table.groupby("radius_px").rms_percent.apply(lambda v: np.sqrt(np.mean(v**2)))
    said = ", ".join(f"{error:.2f} % at a radius of {radius:g} px" for radius, error in rms.items())
    return pd.DataFrame([{"said": said}])


def _in_1e5(row):
    return f"{1e5 * row['mse']:.2f} ± {1e5 * row['stderr']:.2f}"


def seeds():
    """Relative scatter of the MSE between seeds of every method, by dataset and reference."""
    table = pd.Series(read_seed_scatter()).rename_axis(FIT_KEYS).unstack()
    return table.reset_index().sort_values(["dataset", "reference"])


def costs():
    """CPU time and error of each method and setting, as the benchmark has them, in words."""
    table = csv("tables/benchmark_costs.csv").sort_values(["dataset", "fit_cpu_s"])
    labels = {kind.name: kind.look.label for kind in all_methods()}
    changes = table.settings.fillna("as configured").mask(table.point == "paper", "preset `paper`")
    return table.assign(label=table.method.replace(labels), changes=changes)


def errors(name="tables/psf_metrics.csv"):
    """MSE of every method, with its scatter between seeds (`…_sd`)."""
    keys = ["dataset", "split", "reference", "noise_level"]
    rows = add_seed_stderr(csv(name).query("metric == 'mse'"), read_seed_scatter())
    mse, sd = (rows.pivot(index=keys, columns="method", values=v) for v in ("value", "seed_stderr"))
    table = mse.join(sd.add_suffix("_sd")).reset_index()
    return table.sort_values(keys, ascending=[True, False, True, True])


def optics():
    """The telescope's optics beside the least possible error, realisation; `…_given`: the field."""
    rows = csv("tables/psf_efficiency.csv").query("reference == 'realisation'")
    rows = rows.assign(ratio=rows.mse / rows.mse_bound)
    one = csv("tables/psf_optics.csv").query("reference == 'realisation' and metric == 'explained'")
    one = one.assign(flagged=(one.n * (1.0 - one.value)).round().astype(int))
    key = ["dataset", "noise_level"]
    rows = rows.merge(one[[*key, "method", "flagged"]], on=[*key, "method"])
    free = rows.query("method == 'wavefront' and bound == 'bayes'")
    given = rows.query("method == 'wavefront_position' and bound == 'bayes_position'")
    return free.merge(given, on=key, suffixes=("", "_given")).sort_values(key)


def denoisers():
    """MSE of denoisers that know no star, against the realisation, a column a method."""
    rows = csv("studies/optics/denoisers.csv").query("reference == 'realisation'")
    return rows.pivot(
        index=["dataset", "noise_level"], columns="method", values="mse"
    ).reset_index()


def better(first, second):
    """Rows of errors in which one method is better, beyond the scatter of seeds where measured."""
    table = errors()
    gain = table[second] - table[first]
    allowed = SIGNIFICANT * np.hypot(table[f"{first}_sd"], table[f"{second}_sd"])
    return table[(gain > 0) & ~(gain <= allowed)]


def fit():
    """What was fitted to the original-noise rows, by quantity."""
    return {row.quantity: row for row in csv("calibration/fit.csv").itertuples()}


def posterior_means():
    """Both posterior means of every noise level, and what they rest on."""
    rows = csv("tables/psf_bounds.csv").query("metric == 'mse' and method != 'floor'")
    # A record made before these columns leaves them empty.
    since = ["variance", "calibration", "ess_low", "undetected", "missing", "missing_stars"]
    return rows.reindex(columns=[*dict.fromkeys([*rows, *since])]).sort_values(CELL)


def bounds():
    """The posterior mean, the one that is given the field (`…_given`), and the floor."""
    means = dict(list(posterior_means().groupby("method")))
    table = means["bayes"].merge(means["bayes_position"], "left", CELL, suffixes=("", "_given"))
    floor = csv("tables/psf_bounds.csv").query("metric == 'mse' and method == 'floor'")
    return table.merge(floor[[*CELL, "value"]], "left", CELL, suffixes=("", "_floor"))


def efficiency():
    """Bound over error of every method: against the posterior mean, in brackets the floor."""
    rows = csv("tables/psf_efficiency.csv").dropna(subset="efficiency").sort_values("bound")
    cells = [
        f"({row.efficiency:.1g})" if row.bound == "floor" else f"{row.efficiency:.2g}"
        for row in rows.itertuples()
    ]
    table = rows.assign(cell=cells).groupby([*CELL, "method"]).cell.agg(" ".join)
    return table.unstack(fill_value="").reset_index()


def uniform():
    """Errors of scene 3 on uniform states, in units of the range."""
    return csv("tables/alignment_errors.csv").query("test_set == 'uniform' and unit == 'range'")


def mae():
    """Mean absolute error of every method and parameter, their mean, the paper's, the bound."""
    rows = uniform().query("noise_level > 0").set_index(["noise_level", "method"])
    table = rows.pivot(columns="parameter", values="mean_abs_error")
    table["mean"] = table[STATES].mean(axis=1)
    for level in table.index.levels[0]:
        paper = csv(f"tables/alignment_paper_{level}.csv")
        for row in paper.query("source == 'paper' and quantity == 'mean'").to_dict("records"):
            mean = fsum(row[s] for s in STATES) / len(STATES)  # sum() rounds by Python's version
            table.loc[(level, row["method"]), "paper"] = mean
        table.loc[level, "bound"] = table.loc[(level, "cramer_rao"), "mean"]
    order = pd.MultiIndex.from_product([table.index.levels[0], ALIGNERS], names=table.index.names)
    return table.reindex(order.intersection(table.index, sort=False)).reset_index()


def wins(better, worse):
    """In how many columns of the table of errors one method is better than another."""
    table = mae().set_index("method")[STATES]
    won = table.loc[better].to_numpy() < table.loc[worse].to_numpy()
    return {"won": won.sum(), "of": won.size}


def correlation(method, first, second):
    """Correlation of two parameters' errors on uniform states, a row per noise level."""
    picked = "test_set == 'uniform' and noise_level > 0 and method == @method"
    rows = csv("tables/alignment_correlation.csv").query(picked)
    return rows[(rows.parameter_a == first) & (rows.parameter_b == second)].reset_index(drop=True)


def correlations():
    """Correlations of all pairs of parameters on uniform states, with intervals, by method."""
    rows = csv("tables/alignment_correlation.csv").query("test_set == 'uniform'")
    cells = [
        f"{row.correlation:.2f} ({row.ci_low:.2f} … {row.ci_high:.2f})" for row in rows.itertuples()
    ]
    rows = rows.assign(cell=cells, pair=rows.parameter_a + ", " + rows.parameter_b)
    rows = rows.pivot(index=["noise_level", "pair"], columns="method", values="cell").reset_index()
    pairs = rows.pair.str.replace("_", " ").str.replace("decenter", "decentre")
    return rows.assign(pair=pairs)


def cheapest():
    """The fastest setting of every propagator within the budget."""
    keys = ["scene", "aberration", "method"]
    table = csv("tables/benchmark_propagation.csv").query("within_budget == 'yes'")
    return table.sort_values("time_ms").drop_duplicates(keys).sort_values(keys)


def peers():
    """Factors by which other propagators are slower at equal error."""
    table = csv("tables/benchmark_peers.csv")
    rows = table.groupby(["processes", "scene", "aberration", "method"])
    return rows.speedup.agg(["size", "min", "median", "max"]).reset_index()


def inference():
    """Stars per second of the network at its best batch."""
    keys = ["width", "stamp_px", "threads"]
    rows = csv("tables/benchmark_inference.csv").sort_values("stars_per_s")
    return rows.drop_duplicates(keys, keep="last").sort_values(keys)


def flux():
    """RMS errors of the sum of a stamp and of the robust flux."""
    rows = csv("tables/stability_graded.csv").copy()
    rows[["sample", "kind"]] = rows.case.str.split(", ", n=1, expand=True)
    sums, robust = (rows[rows.kind == kind] for kind in ("noisy sum", "robust flux"))
    return sums.merge(robust, on=["sample", "stress"], suffixes=("", "_robust"))


def own_stars():
    """MSE of bright stars degraded to low S/N, by S/N and method."""
    rows = csv("tables/from_stars.csv")
    cells = [f"{row.mse:.2e} ± {row.mse_stderr:.0e}" for row in rows.itertuples()]
    return rows.assign(cell=cells).pivot(index="snr", columns="method", values="cell").reset_index()


def over_mean_psf():
    """MSE of bright stars degraded to low S/N over that of one mean PSF, by S/N and method."""
    table = csv("tables/from_stars.csv").pivot(index="snr", columns="method", values="mse")
    return table.div(table.mean_psf, axis=0).reset_index()


def over_lmmse():
    """MSE over that of linear MMSE, split random, reference realisation."""
    table = errors().query("split == 'random' and reference == 'realisation'")
    methods = ["pca_som", "dae", "gmm", "gmm_position"]
    return table[["dataset", "noise_level"]].join(table[methods].div(table.lmmse, axis=0))


def main():
    """Fill in the pages, or name what has drifted."""
    drifted: list[str] = []
    sources = number_sources()
    pages = (ROOT / "README.md", ROOT / "config/README.md", *sorted((ROOT / "docs").glob("*.md")))
    for page in filter(Path.is_file, pages):
        of_page = sources.pop(page.relative_to(ROOT).as_posix(), {})
        text = filled(page, of_page, drifted)
        if "--check" not in sys.argv:
            page.write_text(text, encoding="utf-8")
    if sources:
        sys.exit(f"docs/numbers.yaml: no page {', '.join(sources)}")
    if "--check" in sys.argv and drifted:
        sys.exit("\n".join(drifted))


if __name__ == "__main__":
    main()
