rule night_images:
    input:
        lambda w: night.image_files(RUN, w.part),
    output:
        f"{RESULTS}/night/rows/{{part}}.csv",
    log:
        f"{RESULTS}/logs/night/images/{{part}}.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/night/images/{{part}}.tsv"
    wildcard_constraints:
        part="[0-9]+",
    threads: 1
    resources:
        # Images of 2048 × 2048 pixels with 1000 stars take 1.3 GB; a retry takes more.
        mem_mb=lambda w, attempt: 1500 * attempt,
        runtime=60,
    params:
        rows=lambda w: night.rows_file(RUN, w.part),
        folder=f"{RESULTS}/night/images",
        source=hash_code("night images", "psfdae.methods.field"),
    message:
        "Measuring images of part {wildcards.part}"
    shell:
        "psfdae paper night images --rows {params.rows} --folder {params.folder} --out {output}"
        " > {log} 2>&1"


rule night_table:
    input:
        lambda w: night.part_tables(RUN),
    output:
        multiext(f"{RESULTS}/night/night", csv=".csv", ecsv=".ecsv"),
    log:
        f"{RESULTS}/logs/night/table.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/night/table.tsv"
    localrule: True
    params:
        source=hash_code("night table"),
    message:
        "Judging the images of the night"
    shell:
        "psfdae paper night table {input} --out {output.csv} > {log} 2>&1"


rule night_page:
    input:
        rules.night_table.output.csv,
    output:
        f"{RESULTS}/night/night.html",
    log:
        f"{RESULTS}/logs/night/page.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/night/page.tsv"
    localrule: True
    params:
        folder=f"{RESULTS}/night/images",
        source=hash_code("night page"),
    message:
        "Drawing the night"
    shell:
        "psfdae paper night page --table {input} --folder {params.folder} --out {output}"
        " > {log} 2>&1"


use rule track as track_night with:
    input:
        rules.night_table.output.csv,
    output:
        f"{RESULTS}/mlflow/night.csv",
    log:
        f"{RESULTS}/logs/track/night.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/track/night.tsv"
    localrule: True
    params:
        what="--night",
        results=lambda w: RESULTS,
        preset=PRESET,
        database=f"{RESULTS}/mlflow.db",
        source=hash_code("track"),
    message:
        "Importing the images of the night into MLflow"


rule night:
    input:
        table=rules.night_table.output.csv,
        page=rules.night_page.output,
        runs=rules.track_night.output,
    log:
        f"{RESULTS}/logs/night/night.log",
    localrule: True
    message:
        "Counting the images of the night"
    shell:
        "psfdae paper night count {input.table} 2>&1 | tee {log}"
