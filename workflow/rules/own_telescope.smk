use rule templates as telescope_templates with:
    output:
        f"{RESULTS}/data/telescope/{{stars}}/templates.h5",
    log:
        f"{RESULTS}/logs/templates/telescope/{{stars}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/templates/telescope/{{stars}}.tsv"
    wildcard_constraints:
        stars=match_any(datasets.list_simulated_datasets()),
    threads: lambda w: load_dataset_config(RUN, w.stars).optics.threads
    resources:
        mem_mb=1000,
    params:
        config=lambda w: settings(RUN, "templates", f"dataset={w.stars}"),
        source=hash_code("templates"),
    message:
        "Propagating the static PSFs of the telescope of {wildcards.stars}"


use rule stars as telescope_stars with:
    input:
        templates=rules.telescope_templates.output,
    output:
        f"{RESULTS}/data/telescope/{{stars}}.h5",
    log:
        f"{RESULTS}/logs/stars/telescope/{{stars}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/stars/telescope/{{stars}}.tsv"
    wildcard_constraints:
        stars=match_any(datasets.list_simulated_datasets()),
    threads: lambda w: load_dataset_config(RUN, w.stars).optics.threads
    resources:
        mem_mb=1000,
        runtime=60,
    params:
        config=lambda w: settings(RUN, "stars", f"dataset={w.stars}"),
        source=hash_code("stars"),


rule figure_telescope:
    input:
        rules.telescope_templates.output,
    output:
        picture=report(
            f"{RESULTS}/figures/telescope/{{stars}}.png",
            caption="../report/own_telescope.rst",
            category=datasets.SCENE_HEADINGS["own_telescope"],
            subcategory="{stars}",
            labels={"figure": "static PSFs"},
        ),
        table=f"{RESULTS}/tables/telescope/{{stars}}.csv",
    log:
        f"{RESULTS}/logs/figure_telescope/{{stars}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/figure_telescope/{{stars}}.tsv"
    wildcard_constraints:
        stars=match_any(datasets.list_simulated_datasets()),
    params:
        source=hash_code("figure telescope"),
    message:
        "Drawing the static PSFs of the telescope of {wildcards.stars}"
    shell:
        "psfdae paper figure telescope --templates {input} --table {output.table}"
        " --out {output.picture} > {log} 2>&1"
