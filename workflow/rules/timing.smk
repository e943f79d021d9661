TIMED_DATASET = "dataset3"

TIMING_LABELS = {
    "baseline": "baseline: error against time",
    "inference": "speed of the network",
    "scaling": "growth of the costs",
}


# Every core, so that no other job runs beside a measurement.
rule benchmark_baseline:
    input:
        stars=lambda w: stars_of(TIMED_DATASET),
    output:
        f"{RESULTS}/tables/benchmark_baseline.csv",
    log:
        f"{RESULTS}/logs/benchmark/baseline.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/benchmark/baseline.tsv"
    threads: workflow.cores
    resources:
        mem_mb=1500,
        runtime=20,
    params:
        config=lambda w: stage_overrides("timing", f"dataset={TIMED_DATASET}"),
        source=source_hash("psfdae.stages.timing", "psfdae.stages.timing_jobs"),
    message:
        "Timing the baseline over its sizes"
    shell:
        "psfdae benchmark-baseline --stars {input.stars} --out {output}"
        " {params.config:q} > {log} 2>&1"


rule benchmark_inference:
    output:
        f"{RESULTS}/tables/benchmark_inference.csv",
    log:
        f"{RESULTS}/logs/benchmark/inference.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/benchmark/inference.tsv"
    threads: workflow.cores
    resources:
        mem_mb=3000,
        runtime=30,
    params:
        config=lambda w: stage_overrides("timing", f"dataset={TIMED_DATASET}"),
        source=source_hash("psfdae.stages.timing"),
    message:
        "Timing the network in torch and onnxruntime"
    shell:
        "psfdae benchmark-inference --out {output} {params.config:q} > {log} 2>&1"


rule benchmark_scaling:
    output:
        f"{RESULTS}/tables/benchmark_scaling.csv",
    log:
        f"{RESULTS}/logs/benchmark/scaling.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/benchmark/scaling.tsv"
    threads: workflow.cores
    resources:
        mem_mb=2000,
        runtime=30,
        disk_mb=1000,
    params:
        config=lambda w: stage_overrides("timing", f"dataset={TIMED_DATASET}"),
        source=source_hash(
            "psfdae.stages.timing",
            "psfdae.stages.timing_jobs",
            chosen=["psfdae.stars.seidel_scene"],
        ),
    message:
        "Measuring how simulation and inference grow"
    shell:
        "psfdae benchmark-scaling --out {output} {params.config:q} > {log} 2>&1"


rule figure_timing:
    input:
        f"{RESULTS}/tables/benchmark_{{timing}}.csv",
    output:
        report(
            f"{RESULTS}/figures/benchmark/{{timing}}.png",
            caption="../report/figure_timing.rst",
            category="Benchmark: time against error",
            subcategory="{timing}",
            labels=lambda w: {"figure": TIMING_LABELS[w.timing]},
        ),
    log:
        f"{RESULTS}/logs/figures/benchmark/{{timing}}.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/benchmark/figure_{{timing}}.tsv"
    wildcard_constraints:
        timing="|".join(TIMING_LABELS),
    threads: 1
    resources:
        mem_mb=500,
        runtime=10,
    params:
        source=source_hash(
            "psfdae.evaluation.throughput_figures", "psfdae.stages.figures"
        ),
    message:
        "Drawing the benchmark {wildcards.timing}"
    shell:
        "psfdae figure benchmark --kind {wildcards.timing} --table {input}"
        " --out {output} > {log} 2>&1"


TIMING_PRODUCTS = [
    file
    for kind in TIMING_LABELS
    for file in (
        f"{RESULTS}/tables/benchmark_{kind}.csv",
        f"{RESULTS}/figures/benchmark/{kind}.png",
    )
]
