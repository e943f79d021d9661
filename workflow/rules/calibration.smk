rule scan:
    output:
        f"{RESULTS}/calibration/scan_{{dataset}}.csv",
    log:
        f"{RESULTS}/logs/scan/{{dataset}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/scan/{{dataset}}.tsv"
    threads: lambda w: load_dataset_config(RUN, w.dataset).optics.threads
    resources:
        mem_mb=1000,
        runtime=30,
    params:
        config=lambda w: settings(RUN, "scan", f"dataset={w.dataset}"),
        source=hash_code("scan"),
    message:
        "Scanning pixel scales and dynamic ranges for {wildcards.dataset}"
    shell:
        "psfdae paper scan --config {params.config} --dataset {wildcards.dataset} --out {output}"
        " > {log} 2>&1"


rule calibrate:
    input:
        scans=expand(rules.scan.output, dataset=datasets.TABLE_DATASETS),
        stars=lambda w: [
            datasets.stars_file(RUN, dataset) for dataset in datasets.TABLE_DATASETS
        ],
    output:
        multiext(
            f"{RESULTS}/calibration/",
            fit="fit.csv",
            columns="columns.csv",
            scales="scales.csv",
            degeneracy="degeneracy.csv",
        ),
    log:
        f"{RESULTS}/logs/calibrate/all.log",
    benchmark:
        f"{RESULTS}/benchmarks/calibrate/all.tsv"
    threads: lambda w: load_dataset_config(RUN, datasets.TABLE_DATASETS[0]).evaluation.threads
    resources:
        mem_mb=2000,
    params:
        config=lambda w: settings(
            RUN, "calibrate", f"dataset={datasets.TABLE_DATASETS[0]}"
        ),
        source=hash_code("calibrate"),
        folder=subpath(output.fit, parent=True),
        scans=lambda w, input: [f"--scan={path}" for path in input.scans],
        stars=lambda w, input: [
            word
            for dataset, path in zip(datasets.TABLE_DATASETS, input.stars)
            for word in ("--stars", dataset, path)
        ],
    message:
        "Fitting noise, dynamic range and pixel scales to the paper"
    shell:
        "psfdae paper calibrate --config {params.config} --out {params.folder}"
        " {params.scans:q} {params.stars:q} > {log} 2>&1"
