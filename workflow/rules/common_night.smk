from psfdae.base.files import as_csv

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
    # Only a night needs this module, and every job reads this file.
    from psfdae.telescope.settings import read_telescope
    from psfdae_paper.stages.night import NightError, list_images

    try:
        rows = list_images(config["images"])
        if config["telescope"]:
            # A wrong key stops before any job.
            read_telescope(Path(config["telescope"]))
            rows = [{"telescope_file": config["telescope"], **row} for row in rows]
    except (NightError, ProductError, ConfigError) as error:
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
    columns = ("image", "catalogue", "mask", "reference", "telescope_file")
    files = [row.get(c) for row in night_parts()[int(part)] for c in columns]
    return [file for file in dict.fromkeys(files) if file and os.path.isfile(file)]
