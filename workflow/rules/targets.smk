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


rule scene1:
    input:
        lambda w: products_of_scene("scene1"),
    localrule: True


rule scene2:
    input:
        lambda w: products_of_scene("scene2"),
    localrule: True


# A target for each file of config/dataset, such as dataset3.
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
