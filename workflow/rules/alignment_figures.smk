rule figure_alignment_stamps:
    input:
        states=f"{ALIGNMENT_DATA}/uniform.h5",
        dae=rules.alignment_dae.output.weights,
    output:
        report(
            f"{ALIGNMENT_FIGURES}/stamps.png",
            caption="../report/figure_alignment_stamps.rst",
            category="Scene 3: alignment of a mirror",
            subcategory="telescope and stamps",
            labels={"figure": "stamps before and after the DAE"},
        ),
    log:
        f"{RESULTS}/logs/figures/alignment/stamps.log",
    benchmark:
        f"{RESULTS}/benchmarks/alignment/figure_stamps.tsv"
    threads: lambda w: alignment_config().evaluation.threads
    resources:
        mem_mb=1000,
        runtime=10,
    params:
        config=lambda w: alignment_stage("alignment_estimate"),
        source=source_hash("psfdae.stages.alignment_figures"),
        folder=subpath(input.dae, parent=True),
    message:
        "Drawing stamps of scene 3"
    shell:
        "psfdae alignment figure stamps --states {input.states} --dae {params.folder}"
        " --out {output} {params.config:q} > {log} 2>&1"


rule figure_alignment_predicted:
    input:
        estimates=f"{ALIGNMENT}/estimates/uniform.h5",
        fits=lambda w: alignment_fits(["uniform"]),
    output:
        report(
            f"{ALIGNMENT_FIGURES}/predicted.png",
            caption="../report/figure_alignment_predicted.rst",
            category="Scene 3: alignment of a mirror",
            subcategory="estimates",
            labels={"figure": "estimates against the truth"},
        ),
    log:
        f"{RESULTS}/logs/figures/alignment/predicted.log",
    benchmark:
        f"{RESULTS}/benchmarks/alignment/figure_predicted.tsv"
    threads: 1
    resources:
        mem_mb=500,
        runtime=10,
    params:
        source=source_hash("psfdae.stages.alignment_figures"),
        fits=lambda w, input: [f"--fit={path}" for path in input.fits],
    message:
        "Drawing estimates of misalignments"
    shell:
        "psfdae alignment figure predicted --estimates {input.estimates} {params.fits:q}"
        " --out {output} > {log} 2>&1"


rule figure_alignment_errors:
    input:
        estimates=f"{ALIGNMENT}/estimates/uniform.h5",
        fits=lambda w: alignment_fits(["uniform"]),
        bound=f"{ALIGNMENT}/bounds/uniform.h5",
    output:
        report(
            f"{ALIGNMENT_FIGURES}/errors.png",
            caption="../report/figure_alignment_errors.rst",
            category="Scene 3: alignment of a mirror",
            subcategory="estimates",
            labels={"figure": "errors against misalignment"},
        ),
    log:
        f"{RESULTS}/logs/figures/alignment/errors.log",
    benchmark:
        f"{RESULTS}/benchmarks/alignment/figure_errors.tsv"
    threads: 1
    resources:
        mem_mb=500,
        runtime=10,
    params:
        source=source_hash("psfdae.stages.alignment_figures"),
        fits=lambda w, input: [f"--fit={path}" for path in input.fits],
    message:
        "Drawing errors against misalignment"
    shell:
        "psfdae alignment figure errors --estimates {input.estimates} {params.fits:q}"
        " --bound {input.bound} --out {output} > {log} 2>&1"


rule figure_alignment_twin:
    output:
        figure=report(
            f"{ALIGNMENT_FIGURES}/twin.png",
            caption="../report/figure_alignment_twin.rst",
            category="Scene 3: alignment of a mirror",
            subcategory="telescope and stamps",
            labels={"figure": "twin ambiguity"},
        ),
        table=f"{RESULTS}/tables/alignment_twin.csv",
    log:
        f"{RESULTS}/logs/figures/alignment/twin.log",
    benchmark:
        f"{RESULTS}/benchmarks/alignment/figure_twin.tsv"
    threads: 1
    resources:
        mem_mb=1000,
        runtime=10,
    params:
        config=lambda w: [*alignment_stage("alignment_twin"), "++optics.threads=1"],
        source=source_hash("psfdae.stages.alignment_figures"),
    message:
        "Drawing the twin ambiguity"
    shell:
        "psfdae alignment figure twin --table {output.table} --out {output.figure}"
        " {params.config:q} > {log} 2>&1"


rule figure_alignment_correlation:
    input:
        rules.alignment_tables.output.correlation,
    output:
        report(
            f"{ALIGNMENT_FIGURES}/correlation.png",
            caption="../report/figure_alignment_correlation.rst",
            category="Scene 3: alignment of a mirror",
            subcategory="estimates",
            labels={"figure": "correlations of errors"},
        ),
    log:
        f"{RESULTS}/logs/figures/alignment/correlation.log",
    benchmark:
        f"{RESULTS}/benchmarks/alignment/figure_correlation.tsv"
    threads: 1
    resources:
        mem_mb=500,
        runtime=10,
    params:
        source=source_hash("psfdae.stages.alignment_figures"),
    message:
        "Drawing correlations of errors"
    shell:
        "psfdae alignment figure correlation --correlation {input} --out {output}"
        " > {log} 2>&1"


ALIGNMENT_PRODUCTS = [
    *rules.alignment_telescope.output,
    *rules.alignment_tables.output,
    *rules.alignment_paper_tables.output,
    *rules.alignment_time.output,
    *rules.figure_alignment_stamps.output,
    *rules.figure_alignment_predicted.output,
    *rules.figure_alignment_errors.output,
    *rules.figure_alignment_twin.output,
    *rules.figure_alignment_correlation.output,
]
