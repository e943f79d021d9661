rule baseline:
    input:
        stars=lambda w: stars_of(w.dataset),
    output:
        model=f"{RESULTS}/pca_som/{{dataset}}/{{split}}.h5",
        trained_on=f"{RESULTS}/pca_som/{{dataset}}/{{split}}.trained_on.yaml",
    log:
        f"{RESULTS}/logs/pca_som/{{dataset}}/{{split}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/baseline/{{dataset}}/{{split}}.tsv"
    threads: lambda w: dataset_config(w.dataset).baseline.threads
    resources:
        mem_mb=1000,
        runtime=20,
    params:
        config=lambda w: stage_overrides("baseline", f"dataset={w.dataset}"),
        source=source_hash("psfdae.stages.baseline"),
    message:
        "Fitting PCA and SOM to {wildcards.dataset}, split {wildcards.split}"
    shell:
        "psfdae baseline --stars {input.stars} --split {wildcards.split}"
        " --out {output.model} {params.config:q} > {log} 2>&1"


rule train:
    input:
        stars=lambda w: stars_of(w.dataset),
    output:
        multiext(
            f"{RESULTS}/dae/{{dataset}}/{{split}}-{{reference}}/",
            weights="dae.safetensors",
            config="config.yaml",
            trained_on="trained_on.yaml",
            history="history.csv",
        ),
    log:
        f"{RESULTS}/logs/dae/{{dataset}}/{{split}}-{{reference}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/train/{{dataset}}/{{split}}-{{reference}}.tsv"
    threads: lambda w: dataset_config(w.dataset).train.threads
    resources:
        mem_mb=1500,
        runtime=60,
    params:
        config=lambda w: stage_overrides("train", f"dataset={w.dataset}"),
        free=lambda w, threads: free_overrides("train", f"dataset={w.dataset}"),
        source=source_hash("psfdae.stages.train"),
        folder=subpath(output.weights, parent=True),
        # Not an output: Snakemake would delete it with a failed job's outputs.
        checkpoint=lambda w: f"{RESULTS}/checkpoints/{w.dataset}-{w.split}-{w.reference}.pt",
    message:
        "Training the DAE of {wildcards.dataset}, {wildcards.split}, {wildcards.reference}"
    shell:
        "psfdae train --stars {input.stars} --split {wildcards.split}"
        " --reference {wildcards.reference} --checkpoint {params.checkpoint}"
        " --out {params.folder} {params.config:q} {params.free:q} > {log} 2>&1"
