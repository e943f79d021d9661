rule runtime:
    input:
        lambda w: [
            file for dataset in default_datasets() for file in products_of(dataset)
        ],
        rules.psf_metrics.output,
        rules.held_out.output,
        rules.calibrate.output,
        ALIGNMENT_PRODUCTS,
        rules.track_alignment.output,
    output:
        f"{RESULTS}/runtime.csv",
    log:
        f"{RESULTS}/logs/runtime/all.log",
    localrule: True
    params:
        results=lambda w: RESULTS,
        source=source_hash("runtime"),
    message:
        "Collecting what the jobs cost"
    shell:
        "psfdae paper runtime --results {params.results} --out {output} > {log} 2>&1"
