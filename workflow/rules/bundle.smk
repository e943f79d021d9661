# The stars and the training of the model that comes with the package.
SHIPPED_DATASET = "field"


rule bundle:
    input:
        stars=lambda w: stars_of(w.dataset),
        model=lambda w: [str(p) for p in method("dae").outputs(packed(w))],
    output:
        f"{RESULTS}/bundles/{{dataset}}-{{split}}-{{reference}}.psf.safetensors",
    log:
        f"{RESULTS}/logs/bundles/{{dataset}}-{{split}}-{{reference}}.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/bundles/{{dataset}}-{{split}}-{{reference}}.tsv"
    threads: lambda w: dataset_config(w.dataset).evaluation.threads
    resources:
        mem_mb=1500,
        runtime=10,
    params:
        config=lambda w: stage_overrides("bundle", f"dataset={w.dataset}"),
        source=source_hash("psfdae.stages.bundle"),
        dae=lambda w: packed(w),
    message:
        "Packing the DAE of {wildcards.dataset}, {wildcards.split}, {wildcards.reference}"
    shell:
        "psfdae bundle --stars {input.stars} --dae {params.dae} --split {wildcards.split}"
        " --licence MIT --out {output} {params.config:q} > {log} 2>&1"


rule bundles:
    input:
        expand(
            rules.bundle.output,
            dataset=default_datasets(),
            split="random",
            reference="realisation",
        ),
    localrule: True


# The shipped model is committed, so nothing but an explicit request renews it.
rule shipped:
    input:
        expand(
            rules.bundle.output,
            dataset=SHIPPED_DATASET,
            split="random",
            reference="realisation",
        ),
    output:
        touch(f"{RESULTS}/.shipped_renewed"),
    log:
        f"{RESULTS}/logs/bundles/shipped.log",
    localrule: True
    threads: 1
    resources:
        mem_mb=500,
        runtime=10,
    params:
        folder="src/psfdae/bundles",
    message:
        "Renewing the model that comes with the package"
    shell:
        "psfdae ship {input} --out {params.folder} > {log} 2>&1"
