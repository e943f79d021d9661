# A rule for each method that stores a fit: train (DAE), baseline (PCA+SOM), fit_gmm, fit_gmm_position,
# … (`Storage.rule` of the method's class). A method that is plugged in gets its rule here, too.
for _method in (m for m in registered() if m.storage):
    _rule = fit_files.get_rule_name(_method)
    _stem = fit_files.stem(_method, "{dataset}", "{split}", "{reference}")
    _names = (f"{{wildcards.{key}}}" for key in ("dataset", "split", "reference"))
    _place = model_of(_method, "{dataset}", "{split}", "{reference}")

    rule:
        name:
            _rule
        input:
            unpack(lambda w, m=_method: start_of(m, w)),
            stars=lambda w: stars_of(w.dataset),
        output:
            [str(path) for path in fit_files.outputs(_method, _place)],
        log:
            f"{RESULTS}/logs/{_rule}/{_stem}.log",
        benchmark:
            f"{RESULTS}/benchmarks/{_rule}/{_stem}.tsv"
        # What takes longest is started first.
        priority: _method.needs.minutes
        threads: lambda w, m=_method: m.threads(dataset_config(w.dataset))
        resources:
            mem_mb=_method.needs.memory_mb,
            runtime=_method.needs.minutes,
        params:
            config=lambda w, m=_method: settings(
                "fit", f"dataset={w.dataset}", name=m.name
            ),
            source=source_hash("fit", _method.__module__),
            method=_method.name,
            more=lambda w, input, m=_method: [
                *(f"--reference={w.reference}" for _ in w.get("reference", "")[:1]),
                *(
                    f"--start={model_of(m, w.dataset, w.split, 'realisation')}"
                    for _ in input.get("start", "")[:1]
                ),
            ],
            place=_place,
            # Not an output: Snakemake would delete it with a failed job's outputs.
            checkpoint=f"{RESULTS}/checkpoints/{_method.name}/{_stem}.pt",
        message:
            f"Fitting {_method.look.label} to {fit_files.stem(_method, *_names)}"
        shell:
            "psfdae paper fit {params.method} --config {params.config} --stars {input.stars}"
            " --split {wildcards.split} {params.more} --checkpoint {params.checkpoint}"
            " --out {params.place} > {log} 2>&1"
