rule runtime:
    input:
        lambda w: [
            file
            for dataset in list_default_datasets(RUN)
            for file in datasets.products(RUN, dataset)
        ],
        rules.psf_metrics.output,
        rules.methods_table.output,
        rules.held_out.output,
        rules.calibrate.output,
        rules.scene3.input,
    output:
        f"{RESULTS}/runtime.csv",
    log:
        f"{RESULTS}/logs/runtime/all.log",
    localrule: True
    params:
        results=lambda w: RESULTS,
        source=hash_code("runtime"),
    message:
        "Collecting the costs of the jobs"
    shell:
        "psfdae paper runtime --results {params.results} --out {output} > {log} 2>&1"
