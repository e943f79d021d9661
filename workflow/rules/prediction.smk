PREDICTION_DATASET = "dataset3"
POPPY_STARS = 500


# Every core, so that no other job runs beside the measurement.
rule predict_throughput:
    input:
        stars=lambda w: stars_of(PREDICTION_DATASET),
        bundle=f"{RESULTS}/bundles/{PREDICTION_DATASET}-random-realisation.psf.safetensors",
    output:
        f"{RESULTS}/tables/predict_throughput.csv",
    log:
        f"{RESULTS}/logs/prediction/throughput.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/prediction/throughput.tsv"
    threads: workflow.cores
    resources:
        mem_mb=1500,
        disk_mb=1000,
        runtime=20,
    params:
        config=lambda w: stage_overrides("prediction", f"dataset={PREDICTION_DATASET}"),
        source=source_hash("psfdae.stages.prediction", "psfdae.benchmark.prediction"),
    message:
        "Timing the prediction from FITS to FITS"
    shell:
        "psfdae benchmark-prediction --stars {input.stars} --bundle {input.bundle}"
        " --out {output} {params.config:q} > {log} 2>&1"


rule predict_poppy:
    input:
        bundle=f"{RESULTS}/bundles/{PREDICTION_DATASET}-random-realisation.psf.safetensors",
        evaluation=f"{RESULTS}/evaluation/{PREDICTION_DATASET}/random-realisation.csv",
    output:
        f"{RESULTS}/tables/predict_poppy.csv",
    log:
        f"{RESULTS}/logs/prediction/poppy.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/prediction/poppy.tsv"
    threads: 1
    resources:
        mem_mb=1500,
        runtime=20,
    params:
        config=lambda w: stage_overrides("prediction", f"dataset={PREDICTION_DATASET}"),
        source=source_hash("psfdae.stages.prediction", "psfdae.benchmark.poppy_stars"),
        # A small preset has small test parts; POPPY takes its time for each star.
        stars=lambda w: min(
            POPPY_STARS, dataset_config(PREDICTION_DATASET).parts.test_stars
        ),
    message:
        "Predicting stars that POPPY has simulated"
    shell:
        "psfdae predict-poppy --bundle {input.bundle} --evaluation {input.evaluation}"
        " --count {params.stars} --out {output} {params.config:q} > {log} 2>&1"


rule prediction:
    input:
        rules.predict_throughput.output,
        rules.predict_poppy.output,
    localrule: True
