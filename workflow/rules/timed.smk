# Timings: each takes all cores, so that no other job disturbs it, and leaves one table; others,
# which measure no time, run side by side. Costs are CPU time on one thread: two of them share the
# cores.
# Programs are in workflow/benchmarks, named by file and function.
rule cost:
    input:
        stars=lambda w: datasets.stars_file(RUN, w.dataset),
        bounds=rules.dataset_bounds.output.summary,
    output:
        f"{RESULTS}/costs/{{dataset}}/{{method}}-{{point}}.csv",
    log:
        f"{RESULTS}/logs/costs/{{dataset}}-{{method}}-{{point}}.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/benchmark/{{dataset}}-{{method}}-{{point}}.tsv"
    wildcard_constraints:
        method=r"\w+",
    threads: max(1, workflow.cores // 2)
    resources:
        mem_mb=2000,
        runtime=30,
    params:
        config=lambda w: settings(
            RUN,
            "costs.cost",
            f"dataset={w.dataset}",
            extra=timings.get_point_overrides(w),
            name=w.method,
        ),
        source=lambda w: source_hash(
            "workflow/benchmarks/costs.py", timings.get_timing_module(w.method)
        ),
        program=locate_program("costs.cost"),
        inputs=as_options,
    message:
        "Timing {wildcards.method}, {wildcards.point}, on {wildcards.dataset}"
    shell:
        "python {params.program} {wildcards.method} --config {params.config}"
        " --dataset {wildcards.dataset} --point {wildcards.point} {params.inputs:q}"
        " --out {output} > {log} 2>&1"


rule benchmark_costs:
    input:
        lambda w: timings.cost_tables(RUN),
    output:
        f"{RESULTS}/tables/benchmark_costs.csv",
    log:
        f"{RESULTS}/logs/costs/table.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/benchmark/benchmark_costs.tsv"
    localrule: True
    params:
        source=hash_code("workflow/benchmarks/costs.py"),
        program=locate_program("costs.costs"),
        points=lambda w: repr(timings.load_timing_points()),
    message:
        "Joining errors and times of all methods"
    shell:
        "python {params.program} --out {output} {input} > {log} 2>&1"


# All methods, and networks that train for minutes, which are timed on request.
use rule benchmark_costs as posterior_network_costs with:
    input:
        rules.benchmark_costs.output,
        lambda w: timings.cost_tables_on_request(RUN),
    output:
        f"{RESULTS}/tables/posterior_network.csv",
    log:
        f"{RESULTS}/logs/costs/posterior_network.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/benchmark/posterior_network.tsv"
    localrule: True
    message:
        "Joining errors and times of all methods and of the posterior networks"


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
        config=lambda w: settings(
            RUN, "speed.inference", timings.choose_timing_dataset()
        ),
        source=hash_code("workflow/benchmarks/speed.py"),
        program=locate_program("speed.inference"),
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
        config=lambda w: settings(RUN, "speed.growth", timings.choose_timing_dataset()),
        source=hash_code(
            "workflow/benchmarks/speed.py", "templates", "stars", "predict"
        ),
        program=locate_program("speed.growth"),
    message:
        "Measuring for the table benchmark_scaling"
    shell:
        "python {params.program} --config {params.config}"
        " --out {output} > {log} 2>&1"


rule predict_throughput:
    input:
        stars=lambda w: datasets.stars_file(RUN, timings.get_timing_dataset()),
        bundle=lambda w: timings.get_timing_bundle(RUN, "dae"),
        mixture=lambda w: timings.get_timing_bundle(RUN, "gmm"),
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
        config=lambda w: settings(
            RUN, "prediction.throughput", timings.choose_timing_dataset()
        ),
        source=hash_code("workflow/benchmarks/prediction.py", "predict"),
        program=locate_program("prediction.throughput"),
        inputs=as_options,
    message:
        "Measuring for the table predict_throughput"
    shell:
        "python {params.program} --config {params.config} {params.inputs:q}"
        " --out {output} > {log} 2>&1"


rule predict_poppy:
    input:
        bundle=lambda w: timings.list_timing_bundles(RUN),
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
        config=lambda w: settings(
            RUN, "prediction.poppy", timings.choose_timing_dataset()
        ),
        source=hash_code("workflow/benchmarks/prediction.py"),
        program=locate_program("prediction.poppy"),
        inputs=as_options,
        limit=lambda w: [f"--count={timings.poppy_stars(RUN)}"],
    message:
        "Measuring for the table predict_poppy"
    shell:
        "python {params.program} --config {params.config} {params.inputs:q} {params.limit}"
        " --out {output} > {log} 2>&1"


rule predict_coverage:
    input:
        stars=lambda w: [
            datasets.stars_file(RUN, timings.get_timing_dataset()),
            f"{RESULTS}/own_stars/example/model/stars.h5",
        ],
        bundle=lambda w: [
            *timings.list_timing_bundles(RUN),
            f"{RESULTS}/own_stars/example/model/example.psf.safetensors",
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
        config=lambda w: settings(
            RUN, "prediction.coverage", timings.choose_timing_dataset()
        ),
        source=hash_code("workflow/benchmarks/prediction.py"),
        program=locate_program("prediction.coverage"),
        inputs=as_options,
    message:
        "Measuring for the table predict_coverage"
    shell:
        "python {params.program} --config {params.config} {params.inputs:q}"
        " --out {output} > {log} 2>&1"


rule predict_strange:
    input:
        stars=lambda w: datasets.stars_file(RUN, timings.get_timing_dataset()),
        bundle=lambda w: timings.get_timing_bundle(RUN, "gmm"),
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
        config=lambda w: settings(
            RUN, "prediction.outliers", timings.choose_timing_dataset()
        ),
        source=hash_code("workflow/benchmarks/prediction.py"),
        program=locate_program("prediction.strange"),
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
        config=lambda w: settings(RUN, "speed.stages", timings.choose_timing_dataset()),
        source=hash_code(
            "workflow/benchmarks/speed.py",
            "templates",
            "stars",
            "fit",
            "evaluate",
            "predict",
        ),
        program=locate_program("speed.stages"),
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
