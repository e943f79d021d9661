STABILITY_DATASET, STABILITY_OTHER = "dataset3", "dataset8"


# Writes the table whatever it says: a failed job would lose it.
rule stability_table:
    input:
        stars=lambda w: stars_of(STABILITY_DATASET),
        turbulence=lambda w: stars_of(STABILITY_OTHER),
    output:
        table=f"{RESULTS}/tables/stability.csv",
        graded=f"{RESULTS}/tables/stability_graded.csv",
    log:
        f"{RESULTS}/logs/stability/table.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/stability/table.tsv"
    threads: lambda w: dataset_config(STABILITY_DATASET).stability.threads
    resources:
        mem_mb=3000,
        runtime=20,
    params:
        config=lambda w: stage_overrides("stability", f"dataset={STABILITY_DATASET}"),
        source=source_hash(
            "psfdae.stages.stability",
            chosen=["psfdae.stars.seidel_scene", "psfdae.stars.turbulence_scene"],
        ),
    message:
        "Stressing the whole chain"
    shell:
        "psfdae stability --table-only --stars {input.stars}"
        " --turbulence {input.turbulence} --out {output.table}"
        " --graded {output.graded} {params.config:q} > {log} 2>&1"


rule figure_stability:
    input:
        rules.stability_table.output.graded,
    output:
        report(
            f"{RESULTS}/figures/stability/graded.png",
            caption="../report/stability.rst",
            category="Stability",
            labels={"figure": "error against stress"},
        ),
    log:
        f"{RESULTS}/logs/figures/stability/graded.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/stability/figure.tsv"
    threads: 1
    resources:
        mem_mb=500,
        runtime=10,
    params:
        source=source_hash("psfdae.stages.stability_report"),
    message:
        "Drawing error against stress"
    shell:
        "psfdae figure stability --graded {input} --out {output} > {log} 2>&1"


rule stability:
    input:
        table=rules.stability_table.output.table,
        graded=rules.stability_table.output.graded,
        figure=rules.figure_stability.output,
    output:
        touch(f"{RESULTS}/.stability_passed"),
    log:
        f"{RESULTS}/logs/stability/verdict.log",
    localrule: True
    threads: 1
    resources:
        mem_mb=500,
        runtime=10,
    params:
        source=source_hash("psfdae.stability.rows"),
    message:
        "Judging the stress tests"
    shell:
        "psfdae stability-verdict {input.table} > {log} 2>&1"
