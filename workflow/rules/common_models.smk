def model_of(method, dataset, split, reference):
    """Folder or file of a fit."""
    return f"{RESULTS}/{method.place(dataset, split, reference)}"


def methods_of(dataset):
    """Methods of a dataset that leave a model."""
    return [m for m in map(method, dataset_config(dataset).methods) if m.stored]


def files_of(method, dataset, split, reference):
    """All files of a fit."""
    return [str(p) for p in method.outputs(model_of(method, dataset, split, reference))]


def option_of(method, dataset, split, reference):
    """Option of a command that takes a fit."""
    place = model_of(method, dataset, split, reference)
    return f"--{method.name.replace('_', '-')}={place}"


def fitted(dataset, split, reference, drawn=False):
    """Files of all models that restore stars of a split, or of those that figures show."""
    wanted = [m for m in methods_of(dataset) if m.drawn or not drawn]
    return [path for m in wanted for path in files_of(m, dataset, split, reference)]


def model_options(dataset, split, reference, drawn=False):
    """Options of a command that takes these models."""
    wanted = [m for m in methods_of(dataset) if m.drawn or not drawn]
    return [option_of(m, dataset, split, reference) for m in wanted]


def bundles_of(dataset, networks):
    """Bundles of a dataset's methods, of some splits and references."""
    return [
        f"{RESULTS}/bundles/{dataset}-{split}-{reference}{m.suffix}.psf.safetensors"
        for m in methods_of(dataset)
        if m.bundled
        for split, reference in networks
    ]


def estimators_source(command, dataset):
    """Hash of a command that applies the methods of a dataset."""
    names = dataset_config(dataset).methods
    return source_hash(command, chosen=[f"psfdae.estimators.{name}" for name in names])


def fit_threads(dataset):
    """Threads of the fits of a dataset's methods."""
    config = dataset_config(dataset)
    return max([m.threads(config) for m in methods_of(dataset)], default=1)


def histories_of(dataset):
    """Courses of the trainings of a dataset, and a label of each."""
    trained = [m for m in methods_of(dataset) if HISTORY in m.diagnostics]
    return {
        str(m.beside(model_of(m, dataset, split, reference), HISTORY)): ", ".join(
            [dataset, split, reference] + [m.label] * (len(trained) > 1)
        )
        for m in trained
        for split, reference in networks_of(dataset)
    }


def fresh_stars(method, dataset):
    """Product with other draws of a dataset's stars, if a method learns from some."""
    config = dataset_config(dataset)
    count = method.fresh(config)
    stars = f"{RESULTS}/data/{config.scene.name}/fresh/{config.stars.name}-{count}.h5"
    return {"fresh": stars} if count else {}
