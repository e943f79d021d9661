rule tables:
    input:
        rules.all.input,
    localrule: True


for _scene in ("scene1",):

    rule:
        name:
            _scene
        input:
            [
                file
                for dataset in default_datasets()
                if dataset_config(dataset).scene.experiment == _scene
                for file in evaluations_of(dataset) + paper_tables_of(dataset)
            ],
        localrule: True


for _dataset in ALL_DATASETS:

    rule:
        name:
            _dataset
        input:
            lambda w, dataset=_dataset: evaluations_of(dataset)
            + paper_tables_of(dataset),
        localrule: True
