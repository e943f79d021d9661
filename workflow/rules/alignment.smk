rule alignment_model:
    output:
        f"{ALIGNMENT_DATA}/model.h5",
    log:
        f"{RESULTS}/logs/alignment/model.log",
    benchmark:
        f"{RESULTS}/benchmarks/alignment/model.tsv"
    threads: 1
    resources:
        mem_mb=500,
        runtime=10,
    params:
        config=lambda w: alignment_stage("alignment_model"),
        source=source_hash("psfdae.stages.alignment"),
    message:
        "Fitting the wavefront of scene 3 to ray-traced states"
    shell:
        "psfdae alignment model --out {output} {params.config:q} > {log} 2>&1"


rule alignment_states:
    output:
        f"{ALIGNMENT_DATA}/{{states}}.h5",
    log:
        f"{RESULTS}/logs/alignment/{{states}}.log",
    benchmark:
        f"{RESULTS}/benchmarks/alignment/{{states}}.tsv"
    wildcard_constraints:
        states="grid|uniform",
    threads: lambda w: alignment_config().optics.threads
    resources:
        mem_mb=500,
        runtime=10,
    params:
        config=lambda w: alignment_stage("alignment_states"),
        source=source_hash("psfdae.stages.alignment"),
    message:
        "Tracing rays and propagating the stamps of scene 3, set {wildcards.states}"
    shell:
        "psfdae alignment states --set {wildcards.states} --out {output} {params.config:q}"
        " > {log} 2>&1"


rule alignment_train_states:
    input:
        model=rules.alignment_model.output,
    output:
        f"{ALIGNMENT_DATA}/train.h5",
    log:
        f"{RESULTS}/logs/alignment/train.log",
    benchmark:
        f"{RESULTS}/benchmarks/alignment/train.tsv"
    threads: lambda w: alignment_config().optics.threads
    resources:
        mem_mb=1000,
        runtime=10,
    params:
        config=lambda w: alignment_stage("alignment_states"),
        source=source_hash("psfdae.stages.alignment"),
    message:
        "Propagating the stamps of scene 3, uniform states for training"
    shell:
        "psfdae alignment states --set train --model {input.model} --out {output}"
        " {params.config:q} > {log} 2>&1"


rule alignment_telescope:
    input:
        model=rules.alignment_model.output,
        grid=f"{ALIGNMENT_DATA}/grid.h5",
        uniform=f"{ALIGNMENT_DATA}/uniform.h5",
    output:
        f"{RESULTS}/tables/alignment_telescope.csv",
    log:
        f"{RESULTS}/logs/alignment/telescope.log",
    benchmark:
        f"{RESULTS}/benchmarks/alignment/telescope.tsv"
    threads: 1
    resources:
        mem_mb=500,
        runtime=10,
    params:
        config=lambda w: alignment_stage("alignment_telescope"),
        source=source_hash("psfdae.stages.alignment"),
    message:
        "Tabulating key figures of scene 3"
    shell:
        "psfdae alignment telescope --model {input.model} --grid {input.grid}"
        " --uniform {input.uniform} --out {output} {params.config:q} > {log} 2>&1"
