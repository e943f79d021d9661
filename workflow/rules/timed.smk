# Timings: each takes all cores, so that no other job disturbs it, and leaves one table.
# Programs are those of workflow/benchmarks, by file and function.
TIMED_BUNDLE = f"{RESULTS}/bundles/{TIMED_DATASET}-random-realisation.psf.safetensors"
TIMED_MIXTURE = TIMED_BUNDLE.replace(
    "realisation", f"realisation{fit_files.suffix_of(method('gmm'))}"
)
OWN_MODEL = f"{RESULTS}/own_stars/example/model"


rule benchmark_baseline:
    input:
        stars=lambda w: stars_of(TIMED_DATASET),
    output:
        f"{RESULTS}/tables/benchmark_baseline.csv",
    log:
        f"{RESULTS}/logs/benchmark/benchmark_baseline.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/benchmark/benchmark_baseline.tsv"
    threads: workflow.cores
    resources:
        mem_mb=1500,
        runtime=20,
        disk_mb=2000,
    params:
        config=lambda w: settings("trainings.baseline", f"dataset={TIMED_DATASET}"),
        source=program_code("trainings.baseline", []),
        program=program("trainings.baseline"),
        inputs=as_options,
    message:
        "Measuring for the table benchmark_baseline"
    shell:
        "python {params.program} --config {params.config} {params.inputs:q}"
        " --out {output} > {log} 2>&1"


rule benchmark_methods:
    input:
        stars=lambda w: stars_of(TIMED_DATASET),
    output:
        f"{RESULTS}/tables/benchmark_methods.csv",
    log:
        f"{RESULTS}/logs/benchmark/benchmark_methods.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/benchmark/benchmark_methods.tsv"
    threads: workflow.cores
    resources:
        mem_mb=1500,
        runtime=20,
        disk_mb=2000,
    params:
        config=lambda w: settings("trainings.methods", f"dataset={TIMED_DATASET}"),
        source=program_code(
            "trainings.methods",
            [method(name).__module__ for name in names_of(TIMED_DATASET)],
        ),
        program=program("trainings.methods"),
        inputs=as_options,
    message:
        "Measuring for the table benchmark_methods"
    shell:
        "python {params.program} --config {params.config} {params.inputs:q}"
        " --out {output} > {log} 2>&1"


rule benchmark_inference:
    output:
        f"{RESULTS}/tables/benchmark_inference.csv",
    log:
        f"{RESULTS}/logs/benchmark/benchmark_inference.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/benchmark/benchmark_inference.tsv"
    threads: workflow.cores
    resources:
        mem_mb=3000,
        runtime=30,
        disk_mb=2000,
    params:
        config=lambda w: settings("speed.inference", f"dataset={TIMED_DATASET}"),
        source=program_code("speed.inference", []),
        program=program("speed.inference"),
    message:
        "Measuring for the table benchmark_inference"
    shell:
        "python {params.program} --config {params.config}"
        " --out {output} > {log} 2>&1"


rule benchmark_scaling:
    output:
        f"{RESULTS}/tables/benchmark_scaling.csv",
    log:
        f"{RESULTS}/logs/benchmark/benchmark_scaling.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/benchmark/benchmark_scaling.tsv"
    threads: workflow.cores
    resources:
        mem_mb=2000,
        runtime=30,
        disk_mb=2000,
    params:
        config=lambda w: settings("speed.growth", f"dataset={TIMED_DATASET}"),
        source=program_code("speed.growth", ["templates", "stars", "predict"]),
        program=program("speed.growth"),
    message:
        "Measuring for the table benchmark_scaling"
    shell:
        "python {params.program} --config {params.config}"
        " --out {output} > {log} 2>&1"


rule predict_throughput:
    input:
        stars=lambda w: stars_of(TIMED_DATASET),
        bundle=TIMED_BUNDLE,
        mixture=TIMED_MIXTURE,
    output:
        f"{RESULTS}/tables/predict_throughput.csv",
    log:
        f"{RESULTS}/logs/benchmark/predict_throughput.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/prediction/predict_throughput.tsv"
    threads: workflow.cores
    resources:
        mem_mb=1500,
        runtime=20,
        disk_mb=2000,
    params:
        config=lambda w: settings("prediction.throughput", f"dataset={TIMED_DATASET}"),
        source=program_code("prediction.throughput", ["predict"]),
        program=program("prediction.throughput"),
        inputs=as_options,
    message:
        "Measuring for the table predict_throughput"
    shell:
        "python {params.program} --config {params.config} {params.inputs:q}"
        " --out {output} > {log} 2>&1"


rule predict_poppy:
    input:
        bundle=every_bundle_of_timed,
    output:
        f"{RESULTS}/tables/predict_poppy.csv",
    log:
        f"{RESULTS}/logs/benchmark/predict_poppy.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/prediction/predict_poppy.tsv"
    threads: workflow.cores
    resources:
        mem_mb=1500,
        runtime=20,
        disk_mb=2000,
    params:
        config=lambda w: settings("prediction.poppy", f"dataset={TIMED_DATASET}"),
        source=program_code("prediction.poppy", []),
        program=program("prediction.poppy"),
        inputs=as_options,
        limit=lambda w: [f"--count={poppy_stars(w)}"],
    message:
        "Measuring for the table predict_poppy"
    shell:
        "python {params.program} --config {params.config} {params.inputs:q} {params.limit}"
        " --out {output} > {log} 2>&1"


rule predict_coverage:
    input:
        stars=lambda w: [stars_of(TIMED_DATASET), f"{OWN_MODEL}/stars.h5"],
        bundle=lambda w: [
            *every_bundle_of_timed(w),
            f"{OWN_MODEL}/example.psf.safetensors",
        ],
    output:
        f"{RESULTS}/tables/predict_coverage.csv",
    log:
        f"{RESULTS}/logs/benchmark/predict_coverage.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/prediction/predict_coverage.tsv"
    threads: workflow.cores
    resources:
        mem_mb=1500,
        runtime=30,
        disk_mb=2000,
    params:
        config=lambda w: settings("prediction.coverage", f"dataset={TIMED_DATASET}"),
        source=program_code("prediction.coverage", []),
        program=program("prediction.coverage"),
        inputs=as_options,
    message:
        "Measuring for the table predict_coverage"
    shell:
        "python {params.program} --config {params.config} {params.inputs:q}"
        " --out {output} > {log} 2>&1"


rule predict_strange:
    input:
        stars=lambda w: stars_of(TIMED_DATASET),
        bundle=TIMED_MIXTURE,
    output:
        f"{RESULTS}/tables/predict_strange.csv",
    log:
        f"{RESULTS}/logs/benchmark/predict_strange.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/prediction/predict_strange.tsv"
    threads: workflow.cores
    resources:
        mem_mb=1500,
        runtime=20,
        disk_mb=2000,
    params:
        config=lambda w: settings("prediction.outliers", f"dataset={TIMED_DATASET}"),
        source=program_code("prediction.strange", []),
        program=program("prediction.strange"),
        inputs=as_options,
    message:
        "Measuring for the table predict_strange"
    shell:
        "python {params.program} --config {params.config} {params.inputs:q}"
        " --out {output} > {log} 2>&1"


rule scaling_stages:
    output:
        f"{RESULTS}/tables/scaling_stages.csv",
    log:
        f"{RESULTS}/logs/benchmark/scaling_stages.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/scaling/scaling_stages.tsv"
    threads: workflow.cores
    resources:
        mem_mb=4000,
        runtime=60,
        disk_mb=2000,
    params:
        config=lambda w: settings("speed.stages", f"dataset={TIMED_DATASET}"),
        source=program_code(
            "speed.stages", ["templates", "stars", "fit", "evaluate", "predict"]
        ),
        program=program("speed.stages"),
    message:
        "Measuring for the table scaling_stages"
    shell:
        "python {params.program} --config {params.config}"
        " --out {output} > {log} 2>&1"


rule prediction:
    input:
        rules.predict_throughput.output,
        rules.predict_poppy.output,
        rules.predict_coverage.output,
        rules.predict_strange.output,
    localrule: True


rule scaling:
    input:
        rules.scaling_stages.output,
    localrule: True
