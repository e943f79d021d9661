# A rule for each method whose fit can be packed: bundle (DAE), bundle_gmm, …; a method that is
# plugged in gets its rule here, too.
for _method in (m for m in registered() if m.storage and m.packing):
    _suffix = fit_files.get_bundle_suffix(_method)
    _stem = f"{{dataset}}-{{split}}-{{reference}}{_suffix}"

    rule:
        name:
            f"bundle{_suffix}".replace("-", "_")
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
            mem_mb=max(1500, _method.needs.memory_mb),
        params:
            config=lambda w: settings("bundle", f"dataset={w.dataset}"),
            source=source_hash("bundle", _method.__module__),
            model=lambda w, m=_method: option_of(m, w.dataset, w.split, w.reference),
            # A model that comes with a package is small.
            size=lambda w: ["--largest-mb=4.8"] * (w.dataset == SHIPPED_DATASET),
        message:
            f"Packing {_method.look.label} of {{wildcards.dataset}}, {{wildcards.split}}, {{wildcards.reference}}"
        shell:
            "psfdae paper bundle --config {params.config} --stars {input.stars} {params.model}"
            " --split {wildcards.split} --reference {wildcards.reference} --licence MIT"
            " {params.size} --out {output} > {log} 2>&1"


rule bundles:
    input:
        lambda w: [
            path
            for dataset in default_datasets()
            for path in bundles_of(dataset, PACKED)
        ],
    localrule: True


# The shipped model is committed, so nothing but an explicit request renews it.
rule shipped:
    input:
        stars=lambda w: stars_of(SHIPPED_DATASET),
        bundles=lambda w: bundles_of(SHIPPED_DATASET, PACKED),
    output:
        touch(f"{RESULTS}/.shipped_renewed"),
    log:
        f"{RESULTS}/logs/bundles/shipped.log",
    localrule: True
    params:
        config=lambda w: settings("ship", f"dataset={SHIPPED_DATASET}"),
        source=source_hash("ship"),
        folder="src/psfdae/denoise/bundles",
        bundles=lambda w, input: [f"--bundle={file}" for file in input.bundles],
    message:
        "Renewing the model that comes with the package"
    shell:
        "psfdae paper ship --config {params.config} --stars {input.stars} {params.bundles}"
        " --out {params.folder} > {log} 2>&1"
