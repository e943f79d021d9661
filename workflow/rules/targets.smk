rule tables:
    input:
        rules.psf_metrics.output,
        rules.methods_table.output,
        rules.held_out.output,
        lambda w: [
            file
            for dataset in datasets.TABLE_DATASETS
            if dataset in list_default_datasets(RUN)
            for file in datasets.paper_tables(RUN, dataset)
        ],
    localrule: True


rule scene1:
    input:
        lambda w: datasets.default_products(RUN, "scene1"),
    localrule: True


rule scene2:
    input:
        lambda w: datasets.default_products(RUN, "scene2"),
    localrule: True


rule scene3:
    input:
        rules.alignment_telescope.output,
        rules.alignment_tables.output,
        rules.alignment_paper_tables.output,
        rules.alignment_time.output,
        rules.figure_alignment_stamps.output,
        rules.figure_alignment_predicted.output,
        rules.figure_alignment_errors.output,
        rules.figure_alignment_costs.output,
        rules.figure_alignment_twin.output,
        rules.figure_alignment_correlation.output,
        rules.track_alignment.output,
    localrule: True


rule tracking:
    input:
        lambda w: expand(rules.track.output, dataset=list_default_datasets(RUN)),
        rules.track_alignment.output,
    localrule: True


rule dataset1:
    input:
        lambda w: datasets.products(RUN, "dataset1"),
    localrule: True


rule dataset2:
    input:
        lambda w: datasets.products(RUN, "dataset2"),
    localrule: True


rule dataset3:
    input:
        lambda w: datasets.products(RUN, "dataset3"),
    localrule: True


rule dataset4:
    input:
        lambda w: datasets.products(RUN, "dataset4"),
    localrule: True


rule dataset5:
    input:
        lambda w: datasets.products(RUN, "dataset5"),
    localrule: True


rule dataset6:
    input:
        lambda w: datasets.products(RUN, "dataset6"),
    localrule: True


rule dataset7:
    input:
        lambda w: datasets.products(RUN, "dataset7"),
    localrule: True


rule dataset8:
    input:
        lambda w: datasets.products(RUN, "dataset8"),
    localrule: True


rule field:
    input:
        lambda w: datasets.products(RUN, "field"),
    localrule: True


# A target for each further file of config/dataset.
for _dataset in datasets.list_datasets_except(rule.name for rule in workflow.rules):

    rule:
        name:
            _dataset
        input:
            lambda w, dataset=_dataset: datasets.products(RUN, dataset),
        localrule: True
