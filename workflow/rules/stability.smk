# Writes the table whatever it says: a failed job would lose it.
rule stability_table:
    input:
        stars=lambda w: datasets.stars_file(RUN, "dataset3"),
        turbulence=lambda w: datasets.stars_file(RUN, "dataset8"),
    output:
        table=f"{RESULTS}/tables/stability.csv",
        graded=f"{RESULTS}/tables/stability_graded.csv",
    log:
        f"{RESULTS}/logs/stability/table.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/stability/table.tsv"
    threads: 2
    resources:
        mem_mb=3000,
        runtime=20,
    params:
        config=lambda w: write_groups(
            RUN,
            "stability",
            ("seed", "noise", "dae", "train", "baseline", "evaluation"),
            compose_choice(RUN, "dataset=dataset3"),
        ),
        source=lambda w: stress_code(),
        # Asks for `threads` as a sign that another place is no reason to repeat a job.
        tests=lambda w, threads: str(STRESS_TESTS),
    message:
        "Stressing the whole chain"
    shell:
        "pytest {params.tests:q} --confcutdir {params.tests:q} -p no:cacheprovider"
        " --stars {input.stars} --turbulence {input.turbulence} --settings {params.config}"
        " --stability-csv {output.table} --graded-csv {output.graded} > {log} 2>&1"
        " || test $? = 1"


rule figure_stability:
    input:
        rules.stability_table.output.graded,
    output:
        report(
            f"{RESULTS}/figures/stability/graded.png",
            caption="../report/stability.rst",
            category="Stability",
            labels={"figure": "error against stress"},
        ),
    log:
        f"{RESULTS}/logs/figures/stability/graded.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/stability/figure.tsv"
    params:
        source=hash_code("workflow/benchmarks/figures.py"),
        program=locate_program("figures.draw"),
    message:
        "Drawing error against stress"
    shell:
        "python {params.program} --kind graded --table {input} --out {output}"
        " > {log} 2>&1"


rule stability:
    input:
        table=rules.stability_table.output.table,
        graded=rules.stability_table.output.graded,
        figure=rules.figure_stability.output,
    output:
        touch(f"{RESULTS}/.stability_passed"),
    log:
        f"{RESULTS}/logs/stability/verdict.log",
    localrule: True
    message:
        "Judging the stress tests"
    shell:
        "! grep ',fail$' {input.table} > {log} 2>&1"
