# Tables and figures of scene 3.


rule alignment_tables:
    input:
        states=f"{RESULTS}/data/alignment/uniform.h5",
        estimates=expand(
            rules.alignment_estimate.output.out, test_set=alignment.TEST_SETS
        ),
        fit=lambda w: alignment.fit_files(RUN, *alignment.TEST_SETS),
        bound=expand(rules.alignment_bound.output, test_set=alignment.TEST_SETS),
    output:
        errors=f"{RESULTS}/tables/alignment_errors.csv",
        correlation=f"{RESULTS}/tables/alignment_correlation.csv",
    log:
        f"{RESULTS}/logs/alignment/tables.log",
    benchmark:
        f"{RESULTS}/benchmarks/alignment/tables.tsv"
    params:
        inputs=as_options,
        source=hash_code("alignment tables"),
    message:
        "Tabulating errors of misalignments"
    shell:
        "psfdae paper alignment tables {params.inputs:q} --errors {output.errors}"
        " --correlation {output.correlation} > {log} 2>&1"


rule alignment_paper_tables:
    input:
        errors=rules.alignment_tables.output.errors,
        correlation=rules.alignment_tables.output.correlation,
    output:
        expand(
            f"{RESULTS}/tables/alignment_paper_{{table}}.{{ending}}",
            table=alignment.PAPER_TABLES,
            ending=["csv", "md", "tex"],
        ),
        page=report(
            f"{RESULTS}/pages/alignment.html",
            caption="../report/alignment_tables.rst",
            category=datasets.SCENE_HEADINGS["scene3"],
            subcategory="tables",
            labels={"figure": "tables beside the paper's"},
        ),
    log:
        f"{RESULTS}/logs/alignment/paper_tables.log",
    benchmark:
        f"{RESULTS}/benchmarks/alignment/paper_tables.tsv"
    localrule: True
    params:
        inputs=as_options,
        note=lambda w: report_page.describe_differences(RUN, "alignment"),
        folder=subpath(output[0], parent=True),
        source=hash_code("alignment paper-tables"),
    message:
        "Comparing the paper's tables of scene 3 with ours"
    shell:
        "psfdae paper alignment paper-tables {params.inputs:q} --note {params.note:q}"
        " --page {output.page} --out {params.folder} > {log} 2>&1"


rule alignment_time:
    input:
        times=lambda w: [
            *expand(
                rules.alignment_estimate.output.times, test_set=alignment.TEST_SETS
            ),
            *alignment.fit_files(RUN, *alignment.TEST_SETS, ending="_times.csv"),
        ],
        histories=expand(
            f"{RESULTS}/alignment/{{name}}/history.csv",
            name=["dae", *list_trained_networks()],
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
        source=hash_code("alignment time-table"),
    message:
        "Tabulating the costs of the estimates of scene 3"
    shell:
        "psfdae paper alignment time-table {params.times:q} {params.histories:q} --out {output}"
        " > {log} 2>&1"


rule figure_alignment_predicted:
    input:
        estimates=f"{RESULTS}/alignment/estimates/uniform.h5",
        fit=lambda w: alignment.fit_files(RUN, "uniform"),
    output:
        report(
            f"{RESULTS}/figures/alignment/predicted.png",
            caption="../report/figure_alignment_predicted.rst",
            category=datasets.SCENE_HEADINGS["scene3"],
            subcategory="estimates",
            labels={"figure": "estimates against the truth"},
        ),
    log:
        f"{RESULTS}/logs/alignment/figure_predicted.log",
    benchmark:
        f"{RESULTS}/benchmarks/alignment/figure_predicted.tsv"
    params:
        inputs=as_options,
        source=hash_code("alignment figure predicted"),
    message:
        "Drawing estimates against the truth"
    shell:
        "psfdae paper alignment figure predicted {params.inputs:q} --out {output} > {log} 2>&1"


rule figure_alignment_errors:
    input:
        estimates=f"{RESULTS}/alignment/estimates/uniform.h5",
        fit=lambda w: alignment.fit_files(RUN, "uniform"),
        bound=f"{RESULTS}/alignment/bounds/uniform.h5",
    output:
        report(
            f"{RESULTS}/figures/alignment/errors.png",
            caption="../report/figure_alignment_errors.rst",
            category=datasets.SCENE_HEADINGS["scene3"],
            subcategory="estimates",
            labels={"figure": "errors against misalignment"},
        ),
    log:
        f"{RESULTS}/logs/alignment/figure_errors.log",
    benchmark:
        f"{RESULTS}/benchmarks/alignment/figure_errors.tsv"
    params:
        inputs=as_options,
        source=hash_code("alignment figure errors"),
    message:
        "Drawing errors against misalignment"
    shell:
        "psfdae paper alignment figure errors {params.inputs:q} --out {output} > {log} 2>&1"


rule figure_alignment_costs:
    input:
        errors=rules.alignment_tables.output.errors,
        times=rules.alignment_time.output,
    output:
        report(
            f"{RESULTS}/figures/alignment/costs.png",
            caption="../report/figure_alignment_costs.rst",
            category=datasets.SCENE_HEADINGS["scene3"],
            subcategory="estimates",
            labels={"figure": "errors against time"},
        ),
    log:
        f"{RESULTS}/logs/alignment/figure_costs.log",
    benchmark:
        f"{RESULTS}/benchmarks/alignment/figure_costs.tsv"
    params:
        inputs=as_options,
        source=hash_code("alignment figure costs"),
    message:
        "Drawing errors against time"
    shell:
        "psfdae paper alignment figure costs {params.inputs:q} --out {output} > {log} 2>&1"


rule figure_alignment_correlation:
    input:
        correlation=rules.alignment_tables.output.correlation,
    output:
        report(
            f"{RESULTS}/figures/alignment/correlation.png",
            caption="../report/figure_alignment_correlation.rst",
            category=datasets.SCENE_HEADINGS["scene3"],
            subcategory="estimates",
            labels={"figure": "correlations of errors"},
        ),
    log:
        f"{RESULTS}/logs/alignment/figure_correlation.log",
    benchmark:
        f"{RESULTS}/benchmarks/alignment/figure_correlation.tsv"
    params:
        inputs=as_options,
        note=lambda w: report_page.describe_differences(RUN, "alignment"),
        source=hash_code("alignment figure correlation"),
    message:
        "Drawing correlations of errors"
    shell:
        "psfdae paper alignment figure correlation {params.inputs:q} --note {params.note:q}"
        " --out {output} > {log} 2>&1"


rule figure_alignment_stamps:
    input:
        states=f"{RESULTS}/data/alignment/uniform.h5",
        dae=rules.alignment_dae.output.weights,
    output:
        report(
            f"{RESULTS}/figures/alignment/stamps.png",
            caption="../report/figure_alignment_stamps.rst",
            category=datasets.SCENE_HEADINGS["scene3"],
            subcategory="telescope and stamps",
            labels={"figure": "stamps before and after the DAE"},
        ),
    log:
        f"{RESULTS}/logs/alignment/figure_stamps.log",
    benchmark:
        f"{RESULTS}/benchmarks/alignment/figure_stamps.tsv"
    threads: lambda w: alignment.load_alignment_config(RUN).evaluation.threads
    resources:
        mem_mb=1000,
    params:
        config=lambda w: settings(RUN, "alignment figure stamps"),
        inputs=as_options,
        source=hash_code("alignment figure stamps"),
    message:
        "Drawing stamps of scene 3"
    shell:
        "psfdae paper alignment figure stamps --config {params.config} {params.inputs:q}"
        " --out {output} > {log} 2>&1"


rule figure_alignment_twin:
    output:
        table=f"{RESULTS}/tables/alignment_twin.csv",
        out=report(
            f"{RESULTS}/figures/alignment/twin.png",
            caption="../report/figure_alignment_twin.rst",
            category=datasets.SCENE_HEADINGS["scene3"],
            subcategory="telescope and stamps",
            labels={"figure": "twin ambiguity"},
        ),
    log:
        f"{RESULTS}/logs/alignment/figure_twin.log",
    benchmark:
        f"{RESULTS}/benchmarks/alignment/figure_twin.tsv"
    resources:
        mem_mb=1000,
    params:
        config=lambda w: settings(RUN, "alignment figure twin"),
        source=hash_code("alignment figure twin"),
    message:
        "Drawing the twin ambiguity"
    shell:
        "psfdae paper alignment figure twin --config {params.config} --table={output.table}"
        " --out={output.out} > {log} 2>&1"
