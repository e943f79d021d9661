# A bundle of each method whose fit can be packed; its name ends in the method's suffix.
rule bundle:
    input:
        stars=lambda w: datasets.stars_file(RUN, w.dataset),
        model=lambda w: fits.fit_outputs(RUN, *fits.identify_fit(w)),
    output:
        f"{RESULTS}/bundles/{{dataset}}-{{split}}-{{reference}}{{suffix}}.psf.safetensors",
    log:
        f"{RESULTS}/logs/bundles/{{dataset}}-{{split}}-{{reference}}{{suffix}}.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/bundles/{{dataset}}-{{split}}-{{reference}}{{suffix}}.tsv"
    wildcard_constraints:
        suffix="|".join(fits.bundle_suffixes()),
    threads: lambda w: load_dataset_config(RUN, w.dataset).evaluation.threads
    resources:
        mem_mb=lambda w: fits.bundle_memory(w.suffix),
    params:
        config=lambda w: settings(RUN, "bundle", f"dataset={w.dataset}"),
        source=lambda w: fits.methods_code("bundle", [fits.bundle_suffixes()[w.suffix]]),
        model=lambda w: fits.fit_option(RUN, *fits.identify_fit(w)),
        # A model that comes with a package is small.
        size=lambda w: ["--largest-mb=4.8"] * (w.dataset == datasets.SHIPPED_DATASET),
    message:
        "Packing {wildcards.dataset}, {wildcards.split}, {wildcards.reference}{wildcards.suffix}"
    shell:
        "psfdae paper bundle --config {params.config} --stars {input.stars} {params.model}"
        " --split {wildcards.split} --reference {wildcards.reference} --licence MIT"
        " {params.size} --out {output} > {log} 2>&1"


rule bundles:
    input:
        lambda w: [
            path
            for dataset in list_default_datasets(RUN)
            for path in fits.bundle_files(RUN, dataset, timings.BUNDLE_FITS)
        ],
    localrule: True


# The shipped model is committed, so nothing but an explicit request renews it.
rule shipped:
    input:
        stars=lambda w: datasets.stars_file(RUN, datasets.SHIPPED_DATASET),
        bundles=lambda w: fits.bundle_files(
            RUN, datasets.SHIPPED_DATASET, timings.BUNDLE_FITS
        ),
    output:
        touch(f"{RESULTS}/.shipped_renewed"),
    log:
        f"{RESULTS}/logs/bundles/shipped.log",
    localrule: True
    params:
        config=lambda w: settings(RUN, "ship", f"dataset={datasets.SHIPPED_DATASET}"),
        source=hash_code("ship"),
        folder="src/psfdae/denoise/bundles",
        bundles=lambda w, input: [f"--bundle={file}" for file in input.bundles],
    message:
        "Renewing the model that comes with the package"
    shell:
        "psfdae paper ship --config {params.config} --stars {input.stars} {params.bundles}"
        " --out {params.folder} > {log} 2>&1"
