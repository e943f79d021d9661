PROPAGATION = f"{RESULTS}/benchmark/propagation/{{scene}}/"
SCENES = options("scene")


rule propagation:
    output:
        multiext(
            PROPAGATION,
            propagation="propagation.csv",
            convergence="convergence.csv",
            choice="choice.csv",
            guard="guard.csv",
            skipping="skipping.csv",
            machine="machine.csv",
        ),
    log:
        f"{RESULTS}/logs/propagation/{{scene}}.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/benchmark/propagation-{{scene}}.tsv"
    threads: timed_threads
    resources:
        mem_mb=3000,
        runtime=30,
    params:
        config=lambda w: stage_overrides(
            "propagation", f"dataset={strictest_dataset(w.scene)}"
        ),
        source=lambda w: source_hash(
            "psfdae.stages.propagation", chosen=[f"psfdae.stars.{w.scene}_scene"]
        ),
        folder=subpath(output.propagation, parent=True),
        datasets=lambda w: sharing_stars(strictest_dataset(w.scene)),
    message:
        "Timing the optics of scene {wildcards.scene} against its error"
    shell:
        "psfdae propagation --datasets {params.datasets} --out {params.folder}"
        " {params.config:q} > {log} 2>&1"


rule import_times:
    output:
        f"{RESULTS}/benchmark/propagation/imports.csv",
    log:
        f"{RESULTS}/logs/propagation/imports.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/benchmark/imports.tsv"
    threads: timed_threads
    resources:
        mem_mb=1000,
        runtime=10,
    params:
        config=lambda w: stage_overrides("propagation", f"dataset={ALL_DATASETS[0]}"),
        source=source_hash("psfdae.stages.propagation", "psfdae.stages.stars"),
    message:
        "Timing the imports that the stages do without"
    shell:
        "psfdae import-times --out {output} {params.config:q} > {log} 2>&1"


rule propagation_tables:
    input:
        scenes=expand(rules.propagation.output.propagation, scene=SCENES),
        extra=rules.import_times.output,
    output:
        multiext(
            f"{RESULTS}/tables/benchmark_",
            propagation="propagation.csv",
            peers="peers.csv",
            convergence="convergence.csv",
            choice="choice.csv",
            guard="guard.csv",
            skipping="skipping.csv",
            machine="machine.csv",
        ),
    log:
        f"{RESULTS}/logs/propagation/tables.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/benchmark/propagation_tables.tsv"
    localrule: True
    threads: 1
    resources:
        mem_mb=500,
        runtime=10,
    params:
        source=source_hash("psfdae.stages.propagation"),
        folder=subpath(output.propagation, parent=True),
        scenes=lambda w, input: [path.rpartition("/")[0] for path in input.scenes],
        extra=lambda w, input: [f"--extra={path}" for path in input.extra],
    message:
        "Joining the tables of the optics benchmark"
    shell:
        "psfdae propagation-tables {params.extra:q} --out {params.folder}"
        " {params.scenes:q} > {log} 2>&1"


rule figure_propagation:
    input:
        rules.propagation_tables.output.propagation,
    output:
        report(
            f"{RESULTS}/figures/benchmark/propagation_{{scene}}.png",
            caption="../report/figure_propagation.rst",
            category="Benchmark: time against error",
            subcategory="propagation",
            labels={"figure": "error against time, {scene}"},
        ),
    log:
        f"{RESULTS}/logs/figures/benchmark/propagation_{{scene}}.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/benchmark/figure_propagation-{{scene}}.tsv"
    threads: 1
    resources:
        mem_mb=500,
        runtime=10,
    params:
        source=source_hash("psfdae.stages.propagation"),
    message:
        "Drawing error against time of the optics of scene {wildcards.scene}"
    shell:
        "psfdae figure propagation --scene {wildcards.scene} --table {input}"
        " --out {output} > {log} 2>&1"


rule figure_skipping:
    input:
        rules.propagation_tables.output.skipping,
    output:
        report(
            f"{RESULTS}/figures/benchmark/skipping.png",
            caption="../report/figure_skipping.rst",
            category="Benchmark: time against error",
            subcategory="propagation",
            labels={"figure": "what is not computed"},
        ),
    log:
        f"{RESULTS}/logs/figures/benchmark/skipping.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/benchmark/figure_skipping.tsv"
    threads: 1
    resources:
        mem_mb=500,
        runtime=10,
    params:
        source=source_hash("psfdae.stages.propagation"),
    message:
        "Drawing what leaving out superfluous work saves"
    shell:
        "psfdae figure skipping --table {input} --out {output} > {log} 2>&1"


PROPAGATION_PRODUCTS = [
    *rules.propagation_tables.output,
    *(f"{RESULTS}/figures/benchmark/propagation_{scene}.png" for scene in SCENES),
    *rules.figure_skipping.output,
]
