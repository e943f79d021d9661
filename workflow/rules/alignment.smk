# Scene 3: states of misalignment, their stamps, the networks, estimates, fits and bounds.
wildcard_constraints:
    states="grid|uniform|train",
    test_set=match_any(alignment.TEST_SETS),
    network=match_any(list_trained_networks()),
    level=r"[0-9.e-]+",


rule alignment_model:
    output:
        f"{RESULTS}/data/alignment/model.h5",
    log:
        f"{RESULTS}/logs/alignment/model.log",
    benchmark:
        f"{RESULTS}/benchmarks/alignment/model.tsv"
    # The longest chain of jobs of a whole run goes through these networks: it starts first.
    priority: 120
    params:
        config=lambda w: settings(RUN, "alignment model"),
        source=hash_code("alignment model"),
    message:
        "Fitting the wavefront of scene 3 to ray-traced states"
    shell:
        "psfdae paper alignment model --config {params.config} --out {output} > {log} 2>&1"


# The many states that networks are trained on take their wavefronts from the model.
rule alignment_states:
    input:
        model=lambda w: rules.alignment_model.output if w.states == "train" else [],
    output:
        f"{RESULTS}/data/alignment/{{states}}.h5",
    log:
        f"{RESULTS}/logs/alignment/{{states}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/alignment/{{states}}.tsv"
    priority: 120
    threads: lambda w: alignment.load_alignment_config(RUN).optics.threads
    resources:
        mem_mb=1000,
    params:
        kind=lambda w: w.states,
        config=lambda w: settings(RUN, "alignment states"),
        inputs=as_options,
        source=hash_code("alignment states"),
    message:
        "Simulating the stamps of scene 3, set {wildcards.states}"
    shell:
        "psfdae paper alignment states --config {params.config} --set {params.kind}"
        " {params.inputs:q} --out {output} > {log} 2>&1"


rule alignment_telescope:
    input:
        model=rules.alignment_model.output,
        grid=f"{RESULTS}/data/alignment/grid.h5",
        uniform=f"{RESULTS}/data/alignment/uniform.h5",
    output:
        f"{RESULTS}/tables/alignment_telescope.csv",
    log:
        f"{RESULTS}/logs/alignment/telescope.log",
    benchmark:
        f"{RESULTS}/benchmarks/alignment/telescope.tsv"
    params:
        config=lambda w: settings(RUN, "alignment telescope"),
        inputs=as_options,
        source=hash_code("alignment telescope"),
    message:
        "Tabulating key figures of scene 3"
    shell:
        "psfdae paper alignment telescope --config {params.config} {params.inputs:q}"
        " --out {output} > {log} 2>&1"


rule alignment_dae:
    input:
        grid=f"{RESULTS}/data/alignment/grid.h5",
        train=f"{RESULTS}/data/alignment/train.h5",
    output:
        **alignment.network_files(RUN, "dae", "dae.safetensors"),
    log:
        f"{RESULTS}/logs/alignment/dae.log",
    benchmark:
        f"{RESULTS}/benchmarks/alignment/dae.tsv"
    priority: 120
    threads: lambda w: alignment.load_alignment_config(RUN).dae_train.threads
    resources:
        mem_mb=1500,
        runtime=60,
    params:
        config=lambda w: settings(RUN, "alignment train-dae"),
        inputs=as_options,
        source=hash_code("alignment train-dae"),
        folder=subpath(output.weights, parent=True),
        # Not an output: Snakemake would delete it with a failed job's outputs.
        checkpoint=f"{RESULTS}/checkpoints/alignment-dae.pt",
    message:
        "Training the DAE of scene 3"
    shell:
        "psfdae paper alignment train-dae --config {params.config} {params.inputs:q}"
        " --checkpoint {params.checkpoint} --out {params.folder} > {log} 2>&1"


rule alignment_network:
    input:
        states=lambda w: alignment.training_states(RUN, w.network),
        dae=lambda w: alignment.network_dae(RUN, w.network),
    output:
        **alignment.network_files(RUN, "{network}", "network.safetensors"),
    log:
        f"{RESULTS}/logs/alignment/{{network}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/alignment/{{network}}.tsv"
    priority: 120
    threads: lambda w: getattr(alignment.load_alignment_config(RUN), f"train_{w.network}").threads
    resources:
        mem_mb=1600,
        runtime=60,
    params:
        config=lambda w: settings(RUN, "alignment train-network", kind=w.network),
        inputs=as_options,
        source=hash_code("alignment train-network"),
        folder=subpath(output.weights, parent=True),
        checkpoint=lambda w: f"{RESULTS}/checkpoints/alignment-{w.network}.pt",
    message:
        "Training the network {wildcards.network} of scene 3"
    shell:
        "psfdae paper alignment train-network --kind {wildcards.network}"
        " --config {params.config} {params.inputs:q} --checkpoint {params.checkpoint}"
        " --out {params.folder} > {log} 2>&1"


rule alignment_bound:
    input:
        states=f"{RESULTS}/data/alignment/{{test_set}}.h5",
        model=rules.alignment_model.output,
    output:
        f"{RESULTS}/alignment/bounds/{{test_set}}.h5",
    log:
        f"{RESULTS}/logs/alignment/bound_{{test_set}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/alignment/bound_{{test_set}}.tsv"
    resources:
        mem_mb=1500,
        runtime=20,
    params:
        config=lambda w: settings(RUN, "alignment bound"),
        inputs=as_options,
        source=hash_code("alignment bound"),
    message:
        "Bounding the errors of misalignments, set {wildcards.test_set}"
    shell:
        "psfdae paper alignment bound --config {params.config} --set {wildcards.test_set}"
        " {params.inputs:q} --out {output} > {log} 2>&1"


rule alignment_estimate:
    input:
        **{
            network: f"{RESULTS}/alignment/{network}/network.safetensors"
            for network in list_trained_networks()
        },
        states=f"{RESULTS}/data/alignment/{{test_set}}.h5",
        dae=rules.alignment_dae.output.weights,
    output:
        out=f"{RESULTS}/alignment/estimates/{{test_set}}.h5",
        times=f"{RESULTS}/alignment/estimates/{{test_set}}_times.csv",
    log:
        f"{RESULTS}/logs/alignment/estimate_{{test_set}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/alignment/estimate_{{test_set}}.tsv"
    threads: lambda w: alignment.load_alignment_config(RUN).evaluation.threads
    resources:
        mem_mb=1500,
        runtime=20,
    params:
        config=lambda w: settings(RUN, "alignment estimate"),
        inputs=as_options,
        source=hash_code("alignment estimate"),
    message:
        "Estimating misalignments with the networks, set {wildcards.test_set}"
    shell:
        "psfdae paper alignment estimate --config {params.config} --set {wildcards.test_set}"
        " {params.inputs:q} --times {output.times} --out {output.out} > {log} 2>&1"


rule alignment_fit:
    input:
        states=f"{RESULTS}/data/alignment/{{test_set}}.h5",
        train=f"{RESULTS}/data/alignment/train.h5",
        model=rules.alignment_model.output,
        network=alignment.likelihood_network(RUN),
    output:
        out=f"{RESULTS}/alignment/fits/{{test_set}}_{{level}}.h5",
        times=f"{RESULTS}/alignment/fits/{{test_set}}_{{level}}_times.csv",
    log:
        f"{RESULTS}/logs/alignment/fit_{{test_set}}_{{level}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/alignment/fit_{{test_set}}_{{level}}.tsv"
    resources:
        mem_mb=1500,
        runtime=20,
    params:
        config=lambda w: settings(RUN, "alignment fit"),
        inputs=as_options,
        source=hash_code("alignment fit"),
    message:
        "Fitting misalignments by maximum likelihood, {wildcards.test_set}, λ = {wildcards.level}"
    shell:
        "psfdae paper alignment fit --config {params.config} --set {wildcards.test_set}"
        " --level {wildcards.level} {params.inputs:q} --times {output.times}"
        " --out {output.out} > {log} 2>&1"
