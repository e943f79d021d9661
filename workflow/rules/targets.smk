rule tables:
    input:
        rules.psf_metrics.output,
        rules.held_out.output,
        lambda w: [
            file
            for dataset in TABULATED
            if dataset in default_datasets()
            for file in paper_tables_of(dataset)
        ],
    localrule: True


for _scene in ("scene1", "scene2"):

    rule:
        name:
            _scene
        input:
            lambda w, scene=_scene: [
                file
                for dataset in default_datasets()
                if dataset_config(dataset).scene.experiment == scene
                for file in products_of(dataset)
            ],
        localrule: True


for _dataset in ALL_DATASETS:

    rule:
        name:
            _dataset
        input:
            lambda w, dataset=_dataset: products_of(dataset),
        localrule: True


rule scene3:
    input:
        ALIGNMENT_PRODUCTS,
        rules.track_alignment.output,
    localrule: True


rule tracking:
    input:
        expand(rules.track.output, dataset=default_datasets()),
        rules.track_alignment.output,
    localrule: True
