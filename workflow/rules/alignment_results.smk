# Tables and figures of scene 3.


rule alignment_tables:
    input:
        states=f"{ALIGNMENT_DATA}/uniform.h5",
        estimates=expand(rules.alignment_estimate.output.out, test_set=ALIGNMENT_SETS),
        fit=lambda w: fits_of(*ALIGNMENT_SETS),
        bound=expand(rules.alignment_bound.output, test_set=ALIGNMENT_SETS),
    output:
        errors=f"{RESULTS}/tables/alignment_errors.csv",
        correlation=f"{RESULTS}/tables/alignment_correlation.csv",
    log:
        f"{RESULTS}/logs/alignment/tables.log",
    benchmark:
        f"{RESULTS}/benchmarks/alignment/tables.tsv"
    params:
        inputs=as_options,
        source=source_hash("alignment tables"),
    message:
        "Tabulating errors of misalignments"
    shell:
        "psfdae paper alignment tables {params.inputs:q} --errors {output.errors}"
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
        [f"{RESULTS}/tables/alignment_paper_{t}.md" for t in ALIGNMENT_PAPER_TABLES],
        [
            of_scene3(
                f"tables/alignment_paper_{t}.csv", "tables", shown, "alignment_tables"
            )
            for t, shown in ALIGNMENT_PAPER_TABLES.items()
        ],
    log:
        f"{RESULTS}/logs/alignment/paper_tables.log",
    benchmark:
        f"{RESULTS}/benchmarks/alignment/paper_tables.tsv"
    localrule: True
    params:
        inputs=as_options,
        folder=subpath(output[0], parent=True),
        source=source_hash("alignment paper-tables"),
    message:
        "Setting the paper's tables of scene 3 beside ours"
    shell:
        "psfdae paper alignment paper-tables {params.inputs:q} --out {params.folder}"
        " > {log} 2>&1"


rule alignment_time:
    input:
        times=lambda w: [
            *expand(rules.alignment_estimate.output.times, test_set=ALIGNMENT_SETS),
            *fits_of(*ALIGNMENT_SETS, what="times"),
        ],
        histories=expand(
            f"{ALIGNMENT}/{{name}}/history.csv", name=["dae", *trained_networks()]
        ),
    output:
        f"{RESULTS}/tables/alignment_time.csv",
    log:
        f"{RESULTS}/logs/alignment/time.log",
    benchmark:
        f"{RESULTS}/benchmarks/alignment/time.tsv"
    localrule: True
    params:
        times=lambda w, input: [f"--times={path}" for path in input.times],
        histories=lambda w, input: [
            f"--history={Path(path).parent.name}={path}" for path in input.histories
        ],
        source=source_hash("alignment time-table"),
    message:
        "Tabulating what the estimates of scene 3 cost"
    shell:
        "psfdae paper alignment time-table {params.times:q} {params.histories:q} --out {output}"
        " > {log} 2>&1"


rule figure_alignment_predicted:
    input:
        estimates=f"{ALIGNMENT}/estimates/uniform.h5",
        fit=lambda w: fits_of("uniform"),
    output:
        of_scene3(
            "figures/alignment/predicted.png",
            "estimates",
            "estimates against the truth",
        ),
    log:
        f"{RESULTS}/logs/alignment/figure_predicted.log",
    benchmark:
        f"{RESULTS}/benchmarks/alignment/figure_predicted.tsv"
    params:
        inputs=as_options,
        source=source_hash("alignment figure predicted"),
    message:
        "Drawing estimates against the truth"
    shell:
        "psfdae paper alignment figure predicted {params.inputs:q} --out {output} > {log} 2>&1"


rule figure_alignment_errors:
    input:
        estimates=f"{ALIGNMENT}/estimates/uniform.h5",
        fit=lambda w: fits_of("uniform"),
        bound=f"{ALIGNMENT}/bounds/uniform.h5",
    output:
        of_scene3(
            "figures/alignment/errors.png", "estimates", "errors against misalignment"
        ),
    log:
        f"{RESULTS}/logs/alignment/figure_errors.log",
    benchmark:
        f"{RESULTS}/benchmarks/alignment/figure_errors.tsv"
    params:
        inputs=as_options,
        source=source_hash("alignment figure errors"),
    message:
        "Drawing errors against misalignment"
    shell:
        "psfdae paper alignment figure errors {params.inputs:q} --out {output} > {log} 2>&1"


rule figure_alignment_correlation:
    input:
        correlation=rules.alignment_tables.output.correlation,
    output:
        of_scene3(
            "figures/alignment/correlation.png", "estimates", "correlations of errors"
        ),
    log:
        f"{RESULTS}/logs/alignment/figure_correlation.log",
    benchmark:
        f"{RESULTS}/benchmarks/alignment/figure_correlation.tsv"
    params:
        inputs=as_options,
        source=source_hash("alignment figure correlation"),
    message:
        "Drawing correlations of errors"
    shell:
        "psfdae paper alignment figure correlation {params.inputs:q} --out {output} > {log} 2>&1"


rule figure_alignment_stamps:
    input:
        states=f"{ALIGNMENT_DATA}/uniform.h5",
        dae=rules.alignment_dae.output.weights,
    output:
        of_scene3(
            "figures/alignment/stamps.png",
            "telescope and stamps",
            "stamps before and after the DAE",
        ),
    log:
        f"{RESULTS}/logs/alignment/figure_stamps.log",
    benchmark:
        f"{RESULTS}/benchmarks/alignment/figure_stamps.tsv"
    threads: lambda w: alignment_config().evaluation.threads
    resources:
        mem_mb=1000,
    params:
        config=lambda w: settings("alignment figure stamps"),
        inputs=as_options,
        source=source_hash("alignment figure stamps"),
    message:
        "Drawing stamps of scene 3"
    shell:
        "psfdae paper alignment figure stamps --config {params.config} {params.inputs:q}"
        " --out {output} > {log} 2>&1"


rule figure_alignment_twin:
    output:
        table=f"{RESULTS}/tables/alignment_twin.csv",
        out=of_scene3(
            "figures/alignment/twin.png", "telescope and stamps", "twin ambiguity"
        ),
    log:
        f"{RESULTS}/logs/alignment/figure_twin.log",
    benchmark:
        f"{RESULTS}/benchmarks/alignment/figure_twin.tsv"
    resources:
        mem_mb=1000,
    params:
        config=lambda w: settings("alignment figure twin"),
        source=source_hash("alignment figure twin"),
    message:
        "Drawing the twin ambiguity"
    shell:
        "psfdae paper alignment figure twin --config {params.config} --table={output.table}"
        " --out={output.out} > {log} 2>&1"


ALIGNMENT_PRODUCTS = [
    *rules.alignment_telescope.output,
    *rules.alignment_tables.output,
    *rules.alignment_paper_tables.output,
    *rules.alignment_time.output,
    *rules.figure_alignment_stamps.output,
    *rules.figure_alignment_predicted.output,
    *rules.figure_alignment_errors.output,
    *rules.figure_alignment_twin.output,
    *rules.figure_alignment_correlation.output,
]
