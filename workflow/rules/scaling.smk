SCALED_DATASET = "dataset3"


# Every core, so that no other job runs beside a measurement.
rule scaling_stages:
    output:
        f"{RESULTS}/tables/scaling_stages.csv",
    log:
        f"{RESULTS}/logs/scaling/stages.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/scaling/stages.tsv"
    threads: workflow.cores
    resources:
        mem_mb=4000,
        runtime=60,
        disk_mb=2000,
    params:
        config=lambda w: stage_overrides("scaling", f"dataset={SCALED_DATASET}"),
        source=source_hash(
            "psfdae.stages.scaling_jobs",
            "psfdae.stages.scaling",
            chosen=["psfdae.stars.seidel_scene"],
        ),
    message:
        "Measuring the stages that grow with the number of stars"
    shell:
        "psfdae scaling stages --out {output} {params.config:q} > {log} 2>&1"


rule scaling_dag:
    output:
        f"{RESULTS}/tables/scaling_dag.csv",
    log:
        f"{RESULTS}/logs/scaling/dag.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/scaling/dag.tsv"
    threads: workflow.cores
    resources:
        mem_mb=4000,
        runtime=60,
    params:
        source=source_hash("psfdae.benchmark.dag"),
        snakefile=workflow.main_snakefile,
        jobs=["--jobs=20", "--jobs=60"] if PRESET == "smoke" else [],
    message:
        "Timing dry runs of large workflows"
    shell:
        "psfdae scaling dag --snakefile {params.snakefile} {params.jobs} --out {output}"
        " > {log} 2>&1"


rule scaling_plan:
    input:
        stages=rules.scaling_stages.output,
        dag=rules.scaling_dag.output,
        runtime=rules.runtime.output,
    output:
        plan=f"{RESULTS}/tables/scaling_plan.csv",
        limits=f"{RESULTS}/tables/scaling_limits.csv",
    log:
        f"{RESULTS}/logs/scaling/plan.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/scaling/plan.tsv"
    localrule: True
    threads: 1
    resources:
        mem_mb=500,
        runtime=10,
    params:
        config=lambda w: stage_overrides("scaling", f"dataset={SCALED_DATASET}"),
        source=source_hash("psfdae.stages.scaling"),
        results=lambda w: RESULTS,
        home=["--home=paper_tables", "--home=track", "--home=track_sweep"],
    message:
        "Predicting what large runs cost"
    shell:
        "psfdae scaling plan --stages {input.stages} --dag {input.dag}"
        " --runtime {input.runtime} --results {params.results} {params.home}"
        " --limits {output.limits} --out {output.plan} {params.config:q} > {log} 2>&1"


rule scaling:
    input:
        rules.scaling_stages.output,
        rules.scaling_dag.output,
        rules.scaling_plan.output,
    localrule: True
