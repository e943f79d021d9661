rule example_field:
    output:
        image=f"{RESULTS}/own_stars/example/image.fits",
        catalogue=f"{RESULTS}/own_stars/example/stars.csv",
    log:
        f"{RESULTS}/logs/own_stars/example_field.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/own_stars/example_field.tsv"
    params:
        source=hash_code("example field"),
    message:
        "Simulating an image of a star field"
    shell:
        "psfdae example field --out {output.image} --catalogue {output.catalogue}"
        " > {log} 2>&1"


rule own_stars:
    input:
        image=rules.example_field.output.image,
        catalogue=rules.example_field.output.catalogue,
    output:
        multiext(
            f"{RESULTS}/own_stars/example/model/",
            bundle="example.psf.safetensors",
            stars="stars.h5",
            report="report.csv",
            selection="selection.csv",
            picture="report.png",
        ),
    log:
        f"{RESULTS}/logs/own_stars/model.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/own_stars/model.tsv"
    threads: lambda w: fits.most_threads(RUN, datasets.OWN_STARS)
    resources:
        mem_mb=1500,
        runtime=30,
    params:
        config=lambda w: settings(
            RUN,
            "train",
            f"dataset={datasets.OWN_STARS}",
            extra=(f"methods=[{','.join(datasets.list_compared_methods(RUN))}]",),
        ),
        source=lambda w: fits.methods_code("train", datasets.list_compared_methods(RUN)),
        folder=subpath(output.bundle, parent=True),
    message:
        "Training on the bright stars of the image"
    shell:
        "psfdae train {input.image} --config {params.config} --name example"
        " --catalogue {input.catalogue} --licence MIT --overwrite --out {params.folder}"
        " --report {params.folder}/report.html > {log} 2>&1"


rule from_stars_example:
    input:
        report=rules.own_stars.output.report,
        selection=rules.own_stars.output.selection,
        picture=rules.own_stars.output.picture,
    output:
        table=f"{RESULTS}/tables/from_stars.csv",
        selection=f"{RESULTS}/tables/from_stars_selection.csv",
        picture=report(
            f"{RESULTS}/figures/own_stars/strip.png",
            caption="../report/own_stars.rst",
            category="Own stars",
            labels={"data": "simulated image", "figure": "restored stars"},
        ),
    log:
        f"{RESULTS}/logs/own_stars/table.log",
    benchmark:
        f"{RESULTS}/benchmarks_on_request/own_stars/table.tsv"
    localrule: True
    message:
        "Collecting the results of the training on the image"
    shell:
        "( cp {input.report} {output.table} && cp {input.selection} {output.selection}"
        " && cp {input.picture} {output.picture} ) > {log} 2>&1"
