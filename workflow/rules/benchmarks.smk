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
        config=lambda w: settings(
            "propagation.measure", f"dataset={strictest_dataset(w.scene)}"
        ),
        source=lambda w: source_hash(
            "workflow/benchmarks/propagation.py:measure",
            chosen=[f"psfdae.stars.scenes:{w.scene.title()}Scene"],
        ),
        program=program("propagation.measure"),
        folder=subpath(output.propagation, parent=True),
        datasets=lambda w: sharing_stars(strictest_dataset(w.scene)),
    message:
        "Timing the optics of scene {wildcards.scene} against its error"
    shell:
        "python {params.program} --config {params.config}"
        " --datasets {params.datasets} --out {params.folder} > {log} 2>&1"


rule propagation_tables:
    input:
        expand(rules.propagation.output.propagation, scene=SCENES),
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
    threads: timed_threads
    resources:
        mem_mb=1000,
    params:
        config=lambda w: settings("propagation.tables", f"dataset={TIMED_DATASET}"),
        source=source_hash("workflow/benchmarks/propagation.py:tables"),
        program=program("propagation.tables"),
        folder=subpath(output.propagation, parent=True),
        scenes=lambda w, input: [f"--scene={Path(path).parent}" for path in input],
    message:
        "Joining the tables of the optics benchmark and timing imports"
    shell:
        "python {params.program} --config {params.config}"
        " {params.scenes:q} --out {params.folder} > {log} 2>&1"


BUNDLE = f"{RESULTS}/bundles/{TIMED_DATASET}-random-realisation.psf.safetensors"
TESTED = f"{RESULTS}/evaluation/{TIMED_DATASET}/random-realisation.csv"
STARS = {"stars": lambda w: stars_of(TIMED_DATASET)}
# By table: target, command, inputs, MB, minutes, stages that it runs as users do.
TIMED = {
    "benchmark_baseline": ("benchmark", "baseline.baseline", STARS, 1500, 20, []),
    "benchmark_inference": ("benchmark", "speed.inference", {}, 3000, 30, []),
    "benchmark_scaling": (
        *("benchmark", "speed.growth", {}, 2000, 30),
        ["stars", "predict"],
    ),
    "predict_throughput": (
        *("prediction", "prediction.throughput", {**STARS, "bundle": BUNDLE}),
        *(1500, 20, ["predict"]),
    ),
    "predict_poppy": (
        *("prediction", "prediction.poppy", {"bundle": BUNDLE, "evaluation": TESTED}),
        *(1500, 20, []),
    ),
    "scaling_stages": (
        *("scaling", "plan.stages", {}, 4000, 60),
        ["stars", "fit", "evaluate", "predict"],
    ),
}

TIMED_TABLES = {name: f"{RESULTS}/tables/{name}.csv" for name in TIMED}

for _table, (_target, _run, _inputs, _mb, _minutes, _stages) in TIMED.items():

    rule:
        name:
            _table
        input:
            **_inputs,
        output:
            TIMED_TABLES[_table],
        log:
            f"{RESULTS}/logs/benchmark/{_table}.log",
        benchmark:
            f"{RESULTS}/benchmarks_on_request/{_target}/{_table}.tsv"
        threads: workflow.cores
        resources:
            mem_mb=_mb,
            runtime=_minutes,
            disk_mb=2000,
        params:
            config=lambda w, run=_run: settings(run, f"dataset={TIMED_DATASET}"),
            source=program_code(_run, _stages),
            program=program(_run),
            inputs=lambda w, input: [f"--{name}={path}" for name, path in input.items()],
            limit=lambda w, run=_run: (
                [f"--count={poppy_stars(w)}"] if run.endswith("poppy") else []
            ),
        message:
            f"Measuring for the table {_table}"
        shell:
            "python {params.program} --config {params.config} {params.inputs:q}"
            " {params.limit} --out {output} > {log} 2>&1"


DRAWN = {
    **{f"propagation_{scene}": f"error against time, {scene}" for scene in SCENES},
    "skipping": "what is not computed",
    "baseline": "baseline: error against time",
    "inference": "speed of the network",
    "scaling": "growth of the costs",
    "training": "training error against time",
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
        [file for name, file in TIMED_TABLES.items() if TIMED[name][0] == "benchmark"],
        expand(
            rules.figure_benchmark.output, drawn=[d for d in DRAWN if d != "training"]
        ),
    localrule: True


rule prediction:
    input:
        [file for name, file in TIMED_TABLES.items() if TIMED[name][0] == "prediction"],
    localrule: True


rule scaling:
    input:
        TIMED_TABLES["scaling_stages"],
    localrule: True
