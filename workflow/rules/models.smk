use rule stars as more_stars with:
    output:
        f"{RESULTS}/data/{{scene}}/fresh/{{stars}}-{{fresh}}.h5",
    log:
        f"{RESULTS}/logs/stars/{{scene}}/fresh/{{stars}}-{{fresh}}.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/more_stars/{{scene}}/{{stars}}-{{fresh}}.tsv"
    wildcard_constraints:
        fresh="[0-9]+",
    params:
        # Another name is another random stream.
        config=lambda w: settings(
            "stars",
            f"stars={w.stars}",
            more=(f"stars.name={w.stars}_fresh", f"stars.count={w.fresh}"),
        ),
        source=source_hash("stars"),
    message:
        "Simulating {wildcards.fresh} other stars {wildcards.stars}"


with one_line():
    ASKED = load_groups(overrides_for("config", GIVEN)).workflow.on_request

for _method in (m for m in registered() if m.stored):
    _stem = _method.stem("{dataset}", "{split}", "{reference}")
    _names = (f"{{wildcards.{key}}}" for key in ("dataset", "split", "reference"))
    _place = model_of(_method, "{dataset}", "{split}", "{reference}")
    _costs = "benchmarks_on_request" if _method.name in ASKED else "benchmarks"

    rule:
        name:
            _method.rule
        input:
            unpack(lambda w, m=_method: fresh_stars(m, w.dataset)),
            unpack(lambda w, m=_method: start_of(m, w)),
            stars=lambda w: stars_of(w.dataset),
        output:
            [str(path) for path in _method.outputs(_place)],
        log:
            f"{RESULTS}/logs/{_method.rule}/{_stem}.log",
        benchmark:
            f"{RESULTS}/{_costs}/{_method.rule}/{_stem}.tsv"
        threads: lambda w, m=_method: m.threads(dataset_config(w.dataset))
        resources:
            mem_mb=_method.memory_mb,
            runtime=_method.minutes,
        params:
            config=lambda w, m=_method: settings(
                "fit", f"dataset={w.dataset}", name=m.name
            ),
            source=source_hash("fit", chosen=[_method.__module__]),
            method=_method.name,
            more=lambda w, input, m=_method: [
                *(f"--reference={w.reference}" for _ in w.get("reference", "")[:1]),
                *(f"--fresh={input.fresh}" for _ in input.get("fresh", "")[:1]),
                *(
                    f"--start={model_of(m, w.dataset, w.split, 'realisation')}"
                    for _ in input.get("start", "")[:1]
                ),
            ],
            place=_place,
            # Not an output: Snakemake would delete it with a failed job's outputs.
            checkpoint=f"{RESULTS}/checkpoints/{_method.name}/{_stem}.pt",
        message:
            f"Fitting {_method.label} to {_method.stem(*_names)}"
        shell:
            "psfdae fit {params.method} --config {params.config} --stars {input.stars}"
            " --split {wildcards.split} {params.more} --checkpoint {params.checkpoint}"
            " --out {params.place} > {log} 2>&1"
