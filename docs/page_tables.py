"""Tables of results that the site shows in its pages.

A paragraph of a page that is nothing but a link with the title `table NAME` names a function of
this module. The site puts its table there; a reader of the Markdown opens the file behind the link.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping
from dataclasses import fields
from functools import partial
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules

import pandas as pd

ROOT = Path(__file__).resolve().parents[1]
RECORD = ROOT / "results/reference"
PAIRS = "decentre x, tilt y", "decentre y, tilt x"
STATES = ["decenter_x", "decenter_y", "tilt_x", "tilt_y"]
ESTIMATORS = {
    "constant": "always the middle",
    "original": "CNN, noisy stamps",
    "dae": "CNN, DAE output",
    "noise_trained": "network trained on noisy stamps",
    "dae_retrained": "network trained on DAE output",
    "max_likelihood": "maximum likelihood",
    "max_likelihood_free": "maximum likelihood, flux and position free",
    "cramer_rao": "Cramér–Rao bound",
    "cramer_rao_free": "Cramér–Rao bound, flux and position free",
}
"""Estimators of scene 3 that the pages show."""


HEADINGS = {
    "noisy": "noisy",
    "mean_psf": "one mean PSF",
    "pca_som": "PCA+SOM",
    "lmmse": "linear MMSE",
    "dae": "DAE",
    "gmm": "mixture",
    "gmm_position": "mixture with field position",
    "field": "field",
}
"""Headings of the columns of methods."""
MB_PER_MIB = 2**20 / 1e6
"""Columns `peak_mb`, `memory_mb` are in MiB, of `scaling_stages` and `benchmark_images` in MB."""

LEVEL = {"dataset": "{dataset}", "λ": "{noise_level}"}
"""Columns that name a noise level."""


def method_columns(form: str, names: str) -> dict[str, str]:
    """Return a column for each of some methods, in one format, such as `{:.2e}`."""
    return {HEADINGS[name]: form.replace("{", "{" + name) for name in names.split()}


def read_record(name: str) -> pd.DataFrame:
    """Read a table of the run of record."""
    return pd.read_csv(RECORD / name)


def read_seed_scatter() -> pd.DataFrame:
    """Read the scatter of errors between seeds, which comes with the package."""
    return pd.read_csv(ROOT / "src/psfdae_paper/evaluation/seed_scatter.csv")


def read_study(name: str) -> pd.DataFrame:
    """Read a table of a study."""
    return pd.read_csv(ROOT / "studies" / name)


def provenance(*names: str) -> dict[str, object]:
    """Read how and where the run of record was made.

    `names` are entries that a page needs: one that is missing or null, such as the CPU time of a
    run with a job whose log lacks it, is an error.
    """
    path = RECORD / "provenance.json"
    run = dict(json.loads(path.read_text(encoding="utf-8")))
    if unknown := [name for name in names if run.get(name) is None]:
        raise ValueError(f"{path}: {', '.join(unknown)} not known; run the record again")
    return run


def recorded(path: Path) -> str:
    """Return date, commit and processor of a file of another run than the record, or ""."""
    if path.is_relative_to(RECORD):
        other_runs: Mapping[str, Mapping[str, str]] = provenance().get("other_runs", {})  # type: ignore[assignment]
        row = other_runs.get(path.relative_to(RECORD).as_posix())
    else:
        study = pd.read_csv(path).iloc[0] if path.suffix == ".csv" else {}
        row = study if "commit" in study else None
    if row is None:
        return ""
    processor = f" on {row['cpu']}" if "cpu" in row else ""
    return f"{row['date']} at commit {row['commit']:.12}{processor}"


def formatted(frame: pd.DataFrame, **columns: str) -> pd.DataFrame:
    """Return columns with these headings, each a format of the columns of a table.

    An underscore in a heading is a space; a number that is missing is an empty cell.
    """
    rows = frame.to_dict("records")
    cells = {
        heading.replace("_", " "): [
            re.sub(r"[+(]*\bnan\b( %|\)| ± nan)*", "", form.format(**row)) for row in rows
        ]
        for heading, form in columns.items()
    }
    return pd.DataFrame(cells)


def label_methods(names: pd.Series) -> pd.Series:
    """Replace the names of methods by the labels of figures."""
    from psfdae.methods import all_methods

    return names.replace({kind.name: kind.look.label for kind in all_methods()})


# The paper's tables, and all methods


def paper_table(dataset: str) -> pd.DataFrame:
    """Errors of the paper's methods in a dataset, the paper's and ours, against the noise level."""
    table = read_record(f"tables/{dataset}_mse.csv")
    levels = {level: f"λ = {level}" for level in table.columns[3:]}
    table = table.rename(columns=levels)
    return table.assign(**{level: table[level].map("{:.3e}".format) for level in levels.values()})


def errors(name: str = "tables/psf_metrics.csv") -> pd.DataFrame:
    """MSE of every method against the realisation, other stars of the field having been seen."""
    rows = read_record(name).query("metric == 'mse' and split == 'random'")
    rows = rows.query("reference == 'realisation'")
    keys = ["dataset", "noise_level"]
    return rows.pivot(index=keys, columns="method", values="value").reset_index()


def paper_preset() -> pd.DataFrame:
    """Errors with the paper's hyper-parameters in dataset 3."""
    table = errors("paper/tables/psf_metrics.csv").query("dataset == 'dataset3'")
    return formatted(table, **{"λ": "{noise_level}", **method_columns("{:.2e}", "pca_som dae")})


def all_errors() -> pd.DataFrame:
    """Errors of all methods in the datasets that the paper has tables of."""
    table = errors().query("dataset in ['dataset3', 'dataset5', 'dataset8']")
    return formatted(
        table,
        **LEVEL,
        **method_columns("{:.2e}", "noisy pca_som lmmse dae gmm gmm_position"),
    )


def optics() -> pd.DataFrame:
    """Errors of the estimators that know the telescope, over the posterior mean."""
    rows = read_record("tables/psf_efficiency.csv").query("reference == 'realisation'")
    rows = rows.assign(ratio=rows.mse / rows.mse_bound, mark=rows.tight.map({"yes": "", "no": "*"}))
    keys = ["dataset", "noise_level"]
    free = rows.query("method == 'wavefront' and bound == 'bayes'")
    given = rows.query("method == 'wavefront_position' and bound == 'bayes_position'")
    both = free.merge(given, on=keys, suffixes=("", "_given")).sort_values(keys)
    return formatted(
        both.query("dataset in ['dataset3', 'dataset4', 'dataset5']"),
        **LEVEL,
        optics="{mse:.2e}",
        over_the_bound="{ratio:.2f}{mark}",
        field_given="{mse_given:.2e}",
        over_its_bound="{ratio_given:.2f}{mark_given}",
    )


def denoisers() -> pd.DataFrame:
    """Errors of denoisers that are trained on no star."""
    rows = read_study("optics/denoisers.csv").query("reference == 'realisation'")
    rows = rows.query("dataset in ['dataset3', 'dataset5']")
    keys = ["dataset", "noise_level"]
    return formatted(
        rows.pivot(index=keys, columns="method", values="mse").reset_index(),
        **LEVEL,
        wavelets="{wavelet:.2e}",
        **{"non-local means": "{nl_means:.2e}"},
        total_variation="{tv:.2e}",
    )


def seed_scatters() -> pd.DataFrame:
    """Scatter of the errors between five seeds, by method."""
    keys = ["dataset", "reference"]
    table = 100 * read_seed_scatter().pivot(index=keys, columns="method", values="scatter")
    table = table.reset_index()
    return formatted(
        table.query("dataset in ['dataset3', 'dataset5', 'dataset8']"),
        dataset="{dataset}",
        reference="{reference}",
        **method_columns("{:.1f} %", "dae pca_som gmm gmm_position"),
    )


# Scene 3


def alignment_errors() -> pd.DataFrame:
    """Mean absolute errors of the state of scene 3, in units of its range, at the larger λ."""
    rows = read_record("tables/alignment_errors.csv")
    rows = rows.query("test_set == 'uniform' and unit == 'range' and noise_level == 0.005")
    table = rows.pivot(index="method", columns="parameter", values="mean_abs_error")
    table = table.assign(mean=table[STATES].mean(axis=1)).sort_values("mean", ascending=False)
    paper = read_record("tables/alignment_paper_0.005.csv")
    paper = paper.query("source == 'paper' and quantity == 'mean'").set_index("method")
    table = table.assign(paper=paper[STATES].mean(axis=1), bound=table.loc["cramer_rao", "mean"])
    table = table.assign(ratio=table["mean"] / table.bound).reset_index()
    return formatted(
        table.assign(label=table.method.map(ESTIMATORS)).dropna(subset="label"),
        estimator="{label}",
        decentre_x="{decenter_x:.4f}",
        decentre_y="{decenter_y:.4f}",
        tilt_x="{tilt_x:.4f}",
        tilt_y="{tilt_y:.4f}",
        mean="{mean:.4f}",
        over_bound="{ratio:.3f}",
        paper="{paper:.4f}",
    )


def alignment_correlations() -> pd.DataFrame:
    """Correlations of the errors of two numbers of a state, with 95 % intervals."""
    rows = read_record("tables/alignment_correlation.csv").query("test_set == 'uniform'")
    pairs = (rows.parameter_a + ", " + rows.parameter_b).str.replace("decenter", "decentre")
    rows = rows.assign(pair=pairs.str.replace("_", " ")).query("noise_level > 0 and pair in @PAIRS")
    cells = formatted(rows, cell="{correlation:.2f} ({ci_low:.2f} … {ci_high:.2f})").cell
    rows = rows.assign(cell=cells.to_numpy())
    names = ["original", "dae", "noise_trained", "max_likelihood", "cramer_rao_pooled"]
    wide = rows.pivot(index=["noise_level", "pair"], columns="method", values="cell")
    wide = wide[names].rename(columns={"cramer_rao_pooled": "Fisher"}).reset_index()
    return wide.rename(columns={"noise_level": "λ"})


# Run time


def method_costs() -> pd.DataFrame:
    """CPU time and error of all methods as configured, and of shorter trainings of the network."""
    table = read_record("tables/posterior_network.csv").sort_values(["dataset", "fit_cpu_s"])
    table = table[(table.point == "configured") | table.method.str.startswith("posterior_network")]
    epochs = table.point.str.extract(r"epochs(\d+)", expand=False)
    settings = (", epochs: " + epochs).fillna("")
    return formatted(
        table.assign(label=label_methods(table.method) + settings, ms=1e3 / table.stars_per_s),
        dataset="{dataset}",
        method="{label}",
        **{"fit, s": "{fit_cpu_s:.1f}", "a star, ms": "{ms:.3g}"},
        MSE_over_the_bound="{over_least:.2f} ± {over_least_stderr:.2f}",
    )


def trainings() -> pd.DataFrame:
    """CPU time and error of trainings of the DAE in dataset 3."""
    table = read_record("tables/benchmark_costs.csv").query("method == 'dae'")
    table = table.query("dataset == 'dataset3'").sort_values("fit_cpu_s")
    settings = table.settings.fillna("as configured").mask(table.point == "paper", "preset `paper`")
    return formatted(
        table.assign(settings=settings, mark=table.knee.map({"yes": " (knee)", "no": ""})),
        setting="{settings}{mark}",
        **{"fit, s": "{fit_cpu_s:.1f}"},
        MSE_over_the_bound="{over_least:.2f}",
    )


def image_costs() -> pd.DataFrame:
    """CPU time of models of images, by psfdae and other programs, and of photometry."""
    table = read_record("tables/benchmark_images.csv")
    table = table.assign(job=table.tool.str.split().str[0] + "_" + table.step)
    # The earlier commit is left out; images of all programs.
    table = table[~table.tool.str.startswith("psfdae ")]
    wide = table.pivot(index="image", columns="job", values=["cpu_s", "peak_mb"])
    seconds = wide.cpu_s.dropna().assign(peak_mb=wide.peak_mb.psfdae_train).reset_index()
    return formatted(
        seconds,
        image="{image}",
        model="{psfdae_train:.1f} s, {peak_mb:.0f} MB",
        photometry="{psfdae_photometry:.1f} s",
        **{"PSFEx, SExtractor": "{psfex_train:.1f} s", "EPSFBuilder": "{epsfbuilder_train:.1f} s"},
        Piff="{piff_train:.1f} s",
    )


def propagators() -> pd.DataFrame:
    """Factors by which other propagators are slower than ours at equal error, scene 1."""
    rows = read_record("tables/benchmark_peers.csv")
    rows = rows.query("processes == 1 and aberration == 'strong' and scene == 'seidel'")
    factors = rows.groupby("method").speedup.agg(["size", "min", "median", "max"]).reset_index()
    labels = {
        "fft": "zero-padded FFT",
        "fft_pruned": "pruned FFT",
        "poppy_mft": "POPPY, matrix DFT",
        "poppy_fresnel": "POPPY, Fresnel",
        "hcipy": "HCIPy",
    }
    return formatted(
        factors.assign(label=factors.method.map(labels)),
        propagator="{label}",
        settings="{size}",
        smallest_factor="{min:.0f}",
        median="{median:.0f}",
        largest="{max:.0f}",
    )


def stages() -> pd.DataFrame:
    """CPU time and memory of each stage for the most stars with which it was measured."""
    table = read_record("tables/scaling_stages.csv").query("measured == 'yes'")
    table = table.sort_values("stars").groupby("stage", sort=False).tail(1)
    return formatted(
        table,
        stage="{stage}",
        stars="{stars:,}",
        **{"CPU time, s": "{cpu_s:.1f}", "memory, MB": "{peak_mb:.0f}"},
    )


def flux_errors() -> pd.DataFrame:
    """RMS errors of the sum of a stamp and of the robust flux, scene 1."""
    rows = read_record("tables/stability_graded.csv").query("stress >= 0.001")
    sums = rows[rows.case == "seidel, noisy sum"]
    both = sums.merge(rows[rows.case == "seidel, robust flux"], on="stress", suffixes=("", "_fit"))
    return formatted(
        both,
        λ="{stress:g}",
        sum_predicted="{bound:.4f}",
        sum_measured="{error:.4f}",
        robust_flux="{error_fit:.4f}",
    )


# Real and simulated images


def own_stars() -> pd.DataFrame:
    """Errors of bright stars degraded to low S/N, by method."""
    rows = read_record("tables/from_stars.csv")
    cells = formatted(rows, cell="{mse:.2e} ± {mse_stderr:.0e}").cell.to_numpy()
    wide = rows.assign(cell=cells).pivot(index="snr", columns="method", values="cell")
    return formatted(
        wide.reset_index(),
        **{"S/N": "{snr:.3g}"},
        **method_columns("{}", "noisy mean_psf lmmse dae gmm field"),
    )


def real_image() -> pd.DataFrame:
    """Errors on a real image: psfdae, and each other package with its best setting."""
    packages = {"psfdae": "psfdae", "piff": "Piff", "psfex": "PSFEx", "epsf": "EPSFBuilder"}
    table = read_study("real_sky/table.csv")
    table = table[(table.centre == "framed") | (table.package == "psfdae")]
    best = table.loc[table.groupby(["snr", "package"]).mse.idxmin()]
    cells = best.assign(value=1e5 * best.mse, error=1e5 * best.stderr)
    cells = best.assign(cell=formatted(cells, cell="{value:.2f} ± {error:.2f}").cell.to_numpy())
    wide = cells.pivot(index="snr", columns="package", values="cell").rename(columns=packages)
    return wide[[*packages.values()]].rename_axis("S/N").reset_index()


def real_image_ratios() -> pd.DataFrame:
    """Errors of psfdae over the smallest of the other packages', by the kind of centre."""
    others = read_study("real_sky/table.csv").query("package != 'psfdae'")
    best = others.loc[others.groupby(["snr", "centre"]).mse.idxmin()]
    cells = formatted(best, cell="{ratio:.2f} ± {ratio_stderr:.2f}").cell.to_numpy()
    wide = best.assign(cell=cells).pivot(index="snr", columns="centre", values="cell")
    return wide[["fitted", "averaged", "framed"]].rename_axis("S/N").reset_index()


def label_bundles(table: pd.DataFrame) -> pd.Series:
    """Return the labels of methods, which end the names of bundles."""
    ends = table.bundle.str.extract(r"-realisation-(\w+)$", expand=False)
    return label_methods(ends.fillna(table.method))


def poppy_stars() -> pd.DataFrame:
    """Errors of the models of dataset 3 on stars that POPPY simulated."""
    table = read_record("tables/predict_poppy.csv")
    table = table.assign(label=label_bundles(table))
    names = ["dataset3-random-realisation", "dataset3-random-realisation-gmm"]
    return formatted(
        table[table.bundle.isin(names)],
        model="{label}",
        **{"S/N": "{snr:.1f}"},
        flux_and_sky_given="{mse_given:.2e}",
        ratio="{ratio_given:.3f}",
        both_estimated="{mse_estimated:.2e}",
        **{"its ratio": "{ratio_estimated:.3f}"},
        **{"within 68 %": "{coverage_estimated:.1%}", "within 95 %": "{coverage95_estimated:.1%}"},
    )


def coverage() -> pd.DataFrame:
    """Part of the pixels within the uncertainty, by S/N and brightness of the pixel."""
    table = read_record("tables/predict_coverage.csv")
    table = table.assign(model=label_bundles(table))
    table = table.query("bundle in ['dataset3-random-realisation-gmm', 'example']")
    keys = ["model", "snr"]
    wide = table.pivot(index=keys, columns="pixels", values=["coverage68", "coverage95"])
    wide.columns = [f"{pixels}_{part[-2:]}" for part, pixels in wide.columns]
    return formatted(
        wide.reset_index().sort_values(keys, ascending=[True, False]),
        model="{model}",
        **{
            "S/N": "{snr:.1f}",
            "brightest, 68 %": "{brightest_68:.1%}",
            "brightest, 95 %": "{brightest_95:.1%}",
            "others, 68 %": "{others_68:.1%}",
            "others, 95 %": "{others_95:.1%}",
        },
    )


def outliers() -> pd.DataFrame:
    """Part of the outliers that either measure finds, at the lowest noise."""
    table = read_record("tables/predict_strange.csv")
    table = table.query("kind != 'usual' and noise_level == 0.001")
    wide = table.pivot(index="kind", columns="measure", values="found").reset_index()
    return formatted(
        wide,
        kind="{kind}",
        by_distance="{distance:.0%}",
        by_outlier_score="{strangeness:.0%}",
    )


def night_cost() -> pd.DataFrame:
    """Processor time, memory and sizes of files of an image of a night."""
    table = read_study("night_cost/table.csv")
    return formatted(
        table.assign(memory_mb=MB_PER_MIB * table.memory_mb),
        **{
            "side, px": "{side_px}",
            "stars": "{stars:.0f}",
            "CPU time, s": "{cpu_s:.1f}",
            "memory, MB": "{memory_mb:.0f}",
            "model, kB": "{model_kb:.0f}",
            "page, kB": "{page_kb:.0f}",
            "catalogue, kB": "{catalogue_kb:.0f}",
        },
    )


# What the paper leaves open


def calibration() -> pd.DataFrame:
    """Constants that were fitted to the paper's rows of noisy images."""
    labels = {
        "kappa": "κ, pixel RMS of the noise over λ",
        "data_range": "dynamic range of SSIM",
        "pixel_scale_scene1": "pixel scale of scene 1, arcsec",
        "pixel_scale_scene2": "pixel scale of scene 2, arcsec (chosen; best of the scan)",
        "r0_scene2": "Fried parameter of scene 2, m (chosen; best of the scan)",
        "ssim_residual_rms": "RMS of the SSIM residuals",
    }
    table = read_record("calibration/fit.csv")
    table = table[table.quantity.isin(labels)]
    return formatted(
        table.assign(label=table.quantity.map(labels)),
        quantity="{label}",
        fit="{fitted:.4f}",
        configured="{configured:.4f}",
    )


def paper_columns() -> pd.DataFrame:
    """Original-noise rows of the paper, and ours."""
    table = read_record("calibration/columns.csv").query("dataset == 'dataset3' or not fitted")
    return formatted(
        table.assign(mark=table.fitted.map({True: "", False: " (left out)"})),
        dataset="{dataset}{mark}",
        λ="{noise_level}",
        κ_of_the_column="{kappa:.2f}",
        **{"MSE, paper": "{mse_paper:.3e}", "ours": "{mse:.3e}", "ratio": "{mse_ratio:.3f}"},
        **{"SSIM, paper": "{ssim_paper:.4f}", "ours at κλ": "{ssim_at_kappa:.4f}"},
    )


def pixel_scales() -> pd.DataFrame:
    """Residuals of the SSIM rows of scene 1 against the pixel scale."""
    table = read_record("calibration/scales.csv").query("experiment == 'scene1'")
    return formatted(
        table.query("0.05 < pixel_scale_arcsec < 0.2"),
        **{"pixel scale, arcsec": "{pixel_scale_arcsec}"},
        RMS="{rms:.4f}",
        largest="{largest:.4f}",
    )


def held_out_fields() -> pd.DataFrame:
    """Errors of the DAE in fields that it has seen and in others, dataset 3."""
    table = read_record("tables/psf_held_out.csv")
    table = table.query("method == 'dae' and dataset == 'dataset3' and reference == 'realisation'")
    return formatted(
        table,
        λ="{noise_level}",
        field_seen="{mse_random:.2e}",
        field_held_out="{mse_held_out:.2e}",
        ratio="{ratio:.3f} ± {stderr:.3f}",
        stars_in_fields="{n} in {fields}",
    )


def paper_rows() -> pd.DataFrame:
    """Errors of the DAE, the paper's and ours, and the posterior mean."""
    table = read_record("tables/paper_rows.csv").query("method == 'dae' and dataset != 'dataset5'")
    return formatted(
        table,
        **LEVEL,
        paper="{mse_paper:.2e}",
        ours="{mse:.2e}",
        posterior_mean="{mse_bound:.2e} ± {stderr:.0e}",
        tight="{tight}",
        **{"the paper's error is": "{verdict}"},
    )


# Bounds


def posterior_means() -> pd.DataFrame:
    """Posterior means of datasets 3 and 5, the one that is given the field, and the floor."""
    rows = read_record("tables/psf_bounds.csv").query("metric == 'mse'")
    rows = rows.query("dataset in ['dataset3', 'dataset5'] and reference == 'realisation'")
    keys = ["dataset", "noise_level"]
    free, given, floor = (rows[rows.method == m] for m in ("bayes", "bayes_position", "floor"))
    table = free.merge(given, on=keys, suffixes=("", "_given"))
    return formatted(
        table.merge(floor[[*keys, "value"]], on=keys, suffixes=("", "_floor")),
        **LEVEL,
        posterior_mean="{value:.2e} ± {stderr:.0e}",
        posterior_variance="{variance:.2e}",
        calibration="{calibration:+.1f}",
        tight="{tight}",
        field_given="{value_given:.2e} ± {stderr_given:.0e}",
        **{"is tight": "{tight_given}"},
        floor="{value_floor:.2e}",
    )


def efficiencies() -> pd.DataFrame:
    """Bound over error of every method: of the posterior mean, and in brackets of the floor."""
    rows = read_record("tables/psf_efficiency.csv").dropna(subset="efficiency").sort_values("bound")
    rows = rows.query("dataset in ['dataset3', 'dataset8'] and reference == 'realisation'")
    is_floor = rows.bound == "floor"
    cells = formatted(rows, cell="{efficiency:.2g}").cell.to_numpy()
    rows = rows.assign(cell=cells)
    rows = rows.assign(cell=rows.cell.mask(is_floor, "(" + rows.cell + ")"))
    keys = ["dataset", "noise_level"]
    table = rows.groupby([*keys, "method"]).cell.agg(" ".join).unstack(fill_value="")
    return formatted(
        table.reset_index(),
        **LEVEL,
        **method_columns("{}", "noisy pca_som lmmse dae gmm gmm_position"),
    )


# The code


def image_options() -> pd.DataFrame:
    """Options of an image: of a command, keyword in Python, meaning."""
    from psfdae.commands.cli import as_click, stage
    from psfdae.image.image_input import ImageOptions

    options = {option.name: option for option in as_click(stage("predict")).params}
    names = [field.name for field in fields(ImageOptions)]
    rows = [(f"`{options[n].opts[0]}`", f"`{n}`", " ".join(options[n].help.split())) for n in names]
    return pd.DataFrame(rows, columns=["option", "keyword", "meaning"])


def rooms(package: str) -> pd.DataFrame:
    """Sub-packages and modules of a package, with the first sentence of their docstrings."""
    modules = iter_modules(import_module(package).__path__)
    names = [module.name for module in modules if not module.name.startswith("_")]
    docstrings = [import_module(f"{package}.{name}").__doc__ or "" for name in names]
    sentences = [" ".join(text.split("\n\n")[0].split()) for text in docstrings]
    return pd.DataFrame({"module": [f"`{name}`" for name in names], "about": sentences})


TABLES: dict[str, Callable[[], pd.DataFrame]] = {
    **{f"dataset{n}": partial(paper_table, f"dataset{n}") for n in (3, 5, 8)},
    **{
        function.__name__: function
        for function in (
            *(paper_preset, all_errors, optics, denoisers, seed_scatters),
            *(alignment_errors, alignment_correlations),
            *(method_costs, trainings, image_costs, propagators, stages, flux_errors),
            *(own_stars, real_image, real_image_ratios, poppy_stars, coverage, outliers),
            *(night_cost, calibration, paper_columns, pixel_scales, held_out_fields, paper_rows),
            *(posterior_means, efficiencies, image_options),
        )
    },
    "library": partial(rooms, "psfdae"),
    "reproduction": partial(rooms, "psfdae_paper"),
}

LINK = re.compile(r'^\[(?P<text>[^\]]+)\]\((?P<path>[^\s)]+) "table (?P<name>\w+)"\)$', re.M)


def markdown_table(frame: pd.DataFrame) -> str:
    """Return a table as Markdown."""
    rows = [frame.columns, ["---"] * frame.shape[1], *frame.astype(str).to_numpy()]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in rows)


def insert_tables(markdown: str, page: Path) -> str:
    """Replace the links that name a table by the table, below it the link and its date."""

    def table(link: re.Match[str]) -> str:
        path = (page.parent / link["path"]).resolve()
        date = recorded(path) if path.suffix == ".csv" else ""
        source = f"[{link['text']}]({link['path']})" if path.suffix == ".csv" else link["text"]
        note = f", recorded {date}, not with the run of record" * bool(date)
        return f"{markdown_table(TABLES[link['name']]())}\n\n*{source}{note}.*"

    return LINK.sub(table, markdown)
