rule bank:
    output:
        f"{RESULTS}/bounds/bank/{{stars}}.h5",
    log:
        f"{RESULTS}/logs/bounds/bank_{{stars}}.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/bounds/bank-{{stars}}.tsv"
    threads: lambda w: compose_choice(RUN, datasets.stars_choice(RUN, w.stars))["bounds"]["threads"]
    resources:
        mem_mb=1500,
        runtime=30,
    params:
        config=lambda w: settings(RUN, "bank", datasets.stars_choice(RUN, w.stars)),
        source=hash_code("bank"),
    message:
        "Simulating the bank of {wildcards.stars}"
    shell:
        "psfdae paper bank --config {params.config} --out {output} > {log} 2>&1"


rule dataset_bounds:
    input:
        stars=lambda w: datasets.stars_file(RUN, w.dataset),
        templates=lambda w: datasets.templates_file(RUN, w.dataset),
        bank=lambda w: bounds.bank_files(RUN, w.dataset),
    output:
        summary=f"{RESULTS}/bounds/{{dataset}}.csv",
        growth=f"{RESULTS}/bounds/{{dataset}}_growth.csv",
        per_star=f"{RESULTS}/bounds/{{dataset}}.parquet",
    log:
        f"{RESULTS}/logs/bounds/{{dataset}}.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/bounds/{{dataset}}.tsv"
    threads: lambda w: load_dataset_config(RUN, w.dataset).bounds.threads
    resources:
        mem_mb=1500,
        runtime=90,
    params:
        config=lambda w: settings(RUN, "bounds", f"dataset={w.dataset}"),
        source=hash_code("bounds"),
        bank=lambda w: [f"--bank={path}" for path in bounds.bank_files(RUN, w.dataset)],
    message:
        "Bounding the errors of {wildcards.dataset}"
    shell:
        "psfdae paper bounds --config {params.config} --dataset {wildcards.dataset}"
        " --stars {input.stars} --templates {input.templates} {params.bank:q}"
        " --growth {output.growth} --per-star {output.per_star} --out {output.summary}"
        " > {log} 2>&1"


rule dataset_optics:
    input:
        stars=lambda w: datasets.stars_file(RUN, w.dataset),
        bank=lambda w: bounds.bank_files(RUN, w.dataset),
    output:
        summary=f"{RESULTS}/wavefront/{{dataset}}.csv",
        per_star=f"{RESULTS}/wavefront/{{dataset}}.parquet",
    log:
        f"{RESULTS}/logs/wavefront/{{dataset}}.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/bounds/optics-{{dataset}}.tsv"
    resources:
        mem_mb=1500,
        runtime=90,
    params:
        config=lambda w: settings(RUN, "optics", f"dataset={w.dataset}"),
        source=hash_code("optics"),
    message:
        "Restoring {wildcards.dataset} by the optics of the telescope"
    shell:
        "psfdae paper optics --config {params.config} --dataset {wildcards.dataset}"
        " --stars {input.stars} --bank {input.bank}"
        " --per-star {output.per_star} --out {output.summary} > {log} 2>&1"


rule psf_bounds:
    input:
        lambda w: bounds.dataset_files(RUN, ".csv"),
    output:
        f"{RESULTS}/tables/psf_bounds.csv",
    log:
        f"{RESULTS}/logs/bounds/psf_bounds.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/bounds/psf_bounds.tsv"
    localrule: True
    params:
        source=hash_code("collect-bounds"),
    message:
        "Collecting the bounds of all datasets"
    shell:
        "psfdae paper collect-bounds --out {output} {input} > {log} 2>&1"


use rule psf_bounds as psf_bounds_growth with:
    input:
        lambda w: bounds.dataset_files(RUN, "_growth.csv"),
    output:
        f"{RESULTS}/tables/psf_bounds_growth.csv",
    log:
        f"{RESULTS}/logs/bounds/psf_bounds_growth.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/bounds/psf_bounds_growth.tsv"
    localrule: True
    message:
        "Collecting the dependence of the posterior means on their banks"


use rule psf_bounds as psf_optics with:
    input:
        lambda w: [
            path
            for dataset in list_default_datasets(RUN)
            for path in bounds.optics_files(RUN, dataset, "csv")
        ],
    output:
        f"{RESULTS}/tables/psf_optics.csv",
    log:
        f"{RESULTS}/logs/wavefront/psf_optics.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/bounds/psf_optics.tsv"
    localrule: True
    message:
        "Collecting the errors of the methods that know the telescope"


rule wavefront:
    input:
        rules.psf_optics.output,
    localrule: True


rule psf_efficiency:
    input:
        bounds=lambda w: bounds.dataset_files(RUN, ".csv"),
        best=lambda w: bounds.dataset_files(RUN, ".parquet"),
        methods=lambda w: [
            path
            for dataset in list_default_datasets(RUN)
            for path in datasets.star_errors(RUN, dataset, ["random"])
            + bounds.optics_files(RUN, dataset, "parquet")
        ],
    output:
        f"{RESULTS}/tables/psf_efficiency.csv",
    log:
        f"{RESULTS}/logs/bounds/psf_efficiency.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/bounds/psf_efficiency.tsv"
    resources:
        mem_mb=1000,
    params:
        bounds=lambda w, input: [f"--bounds={path}" for path in input.bounds],
        best=lambda w, input: [f"--bounds-per-star={path}" for path in input.best],
        source=hash_code("efficiency"),
    message:
        "Comparing all methods with the bounds"
    shell:
        "psfdae paper efficiency {params.bounds:q} {params.best:q} --out {output}"
        " {input.methods} > {log} 2>&1"


rule paper_rows:
    input:
        bounds=rules.psf_bounds.output,
        efficiency=rules.psf_efficiency.output,
    output:
        f"{RESULTS}/tables/paper_rows.csv",
    log:
        f"{RESULTS}/logs/bounds/paper_rows.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/bounds/paper_rows.tsv"
    localrule: True
    params:
        inputs=as_options,
        source=hash_code("paper-rows"),
    message:
        "Comparing the paper's errors with the bounds"
    shell:
        "psfdae paper paper-rows {params.inputs:q} --out {output} > {log} 2>&1"


rule figure_bounds:
    input:
        bounds=rules.psf_bounds.output,
        efficiency=rules.psf_efficiency.output,
    output:
        report(
            f"{RESULTS}/figures/bounds/{{dataset}}_errors.png",
            caption="../report/figure_bounds.rst",
            category="Bounds: the best possible",
            subcategory="{dataset}",
            labels={"figure": "errors above the bounds"},
        ),
    log:
        f"{RESULTS}/logs/figures/bounds/{{dataset}}_errors.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/bounds/figure_errors-{{dataset}}.tsv"
    params:
        source=hash_code("figure bounds"),
    message:
        "Drawing {wildcards.dataset}: errors above the bounds"
    shell:
        "psfdae paper figure bounds --dataset {wildcards.dataset} --bounds {input.bounds}"
        " --efficiency {input.efficiency}"
        " --out {output} > {log} 2>&1"


rule figure_efficiency:
    input:
        efficiency=rules.psf_efficiency.output,
    output:
        report(
            f"{RESULTS}/figures/bounds/{{dataset}}_efficiency.png",
            caption="../report/figure_efficiency.rst",
            category="Bounds: the best possible",
            subcategory="{dataset}",
            labels={"figure": "efficiency"},
        ),
    log:
        f"{RESULTS}/logs/figures/bounds/{{dataset}}_efficiency.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/bounds/figure_efficiency-{{dataset}}.tsv"
    params:
        source=hash_code("figure efficiency"),
    message:
        "Drawing {wildcards.dataset}: efficiency"
    shell:
        "psfdae paper figure efficiency --dataset {wildcards.dataset}"
        " --efficiency {input.efficiency}"
        " --out {output} > {log} 2>&1"


rule figure_bank_growth:
    input:
        growth=rules.dataset_bounds.output.growth,
    output:
        report(
            f"{RESULTS}/figures/bounds/{{dataset}}_growth.png",
            caption="../report/figure_bank_growth.rst",
            category="Bounds: the best possible",
            subcategory="{dataset}",
            labels={"figure": "growth of the bank"},
        ),
    log:
        f"{RESULTS}/logs/figures/bounds/{{dataset}}_growth.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/bounds/figure_growth-{{dataset}}.tsv"
    params:
        source=hash_code("figure bank-growth"),
    message:
        "Drawing {wildcards.dataset}: growth of the bank"
    shell:
        "psfdae paper figure bank-growth --dataset {wildcards.dataset} --growth {input.growth}"
        " --out {output} > {log} 2>&1"


rule figure_headline:
    input:
        restored=f"{RESULTS}/evaluation/{HEADLINE_DATASET}/random-realisation.h5",
        bounds=rules.psf_bounds.output,
        efficiency=rules.psf_efficiency.output,
    output:
        report(
            f"{RESULTS}/figures/headline.png",
            caption="../report/figure_headline.rst",
            category="Bounds: the best possible",
            subcategory=HEADLINE_DATASET,
            labels={"figure": "in one look"},
        ),
    log:
        f"{RESULTS}/logs/figures/headline.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/bounds/figure_headline.tsv"
    resources:
        runtime=5,
    params:
        source=lambda w: fits.estimators_code(RUN, "figure headline", HEADLINE_DATASET),
        level=lambda w: datasets.shown_levels(RUN, HEADLINE_DATASET)[-1],
    message:
        "Drawing the figure of the README"
    shell:
        "psfdae paper figure headline --restored {input.restored} --level {params.level}"
        " --bounds {input.bounds} --efficiency {input.efficiency} --out {output}"
        " > {log} 2>&1"


rule bounds:
    input:
        # The tables of the bounds have the datasets of the default target.
        lambda w: (
            rules.figure_headline.output
            if HEADLINE_DATASET in list_default_datasets(RUN)
            else []
        ),
        rules.psf_bounds.output,
        rules.psf_bounds_growth.output,
        rules.wavefront.input,
        rules.psf_efficiency.output,
        rules.paper_rows.output,
        lambda w: [
            file
            for dataset in list_default_datasets(RUN)
            for file in bounds.bound_figures(RUN, dataset)
        ],
    localrule: True
