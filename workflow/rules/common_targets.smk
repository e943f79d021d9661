with one_line():
    KNEE = import_module("trainings").load_knee()
FRESH = "fresh_realisations"
KNEE_DATASET = TIMED_DATASET = "dataset3"
POPPY_STARS = 500


def has_bank(dataset):
    """Whether the stars of a dataset have random aberrations, of which a bank is drawn."""
    return dataset_config(dataset).stars.aberration_fraction > 0


def bank_of(dataset):
    stars = dataset_config(dataset).stars.name
    return [f"{BOUNDS}/bank/{stars}.h5"] if has_bank(dataset) else []


def per_star_of(dataset):
    """Errors of the methods on the test stars of the split that is bounded."""
    return [
        csv.removesuffix(".csv") + ".parquet"
        for csv in evaluations_of(dataset, ["random"])
    ]


def bound_figures_of(dataset):
    kinds = ["errors", "efficiency"] + (["growth"] if has_bank(dataset) else [])
    return [f"{RESULTS}/figures/bounds/{dataset}_{kind}.png" for kind in kinds]


def knee_overrides(point):
    """What a point changes; the fresh stars have no test part."""
    own = list(KNEE.points[point])
    if point == FRESH:
        own += [f"parts.train_stars={KNEE.fresh_stars - 1}", "parts.test_stars=1"]
        own += [f"stars.count={KNEE.fresh_stars}"]
    return tuple(own)


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


def sharing_stars(dataset):
    """Number of datasets that are made of the same stars."""
    stars = dataset_config(dataset).stars.name
    return sum(dataset_config(d).stars.name == stars for d in ALL_DATASETS)


def timed_threads(w):
    """A timing takes as many cores as it may use, so that no other job disturbs it."""
    return dataset_config(ALL_DATASETS[0]).benchmark.threads


def poppy_stars(w):
    """A small preset has small test parts; POPPY takes its time for each star."""
    return min(POPPY_STARS, dataset_config(TIMED_DATASET).parts.test_stars)
