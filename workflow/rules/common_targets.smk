from psfdae_paper.configuration.aligners import ESTIMATORS, trained_networks
from psfdae.denoise.bundle import SUFFIX

with one_line():
    TIMED = import_module("costs").load_points()
TIMED_DATASET = TIMED.datasets[0]
# The stars and the training of the model that comes with the package.
SHIPPED_DATASET = "field"
PACKED = [("random", "realisation")]
POPPY_STARS = 1500


def has_bank(dataset):
    """Whether the stars of a dataset have random aberrations, of which a bank is drawn."""
    return dataset_config(dataset).stars.aberration_fraction > 0


def bank_of(dataset):
    stars = dataset_config(dataset).stars.name
    return [f"{BOUNDS}/bank/{stars}.h5"] if has_bank(dataset) else []


def per_star_of(dataset, splits=None):
    """Errors of the methods on single test stars, of all splits unless some are named."""
    return [
        csv.removesuffix(".csv") + ".parquet" for csv in evaluations_of(dataset, splits)
    ]


def optics_of(dataset, ending):
    """Errors of the methods that know the telescope: csv, or parquet of single stars."""
    return [f"{RESULTS}/wavefront/{dataset}.{ending}"] if has_bank(dataset) else []


def bound_figures_of(dataset):
    kinds = ["errors", "efficiency"] + (["growth"] if has_bank(dataset) else [])
    return [f"{RESULTS}/figures/bounds/{dataset}_{kind}.png" for kind in kinds]


def timed_points(w):
    """Tables of all methods and settings whose error is set against their time."""
    return [
        f"{RESULTS}/costs/{dataset}/{name}-{point}.csv"
        for dataset in TIMED.datasets
        for name in [*names_of(dataset), *TIMED.further_methods]
        if name in TIMED.further_methods or method(name).look.restores
        for point in TIMED.overrides(dataset, name)
    ]


def timed_module(name):
    """Module of a method, or the program of the denoisers."""
    program = f"workflow/benchmarks/{name}.py"
    return program if name == "denoisers" else method(name).__module__


@cache
def strictest_dataset(scene):
    """The dataset of a scene with the least noise and the strongest aberrations."""

    def strictness(dataset):
        settings = dataset_config(dataset)
        return (-min(settings.noise.levels), settings.stars.aberration_fraction)

    return max(
        (d for d in ALL_DATASETS if dataset_config(d).scene.name == scene),
        key=strictness,
    )


def every_bundle_of_timed(w):
    """Bundles of the methods of the timed dataset."""
    return bundles_of(TIMED_DATASET, PACKED)


def poppy_stars(w):
    """A small preset has small test parts; POPPY takes its time for each star."""
    return min(POPPY_STARS, dataset_config(TIMED_DATASET).parts.test_stars)


ALIGNMENT_DATA = f"{RESULTS}/data/alignment"
ALIGNMENT = f"{RESULTS}/alignment"
ALIGNMENT_SETS = ["uniform", "grid"]


def alignment_config():
    """Checked configuration of scene 3; a wrong key stops before any job."""
    return dataset_config(SCENE3)


def as_options(wildcards, input):
    """Named inputs as options of these names; weights stand for the network's folder."""
    options = []
    for name, found in input.items():
        for path in [found] if isinstance(found, str) else found:
            weights = path.endswith(".safetensors") and not path.endswith(SUFFIX)
            value = Path(path).parent if weights else path
            options.append(f"--{name.replace('_', '-')}={value}")
    return options


def network_files(name, weights):
    """What a training of scene 3 leaves."""
    files = ("config.yaml", "trained_on.yaml", "history.csv")
    named = {file.partition(".")[0]: f"{ALIGNMENT}/{name}/{file}" for file in files}
    return {"weights": f"{ALIGNMENT}/{name}/{weights}", **named}


def fits_of(*test_sets, what="out"):
    """Fits of test sets, or their times, at all noise levels."""
    levels = [f"{level:g}" for level in alignment_config().noise.levels]
    path = getattr(rules.alignment_fit.output, what)
    return expand(path, test_set=test_sets, level=levels)


def of_scene3(name, part, shown, caption=None):
    """A product of scene 3 in the report."""
    return report(
        f"{RESULTS}/{name}",
        caption=f"../report/{caption or f'figure_alignment_{Path(name).stem}'}.rst",
        category="Scene 3: alignment of a mirror",
        subcategory=part,
        labels={"figure": shown},
    )


# What the first page of the report asks (workflow/report/workflow.rst).


def shown_first(categories, pattern):
    """Of the report's files, that of a pattern: of `HEADLINE_DATASET`, else any; None."""
    # Snakemake's own list of files has only one of each name.
    listed = [
        file
        for subcategories in categories.values()
        for files in subcategories.values()
        for file in files
        if file.path.match(pattern)
    ]
    return min(
        listed,
        key=lambda file: (HEADLINE_DATASET not in file.path.parts, str(file.path)),
        default=None,
    )


def methods_shown():
    """Label of each method of the datasets, and the first sentence of its module."""
    names = {name: None for dataset in default_datasets() for name in names_of(dataset)}
    return {
        method(name)
        .look.label: getdoc(import_module(method(name).__module__))
        .partition("\n\n")[0]
        .replace("\n", " ")
        for name in names
    }


def aligners_shown():
    """Labels of the methods of scene 3."""
    return [estimator.look.label for estimator in ESTIMATORS.values() if estimator.network]
