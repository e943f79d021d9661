ALIGNMENT_FIGURES = f"{RESULTS}/figures/alignment"


wildcard_constraints:
    test_set="|".join(ALIGNMENT_SETS),
    cnn="|".join(ALIGNMENT_CNNS),
    level=r"[0-9.e-]+",


rule alignment_dae:
    input:
        grid=f"{ALIGNMENT_DATA}/grid.h5",
        train=f"{ALIGNMENT_DATA}/train.h5",
    output:
        multiext(
            f"{ALIGNMENT}/dae/",
            weights="dae.safetensors",
            config="config.yaml",
            trained_on="trained_on.yaml",
            history="history.csv",
        ),
    log:
        f"{RESULTS}/logs/alignment/dae.log",
    benchmark:
        f"{RESULTS}/benchmarks/alignment/dae.tsv"
    threads: lambda w: alignment_config().dae_train.threads
    resources:
        mem_mb=1500,
        runtime=60,
    params:
        config=lambda w: alignment_stage("alignment_dae"),
        free=lambda w, threads: alignment_stage("alignment_dae", neutral),
        source=source_hash("psfdae.stages.alignment_train"),
        folder=subpath(output.weights, parent=True),
        # Not an output: Snakemake would delete it with a failed job's outputs.
        checkpoint=f"{RESULTS}/checkpoints/alignment-dae.pt",
    message:
        "Training the DAE of scene 3"
    shell:
        "psfdae alignment train-dae --grid {input.grid} --train {input.train}"
        " --checkpoint {params.checkpoint} --out {params.folder} {params.config:q}"
        " {params.free:q} > {log} 2>&1"


rule alignment_cnn:
    input:
        unpack(cnn_inputs),
    output:
        multiext(
            f"{ALIGNMENT}/{{cnn}}/",
            weights="cnn.safetensors",
            config="config.yaml",
            trained_on="trained_on.yaml",
            history="history.csv",
        ),
    log:
        f"{RESULTS}/logs/alignment/{{cnn}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/alignment/{{cnn}}.tsv"
    threads: 1
    resources:
        mem_mb=1500,
        runtime=60,
    params:
        config=lambda w: alignment_stage(f"alignment_{w.cnn}"),
        free=lambda w, threads: alignment_stage(f"alignment_{w.cnn}", neutral),
        source=source_hash("psfdae.stages.alignment_train"),
        folder=subpath(output.weights, parent=True),
        dae=lambda w, input: (
            [f"--dae={ALIGNMENT}/dae"] if w.cnn == "dae_retrained" else []
        ),
        checkpoint=lambda w: f"{RESULTS}/checkpoints/alignment-{w.cnn}.pt",
    message:
        "Training the CNN {wildcards.cnn} of scene 3"
    shell:
        "psfdae alignment train-cnn --kind {wildcards.cnn} --states {input.states}"
        " {params.dae:q} --checkpoint {params.checkpoint} --out {params.folder}"
        " {params.config:q} {params.free:q} > {log} 2>&1"


rule alignment_estimate:
    input:
        states=f"{ALIGNMENT_DATA}/{{test_set}}.h5",
        dae=rules.alignment_dae.output.weights,
        cnns=expand(rules.alignment_cnn.output.weights, cnn=ALIGNMENT_CNNS),
    output:
        estimates=f"{ALIGNMENT}/estimates/{{test_set}}.h5",
        times=f"{ALIGNMENT}/estimates/{{test_set}}_times.csv",
    log:
        f"{RESULTS}/logs/alignment/estimate_{{test_set}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/alignment/estimate_{{test_set}}.tsv"
    threads: lambda w: alignment_config().evaluation.threads
    resources:
        mem_mb=1500,
        runtime=10,
    params:
        config=lambda w: alignment_stage("alignment_estimate"),
        source=source_hash("psfdae.stages.alignment_evaluate"),
        folder=lambda w: ALIGNMENT,
    message:
        "Estimating misalignments with the networks, set {wildcards.test_set}"
    shell:
        "psfdae alignment estimate --set {wildcards.test_set} --states {input.states}"
        " --dae {params.folder}/dae --original {params.folder}/original"
        " --noise-trained {params.folder}/noise_trained"
        " --dae-retrained {params.folder}/dae_retrained --out {output.estimates}"
        " --times {output.times} {params.config:q} > {log} 2>&1"


rule alignment_fit:
    input:
        states=f"{ALIGNMENT_DATA}/{{test_set}}.h5",
        model=rules.alignment_model.output,
        cnn=f"{ALIGNMENT}/noise_trained/cnn.safetensors",
    output:
        fit=f"{ALIGNMENT}/fits/{{test_set}}_{{level}}.h5",
        times=f"{ALIGNMENT}/fits/{{test_set}}_{{level}}_times.csv",
    log:
        f"{RESULTS}/logs/alignment/fit_{{test_set}}_{{level}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/alignment/fit_{{test_set}}_{{level}}.tsv"
    threads: 1
    resources:
        mem_mb=1500,
        runtime=20,
    params:
        # One thread of its own per job: the jobs fill the machine.
        config=lambda w: [*alignment_stage("alignment_fit"), "++optics.threads=1"],
        source=source_hash("psfdae.stages.alignment_evaluate"),
        folder=lambda w: ALIGNMENT,
    message:
        "Fitting misalignments by maximum likelihood, {wildcards.test_set}, λ = {wildcards.level}"
    shell:
        "psfdae alignment fit --set {wildcards.test_set} --level {wildcards.level}"
        " --states {input.states} --model {input.model} --cnn {params.folder}/noise_trained"
        " --out {output.fit} --times {output.times} {params.config:q} > {log} 2>&1"


rule alignment_bound:
    input:
        states=f"{ALIGNMENT_DATA}/{{test_set}}.h5",
        model=rules.alignment_model.output,
    output:
        f"{ALIGNMENT}/bounds/{{test_set}}.h5",
    log:
        f"{RESULTS}/logs/alignment/bound_{{test_set}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/alignment/bound_{{test_set}}.tsv"
    threads: 1
    resources:
        mem_mb=1000,
        runtime=10,
    params:
        config=lambda w: [*alignment_stage("alignment_bound"), "++optics.threads=1"],
        source=source_hash("psfdae.stages.alignment_evaluate"),
    message:
        "Bounding the errors of misalignments, set {wildcards.test_set}"
    shell:
        "psfdae alignment bound --set {wildcards.test_set} --states {input.states}"
        " --model {input.model} --out {output} {params.config:q} > {log} 2>&1"


ALIGNMENT_ESTIMATES = expand(
    rules.alignment_estimate.output.estimates, test_set=ALIGNMENT_SETS
)
ALIGNMENT_BOUNDS = expand(rules.alignment_bound.output, test_set=ALIGNMENT_SETS)


rule alignment_tables:
    input:
        states=f"{ALIGNMENT_DATA}/uniform.h5",
        estimates=ALIGNMENT_ESTIMATES,
        fits=lambda w: alignment_fits(),
        bounds=ALIGNMENT_BOUNDS,
    output:
        errors=f"{RESULTS}/tables/alignment_errors.csv",
        correlation=f"{RESULTS}/tables/alignment_correlation.csv",
    log:
        f"{RESULTS}/logs/alignment/tables.log",
    benchmark:
        f"{RESULTS}/benchmarks/alignment/tables.tsv"
    threads: 1
    resources:
        mem_mb=500,
        runtime=10,
    params:
        source=source_hash("psfdae.stages.alignment_tables"),
        estimates=lambda w, input: [f"--estimates={path}" for path in input.estimates],
        fits=lambda w, input: [f"--fit={path}" for path in input.fits],
        bounds=lambda w, input: [f"--bound={path}" for path in input.bounds],
    message:
        "Tabulating errors of misalignments"
    shell:
        "psfdae alignment tables --states {input.states} {params.estimates:q}"
        " {params.fits:q} {params.bounds:q} --errors {output.errors}"
        " --correlation {output.correlation} > {log} 2>&1"


ALIGNMENT_PAPER_TABLES = {
    "0.002": "table of errors at λ = 0.002",
    "0.005": "table of errors at λ = 0.005",
    "correlation": "table of correlations",
}


rule alignment_paper_tables:
    input:
        errors=rules.alignment_tables.output.errors,
        correlation=rules.alignment_tables.output.correlation,
    output:
        [
            report(
                f"{RESULTS}/tables/alignment_paper_{table}.csv",
                caption="../report/alignment_tables.rst",
                category="Scene 3: alignment of a mirror",
                subcategory="tables",
                labels={"figure": label},
            )
            for table, label in ALIGNMENT_PAPER_TABLES.items()
        ],
        expand(
            f"{RESULTS}/tables/alignment_paper_{{table}}.md",
            table=ALIGNMENT_PAPER_TABLES,
        ),
    log:
        f"{RESULTS}/logs/alignment/paper_tables.log",
    benchmark:
        f"{RESULTS}/benchmarks/alignment/paper_tables.tsv"
    localrule: True
    threads: 1
    resources:
        mem_mb=500,
        runtime=10,
    params:
        source=source_hash("psfdae.stages.alignment_tables"),
        folder=lambda w: f"{RESULTS}/tables",
    message:
        "Setting the paper's tables of scene 3 beside ours"
    shell:
        "psfdae alignment paper-tables --errors {input.errors}"
        " --correlation {input.correlation} --out {params.folder} > {log} 2>&1"


rule alignment_time:
    input:
        estimates=expand(rules.alignment_estimate.output.times, test_set=ALIGNMENT_SETS),
        fits=lambda w: alignment_fits(what="times"),
        dae=rules.alignment_dae.output.history,
        cnns=expand(rules.alignment_cnn.output.history, cnn=ALIGNMENT_CNNS),
    output:
        f"{RESULTS}/tables/alignment_time.csv",
    log:
        f"{RESULTS}/logs/alignment/time.log",
    benchmark:
        f"{RESULTS}/benchmarks/alignment/time.tsv"
    localrule: True
    threads: 1
    resources:
        mem_mb=500,
        runtime=10,
    params:
        source=source_hash("psfdae.stages.alignment_tables"),
        times=lambda w, input: [
            f"--times={path}" for path in (*input.estimates, *input.fits)
        ],
        histories=[
            f"--history={name}={ALIGNMENT}/{name}/history.csv"
            for name in ("dae", *ALIGNMENT_CNNS)
        ],
    message:
        "Tabulating what the estimates of scene 3 cost"
    shell:
        "psfdae alignment time-table {params.times:q} {params.histories:q} --out {output}"
        " > {log} 2>&1"
