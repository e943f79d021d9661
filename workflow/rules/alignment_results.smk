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
        outputs=lambda w, output: as_options(w, output),
        source=source_hash("alignment tables"),
    message:
        "Tabulating errors of misalignments"
    shell:
        "psfdae alignment tables {params.inputs:q} {params.outputs:q} > {log} 2>&1"


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
        "psfdae alignment paper-tables {params.inputs:q} --out {params.folder}"
        " > {log} 2>&1"


rule alignment_time:
    input:
        times=lambda w: [
            *expand(rules.alignment_estimate.output.times, test_set=ALIGNMENT_SETS),
            *fits_of(*ALIGNMENT_SETS, what="times"),
        ],
        histories=expand(f"{ALIGNMENT}/{{name}}/history.csv", name=["dae", *TRAINED]),
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
        "psfdae alignment time-table {params.times:q} {params.histories:q} --out {output}"
        " > {log} 2>&1"


UNIFORM = {"estimates": f"{ALIGNMENT}/estimates/uniform.h5"}
UNIFORM["fit"] = lambda w: fits_of("uniform")
ERRORS = {**UNIFORM, "bound": f"{ALIGNMENT}/bounds/uniform.h5"}
CORRELATION = {"correlation": rules.alignment_tables.output.correlation}

for _figure, _shown, _inputs in (
    ("predicted", "estimates against the truth", UNIFORM),
    ("errors", "errors against misalignment", ERRORS),
    ("correlation", "correlations of errors", CORRELATION),
):

    rule:
        name:
            f"figure_alignment_{_figure}"
        input:
            **_inputs,
        output:
            of_scene3(f"figures/alignment/{_figure}.png", "estimates", _shown),
        log:
            f"{RESULTS}/logs/alignment/figure_{_figure}.log",
        benchmark:
            f"{RESULTS}/benchmarks/alignment/figure_{_figure}.tsv"
        params:
            figure=_figure,
            inputs=as_options,
            source=source_hash(f"alignment figure {_figure}"),
        message:
            f"Drawing {_shown}"
        shell:
            "psfdae alignment figure {params.figure} {params.inputs:q} --out {output}"
            " > {log} 2>&1"


rule figure_alignment_stamps:
    input:
        states=f"{ALIGNMENT_DATA}/uniform.h5",
        dae=rules.alignment_dae.output.weights,
    output:
        out=of_scene3(
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
        figure="stamps",
        config=lambda w: settings("alignment figure stamps"),
        inputs=as_options,
        outputs=lambda w, output: as_options(w, output),
        source=source_hash("alignment figure stamps"),
    message:
        "Drawing stamps of scene 3"
    shell:
        "psfdae alignment figure {params.figure} --config {params.config}"
        " {params.inputs:q} {params.outputs:q} > {log} 2>&1"


use rule figure_alignment_stamps as figure_alignment_twin with:
    input:
        [],
    output:
        table=f"{RESULTS}/tables/alignment_twin.csv",
        out=of_scene3(
            "figures/alignment/twin.png", "telescope and stamps", "twin ambiguity"
        ),
    log:
        f"{RESULTS}/logs/alignment/figure_twin.log",
    benchmark:
        f"{RESULTS}/benchmarks/alignment/figure_twin.tsv"
    threads: 1
    params:
        figure="twin",
        config=lambda w: settings("alignment figure twin"),
        source=source_hash("alignment figure twin"),
    message:
        "Drawing the twin ambiguity"


ALIGNMENT_FIGURES = ("stamps", "predicted", "errors", "twin", "correlation")
ALIGNMENT_PRODUCTS = [
    *rules.alignment_telescope.output,
    *rules.alignment_tables.output,
    *rules.alignment_paper_tables.output,
    *rules.alignment_time.output,
    *(
        file
        for name in ALIGNMENT_FIGURES
        for file in getattr(rules, f"figure_alignment_{name}").output
    ),
]
