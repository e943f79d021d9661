KNEE_FOLDER = f"{RESULTS}/knee/{{point}}"


use rule stars as fresh_stars with:
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
        config=lambda w: settings(
            "stars",
            f"dataset={KNEE_DATASET}",
            # Another name is another random stream.
            more=("stars.name=fresh", f"stars.count={KNEE.fresh_stars}"),
        ),
        source=source_hash("stars", chosen=["psfdae.stars.scenes:SeidelScene"]),
    message:
        "Simulating other stars for the knee of the training"


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
    resources:
        mem_mb=2000,
        runtime=60,
    params:
        config=lambda w: settings(
            "train", f"dataset={KNEE_DATASET}", more=knee_overrides(w.point)
        ),
        source=source_hash("train", chosen=["psfdae.estimators.dae"]),
        folder=subpath(output.weights, parent=True),
        checkpoint=lambda w: f"{RESULTS}/checkpoints/knee-{w.point}.pt",
    message:
        "Training point {wildcards.point} of the knee"
    shell:
        "psfdae train --config {params.config} --stars {input.stars}"
        " --checkpoint {params.checkpoint} --out {params.folder} > {log} 2>&1"


rule knee_table:
    input:
        expand(rules.knee_train.output, point=KNEE.points),
        stars=lambda w: stars_of(KNEE_DATASET),
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
    params:
        config=lambda w: settings("trainings.knee_table", f"dataset={KNEE_DATASET}"),
        source=source_hash("workflow/benchmarks/trainings.py:knee_table"),
        program=program("trainings.knee"),
        points=[f"--point={p}={KNEE_FOLDER.format(point=p)}" for p in KNEE.points],
    message:
        "Testing the trainings of the knee"
    shell:
        "python {params.program} --config {params.config}"
        " --stars {input.stars} {params.points:q} --stopping {output.stopping}"
        " --out {output.table} > {log} 2>&1"


rule training_knee:
    input:
        rules.knee_table.output,
        expand(rules.figure_benchmark.output, drawn="training"),
    localrule: True
