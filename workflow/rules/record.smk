rule runtime:
    input:
        [file for dataset in default_datasets() for file in products_of(dataset)],
        rules.psf_metrics.output,
        rules.calibrate.output,
    output:
        f"{RESULTS}/runtime.csv",
    log:
        f"{RESULTS}/logs/runtime/all.log",
    localrule: True
    threads: 1
    resources:
        mem_mb=500,
    params:
        results=lambda w: RESULTS,
        source=source_hash("psfdae.stages.record"),
    message:
        "Collecting what the jobs cost"
    shell:
        "psfdae runtime --results {params.results} --out {output} > {log} 2>&1"


# The run of record is committed, so nothing but an explicit request renews it.
rule reference:
    input:
        rules.psf_metrics.output,
        rules.calibrate.output,
        rules.runtime.output,
        [file for dataset in TABULATED for file in paper_tables_of(dataset)],
        [file for dataset in default_datasets() for file in figures_of(dataset)],
        # Rows of the preset paper, where it has been run.
        glob.glob(f"{RESULTS}/paper/tables/psf_metrics.csv"),
    output:
        touch(f"{RESULTS}/.reference_renewed"),
    log:
        f"{RESULTS}/logs/reference/all.log",
    localrule: True
    threads: 1
    resources:
        mem_mb=500,
    params:
        results=lambda w: RESULTS,
        folder="results/reference",
    message:
        "Renewing the run of record"
    shell:
        "psfdae reference --results {params.results} --out {params.folder} {input}"
        " > {log} 2>&1"
