rule experiment_table:
    input:
        lambda w: experiments.experiment_evaluations(RUN),
    output:
        multiext(
            f"{RESULTS}/experiments/{{experiment}}/",
            table="errors.csv",
            markdown="errors.md",
            definition="experiment.yaml",
        ),
    log:
        f"{RESULTS}/logs/experiments/{{experiment}}/table.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/experiments/{{experiment}}/table.tsv"
    wildcard_constraints:
        experiment=RUN.experiment or "none",
    localrule: True
    params:
        # The name of a variant does not depend on the name of its setting, which is in the table.
        settings=lambda w: [f"{v.setting}={v.name}" for v in RUN.variants],
        given=lambda w: [f"--override={word}" for word in RUN.overrides],
        source=hash_code("experiment"),
        folder=subpath(output.table, parent=True),
    message:
        "Comparing the settings of experiment {wildcards.experiment}"
    shell:
        "psfdae paper experiment {wildcards.experiment} {input} {params.given:q}"
        " --out {params.folder} > {log} 2>&1"


rule figure_experiment:
    input:
        rules.experiment_table.output.table,
    output:
        report(
            f"{RESULTS}/experiments/{{experiment}}/errors.png",
            caption="../report/figure_experiment.rst",
            category="Experiments",
            labels={"data": "{experiment}", "figure": "errors by setting"},
        ),
    log:
        f"{RESULTS}/logs/experiments/{{experiment}}/figure.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/experiments/{{experiment}}/figure.tsv"
    wildcard_constraints:
        experiment=RUN.experiment or "none",
    params:
        source=hash_code("figure experiment"),
    message:
        "Drawing the errors of experiment {wildcards.experiment}"
    shell:
        "psfdae paper figure experiment --name {wildcards.experiment} --out {output} {input}"
        " > {log} 2>&1"


use rule track as track_experiment with:
    input:
        rules.experiment_table.output,
        rules.figure_experiment.output,
    output:
        f"{RESULTS}/mlflow/experiment_{{experiment}}.csv",
    log:
        f"{RESULTS}/logs/track/experiment_{{experiment}}.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/experiments/{{experiment}}/track.tsv"
    localrule: True
    params:
        what=lambda w: [f"--experiment {w.experiment}", *experiments.variant_stars(RUN)],
    message:
        "Importing experiment {wildcards.experiment} into MLflow"


rule experiment:
    input:
        lambda w: experiments.experiment_products(RUN),
    localrule: True
