rule templates:
    output:
        f"{RESULTS}/data/{{scene}}/templates.h5",
    log:
        f"{RESULTS}/logs/templates/{{scene}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/templates/{{scene}}.tsv"
    threads: lambda w: composed(f"scene={w.scene}")["optics"]["threads"]
    params:
        config=lambda w: settings("templates", f"scene={w.scene}"),
        source=source_hash("templates"),
    message:
        "Propagating the static PSFs of scene {wildcards.scene}"
    shell:
        "psfdae paper templates --config {params.config} --out {output} > {log} 2>&1"


rule stars:
    input:
        templates=lambda w: templates_of(w.stars),
    output:
        f"{RESULTS}/data/{{scene}}/{{stars}}.h5",
    log:
        f"{RESULTS}/logs/stars/{{scene}}/{{stars}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/stars/{{scene}}/{{stars}}.tsv"
    threads: lambda w: composed(f"scene={w.scene}")["optics"]["threads"]
    resources:
        mem_mb=1000,
        runtime=30,
    params:
        config=lambda w: settings("stars", f"stars={w.stars}"),
        source=source_hash("stars"),
    message:
        "Simulating the noise-free stars {wildcards.stars}"
    shell:
        "psfdae paper stars --config {params.config} --templates {input.templates}"
        " --out {output} > {log} 2>&1"
