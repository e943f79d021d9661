rule evaluate:
    input:
        stars=lambda w: datasets.stars_file(RUN, w.dataset),
        models=lambda w: fits.list_fit_files(RUN, w.dataset, w.split, w.reference),
    output:
        summary=f"{RESULTS}/evaluation/{{dataset}}/{{split}}-{{reference}}.csv",
        per_star=f"{RESULTS}/evaluation/{{dataset}}/{{split}}-{{reference}}.parquet",
        restored=f"{RESULTS}/evaluation/{{dataset}}/{{split}}-{{reference}}.h5",
    log:
        f"{RESULTS}/logs/evaluate/{{dataset}}/{{split}}-{{reference}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/evaluate/{{dataset}}/{{split}}-{{reference}}.tsv"
    threads: lambda w: load_dataset_config(RUN, w.dataset).evaluation.threads
    resources:
        mem_mb=1500,
    params:
        config=lambda w: settings(RUN, "evaluate", f"dataset={w.dataset}"),
        source=lambda w: fits.estimators_code(RUN, "evaluate", w.dataset),
        models=lambda w: fits.fit_options(RUN, w.dataset, w.split, w.reference),
    message:
        "Evaluating {wildcards.dataset}, {wildcards.split}, {wildcards.reference}"
    shell:
        "psfdae paper evaluate --config {params.config} --dataset {wildcards.dataset}"
        " --split {wildcards.split} --reference {wildcards.reference}"
        " --stars {input.stars} {params.models} --per-star {output.per_star}"
        " --restored {output.restored} --out {output.summary} > {log} 2>&1"


rule paper_tables:
    input:
        lambda w: datasets.evaluations(RUN, w.dataset, ["random"]),
    output:
        **{
            metric: f"{RESULTS}/tables/{{dataset}}_{metric}.csv"
            for metric in datasets.METRICS
        },
        texts=expand(
            f"{RESULTS}/tables/{{{{dataset}}}}_{{metric}}.{{ending}}",
            metric=datasets.METRICS,
            ending=["md", "tex"],
        ),
        page=report(
            f"{RESULTS}/pages/{{dataset}}.html",
            caption="../report/paper_tables.rst",
            category=lambda w: datasets.report_category(RUN, w),
            subcategory="{dataset}",
            labels={"figure": "tables beside the paper's"},
        ),
    log:
        f"{RESULTS}/logs/paper_tables/{{dataset}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/paper_tables/{{dataset}}.tsv"
    localrule: True
    params:
        source=hash_code("paper-tables"),
        out=datasets.metric_options,
        note=lambda w: report_page.describe_differences(RUN, w.dataset),
    message:
        "Writing the paper's tables of {wildcards.dataset}"
    shell:
        "psfdae paper paper-tables --dataset {wildcards.dataset} {params.out} {input}"
        " --note {params.note:q} --page {output.page} > {log} 2>&1"


rule held_out:
    input:
        lambda w: [
            path
            for dataset in list_default_datasets(RUN)
            for path in datasets.star_errors(RUN, dataset)
        ],
    output:
        f"{RESULTS}/tables/psf_held_out.csv",
    log:
        f"{RESULTS}/logs/held_out/all.log",
    benchmark:
        f"{RESULTS}/benchmarks/held_out/all.tsv"
    localrule: True
    params:
        source=hash_code("held-out"),
    message:
        "Comparing held-out with seen fields, star by star"
    shell:
        "psfdae paper held-out --out {output} {input} > {log} 2>&1"


rule psf_metrics:
    input:
        # Evaluated only where it is asked for: a job of a cluster reads all rules at its start.
        lambda w: [
            csv
            for dataset in list_default_datasets(RUN)
            for csv in datasets.evaluations(RUN, dataset)
        ],
    output:
        f"{RESULTS}/tables/psf_metrics.csv",
    log:
        f"{RESULTS}/logs/psf_metrics/all.log",
    benchmark:
        f"{RESULTS}/benchmarks/psf_metrics/all.tsv"
    localrule: True
    params:
        source=hash_code("collect"),
    message:
        "Collecting the metrics of all datasets"
    shell:
        "psfdae paper collect --out {output} {input} > {log} 2>&1"


rule methods_table:
    input:
        rules.psf_metrics.output,
    output:
        **{
            metric: f"{RESULTS}/tables/methods_{metric}.md"
            for metric in datasets.METRICS
        },
        latex=expand(
            f"{RESULTS}/tables/methods_{{metric}}.tex", metric=datasets.METRICS
        ),
        page=report(
            f"{RESULTS}/pages/methods.html",
            caption="../report/methods_table.rst",
            category="All methods",
            labels={"figure": "table of all methods"},
        ),
    log:
        f"{RESULTS}/logs/methods_table/all.log",
    benchmark:
        f"{RESULTS}/benchmarks/methods_table/all.tsv"
    localrule: True
    params:
        source=hash_code("methods-table"),
        out=datasets.metric_options,
        note=lambda w: "; ".join(report_page.list_warnings(RUN)),
    message:
        "Writing the table of all methods"
    shell:
        "psfdae paper methods-table {input} {params.out} --note {params.note:q}"
        " --page {output.page} > {log} 2>&1"
