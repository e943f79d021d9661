"""Cost and error of the PCA+SOM baseline over its three sizes."""

from time import perf_counter
from typing import Annotated

import numpy as np

from measure import alone, write, yes
from psfdae.belonging import STARS, require
from psfdae.cli import File, command, program
from psfdae.configuration.compose import part
from psfdae.configuration.schema import Config
from psfdae.configuration.stages import SIMULATION
from psfdae.files import read_product
from psfdae.rng import stream
from psfdae.stages import common
from psfdae.stars.noise import mixed_levels

SIZES = ("components", "rows", "columns", "epochs")
COMPONENTS, MAPS, EPOCHS = (5, 10, 20, 40), (7, 11, 15), (2, 10, 50)
CHEAP_S = 3.0  # within which a fit is repeated

READS = (*SIMULATION, "noise", "parts", "baseline", "benchmark")


@command("baseline", reads=READS)
def baseline(
    config: Config,
    stars: Annotated[File, "Product of the stage stars."],
    out: Annotated[File, "CSV with time and error of PCA+SOM over its sizes."],
) -> None:
    """Time PCA+SOM over components, map and epochs, on a quiet machine."""
    require(stars, read_product(stars, "stars", ()).config, STARS, config)
    rows = alone(config.baseline.threads, time_points, config.model_dump(), stars)
    write(out, [{**row, "threads": config.baseline.threads} for row in rows])


def grid_around(used, most_components):
    """Points (components, rows, columns, epochs): `used`, one size changed, the two extremes."""
    components, rows, columns, epochs = used
    points = [used]
    points += [(k, rows, columns, epochs) for k in COMPONENTS]
    points += [(components, side, side, epochs) for side in MAPS]
    points += [(components, rows, columns, t) for t in EPOCHS]
    points += [(COMPONENTS[i], MAPS[i], MAPS[i], EPOCHS[i]) for i in (0, -1)]
    return [point for point in dict.fromkeys(points) if point[0] <= most_components]


def time_points(tree, stars):
    """Fit and test settings on the training and test stars of the split random."""
    # Imported before the clock starts.
    import minisom  # noqa: F401
    import sklearn.decomposition  # noqa: F401

    config = part(READS, tree)
    settings, levels = config.baseline, config.noise.levels
    common.limit_threads(settings.threads)
    product = common.read_stars(stars, "template")
    parts = common.split_stars(product, "random", config)
    # The draws of the stage `baseline`: the point in use is the very model of the tables.
    rng = stream(config.seed, "noise", "baseline")
    drawn = mixed_levels(np.asarray(levels), parts.train.size, rng)
    train = common.noise_model(config).draw(product["realisation"][parts.train], drawn, rng)
    truths = {name: product[name][parts.test] for name in ("realisation", "template")}
    clean = truths["realisation"]
    tests = [common.noisy_test_images(config, clean, level) for level in levels]
    shared = {"sigma": settings.sigma, "learning_rate": settings.learning_rate}
    shared["seed"] = int(stream(config.seed, "baseline", "map").integers(2**31))
    used = tuple(getattr(settings, size) for size in SIZES)
    rows = []
    for point in grid_around(used, min(config.parts.train_stars, config.framing.stamp_px**2)):
        sizes = dict(zip(SIZES, point, strict=True))
        measured = time_point(train, tests, truths, sizes | shared, config.benchmark.repeats)
        rows.append({**sizes, "used": yes(point == used), **measured, "n": len(clean)})
    return rows


def time_point(train, tests, truths, fit, repeats):
    """Fit noisy images and restore tests of each λ: median times and mean errors."""
    from psfdae.estimators.pca_som import fit_pca_som

    model, fit_s, done = median_time(lambda: fit_pca_som(train, **fit), repeats)
    estimates, predict_s, _ = median_time(lambda: [model.predict(x) for x in tests], repeats)
    rate = sum(len(x) for x in tests) / predict_s
    errors = {
        f"mse_{name}": np.mean([((estimate - truth) ** 2).mean() for estimate in estimates])
        for name, truth in truths.items()
    }
    return {"fit_s": fit_s, "predict_stars_per_s": rate, "repeats": done, **errors}


def median_time(call, repeats):
    """Result, median seconds and number of repeats; fewer if they take long."""
    times: list[float] = []
    while not times or (len(times) < repeats and sum(times) + times[0] < CHEAP_S):
        start = perf_counter()
        result = call()
        times.append(perf_counter() - start)
    return result, np.median(times), len(times)


if __name__ == "__main__":
    program(baseline)
