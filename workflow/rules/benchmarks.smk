rule propagation:
    output:
        multiext(
            f"{RESULTS}/benchmark/propagation/{{scene}}/",
            "propagation.csv",
            "convergence.csv",
            "machine.csv",
        ),
    log:
        f"{RESULTS}/logs/propagation/{{scene}}.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/benchmark/propagation-{{scene}}.tsv"
    threads: workflow.cores
    resources:
        mem_mb=3000,
        runtime=30,
    params:
        config=lambda w: settings(
            RUN,
            "propagation.measure",
            f"dataset={timings.strictest_dataset(RUN, w.scene)}",
        ),
        source=hash_code("workflow/benchmarks/propagation.py"),
        program=locate_program("propagation.measure"),
        folder=subpath(output[0], parent=True),
    message:
        "Timing the optics of scene {wildcards.scene} against its error"
    shell:
        "python {params.program} --config {params.config}"
        " --out {params.folder} > {log} 2>&1"


rule propagation_tables:
    input:
        expand(rules.propagation.output[0], scene=datasets.list_scenes()),
    output:
        multiext(
            f"{RESULTS}/tables/benchmark_",
            "propagation.csv",
            "convergence.csv",
            "machine.csv",
            "peers.csv",
        ),
    log:
        f"{RESULTS}/logs/propagation/tables.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/benchmark/propagation_tables.tsv"
    resources:
        mem_mb=1000,
    params:
        source=hash_code("workflow/benchmarks/propagation.py"),
        program=locate_program("propagation.tables"),
        folder=subpath(output[0], parent=True),
        scenes=lambda w, input: [f"--scene={Path(path).parent}" for path in input],
    message:
        "Joining the tables of the optics benchmark"
    shell:
        "python {params.program} {params.scenes:q} --out {params.folder} > {log} 2>&1"


rule figure_benchmark:
    input:
        lambda w: f"{RESULTS}/tables/benchmark_{w.drawn.partition('_')[0]}.csv",
    output:
        report(
            f"{RESULTS}/figures/benchmark/{{drawn}}.png",
            caption="../report/figure_benchmark.rst",
            category="Benchmark: time against error",
            subcategory=lambda w: w.drawn.partition("_")[0],
            labels=lambda w: {"figure": timings.figures()[w.drawn]},
        ),
    log:
        f"{RESULTS}/logs/figures/benchmark/{{drawn}}.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/benchmark/figure_{{drawn}}.tsv"
    wildcard_constraints:
        drawn=match_any([*timings.figures()]),
    params:
        source=hash_code("workflow/benchmarks/figures.py"),
        program=locate_program("figures.draw"),
        kind=lambda w: w.drawn.partition("_")[0],
        scene=lambda w: timings.scene_options(w.drawn),
    message:
        "Drawing the benchmark {wildcards.drawn}"
    shell:
        "python {params.program} --kind {params.kind} {params.scene:q}"
        " --table {input} --out {output} > {log} 2>&1"


use rule figure_benchmark as posterior_network with:
    input:
        rules.posterior_network_costs.output,
    output:
        report(
            f"{RESULTS}/figures/benchmark/posterior_network.png",
            caption="../report/figure_benchmark.rst",
            category="Benchmark: time against error",
            subcategory="costs",
            labels={
                "figure": "all methods and posterior networks: error against time"
            },
        ),
    log:
        f"{RESULTS}/logs/figures/benchmark/posterior_network.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/benchmark/figure_posterior_network.tsv"
    params:
        kind="costs",
        scene=[],
    message:
        "Drawing errors of all methods and of the posterior networks against time"


rule benchmark:
    input:
        rules.propagation_tables.output,
        rules.benchmark_costs.output,
        rules.benchmark_inference.output,
        rules.benchmark_scaling.output,
        rules.prediction.input,
        rules.scaling.input,
        expand(rules.figure_benchmark.output, drawn=timings.figures()),
    localrule: True


# The scatter of a method over its own random draws, for the same stars.
rule seeds_of_method:
    input:
        lambda w: fits.seed_fits(RUN, w),
        stars=lambda w: datasets.stars_file(RUN, w.dataset),
    output:
        f"{RESULTS}/seeds/{{dataset}}/{{method}}.csv",
    log:
        f"{RESULTS}/logs/seeds/{{dataset}}-{{method}}.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/seeds/{{dataset}}-{{method}}.tsv"
    wildcard_constraints:
        method=r"\w+",
    threads: lambda w: fits.fit_threads(RUN, w.method)(w)
    resources:
        mem_mb=lambda w: fits.fit_resources(w.method)["mem_mb"],
        runtime=lambda w: 5 * fits.fit_resources(w.method)["runtime"],
    params:
        config=lambda w: settings(
            RUN, "trainings.seeds", f"dataset={w.dataset}", name=w.method
        ),
        source=lambda w: source_hash(
            "workflow/benchmarks/trainings.py", timings.get_timing_module(w.method)
        ),
        program=locate_program("trainings.seeds"),
        method=lambda w: w.method,
        results=lambda w: RESULTS,
        references=lambda w: [
            f"--reference={r}"
            for r in load_dataset_config(RUN, w.dataset).dataset.references
        ],
    message:
        "Fitting {wildcards.method} to {wildcards.dataset} with other seeds"
    shell:
        "python {params.program} {params.method} --config {params.config}"
        " --dataset {wildcards.dataset} {params.references} --stars {input.stars}"
        " --results {params.results} --out {output} > {log} 2>&1"


rule seed_scatter:
    input:
        lambda w: [
            f"{RESULTS}/seeds/{dataset}/{name}.csv"
            for dataset in list_default_datasets(RUN)
            for name in fits.method_names(RUN, dataset)
        ],
    output:
        f"{RESULTS}/tables/seed_scatter.csv",
    log:
        f"{RESULTS}/logs/seeds/scatter.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/seeds/scatter.tsv"
    localrule: True
    params:
        source=hash_code("workflow/benchmarks/trainings.py"),
        program=locate_program("trainings.scatter"),
    message:
        "Pooling the scatter between seeds"
    shell:
        "python {params.program} --out {output} {input} > {log} 2>&1"


# The table that comes with the package is committed: nothing but an explicit request renews it.
rule seeds:
    input:
        rules.seed_scatter.output,
    output:
        touch(f"{RESULTS}/.seeds_renewed"),
    log:
        f"{RESULTS}/logs/seeds/all.log",
    localrule: True
    params:
        table="src/psfdae_paper/evaluation/seed_scatter.csv",
    message:
        "Renewing the scatter between seeds that comes with the package"
    shell:
        "install -D -m 644 {input} {params.table} 2> {log}"
