# A rule for each of our methods that store a fit. `fits.fit_params` has their parameters.
rule train:
    input:
        unpack(fits.start_files(RUN, "dae")),
        stars=lambda w: datasets.stars_file(RUN, w.dataset),
    output:
        fits.fit_outputs(RUN, "dae"),
    log:
        f"{RESULTS}/logs/train/{{dataset}}/{{split}}-{{reference}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/train/{{dataset}}/{{split}}-{{reference}}.tsv"
    # Fits that take longest are started first.
    priority: fits.fit_resources("dae")["runtime"]
    threads: fits.fit_threads(RUN, "dae")
    resources:
        **fits.fit_resources("dae"),
    params:
        **fits.fit_params(RUN, "dae"),
    message:
        "Training the DAE on {wildcards.dataset}, {wildcards.split}, {wildcards.reference}"
    shell:
        "psfdae paper fit {params.method} --config {params.config} --stars {input.stars}"
        " --split {wildcards.split} {params.more} --checkpoint {params.checkpoint}"
        " --out {params.path} > {log} 2>&1"


use rule train as baseline with:
    input:
        unpack(fits.start_files(RUN, "pca_som")),
        stars=lambda w: datasets.stars_file(RUN, w.dataset),
    output:
        fits.fit_outputs(RUN, "pca_som"),
    log:
        f"{RESULTS}/logs/baseline/{{dataset}}/{{split}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/baseline/{{dataset}}/{{split}}.tsv"
    priority: fits.fit_resources("pca_som")["runtime"]
    threads: fits.fit_threads(RUN, "pca_som")
    resources:
        **fits.fit_resources("pca_som"),
    params:
        **fits.fit_params(RUN, "pca_som"),
    message:
        "Fitting PCA and SOM to {wildcards.dataset}, {wildcards.split}"


use rule train as fit_gmm with:
    input:
        unpack(fits.start_files(RUN, "gmm")),
        stars=lambda w: datasets.stars_file(RUN, w.dataset),
    output:
        fits.fit_outputs(RUN, "gmm"),
    log:
        f"{RESULTS}/logs/fit_gmm/{{dataset}}/{{split}}-{{reference}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/fit_gmm/{{dataset}}/{{split}}-{{reference}}.tsv"
    priority: fits.fit_resources("gmm")["runtime"]
    threads: fits.fit_threads(RUN, "gmm")
    resources:
        **fits.fit_resources("gmm"),
    params:
        **fits.fit_params(RUN, "gmm"),
    message:
        "Fitting the Gaussian mixture to {wildcards.dataset}, {wildcards.split}, {wildcards.reference}"


use rule train as fit_gmm_position with:
    input:
        unpack(fits.start_files(RUN, "gmm_position")),
        stars=lambda w: datasets.stars_file(RUN, w.dataset),
    output:
        fits.fit_outputs(RUN, "gmm_position"),
    log:
        f"{RESULTS}/logs/fit_gmm_position/{{dataset}}/{{split}}-{{reference}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/fit_gmm_position/{{dataset}}/{{split}}-{{reference}}.tsv"
    priority: fits.fit_resources("gmm_position")["runtime"]
    threads: fits.fit_threads(RUN, "gmm_position")
    resources:
        **fits.fit_resources("gmm_position"),
    params:
        **fits.fit_params(RUN, "gmm_position"),
    message:
        "Fitting the Gaussian mixture with positions to {wildcards.dataset}, {wildcards.split}, {wildcards.reference}"


use rule train as fit_posterior_network with:
    input:
        unpack(fits.start_files(RUN, "posterior_network")),
        stars=lambda w: datasets.stars_file(RUN, w.dataset),
    output:
        fits.fit_outputs(RUN, "posterior_network"),
    log:
        f"{RESULTS}/logs/fit_posterior_network/{{dataset}}/{{split}}-{{reference}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/fit_posterior_network/{{dataset}}/{{split}}-{{reference}}.tsv"
    priority: fits.fit_resources("posterior_network")["runtime"]
    threads: fits.fit_threads(RUN, "posterior_network")
    resources:
        **fits.fit_resources("posterior_network"),
    params:
        **fits.fit_params(RUN, "posterior_network"),
    message:
        "Training the posterior network on {wildcards.dataset}, {wildcards.split}, {wildcards.reference}"


use rule train as fit_posterior_network_position with:
    input:
        unpack(fits.start_files(RUN, "posterior_network_position")),
        stars=lambda w: datasets.stars_file(RUN, w.dataset),
    output:
        fits.fit_outputs(RUN, "posterior_network_position"),
    log:
        f"{RESULTS}/logs/fit_posterior_network_position/{{dataset}}/{{split}}-{{reference}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/fit_posterior_network_position/{{dataset}}/{{split}}-{{reference}}.tsv"
    priority: fits.fit_resources("posterior_network_position")["runtime"]
    threads: fits.fit_threads(RUN, "posterior_network_position")
    resources:
        **fits.fit_resources("posterior_network_position"),
    params:
        **fits.fit_params(RUN, "posterior_network_position"),
    message:
        "Training the posterior network with positions on {wildcards.dataset}, {wildcards.split}, {wildcards.reference}"


use rule train as fit_posterior_network_refined with:
    input:
        unpack(fits.start_files(RUN, "posterior_network_refined")),
        stars=lambda w: datasets.stars_file(RUN, w.dataset),
    output:
        fits.fit_outputs(RUN, "posterior_network_refined"),
    log:
        f"{RESULTS}/logs/fit_posterior_network_refined/{{dataset}}/{{split}}-{{reference}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/fit_posterior_network_refined/{{dataset}}/{{split}}-{{reference}}.tsv"
    priority: fits.fit_resources("posterior_network_refined")["runtime"]
    threads: fits.fit_threads(RUN, "posterior_network_refined")
    resources:
        **fits.fit_resources("posterior_network_refined"),
    params:
        **fits.fit_params(RUN, "posterior_network_refined"),
    message:
        "Training the posterior network with refined wavefronts on {wildcards.dataset}, {wildcards.split}, {wildcards.reference}"


use rule train as fit_field with:
    input:
        unpack(fits.start_files(RUN, "field")),
        stars=lambda w: datasets.stars_file(RUN, w.dataset),
    output:
        fits.fit_outputs(RUN, "field"),
    log:
        f"{RESULTS}/logs/fit_field/{{dataset}}/{{split}}-{{reference}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/fit_field/{{dataset}}/{{split}}-{{reference}}.tsv"
    priority: fits.fit_resources("field")["runtime"]
    threads: fits.fit_threads(RUN, "field")
    resources:
        **fits.fit_resources("field"),
    params:
        **fits.fit_params(RUN, "field"),
    message:
        "Fitting the field to {wildcards.dataset}, {wildcards.split}, {wildcards.reference}"


# Methods of other packages (entry points psfdae.methods) have rules with the names that they give.
for _rule, _name in fits.list_new_rules(rule.name for rule in workflow.rules).items():

    rule:
        name:
            _rule
        input:
            unpack(fits.start_files(RUN, _name)),
            stars=lambda w: datasets.stars_file(RUN, w.dataset),
        output:
            fits.fit_outputs(RUN, _name),
        log:
            f"{RESULTS}/logs/{fits.fit_log(_name)}.log",
        benchmark:
            f"{RESULTS}/benchmarks/{fits.fit_log(_name)}.tsv"
        priority: fits.fit_resources(_name)["runtime"]
        threads: fits.fit_threads(RUN, _name)
        resources:
            **fits.fit_resources(_name),
        params:
            **fits.fit_params(RUN, _name),
        message:
            f"Fitting {_name} to {{wildcards.dataset}}, {{wildcards.split}}"
        shell:
            "psfdae paper fit {params.method} --config {params.config} --stars {input.stars}"
            " --split {wildcards.split} {params.more} --checkpoint {params.checkpoint}"
            " --out {params.path} > {log} 2>&1"
