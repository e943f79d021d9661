rule track:
    input:
        stars=lambda w: datasets.stars_file(RUN, w.dataset),
        evaluations=lambda w: datasets.evaluations(RUN, w.dataset),
        figures=lambda w: datasets.figures(RUN, w.dataset),
    output:
        f"{RESULTS}/mlflow/{{dataset}}.csv",
    log:
        f"{RESULTS}/logs/track/{{dataset}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/track/{{dataset}}.tsv"
    # SQLite takes one machine; jobs that meet on it wait for each other.
    localrule: True
    params:
        what=lambda w, input: f"--stars {w.dataset} {input.stars}",
        results=lambda w: RESULTS,
        preset=PRESET,
        # Not an output: Snakemake would delete it, and with it the runs of older configs.
        database=f"{RESULTS}/mlflow.db",
        source=hash_code("track"),
    message:
        "Importing the runs of {wildcards.dataset} into MLflow"
    shell:
        "psfdae paper track --results {params.results} --preset {params.preset}"
        " --database {params.database} {params.what} --out {output} > {log} 2>&1"


use rule track as track_alignment with:
    input:
        rules.alignment_tables.output.errors,
        rules.alignment_dae.output,
        expand(rules.alignment_network.output, network=list_trained_networks()),
        rules.figure_alignment_predicted.output,
        rules.figure_alignment_errors.output,
        rules.figure_alignment_correlation.output,
        rules.figure_alignment_stamps.output,
    output:
        f"{RESULTS}/mlflow/alignment.csv",
    log:
        f"{RESULTS}/logs/track/alignment.log",
    benchmark:
        f"{RESULTS}/benchmarks/track/alignment.tsv"
    localrule: True
    params:
        what="--alignment",
    message:
        "Importing the runs of scene 3 into MLflow"
