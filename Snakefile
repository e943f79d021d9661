"""psfdae: from telescope to tables. Rules are in workflow/rules, settings in config."""

from snakemake.utils import min_version

min_version("9.20")


report: "workflow/report/workflow.rst"


# By tag: its digest has not been read from the registry. `docker buildx imagetools inspect` shows it.
container: "docker://condaforge/miniforge3:25.3.1-0"


include: "workflow/rules/cpu_time.smk"
include: "workflow/rules/common.smk"
include: "workflow/rules/common_targets.smk"
include: "workflow/rules/common_sweep.smk"
include: "workflow/rules/data.smk"
include: "workflow/rules/own_telescope.smk"
include: "workflow/rules/models.smk"
include: "workflow/rules/bundle.smk"
include: "workflow/rules/own_stars.smk"
include: "workflow/rules/evaluation.smk"
include: "workflow/rules/figures.smk"
include: "workflow/rules/calibration.smk"
include: "workflow/rules/alignment.smk"
include: "workflow/rules/alignment_results.smk"
include: "workflow/rules/tracking.smk"
include: "workflow/rules/bounds.smk"
include: "workflow/rules/stability.smk"
include: "workflow/rules/benchmarks.smk"
include: "workflow/rules/sweep.smk"
include: "workflow/rules/record.smk"


# Where the digests of the products go: `psfdae verify` compares.
onstart:
    Path(RESULTS, DIGESTS).mkdir(parents=True, exist_ok=True)
    # The limit (100 jobs a second) wakes Snakemake 9 once a second for every job that has ended.
    if workflow.local_exec:
        workflow.scheduler.job_rate_limiter = None


rule all:
    default_target: True
    input:
        rules.runtime.input,
        rules.runtime.output,
    localrule: True


include: "workflow/rules/targets.smk"
include: "workflow/rules/reference.smk"
