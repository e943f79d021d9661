rule templates:
    output:
        f"{RESULTS}/data/{{scene}}/templates.h5",
    log:
        f"{RESULTS}/logs/templates/{{scene}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/templates/{{scene}}.tsv"
    threads: lambda w: compose_choice(RUN, datasets.scene_choice(RUN, w.scene))["optics"]["threads"]
    params:
        config=lambda w: settings(RUN, "templates", datasets.scene_choice(RUN, w.scene)),
        source=hash_code("templates"),
    message:
        "Propagating the static PSFs of scene {wildcards.scene}"
    shell:
        "psfdae paper templates --config {params.config} --out {output} > {log} 2>&1"


rule stars:
    input:
        templates=rules.templates.output,
    output:
        f"{RESULTS}/data/{{scene}}/{{stars}}.h5",
    log:
        f"{RESULTS}/logs/stars/{{scene}}/{{stars}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/stars/{{scene}}/{{stars}}.tsv"
    threads: lambda w: compose_choice(RUN, datasets.scene_choice(RUN, w.scene))["optics"]["threads"]
    resources:
        mem_mb=1000,
        runtime=30,
    params:
        config=lambda w: settings(RUN, "stars", datasets.stars_choice(RUN, w.stars)),
        source=hash_code("stars"),
    message:
        "Simulating the noise-free stars {wildcards.stars}"
    shell:
        "psfdae paper stars --config {params.config} --templates {input.templates}"
        " --out {output} > {log} 2>&1"
