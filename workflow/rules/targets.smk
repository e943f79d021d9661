localrules:
    all,
    tables,


rule all:
    default_target: True
    input:
        rules.psf_metrics.output,
        [file for dataset in default_datasets() for file in paper_tables_of(dataset)],


rule tables:
    input:
        rules.all.input,


for _scene in ("scene1",):

    rule:
        name:
            _scene
        localrule: True
        input:
            [
                file
                for dataset in default_datasets()
                if dataset_config(dataset).scene.experiment == _scene
                for file in evaluations_of(dataset) + paper_tables_of(dataset)
            ],


for _dataset in ALL_DATASETS:

    rule:
        name:
            _dataset
        localrule: True
        input:
            lambda w, dataset=_dataset: evaluations_of(dataset)
            + paper_tables_of(dataset),
