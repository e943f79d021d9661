# The run of record is committed, so nothing but an explicit request renews it.
rule reference:
    input:
        rules.tables.input,
        rules.calibrate.output,
        rules.runtime.output,
        lambda w: [
            file for dataset in default_datasets() for file in figures_of(dataset)
        ],
        ALIGNMENT_PRODUCTS,
        rules.benchmark.input,
        rules.baseline_readings.output,
        rules.stability.input,
        rules.bounds.input,
        rules.prediction.input,
        rules.from_stars_example.output,
    output:
        touch(f"{RESULTS}/.reference_renewed"),
    log:
        f"{RESULTS}/logs/reference/all.log",
    localrule: True
    params:
        results=lambda w: RESULTS,
        folder="results/reference",
        # What takes long stays from the record before where it has not been run again.
        keep=[
            f"--keep={file}"
            for file in (
                "paper/tables/psf_metrics.csv",
                "runtime_before.csv",
                "tables/benchmark_training.csv",
                "tables/benchmark_stopping.csv",
                "figures/benchmark/training.png",
                "tables/scaling_stages.csv",
                *(
                    f"tables/psf_{name}_on_request.csv"
                    for name in ("metrics", "efficiency")
                ),
                "tables/seed_scatter.csv",
                "tables/real_sky.csv",
                "tables/simulated_sky.csv",
                "tables/simulated_sky_scatter.csv",
                "sweeps/gmm/summary.csv",
                *(
                    f"sweeps/{name}/{table}.csv"
                    for name in ("dae_training", "dae_crop", "network_epochs")
                    for table in ("summary", "cost")
                ),
            )
        ],
    message:
        "Renewing the run of record"
    shell:
        "psfdae reference --results {params.results} --out {params.folder} {params.keep}"
        " {input} > {log} 2>&1"
