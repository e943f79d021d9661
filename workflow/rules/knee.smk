KNEE_FOLDER = f"{RESULTS}/knee/{{point}}"


rule fresh_stars:
    input:
        templates=lambda w: templates_of(dataset_config(KNEE_DATASET).stars.name),
    output:
        f"{RESULTS}/knee/fresh_stars.h5",
    log:
        f"{RESULTS}/logs/knee/fresh_stars.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/training_knee/fresh_stars.tsv"
    threads: lambda w: dataset_config(KNEE_DATASET).optics.threads
    resources:
        mem_mb=3000,
        runtime=20,
    params:
        config=lambda w: stage_overrides(
            "stars",
            f"dataset={KNEE_DATASET}",
            # Another name is another random stream.
            ["stars.name=fresh", f"stars.count={KNEE.fresh_stars}"],
        ),
        source=source_hash("stars", chosen=["psfdae.stars.seidel_scene"]),
    message:
        "Simulating other stars for the knee of the training"
    shell:
        "psfdae stars --templates {input.templates} --out {output} {params.config:q}"
        " > {log} 2>&1"


rule knee_train:
    input:
        stars=lambda w: (
            rules.fresh_stars.output[0] if w.point == FRESH else stars_of(KNEE_DATASET)
        ),
    output:
        multiext(
            f"{KNEE_FOLDER}/",
            weights="dae.safetensors",
            config="config.yaml",
            trained_on="trained_on.yaml",
            history="history.csv",
        ),
    log:
        f"{RESULTS}/logs/knee/{{point}}.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/training_knee/{{point}}.tsv"
    threads: 1
    resources:
        mem_mb=2000,
        runtime=60,
    params:
        config=lambda w: knee_overrides(w.point, stage_overrides),
        free=lambda w, threads: knee_overrides(w.point, free_overrides),
        source=source_hash("train", chosen=["psfdae.estimators.dae"]),
        folder=subpath(output.weights, parent=True),
        checkpoint=lambda w: f"{RESULTS}/checkpoints/knee-{w.point}.pt",
    message:
        "Training point {wildcards.point} of the knee"
    shell:
        "psfdae train --stars {input.stars} --split random --reference realisation"
        " --checkpoint {params.checkpoint} --out {params.folder} {params.config:q}"
        " {params.free:q} > {log} 2>&1"


rule knee_table:
    input:
        stars=lambda w: stars_of(KNEE_DATASET),
        networks=expand(rules.knee_train.output.weights, point=KNEE.points),
        histories=expand(rules.knee_train.output.history, point=KNEE.points),
        configs=expand(rules.knee_train.output.config, point=KNEE.points),
    output:
        table=f"{RESULTS}/tables/benchmark_training.csv",
        stopping=f"{RESULTS}/tables/benchmark_stopping.csv",
    log:
        f"{RESULTS}/logs/knee/table.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/training_knee/table.tsv"
    threads: lambda w: dataset_config(KNEE_DATASET).evaluation.threads
    resources:
        mem_mb=1500,
        runtime=10,
    params:
        config=lambda w: stage_overrides("knee", f"dataset={KNEE_DATASET}"),
        source=source_hash("psfdae.stages.knee"),
        points=[
            f"--point={point}={KNEE_FOLDER.format(point=point)}"
            for point in KNEE.points
        ],
    message:
        "Testing the trainings of the knee"
    shell:
        "psfdae training-knee --stars {input.stars} {params.points:q}"
        " --out {output.table} --stopping {output.stopping} {params.config:q}"
        " > {log} 2>&1"


rule figure_knee:
    input:
        rules.knee_table.output.table,
    output:
        report(
            f"{RESULTS}/figures/benchmark/training.png",
            caption="../report/figure_knee.rst",
            category="Benchmark: time against error",
            subcategory="training",
            labels={"figure": "training error against time"},
        ),
    log:
        f"{RESULTS}/logs/figures/benchmark/training.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/training_knee/figure.tsv"
    threads: 1
    resources:
        mem_mb=500,
        runtime=10,
    params:
        source=source_hash("psfdae.stages.knee"),
    message:
        "Drawing the training error against time"
    shell:
        "psfdae figure knee --table {input} --out {output} > {log} 2>&1"


rule training_knee:
    input:
        rules.knee_table.output,
        rules.figure_knee.output,
    localrule: True
