wildcard_constraints:
    sweep=r"[^/]+",


# States of their own choose between networks: all others train or test.
use rule alignment_states as sweep_validation_states with:
    input:
        model=rules.alignment_model.output,
    output:
        f"{RESULTS}/data/alignment/validation.h5",
    log:
        f"{RESULTS}/logs/alignment/validation.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/sweep/validation_states.tsv"
    params:
        kind="uniform",
        config=lambda w: settings(
            RUN,
            "alignment states",
            extra=(f"seed={alignment.load_alignment_config(RUN).seed + 1}",),
        ),
    message:
        "Propagating the stamps of scene 3, uniform states that choose between networks"


rule sweep_point:
    input:
        unpack(lambda w: sweeps.sweep_data(RUN, w.sweep)),
        known=lambda w: sweeps.known_results(RUN, w),
    output:
        f"{RESULTS}/sweeps/{{sweep}}/points/{{point}}/result.json",
    log:
        f"{RESULTS}/logs/sweeps/{{sweep}}/{{point}}.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/sweep/{{sweep}}/{{point}}.tsv"
    wildcard_constraints:
        point="[0-9a-f]{12}",
    threads: lambda w: sweeps.point_threads(RUN, w)
    resources:
        mem_mb=2000,
    params:
        # The point's name is the hash of its settings, so that these need not be compared: asking
        # for `threads` tells Snakemake that they are no reason to repeat a job.
        given=lambda w, threads: RUN.overrides,
        data=lambda w, input: [
            word
            for role in sweeps.sweep_data(RUN, w.sweep)
            for word in ("--data", role, input[role])
        ],
        source=lambda w: sweeps.sweep_code(RUN, w.sweep),
        folder=subpath(output[0], parent=True),
        # Not an output: Snakemake would delete it with a failed job's outputs.
        checkpoint=lambda w: f"{RESULTS}/checkpoints/sweep-{w.sweep}-{w.point}.pt",
    message:
        "Training point {wildcards.point} of sweep {wildcards.sweep}"
    shell:
        "psfdae paper sweep point {wildcards.sweep} {params.data:q}"
        " --checkpoint {params.checkpoint} --out {params.folder}"
        " {params.given:q} > {log} 2>&1"


rule sweep_summary:
    input:
        lambda w: sweeps.sweep_results(RUN, w.sweep),
    output:
        multiext(
            f"{RESULTS}/sweeps/{{sweep}}/",
            summary="summary.csv",
            cost="cost.csv",
            best="best.yaml",
            definition="sweep.yaml",
            study="study.journal",
        ),
    log:
        f"{RESULTS}/logs/sweeps/{{sweep}}/summary.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/sweep/{{sweep}}/summary.tsv"
    threads: 1
    resources:
        mem_mb=500,
    params:
        given=RUN.overrides,
        definition=lambda w: sweeps.sweep_plan(RUN, w.sweep).sweep.model_dump_json(),
        source=hash_code("sweep summary"),
        points=lambda w: f"{RESULTS}/sweeps/{w.sweep}/points",
        folder=subpath(output.summary, parent=True),
    message:
        "Summarising sweep {wildcards.sweep}"
    shell:
        "psfdae paper sweep summary {wildcards.sweep} --points {params.points}"
        " --out {params.folder} {params.given:q} > {log} 2>&1"


rule figure_sweep:
    input:
        rules.sweep_summary.output.study,
    output:
        report(
            f"{RESULTS}/sweeps/{{sweep}}/figures/{{sweep_figure}}.png",
            caption="../report/figure_sweep.rst",
            category="Sweeps",
            labels={"data": "{sweep}", "figure": "{sweep_figure}"},
        ),
    log:
        f"{RESULTS}/logs/sweeps/{{sweep}}/{{sweep_figure}}.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/sweep/{{sweep}}/{{sweep_figure}}.tsv"
    wildcard_constraints:
        sweep_figure=match_any(sweeps.ALL_AXES + sweeps.TWO_AXES),
    threads: 1
    resources:
        mem_mb=500,
    params:
        source=hash_code("sweep figure"),
    message:
        "Drawing the figure {wildcards.sweep_figure} of sweep {wildcards.sweep}"
    shell:
        "psfdae paper sweep figure {wildcards.sweep_figure} --study {input} --out {output}"
        " > {log} 2>&1"


use rule track as track_sweep with:
    input:
        rules.sweep_summary.output,
        lambda w: sweeps.sweep_figures(RUN, w.sweep),
    output:
        f"{RESULTS}/mlflow/sweep_{{sweep}}.csv",
    log:
        f"{RESULTS}/logs/track/sweep_{{sweep}}.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/sweep/{{sweep}}/track.tsv"
    localrule: True
    params:
        what="--sweep {sweep}",
    message:
        "Importing sweep {wildcards.sweep} into MLflow"


rule sweep:
    input:
        lambda w: sweeps.sweep_products(RUN),
    localrule: True
