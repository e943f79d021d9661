PROPAGATION = f"{RESULTS}/benchmark/propagation/{{scene}}/"
SCENES = options("scene")
OPTICS = ["propagation", "convergence", "machine"]


rule propagation:
    output:
        multiext(PROPAGATION, *(f"{name}.csv" for name in OPTICS)),
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
            "propagation.measure", f"dataset={strictest_dataset(w.scene)}"
        ),
        source=lambda w: source_hash("workflow/benchmarks/propagation.py"),
        program=program("propagation.measure"),
        folder=subpath(output[0], parent=True),
    message:
        "Timing the optics of scene {wildcards.scene} against its error"
    shell:
        "python {params.program} --config {params.config}"
        " --out {params.folder} > {log} 2>&1"


rule propagation_tables:
    input:
        expand(rules.propagation.output[0], scene=SCENES),
    output:
        multiext(
            f"{RESULTS}/tables/benchmark_",
            *(f"{name}.csv" for name in [*OPTICS, "peers"]),
        ),
    log:
        f"{RESULTS}/logs/propagation/tables.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/benchmark/propagation_tables.tsv"
    resources:
        mem_mb=1000,
    params:
        source=source_hash("workflow/benchmarks/propagation.py"),
        program=program("propagation.tables"),
        folder=subpath(output[0], parent=True),
        scenes=lambda w, input: [f"--scene={Path(path).parent}" for path in input],
    message:
        "Joining the tables of the optics benchmark"
    shell:
        "python {params.program} {params.scenes:q} --out {params.folder} > {log} 2>&1"


DRAWN = {
    **{f"propagation_{scene}": f"error against time, {scene}" for scene in SCENES},
    "costs": "all methods: error against time",
    "inference": "speed of the network",
    "scaling": "growth of the costs",
}


rule figure_benchmark:
    input:
        lambda w: f"{RESULTS}/tables/benchmark_{w.drawn.partition('_')[0]}.csv",
    output:
        report(
            f"{RESULTS}/figures/benchmark/{{drawn}}.png",
            caption="../report/figure_benchmark.rst",
            category="Benchmark: time against error",
            subcategory=lambda w: w.drawn.partition("_")[0],
            labels=lambda w: {"figure": DRAWN[w.drawn]},
        ),
    log:
        f"{RESULTS}/logs/figures/benchmark/{{drawn}}.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/benchmark/figure_{{drawn}}.tsv"
    wildcard_constraints:
        drawn="|".join(DRAWN),
    params:
        source=source_hash("workflow/benchmarks/figures.py"),
        program=program("figures.draw"),
        kind=lambda w: w.drawn.partition("_")[0],
        scene=lambda w: [f"--scene={s}" for s in SCENES if w.drawn.endswith(f"_{s}")],
    message:
        "Drawing the benchmark {wildcards.drawn}"
    shell:
        "python {params.program} --kind {params.kind} {params.scene:q}"
        " --table {input} --out {output} > {log} 2>&1"


rule benchmark:
    input:
        rules.propagation_tables.output,
        rules.benchmark_costs.output,
        rules.benchmark_inference.output,
        rules.benchmark_scaling.output,
        rules.prediction.input,
        rules.scaling.input,
        expand(rules.figure_benchmark.output, drawn=DRAWN),
    localrule: True


# The scatter of each method over its own random draws, for the same stars: a rule for each method
# (seeds_dae, seeds_gmm, …), those that are plugged in included.
SEEDS = f"{RESULTS}/seeds/{{dataset}}"

for _method in registered():

    rule:
        name:
            f"seeds_{_method.name}"
        input:
            lambda w, m=_method: [
                path
                for reference in dataset_config(w.dataset).dataset.references
                if m.storage
                for path in files_of(m, w.dataset, "random", reference)
            ],
            stars=lambda w: stars_of(w.dataset),
        output:
            f"{SEEDS}/{_method.name}.csv",
        log:
            f"{RESULTS}/logs/seeds/{{dataset}}-{_method.name}.log",
        benchmark:
            f"{RESULTS}/benchmarks_on_request/seeds/{{dataset}}-{_method.name}.tsv"
        # What takes longest is started first.
        priority: _method.needs.minutes
        threads: lambda w, m=_method: m.threads(dataset_config(w.dataset))
        resources:
            mem_mb=_method.needs.memory_mb,
            runtime=5 * _method.needs.minutes,
        params:
            config=lambda w, m=_method: settings(
                "trainings.seeds", f"dataset={w.dataset}", name=m.name
            ),
            source=lambda w, m=_method: program_code("trainings.seeds", [m.__module__]),
            program=program("trainings.seeds"),
            method=_method.name,
            results=lambda w: RESULTS,
            references=lambda w: [
                f"--reference={r}"
                for r in dataset_config(w.dataset).dataset.references
            ],
        message:
            f"Fitting {_method.look.label} to {{wildcards.dataset}} with other seeds"
        shell:
            "python {params.program} {params.method} --config {params.config}"
            " --dataset {wildcards.dataset} {params.references} --stars {input.stars}"
            " --results {params.results} --out {output} > {log} 2>&1"


rule seed_scatter:
    input:
        lambda w: [
            f"{SEEDS}/{name}.csv".format(dataset=dataset)
            for dataset in default_datasets()
            for name in names_of(dataset)
        ],
    output:
        f"{RESULTS}/tables/seed_scatter.csv",
    log:
        f"{RESULTS}/logs/seeds/scatter.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/seeds/scatter.tsv"
    localrule: True
    params:
        source=program_code("trainings.scatter", []),
        program=program("trainings.scatter"),
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
