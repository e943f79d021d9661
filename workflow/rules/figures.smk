rule figure_templates:
    input:
        rules.templates.output,
    output:
        report(
            f"{RESULTS}/figures/{{scene}}/templates.png",
            caption="../report/figure_templates.rst",
            category=lambda w: datasets.report_category(RUN, w),
            subcategory="static PSFs",
            labels={"figure": "static PSFs"},
        ),
    log:
        f"{RESULTS}/logs/figure_templates/{{scene}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/figure_templates/{{scene}}.tsv"
    params:
        kind="templates",
        source=hash_code("figure templates"),
    message:
        "Drawing the static PSFs of scene {wildcards.scene}"
    shell:
        "psfdae paper figure {params.kind} --templates {input} --out {output} > {log} 2>&1"


use rule figure_templates as figure_energy with:
    output:
        report(
            f"{RESULTS}/figures/{{scene}}/energy.png",
            caption="../report/figure_energy.rst",
            category=lambda w: datasets.report_category(RUN, w),
            subcategory="static PSFs",
            labels={"figure": "light in the stamp"},
        ),
    log:
        f"{RESULTS}/logs/figure_energy/{{scene}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/figure_energy/{{scene}}.tsv"
    params:
        kind="energy",
        source=hash_code("figure energy"),
    message:
        "Drawing the light inside the stamps of scene {wildcards.scene}"


rule figure_strip:
    input:
        f"{RESULTS}/evaluation/{{dataset}}/random-{{reference}}.h5",
    output:
        report(
            f"{RESULTS}/figures/{{dataset}}/strip_{{reference}}.png",
            caption="../report/figure_strip.rst",
            category=lambda w: datasets.report_category(RUN, w),
            subcategory="{dataset}",
            labels={"figure": "restored stars, {reference}"},
        ),
    log:
        f"{RESULTS}/logs/figure_strip/{{dataset}}-{{reference}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/figure_strip/{{dataset}}-{{reference}}.tsv"
    params:
        source=lambda w: fits.estimators_code(RUN, "figure strip", w.dataset),
        levels=lambda w: [
            f"--level={level:g}" for level in datasets.shown_levels(RUN, w.dataset)
        ],
    message:
        "Drawing restored stars of {wildcards.dataset}, {wildcards.reference}"
    shell:
        "psfdae paper figure strip --restored {input} {params.levels} --out {output}"
        " > {log} 2>&1"


rule figure_curves:
    input:
        lambda w: list(fits.histories(RUN, w.dataset)),
    output:
        report(
            f"{RESULTS}/figures/{{dataset}}/curves.png",
            caption="../report/figure_curves.rst",
            category=lambda w: datasets.report_category(RUN, w),
            subcategory="{dataset}",
            labels={"figure": "training"},
        ),
    log:
        f"{RESULTS}/logs/figure_curves/{{dataset}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/figure_curves/{{dataset}}.tsv"
    params:
        labels=lambda w: [
            f"--label={x}" for x in fits.histories(RUN, w.dataset).values()
        ],
        training=lambda w: report_page.describe_training(RUN, w.dataset),
        source=hash_code("figure curves"),
    message:
        "Drawing the training curves of {wildcards.dataset}"
    shell:
        "psfdae paper figure curves {params.labels:q} --out {output} {input} > {log} 2>&1"


rule figure_errors:
    input:
        lambda w: datasets.evaluations(RUN, w.dataset),
    output:
        **{
            metric: report(
                f"{RESULTS}/figures/{{dataset}}/errors_{metric}.png",
                caption="../report/figure_errors.rst",
                category=lambda w: datasets.report_category(RUN, w),
                subcategory="{dataset}",
                labels={"figure": f"{metric} against noise"},
            )
            for metric in datasets.METRICS
        },
    log:
        f"{RESULTS}/logs/figure_errors/{{dataset}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/figure_errors/{{dataset}}.tsv"
    params:
        source=lambda w: fits.estimators_code(RUN, "figure errors", w.dataset),
        out=datasets.metric_options,
        note=lambda w: report_page.describe_differences(RUN, w.dataset),
    message:
        "Drawing errors of {wildcards.dataset} against the noise level"
    shell:
        "psfdae paper figure errors --dataset {wildcards.dataset} {params.out} {input}"
        " --note {params.note:q} > {log} 2>&1"
