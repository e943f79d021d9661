# What the run of record holds: `make reference` takes it if all of it is up to date.
rule reference:
    input:
        rules.tables.input,
        rules.calibrate.output,
        rules.runtime.output,
        lambda w: [
            file
            for dataset in list_default_datasets(RUN)
            for file in datasets.figures(RUN, dataset)
        ],
        rules.scene3.input,
        rules.benchmark.input,
        rules.stability.input,
        rules.bounds.input,
        rules.from_stars_example.output,
    localrule: True
