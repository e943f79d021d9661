from psfdae.base.files import as_csv
from psfdae_paper.stages.night import NightError, listed_images

NIGHT = f"{RESULTS}/night"
# Images of a job: its first fit and its imports serve all of them.
IMAGES_PER_JOB = 10


@cache
def night_parts():
    """Rows of the list of images, those of each job."""
    if not config["images"]:
        sys.exit(
            "psfdae: night: --config images='night/*.fits', or a CSV list of images"
        )
    try:
        rows = listed_images(config["images"])
    except (NightError, ProductError) as error:
        sys.exit(f"psfdae: {error}")
    return [
        rows[start : start + IMAGES_PER_JOB]
        for start in range(0, len(rows), IMAGES_PER_JOB)
    ]


@cache
def night_rows(part):
    """File with the rows of a job; its name follows from them: another name repeats the job."""
    text = as_csv(night_parts()[int(part)])
    path = Path(NIGHT, ".rows", f"{hashlib.sha256(text.encode()).hexdigest()[:16]}.csv")
    if not (workflow.dryrun or path.is_file()):
        write_text(path, text)
    return str(path)


def night_files(part):
    """Files of the images of a job; one that is missing is a row with a reason."""
    columns = ("image", "catalogue", "mask", "reference")
    files = [row.get(c) for row in night_parts()[int(part)] for c in columns]
    return [file for file in dict.fromkeys(files) if file and os.path.isfile(file)]


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
        mem_mb=1000,
        runtime=60,
    params:
        rows=lambda w: night_rows(w.part),
        folder=f"{NIGHT}/images",
        source=source_hash("night images", method("field").__module__),
    message:
        "Measuring images of part {wildcards.part}"
    shell:
        "psfdae night images --rows {params.rows} --folder {params.folder} --out {output}"
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
        "psfdae night table {input} --out {output.csv} > {log} 2>&1"


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
        "psfdae night page --table {input} --folder {params.folder} --out {output}"
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
    localrule: True
    shell:
        "psfdae night count {input.table}"
