from snakemake.exceptions import WorkflowError

from psfdae_paper.configuration.aligners import swept_networks
from psfdae_paper.configuration.sweep import sweep_names
from psfdae_paper.stages.sweep import training_module
from psfdae_paper.sweeps.points import plan_sweep

SWEEPS = f"{RESULTS}/sweeps"
SWEEP_FIGURES = ["parallel", "response"]


@cache
@one_line()
def sweep_plan(name):
    """Points of a sweep; a wrong key stops before any job."""
    plan = plan_sweep(name, GIVEN)
    assert plan.points
    return plan


def sweep_point_of(w):
    points = sweep_plan(w.sweep).points
    if w.point not in points:
        raise WorkflowError(f"sweep {w.sweep} has no point {w.point}")
    return points[w.point]


def sweep_data(w):
    """Products that the points of a sweep share, by role."""
    sweep = sweep_plan(w.sweep).sweep
    if sweep.dataset:
        return {"stars": stars_of(sweep.dataset)}
    return {
        "states": f"{ALIGNMENT_DATA}/{'grid' if sweep.model == 'original' else 'train'}.h5",
        "validation": f"{ALIGNMENT_DATA}/validation.h5",
        "test": f"{ALIGNMENT_DATA}/uniform.h5",
    }


def sweep_known(w):
    """Results that a trial of an adaptive sweep learns from."""
    known = sweep_plan(w.sweep).earlier_trials(sweep_point_of(w))
    return [f"{SWEEPS}/{w.sweep}/points/{point.name}/result.json" for point in known]


def sweep_threads(w):
    groups = [g for g in sweep_point_of(w).config.values() if isinstance(g, dict)]
    return max(group.get("threads", 1) for group in groups)


@cache
def sweep_source(name):
    """Code that a point consists of: its model's, and the search's if there is one."""
    sweep = sweep_plan(name).sweep
    search = ["psfdae_paper.sweeps.adaptive"] if sweep.kind == "adaptive" else []
    own = [] if sweep.model in swept_networks() else [method(sweep.model).__module__]
    return source_hash("sweep point", training_module(sweep.model), *own, *search)


def sweep_results(w):
    points = sweep_plan(w.sweep).points
    return [f"{SWEEPS}/{w.sweep}/points/{name}/result.json" for name in points]


def sweep_products(w):
    """What the target sweep builds."""
    name = config["sweep"]
    if not name:
        raise WorkflowError(
            f"which sweep? --config sweep=NAME, one of {', '.join(sweep_names())}"
        )
    sweep_plan(name)
    figures = [f"{SWEEPS}/{name}/figures/{kind}.png" for kind in SWEEP_FIGURES]
    return [
        *(f"{SWEEPS}/{name}/{file}" for file in ("summary.csv", "best.yaml")),
        *figures,
        f"{RESULTS}/mlflow/sweep_{name}.csv",
    ]
