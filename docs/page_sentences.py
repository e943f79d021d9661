"""Sentences and rows of pages with numbers, as the tables of the repository give them.

`tests/docs/test_docs.py` compares them with the pages, and prints the sentences to renew.
"""

from __future__ import annotations

import tomllib

import numpy as np
import page_tables as tables

from psfdae.image.camera import HEADER_KEYS
from psfdae_paper.configuration.alignment import Alignment
from psfdae_paper.configuration.compose import compose, list_datasets
from psfdae_paper.evaluation.comparison import SIGNIFICANT

STATES = tables.STATES


def join(values, form="{}"):
    """Values in a sentence."""
    return ", ".join(form.format(value) for value in values)


def readme():
    """Times of the run of record, and errors of one dataset and of a sweep."""
    sizes = ("environment_mb", "results_mb", "peak_mb", "matrix_product_gflops")
    run = tables.provenance("cores", "cpu", "install_s", "wall_s", "tests_s", "cpu_s", *sizes)
    jobs = tables.read_record("runtime.csv")
    training_s = jobs[jobs.rule == "train"].cpu_s.sum()
    yield f"On {run['cores']} cores of the machine of the record ({run['cpu']}, "
    yield f"{run['matrix_product_gflops']:.0f} GFLOP/s in matrix products)"
    environment_gb = run["environment_mb"] / 1e3
    yield f"| `make env`, once | {run['install_s'] / 60:.1f} min | | {environment_gb:.1f} GB |"
    reproduce = f"{run['wall_s'] / 60:.1f} min | {tables.MB_PER_MIB * run['peak_mb'] / 1e3:.1f} GB"
    yield f"| `make reproduce` | {reproduce} | {run['results_mb'] / 1e3:.1f} GB |"
    yield f"| `make test` | {run['tests_s'] / 60:.1f} min | | |"
    yield f"took {run['cpu_s'] / 60:.1f} min of CPU time"
    yield f"trainings of the DAE {training_s / 60:.1f} min of it"
    project = tomllib.loads((tables.ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    python = project["requires-python"].removeprefix(">=")
    yield f"in a virtual environment of Python {python} or newer is enough"
    # One dataset, next to the paper's table.
    level = "0.003"
    table = tables.read_record("tables/dataset3_mse.csv").set_index(["source", "reference"])[level]
    yield f"| MSE at λ = {level} | noisy | PCA+SOM | DAE |"
    yield f"| paper | {' | '.join(f'{v:.2e}' for v in table['paper', 'as published'])} |"
    yield f"| psfdae | {' | '.join(f'{v:.2e}' for v in table['psfdae', 'realisation'])} |"
    # A sweep, and the runs as MLflow shows them.
    points = tables.read_record("sweeps/network_epochs/summary.csv")
    points = points.sort_values("train_noise_trained.epochs")
    epochs = points["train_noise_trained.epochs"].unique()
    yield f"| mean absolute error after | {' | '.join(map(str, epochs))} epochs |"
    for name, label in (("perceptron", "perceptron"), ("cnn", "CNN")):
        errors = points[points.network == name].validation_mae
        yield f"| {label} | {' | '.join(f'{v:.4f}' for v in errors)} |"
    summary = tables.RECORD / "sweeps/network_epochs/summary.csv"
    yield f"are in units of its range (recorded {tables.recorded(summary)})"
    rows = tables.read_record("tables/psf_metrics.csv").query("dataset == 'dataset3'")
    rows = rows.query("split == 'random' and reference == 'realisation'")
    means = rows.groupby(["metric", "method"]).value.mean()
    names = ["gmm", "dae", "lmmse", "pca_som"]
    mse, ssim = 1e6 * means["mse"][names], means["ssim"][names]
    yield f"| `test_mse_1e-6` | {' | '.join(f'{v:.1f}' for v in mse)} |"
    yield f"| `test_ssim` | {' | '.join(f'{v:.3f}' for v in ssim)} |"
    ratio = tables.real_image_ratios().set_index("S/N").framed[10]
    study = tables.recorded(tables.ROOT / "studies/real_sky/table.csv")
    yield f"is {ratio} (recorded {study}) times the smallest one of [other packages]"


def training():
    """Defaults of the training, and errors of the methods."""
    config = compose(["dataset=from_stars"])
    stars = config["calibration_stars"]
    yield f"more than {stars['search_px']} px from the listed position"
    ratio = f"{100 * stars['neighbour_ratio']:g} %"
    yield f"a neighbour within {stars['isolation_px']:g} px has {ratio} of its brightness"
    yield f"differs from its nearest neighbours {stars['misfit']:g} times as much"
    light = f"{100 * stars['light_min']:g} %"
    yield f"If stamps of {config['framing']['stamp_px']} px hold less than {light}"
    yield f"The others become {config['parts']['train_stars']} images"
    yield f"with an error of up to {config['framing']['jitter_px']} px"
    yield f"new noise for S/N {join(stars['snr_levels'], '{:g}')}."
    yield f"order (up to {max(config['field']['orders'])})"
    table = tables.read_record("tables/from_stars.csv").pivot(
        index="snr", columns="method", values="mse"
    )
    over = table.div(table.mean_psf, axis=0).loc[10]
    yield f"the MSE is {over.field:.2f} of the MSE of one mean PSF for the field model, "
    yield f"{over.gmm:.2f} for the mixture, and {over.lmmse:.2f} for linear MMSE"
    errors = tables.errors().set_index(["dataset", "noise_level"]).loc["dataset3", 0.002]
    ratios = f"{errors.gmm / errors.lmmse:.2f}, the DAE {errors.dae / errors.lmmse:.2f}"
    yield f"the mixture has {ratios} of the MSE of linear MMSE"
    draws = tables.read_study("exposures/draws.csv")
    over = draws[["10_and_first", "10_and_second"]].div(draws.own_100, axis=0)
    yield f"In {len(draws)} simulated pairs of exposures"
    yield f"{' and '.join(f'{v:.2f}' for v in over.median())} (medians, two models)"
    count = int((over > 1.15).to_numpy().sum())
    yield f"above 1.15 in {count} of {over.size} fits, at most {over.max().max():.1f}"
    yield f"with the 10 stars alone it is {(draws.own_10 / draws.own_100).median():.0f} "


def report():
    """Sizes of the samples, and errors of psfdae and of other packages."""
    stars = tables.read_record("tables/from_stars.csv").iloc[0]
    verdicts = tables.read_record("tables/from_stars_selection.csv").verdict
    good = (verdicts == "good").sum()
    yield f"has {len(verdicts)} stars, of which {good} are good and {stars.stars:.0f} of these "
    yield f"whose noise adds {stars.truth_mse:.1e} to every MSE"
    yield f"has {tables.read_study('real_sky/table.csv').stars[0]} bright stars"
    sky = tables.read_study("simulated_sky/table.csv")
    packages = ("psfdae", "Piff", "PSFEx")
    smallest = {name: sky[sky.package.str.startswith(name)].mse.min() for name in packages}
    yield f"has {sky.stars[0] + sky.learnt[0]} bright stars, of which {sky.stars[0]} are held out"
    yield f"is {smallest['psfdae'] / smallest['PSFEx']:.2f} of the MSE of PSFEx"
    yield f"and {smallest['psfdae'] / smallest['Piff']:.2f} of the MSE of Piff"
    fields = tables.read_study("crowded_sky/found.csv")
    fields_psfdae, fields_truth = (fields[fields.catalogue == name] for name in ("psfdae", "truth"))
    counts = " and ".join(f"{100 * v:.1f}" for v in fields_psfdae.completeness)
    spurious = " and ".join(map(str, fields_psfdae.false))
    yield f"finds {counts} % of the stars, and {spurious} false ones"
    scatter = " and ".join(f"{v:.2f}" for v in fields_psfdae.scatter_percent)
    yield f"scatter by {scatter} %, with the true PSF by "
    yield f"{' and '.join(f'{v:.2f}' for v in fields_truth.scatter_percent)} %"
    coverage = " and ".join(f"{100 * v:.0f}" for v in fields_psfdae.coverage68)
    yield f"{coverage} % of all fluxes are within"
    yield f"POPPY simulated {tables.read_record('tables/predict_poppy.csv').stars[0]} stars"
    strange = tables.read_record("tables/predict_strange.csv")
    yield f"limits that {100 * strange.false_alarms.max():.0f} % of the unchanged stars exceed"
    speed = tables.read_record("tables/predict_throughput.csv").iloc[0]
    rates = f"a network takes {speed.predict_per_s:.0f} and a mixture {speed.mixture_per_s:.0f}"
    yield f"with {speed.threads:.0f} threads, {rates} stamps of {speed.stamp_px:.0f} × "
    yield f"in at most {tables.MB_PER_MIB * speed.peak_mb:.0f} MB"


def own_telescope():
    """Defaults of a dataset of one's own, and errors of wavefronts."""
    config = compose(["dataset=_telescope"])
    stamp, points = config["framing"]["stamp_px"], config["grid"]["points"]
    yield f"{config['stars']['count']} stars in stamps of {stamp} × {stamp} px"
    yield f"at {points} × {points} field points"
    yield f"multiplied by 1 + {config['stars']['aberration_fraction']} N(0, 1)"
    levels = config["noise"]["levels"]
    yield f"noise levels λ go from {levels[0]} to {levels[-1]}"
    stars = tables.read_study("wavefront/stars.csv").query("coefficient == 'pooled'")
    fractions = [f"{100 * value:.1f} %" for value in stars.held]
    yield f"POPPY simulated {stars.stars.iloc[0]} stars"
    yield f"intervals of 68.27 % hold {fractions[0]} of the coefficients"
    yield f"of 95.45 % hold {fractions[1]}"
    yield f"One star takes {stars.ms_per_star.iloc[0]:.0f} ms of one core"
    joint, seeing = (tables.read_study(f"wavefront/{name}.csv") for name in ("joint", "seeing"))
    yield f"over their errors scatter by {((joint.found - joint.truth) / joint.error).std():.2f}"
    yield f"are {(joint.error / joint.bound).mean():.2f} times the Cramér–Rao bound"
    pull = (seeing.found - seeing.truth) / seeing.error
    yield f"In {len(seeing)} simulated nights"
    yield f"within {100 * (seeing.error / seeing.truth).mean():.1f} %"
    yield f"the same ratio scatters by {pull.std():.2f} about {pull.mean():.2f}"


def input_page():
    """Keys of headers in the order in which they are looked for."""
    for name in HEADER_KEYS:
        yield join(HEADER_KEYS[name], "`{}`")


def scenes():
    """The datasets and the three telescopes."""
    for name in list_datasets():
        config = compose([f"dataset={name}"])
        if name not in {f"dataset{number}" for number in range(1, 9)}:
            continue
        fraction = config["stars"]["aberration_fraction"]
        cells = [
            name,
            config["scene"]["experiment"][-1],
            f"± {100 * fraction:g} %" if fraction else "none",
            join(config["noise"]["levels"]),
            config["stars"]["count"],
            config["parts"]["train_stars"],
            config["parts"]["test_stars"],
            join(config["dataset"]["splits"]),
            join(config["dataset"]["references"]),
        ]
        yield f"| {' | '.join(map(str, cells))} |"
    scene1, scene2 = compose(["dataset=dataset3"]), compose(["dataset=dataset8"])
    noise, scene3 = scene1["noise"], compose(Alignment.choice)
    yield f"at most ± {scene1['framing']['jitter_px']} px per axis"
    yield f"κ = {noise['kappa']}, B = {noise['background_photons']:g}"
    aperture = f"| aperture | {scene1['telescope']['diameter_m']} m, "
    yield f"{aperture}central obscuration {scene1['telescope']['obscuration']} |"
    yield f"| aperture | {scene2['telescope']['diameter_m']} m, not obscured |"
    yield optics_row(scene1["telescope"], scene1["framing"]["stamp_px"])
    yield optics_row(scene2["telescope"], scene2["framing"]["stamp_px"])
    yield f"| field points | {grid_of(scene1)}, {scene1['grid']['spacing_deg']:.3g}° apart |"
    yield f"| field points | {grid_of(scene2)}, {60 * scene2['grid']['spacing_deg']:.3g}′ apart |"
    terms = ["spherical", "coma", "astigmatism", "field_curvature", "distortion"]
    values = join([f"{term.replace('_', ' ')} {scene1['wavefront'][term]}" for term in terms])
    yield f"relative field 1 at {scene1['grid']['edge_deg']:.3g}° | {values} |"
    waves = scene2["wavefront"]
    yield f"von Kármán, r0 {waves['r0_m']} m, outer scale {waves['outer_scale_m']} m"
    heights = join(waves["layer_heights_m"], "{:g}")
    yield f"heights {heights} m with {join(waves['layer_strengths'])} of the strength"
    yield f"up to {scene1['gmm']['components'][-1]} clusters"
    state, telescope = scene3["alignment"], scene3["telescope"]
    aperture = f"| aperture | {telescope['diameter_m']} m, "
    yield f"{aperture}central obscuration {telescope['obscuration']} |"
    yield f"with {len(scene3['prescription']['lenses'])} lenses as corrector"
    yield optics_row(telescope, state["stamp_px"])
    radius = f"{60 * state['field_radius_deg']:.3g}′"
    yield f"Stars at {state['field_points'] + 1} positions"
    yield f"centre and {state['field_points']} on a circle of {radius}"
    yield (
        f"decentre in x and y ± {1e3 * state['decenter_range_m']:g} mm, "
        f"tilt about x and y ± {state['tilt_range_deg']}°"
    )
    yield f"{1e3 * state['defocus_m']:g} mm beyond focus"
    grid = state["grid_levels"] ** 4
    yield f"grid of {grid}, {state['test_states']} uniform ones for tests, {state['train_states']} "
    yield f"| noise levels λ | {join(scene3['noise']['levels'])} |"


def grid_of(config):
    """The grid of field points in words."""
    return f"{config['grid']['points']} × {config['grid']['points']}"


def optics_row(telescope, stamp_px):
    """The row of a telescope with its wavelength, pixel and stamp."""
    nm, pixel = 1e9 * telescope["wavelength_m"], telescope["pixel_scale_arcsec"]
    return f"| {nm:.4g} nm, {pixel}″, {stamp_px} × {stamp_px} px |"


def reproduce():
    """Times of the targets on request, and the scatter between seeds."""
    seconds = tables.provenance("on_request_s")["on_request_s"]
    minutes = {name: value / 60 for name, value in seconds.items()}
    yield f"`make stability` took {minutes['stability']:.1f} min"
    yield f"`make bounds` {minutes['bounds']:.1f} min and "
    yield f"`make benchmark` {minutes['benchmark']:.0f} min"
    scatter = 100 * tables.read_seed_scatter().query("method == 'dae'").scatter
    yield f"scatter between seeds, {min(scatter):.1f} to {max(scatter):.1f} %"


def results():
    """Errors of the DAE, its input and the mixture; the alignment; run times."""
    run = tables.provenance("commit", "wall_s", "cores")
    yield f"{run['commit']:.12}, preset `fast`, {run['wall_s'] / 60:.1f} min on "
    yield f"min on {run['cores']} cores."
    rows = tables.read_record("tables/psf_metrics.csv").query("metric == 'mse'")
    rows = rows.query("split == 'random'")
    keys = ["reference", "dataset", "noise_level"]
    mse, scatter = (
        rows.pivot(index=keys, columns="method", values=v) for v in ("value", "seed_stderr")
    )

    def worse(first, second):
        allowed = SIGNIFICANT * np.hypot(scatter[first], scatter[second])
        gain = mse[first] - mse[second]
        return mse[(gain > 0) & ~(gain <= allowed)]

    below_input = worse("dae", "noisy").loc["realisation"]
    yield " and in ".join(
        f"{dataset} at λ = {level} ({row.dae:.1e} against {row.noisy:.1e})"
        for (dataset, level), row in below_input.iterrows()
    )
    wins = worse("gmm", "dae").groupby("reference").size()
    total = mse.groupby("reference").size()
    yield f"in {wins.template} of {total.template} rows against the template and "
    yield f"in {wins.realisation} of {total.realisation} rows against the realisation"
    bounds = compose([])["bounds"]
    yield f"among {bounds['bank_stars'] + bounds['position_stars']} simulated stars"
    yield f"MSE on the {tables.read_record('tables/psf_optics.csv').n[0]} test stars"
    costs = tables.read_record("tables/benchmark_costs.csv").query("point == 'configured'")
    costs = costs.set_index(["method", "dataset"])
    ms = 1e3 / costs.stars_per_s.xs("dataset3", level="dataset")
    yield f"a star takes {ms.wavefront:.0f} ms on one core, with the field given "
    yield f"{ms.wavefront_position:.0f} ms, the DAE {ms.dae:.2f} ms"
    yield from alignment()
    gmm, dae = (costs.loc[method] for method in ("gmm", "dae"))
    datasets = "dataset3", "dataset5"
    yield (
        f"fitted in {gmm.fit_cpu_s[datasets[0]]:.0f} s to {gmm.over_least[datasets[0]]:.1f} "
        f"times the bound in dataset 3 and {gmm.over_least[datasets[1]]:.1f} times in dataset 5"
    )
    yield (
        f"takes {dae.fit_cpu_s[datasets[0]]:.0f} s to {dae.over_least[datasets[0]]:.1f} and "
        f"{dae.over_least[datasets[1]]:.1f} times"
    )
    networks = tables.read_record("tables/posterior_network.csv").query("point == 'configured'")
    networks = networks.set_index(["method", "dataset"])
    for name, words in (
        ("posterior_network", "The network takes {fit:.0f} s and reaches "),
        ("posterior_network_refined", "it takes {fit:.0f} s and reaches "),
        ("wavefront", "The optics alone take {fit:.0f} s and reach "),
    ):
        near, far = (networks.loc[name, dataset] for dataset in datasets)
        yield words.format(fit=near.fit_cpu_s)
        yield f"{near.over_least:.2f} times the bound in dataset 3 and "
        yield f"{far.over_least:.2f} times in dataset 5, in "
        yield f"{1e3 / near.stars_per_s:.3g} and {1e3 / far.stars_per_s:.3g} ms a star"
    stress = tables.read_record("tables/stability.csv")
    assert (stress.verdict == "pass").all()
    yield f"Each of the {len(stress)} rows"


def alignment():
    """Scene 3: cases in which one estimator is better than another, and means of the rows."""
    config = compose(Alignment.choice)
    telescope = tables.read_record("tables/alignment_telescope.csv").set_index("quantity").value
    yield f"its detector lies {telescope['defocus_centre']:.2f} waves RMS beyond focus"
    # Distance of the stamps of a state and its twin, at the highest noise, in focus and beyond.
    twins = tables.read_record("tables/alignment_twin.csv").query("position == -1")
    level, defocus_mm = twins.noise_level.max(), 1e3 * config["alignment"]["defocus_m"]
    at_level = twins[twins.noise_level == level]
    in_focus, beyond = (
        at_level[np.isclose(at_level.defocus_mm, mm)].chi2.item() ** 0.5 for mm in (0.0, defocus_mm)
    )
    yield f"at λ = {level:g} they differ by {in_focus:.1f} σ in focus, and by {beyond:.1f} σ there"
    fit, states = config["fit"], config["alignment"]["train_states"]
    yield f"nearest {fit['neighbours']} of {states:,} training states"
    yield f"{fit['outer_states']} states beyond the range"
    rows = tables.read_record("tables/alignment_errors.csv")
    rows = rows.query("test_set == 'uniform' and unit == 'range' and noise_level > 0")
    yield f"Test states are {rows.n.iloc[0]} uniform ones"
    table = rows.pivot(
        index=["noise_level", "parameter"], columns="method", values="mean_abs_error"
    )
    table = table[table.index.get_level_values("parameter").isin(STATES)]
    for text, first, second in (
        ("better than `original` in {} of {} cases", "dae", "original"),
        ("has seen noise, in {} of {};", "dae", "noise_trained"),
        ("`dae_retrained` in {} of {}.", "dae_retrained", "noise_trained"),
    ):
        yield text.format((table[first] < table[second]).sum(), len(table))
    paper = []
    for level in config["noise"]["levels"]:
        published = tables.read_record(f"tables/alignment_paper_{level}.csv").set_index("method")
        published = published.query("source == 'paper' and quantity == 'mean'")
        paper.append(published.loc["dae", STATES].astype(float).mean())
    bound = table.cramer_rao.groupby("noise_level").mean()
    yield f"average {paper[0]:.3f} and {paper[1]:.3f}; the bound is "
    yield " and ".join(f"{value:.3f}" for value in bound)


def fidelity():
    """The smallest original-noise error of dataset 5."""
    columns = tables.read_record("calibration/columns.csv").query("dataset == 'dataset5'")
    yield f"falls to {columns.mse_paper.min():.1e} with 50 % random aberrations"


def bounds():
    """Sizes of the samples, and the right template in scene 2."""
    config = compose([])["bounds"]
    yield f"first {config['test_stars']} test stars"
    yield f"up to {config['bank_stars']} newly simulated stars"
    yield f"at least {config['star_draws']} importance samples"
    yield f"{config['position_stars']} additional stars"
    rows = tables.read_record("tables/psf_bounds.csv").query("dataset == 'dataset8'")
    right = rows.query("metric == 'p_right' and method == 'bayes'").value
    yield f"probability is {join(right[:-1], '{:.3f}')} and {right.iloc[-1]:.3f} at the four"
    verdicts = tables.read_record("tables/psf_efficiency.csv").verdict.dropna()
    assert (verdicts != "beaten").all()
    yield f"Of the {len(verdicts)} comparisons none fails"


SENTENCES = {
    "README.md": readme,
    "docs/input.md": input_page,
    "docs/training.md": training,
    "docs/report.md": report,
    "docs/own_telescope.md": own_telescope,
    "docs/scenes.md": scenes,
    "docs/reproduce.md": reproduce,
    "docs/results.md": results,
    "docs/fidelity.md": fidelity,
    "docs/bounds.md": bounds,
}
