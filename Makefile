# Everything a newcomer needs: `make reproduce` and `make test`.
#   CORES=n          cores for the workflow (default: all)
#   PRESET=name      smoke, fast (default) or paper
#   SET="a.b=1 …"    Hydra overrides for every dataset
#   RESULTS=folder   of this run, whose PRESET and SET it keeps (default: results, or results/PRESET)
#   TARGETS="…"      Snakemake targets, for example dataset3 (default: all)
#   IMAGES="…"       of `make night`, a pattern or a CSV list; FITS files of `make benchmark TARGETS=images`
#   FILE=run.tar     archive of a run that `make archive` writes and `make fetch` unpacks
#   AGAINST=commit   that `make benchmark TARGETS=run` or TARGETS=images compares this one with
#   PORT=n           port of the MLflow page (default: 5000)
#   TRACK=live       shows trainings in MLflow while they run (default: once they are finished)
#   TORCH_INDEX=url  package index with PyTorch's CPU builds (default: pip's own index)
#   PYTHON=python3   interpreter that makes the environment (3.11 or newer)
#   PART=k/n         the k-th of n parts of `make nightly` (default: all of it)
#   PYTHONS="…", RESOLUTION=…  of `make test-pythons` (CONTRIBUTING.md)
GIVEN := CORES PRESET SET RESULTS TARGETS IMAGES FILE AGAINST PORT TRACK TORCH_INDEX PYTHON PART PYTHONS RESOLUTION

# What a user gives reaches the recipes through the environment, unchanged: neither make nor a shell
# expands a text that may come from a colleague's file.
$(foreach name,$(GIVEN),$(eval override $(name) := $$(value $(name))))
# A mistyped PRESET would be ignored without a word.
UNKNOWN := $(strip $(foreach name,$(.VARIABLES),$(if $(filter command,$(origin $(name))),$(name))))
$(if $(UNKNOWN),$(error $(UNKNOWN): no variable of this Makefile, whose first lines list them))
PSFDAE_RESULTS := $(or $(RESULTS),results$(if $(filter-out fast,$(PRESET)),/$(PRESET)))
export $(GIVEN) PSFDAE_RESULTS

export PATH := $(CURDIR)/.venv/bin:$(PATH)
export PYTHONUNBUFFERED := 1
# Where an environment forbids to keep compiled modules, every job would compile them again.
export PYTHONDONTWRITEBYTECODE :=
export MLFLOW_DISABLE_TELEMETRY := true
# Everything stays in this folder, caches of libraries, too.
export XDG_CACHE_HOME := $(CURDIR)/.cache
export MPLCONFIGDIR := $(CURDIR)/.cache/matplotlib
# pip keeps what it has downloaded only where PIP_CACHE_DIR says so, as jobs on GitHub do.
export PIP_NO_CACHE_DIR := $(if $(PIP_CACHE_DIR),,1)

SNAKEMAKE := snakemake --cores "$${CORES:-all}" --config preset="$$PRESET" set="$$SET" results="$$RESULTS"
LOCKED := sh workflow/locked.sh $(SNAKEMAKE)
# The tests of a file run in one worker, the smoke run first (tests/conftest.py).
PYTEST := env OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 pytest --numprocesses logical \
  --maxprocesses 4 --dist loadfile --no-loadscope-reorder
FAST_TESTS := $(PYTEST) -m "not slow and not written"

.PHONY: $(shell sed -nE 's/^([a-z-]+):.*/\1/p' Makefile)

help: ## List the targets
	@grep -hE '^[a-z_-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 16

env: .venv/.complete ## Create the environment .venv from the lock file

.venv/.complete: requirements.lock $(wildcard requirements/*.lock) pyproject.toml
	sh requirements/install.sh .venv
	touch $@

reproduce: env ## Build everything of the preset: datasets, models, tables, report
	@sh workflow/reproduce.sh $(SNAKEMAKE)

benchmark: env ## Time against error, on a quiet machine; TARGETS=run AGAINST=commit: of a run; TARGETS=images
stability: env ## Stress tests of the whole chain
bounds: env ## How far each method is from the best possible one
bundles: env ## Pack each dataset's network as a model that psfdae predict takes
benchmark stability bounds bundles:
	@case "$@ $$TARGETS" in "benchmark run") python workflow/benchmarks/commits.py compare \
	  --against "$$AGAINST" --preset "$${PRESET:-fast}" --out "$$PSFDAE_RESULTS/tables/benchmark_run.csv";; \
	"benchmark images") python workflow/benchmarks/image_costs.py $$IMAGES --against "$$AGAINST" \
	  --results "$$PSFDAE_RESULTS";; *) $(LOCKED) -- $@;; esac
night: env ## Model the images of a night: IMAGES="night/*.fits", or a CSV list of images
	@$(LOCKED) images="$$IMAGES" -- night

report: env ## Gather the figures of a finished run in results/report.html
	@sh workflow/report.sh $(SNAKEMAKE)

archive: report ## A finished run as one file, FILE=run.tar: results, models, report, checksums, citation
	psfdae paper archive "$$PSFDAE_RESULTS" --out "$${FILE:-psfdae-run.tar}"
fetch: env ## Unpack and verify FILE=run.tar in place of computing it
	psfdae paper fetch "$${FILE:-psfdae-run.tar}" --results "$$PSFDAE_RESULTS"

mlflow: env ## Compare the tracked runs in a browser (PORT=n)
	@test -f "$$PSFDAE_RESULTS/mlflow.db" || { echo "no $$PSFDAE_RESULTS/mlflow.db yet: make reproduce"; exit 1; }
	mlflow ui --workers 1 --port "$${PORT:-5000}" --backend-store-uri "sqlite:///$$PSFDAE_RESULTS/mlflow.db" \
	  --artifacts-destination "$$PSFDAE_RESULTS/mlartifacts"
reference: env ## Make the finished run in results the run of record
	@sh workflow/reference.sh
site: env ## Build the site of README and docs in site/
	NO_MKDOCS_2_WARNING=1 mkdocs build --strict

lint: env ## Check style, words and types of Python, and Snakemake files
	ruff check . && ruff format --check .
	lint-imports --no-cache
	python workflow/house.py
	mypy
	snakefmt --check Snakefile workflow && snakemake --lint
format: env ## Format Python and Snakemake files
	ruff check --fix . && ruff format . && snakefmt Snakefile workflow

test: env ## Lint, unit tests and the smoke workflow
	@$(MAKE) --no-print-directory --jobs 2 lint fast-tests

# Beside lint, which keeps one core busy for a minute while the first tests are collected.
fast-tests: env
	$(FAST_TESTS) --junitxml results/tests.xml

nightly: env ## The slow tests; PART=3/7: the third seventh of their files
	$(PYTEST) -m slow $${PART:+--part "$$PART"}
test-all: test nightly ## The tests, then the slow ones
test-light: env ## The commands and Python lines of the pages in a plain installation
	$(PYTEST) -m slow tests/docs/test_light_install.py
test-docs: env ## Every command of README and docs as it is written
	pytest -m written
test-pythons: env ## The fast tests with other Pythons, and the newest or lowest versions of dependencies
	sh tests/pythons.sh $(FAST_TESTS)
dist: env ## Build the source distribution and the wheel in dist/
	uv build --no-build-isolation --python .venv/bin/python --out-dir dist
lock: env ## Renew the lock files from pyproject.toml and requirements; torch's CPU builds from TORCH_INDEX
	sh requirements/lock.sh

clean: ## Remove results (but not results/reference) and Snakemake's memory of them
	find results -mindepth 1 -maxdepth 1 ! -name reference -exec rm -rf {} + 2>/dev/null || true
	rm -rf .snakemake .cache
