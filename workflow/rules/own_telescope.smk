rule figure_telescope:
    input:
        lambda w: datasets.templates_file(RUN, w.dataset),
    output:
        picture=report(
            f"{RESULTS}/figures/telescope/{{dataset}}.png",
            caption="../report/own_telescope.rst",
            category=datasets.SCENE_HEADINGS["own_telescope"],
            subcategory="{dataset}",
            labels={"figure": "static PSFs"},
        ),
        table=f"{RESULTS}/tables/telescope/{{dataset}}.csv",
    log:
        f"{RESULTS}/logs/figure_telescope/{{dataset}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/figure_telescope/{{dataset}}.tsv"
    params:
        source=hash_code("figure telescope"),
    message:
        "Drawing the static PSFs of the telescope of {wildcards.dataset}"
    shell:
        "psfdae paper figure telescope --templates {input} --table {output.table}"
        " --out {output.picture} > {log} 2>&1"
