rule experiment_table:
    input:
        lambda w: experiments.experiment_evaluations(RUN),
    output:
        table=f"{RESULTS}/experiments/{{experiment}}/errors.csv",
        markdown=f"{RESULTS}/experiments/{{experiment}}/errors.md",
    log:
        f"{RESULTS}/logs/experiments/{{experiment}}/table.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/experiments/{{experiment}}/table.tsv"
    wildcard_constraints:
        experiment=RUN.experiment or "none",
    localrule: True
    params:
        variants=lambda w: experiments.variant_options(RUN),
        source=hash_code("experiment"),
    message:
        "Comparing the settings of experiment {wildcards.experiment}"
    shell:
        "psfdae paper experiment {params.variants} --markdown {output.markdown}"
        " --out {output.table} {input} > {log} 2>&1"


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


rule experiment:
    input:
        lambda w: experiments.experiment_products(RUN),
    localrule: True
