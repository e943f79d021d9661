# The stars and the training of the model that comes with the package.
SHIPPED_DATASET = "field"


for _method in (m for m in registered() if m.stored and m.bundled):
    _stem = f"{{dataset}}-{{split}}-{{reference}}{_method.suffix}"

    rule:
        name:
            f"bundle{_method.suffix}".replace("-", "_")
        input:
            stars=lambda w: stars_of(w.dataset),
            model=lambda w, m=_method: files_of(m, w.dataset, w.split, w.reference),
        output:
            f"{RESULTS}/bundles/{_stem}.psf.safetensors",
        log:
            f"{RESULTS}/logs/bundles/{_stem}.log",
        benchmark:
            f"{RESULTS}/benchmarks_on_request/bundles/{_stem}.tsv"
        threads: lambda w: dataset_config(w.dataset).evaluation.threads
        resources:
            mem_mb=1500,
        params:
            config=lambda w: settings("bundle", f"dataset={w.dataset}"),
            source=source_hash("bundle", chosen=[f"psfdae.estimators.{_method.name}"]),
            model=lambda w, m=_method: option_of(m, w.dataset, w.split, w.reference),
        message:
            f"Packing {_method.label} of {{wildcards.dataset}}, {{wildcards.split}}, {{wildcards.reference}}"
        shell:
            "psfdae bundle --config {params.config} --stars {input.stars} {params.model}"
            " --split {wildcards.split} --reference {wildcards.reference} --licence MIT"
            " --out {output} > {log} 2>&1"


rule bundles:
    input:
        lambda w: [
            path
            for dataset in default_datasets()
            for path in bundles_of(dataset, [("random", "realisation")])
        ],
    localrule: True


# The shipped model is committed, so nothing but an explicit request renews it.
rule shipped:
    input:
        f"{RESULTS}/bundles/{SHIPPED_DATASET}-random-realisation.psf.safetensors",
    output:
        touch(f"{RESULTS}/.shipped_renewed"),
    log:
        f"{RESULTS}/logs/bundles/shipped.log",
    localrule: True
    params:
        folder="src/psfdae/bundles",
    message:
        "Renewing the model that comes with the package"
    shell:
        "psfdae ship {input} --out {params.folder} > {log} 2>&1"
