# Timings: each takes all cores, so that no other job disturbs it, and leaves one table; others,
# which measure no time, run side by side.
# Programs are those of workflow/benchmarks, by file and function.
TIMED_BUNDLE = f"{RESULTS}/bundles/{TIMED_DATASET}-random-realisation.psf.safetensors"
TIMED_MIXTURE = TIMED_BUNDLE.replace(
    "realisation", f"realisation{fit_files.get_bundle_suffix(method('gmm'))}"
)
OWN_MODEL = f"{RESULTS}/own_stars/example/model"


rule cost:
    input:
        stars=lambda w: stars_of(w.dataset),
        bounds=rules.dataset_bounds.output.summary,
    output:
        f"{RESULTS}/costs/{{dataset}}/{{method}}-{{point}}.csv",
    log:
        f"{RESULTS}/logs/costs/{{dataset}}-{{method}}-{{point}}.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/benchmark/{{dataset}}-{{method}}-{{point}}.tsv"
    wildcard_constraints:
        method=r"\w+",
    threads: workflow.cores
    resources:
        mem_mb=2000,
        runtime=30,
    params:
        config=lambda w: settings(
            "costs.cost",
            f"dataset={w.dataset}",
            more=tuple(TIMED.overrides(w.dataset, w.method)[w.point]),
            name=w.method,
        ),
        source=lambda w: program_code("costs.cost", [timed_module(w.method)]),
        program=program("costs.cost"),
        inputs=as_options,
    message:
        "Timing {wildcards.method}, {wildcards.point}, on {wildcards.dataset}"
    shell:
        "python {params.program} {wildcards.method} --config {params.config}"
        " --dataset {wildcards.dataset} --point {wildcards.point} {params.inputs:q}"
        " --out {output} > {log} 2>&1"


rule benchmark_costs:
    input:
        timed_points,
    output:
        f"{RESULTS}/tables/benchmark_costs.csv",
    log:
        f"{RESULTS}/logs/costs/table.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/benchmark/benchmark_costs.tsv"
    localrule: True
    params:
        source=program_code("costs.costs", []),
        program=program("costs.costs"),
        points=repr(TIMED),
    message:
        "Joining errors and times of all methods"
    shell:
        "python {params.program} --out {output} {input} > {log} 2>&1"


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
        f"{RESULTS}/benchmarks_on_request/benchmark/predict_throughput.tsv"
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
        f"{RESULTS}/benchmarks_on_request/benchmark/predict_poppy.tsv"
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
        f"{RESULTS}/benchmarks_on_request/benchmark/predict_coverage.tsv"
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
        f"{RESULTS}/benchmarks_on_request/benchmark/predict_strange.tsv"
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
        f"{RESULTS}/benchmarks_on_request/benchmark/scaling_stages.tsv"
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
