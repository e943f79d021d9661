"""psfdae: from telescope to tables. Rules are in workflow/rules, settings in config."""

from snakemake.utils import min_version

min_version("9.0")


container: "docker://condaforge/miniforge3:25.3.1-0"


include: "workflow/rules/common.smk"
include: "workflow/rules/data.smk"
include: "workflow/rules/models.smk"
include: "workflow/rules/evaluation.smk"


rule all:
    default_target: True
    input:
        rules.psf_metrics.output,
        [file for dataset in default_datasets() for file in paper_tables_of(dataset)],
    localrule: True


include: "workflow/rules/targets.smk"
