rule night_images:
    input:
        lambda w: night_files(w.part),
    output:
        f"{NIGHT}/rows/{{part}}.csv",
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
        rows=lambda w: night_rows(w.part),
        folder=f"{NIGHT}/images",
        source=source_hash("night images", method("field").__module__),
    message:
        "Measuring images of part {wildcards.part}"
    shell:
        "psfdae paper night images --rows {params.rows} --folder {params.folder} --out {output}"
        " > {log} 2>&1"


rule night_table:
    input:
        lambda w: [f"{NIGHT}/rows/{part}.csv" for part in range(len(night_parts()))],
    output:
        multiext(f"{NIGHT}/night", csv=".csv", ecsv=".ecsv"),
    log:
        f"{RESULTS}/logs/night/table.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/night/table.tsv"
    localrule: True
    params:
        source=source_hash("night table"),
    message:
        "Judging the images of the night"
    shell:
        "psfdae paper night table {input} --out {output.csv} > {log} 2>&1"


rule night_page:
    input:
        rules.night_table.output.csv,
    output:
        f"{NIGHT}/night.html",
    log:
        f"{RESULTS}/logs/night/page.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/night/page.tsv"
    localrule: True
    params:
        folder=f"{NIGHT}/images",
        source=source_hash("night page"),
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
        source=source_hash("track"),
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
