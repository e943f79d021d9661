# Everything a newcomer needs: `make reproduce` and `make test`.
#   CORES=n          cores for the workflow (default: all)
#   PRESET=name      smoke, fast (default) or paper
#   SET="a.b=1 …"    Hydra overrides for every dataset
#   RESULTS=folder   folder that is written and read (default: results, or results/PRESET); a finished
#                    run in it gives PRESET and SET where they are not given
#   TARGETS="…"      Snakemake targets, for example dataset3 (default: all)
#   IMAGES="…"       images of `make night`: a pattern such as night/*.fits, or a CSV list
#   AGAINST=commit   that `make benchmark TARGETS=run` compares this one with
#   PORT=n           port of the MLflow page (default: 5000)
#   TRACK=live       shows trainings in MLflow while they run (default: once they are finished)
#   TORCH_INDEX=url  package index with PyTorch's CPU builds (default: pip's own index)
#   PYTHON=python3   interpreter that makes the environment (3.11 or newer)
#   PART=k/n         the k-th of n parts of `make nightly` (default: all of it)
#   PYTHONS="…"      interpreters of `make test-pythons` (default: 3.11 to 3.14)
#   RESOLUTION=…     its versions of dependencies: highest (default) or lowest-direct

PYTHON ?= python3
CORES ?= all
PRESET ?=
SET ?=
RESULTS ?=
TARGETS ?=
AGAINST ?=
IMAGES ?=
TORCH_INDEX ?=
PORT ?= 5000
TRACK ?=
PART ?=
PYTHONS ?= 3.11 3.12 3.13 3.14
RESOLUTION ?= highest

VENV := .venv
PIP := $(VENV)/bin/python -m pip --disable-pip-version-check --no-input
# Hashed files only; what has no wheel is built with the pinned tools of build.lock.
HASHED := $(PIP) install --quiet --require-hashes --no-build-isolation
TORCH = $(shell sed -nE 's/^torch==//p' requirements/torch.in)
FROM = $(if $(TORCH_INDEX),--index-url "$$TORCH_INDEX")
COMPILE := uv pip compile --quiet --upgrade --universal --python-version 3.11 --generate-hashes \
  --no-header --no-annotate
export PATH := $(CURDIR)/$(VENV)/bin:$(PATH)
export PYTHONUNBUFFERED := 1
# Where an environment forbids to keep compiled modules, every job would compile them again.
export PYTHONDONTWRITEBYTECODE :=
export MLFLOW_DISABLE_TELEMETRY := true
# Everything stays in this folder, caches of libraries, too.
export XDG_CACHE_HOME := $(CURDIR)/.cache
export MPLCONFIGDIR := $(CURDIR)/.cache/matplotlib
# pip keeps what it has downloaded only where PIP_CACHE_DIR says so, as jobs on GitHub do.
export PIP_NO_CACHE_DIR := $(if $(PIP_CACHE_DIR),,1)

# What a user gives reaches the recipes through the environment, as it stands: neither make nor
# a shell expands a text that may come from a colleague's file.
override CORES := $(value CORES)
override PRESET := $(value PRESET)
override SET := $(value SET)
override RESULTS := $(value RESULTS)
override TARGETS := $(value TARGETS)
override AGAINST := $(value AGAINST)
override IMAGES := $(value IMAGES)
override PORT := $(value PORT)
override TRACK := $(value TRACK)
override TORCH_INDEX := $(value TORCH_INDEX)
override PART := $(value PART)
override PYTHONS := $(value PYTHONS)
override RESOLUTION := $(value RESOLUTION)
PSFDAE_RESULTS := $(or $(RESULTS),results$(if $(filter-out fast,$(PRESET)),/$(PRESET)))
export CORES PRESET SET RESULTS TARGETS AGAINST IMAGES PORT TRACK TORCH_INDEX PART PYTHONS RESOLUTION PSFDAE_RESULTS
SNAKEMAKE := snakemake --cores "$$CORES" --config preset="$$PRESET" set="$$SET" \
  results="$$RESULTS"
# -f: a target is no pattern of file names.
LOCKED := set -f; sh workflow/locked.sh $(SNAKEMAKE)
# Targets on request are in the report where they have been built.
REPORTED = all \
  $(if $(wildcard $(PSFDAE_RESULTS)/figures/benchmark/inference.png),benchmark) \
  $(if $(wildcard $(PSFDAE_RESULTS)/.stability_passed),stability) \
  $(if $(wildcard $(PSFDAE_RESULTS)/tables/psf_efficiency.csv),bounds) \
  $(if $(wildcard $(PSFDAE_RESULTS)/figures/own_stars/strip.png),from_stars_example)
# The 24 × 24 trainings take longest; started last, one would run alone in the end.
LONGEST_FIRST := $(if $(strip $(TARGETS)),,--prioritize scene2)
# The tests of a file run in one worker, the smoke run first (tests/conftest.py).
PYTEST := env OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 pytest --numprocesses logical \
  --maxprocesses 4 --dist loadfile --no-loadscope-reorder
FAST_TESTS := $(PYTEST) -m "not slow and not written"

# A mistyped PRESET would be ignored without a word.
UNKNOWN := $(strip $(foreach name,$(.VARIABLES),$(if $(filter command,$(origin $(name))),$(name))))
$(if $(filter-out PYTHON,$(UNKNOWN)),$(error $(UNKNOWN): no variable of this Makefile, whose first lines list them))

.DEFAULT_GOAL := help
.PHONY: help env reproduce report mlflow reference notebook site test fast-tests nightly test-all test-light test-docs test-pythons dist lint format lock clean \
  benchmark stability bounds bundles shipped night

help: ## List the targets
	@grep -hE '^[a-z_-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 16

env: $(VENV)/.complete ## Create the environment .venv from the lock file

$(VENV)/.complete: requirements.lock $(wildcard requirements/*.lock) pyproject.toml
	$(PYTHON) -c 'import sys; sys.exit("psfdae needs Python 3.11 or newer" if sys.version_info < (3, 11) else 0)'
	$(PYTHON) -m venv $(VENV)
	$(HASHED) --no-deps --requirement requirements/build.lock
	$(HASHED) --no-deps --requirement requirements.lock
	@$(PIP) index versions torch $(FROM) | grep -F '$(TORCH)+cpu' >/dev/null && lock=torch-cpu || lock=torch; \
	set -x; $(HASHED) $(FROM) --constraint requirements/$$lock.lock torch==$(TORCH)
	$(PIP) install --quiet --no-index --no-deps --no-build-isolation --editable .
	touch $@

reproduce: env ## Build everything of the preset: datasets, models, tables, report
	@case "$$TRACK" in '') ;; live) export PSFDAE_EPOCHS=psfdae_paper.stages.live:logger ;; \
	    *) echo "TRACK=$$TRACK: live, or nothing"; exit 2;; esac; \
	  $(LOCKED) $(LONGEST_FIRST) -- $$TARGETS
	@psfdae paper manifest "$$PSFDAE_RESULTS"
	@$(MAKE) --no-print-directory report
	@[ "$$PSFDAE_RESULTS" != results ] || [ ! -d results/evaluation ] || \
	  psfdae paper compare results results/reference || true
	@show() { [ ! -e "$$1" ] || printf '  %-36s %s\n' "$${3:-$$1}" "$$2"; }; \
	  mlflow="make mlflow"; [ "$$PSFDAE_RESULTS" = results ] || mlflow="$$mlflow RESULTS=$$PSFDAE_RESULTS"; \
	  echo "To open:"; \
	  show "$$PSFDAE_RESULTS/report.html" "all figures, with captions"; \
	  show "$$PSFDAE_RESULTS/tables/psf_metrics.csv" "mean errors of all methods"; \
	  show docs/results.md "the run of record beside the paper"; \
	  show "$$PSFDAE_RESULTS/mlflow.db" "the runs side by side, in a browser" "$$mlflow"

benchmark: env ## Run time against error, on a quiet machine; TARGETS=run AGAINST=commit: that of a whole run
stability: env ## Stress tests of the whole chain
bounds: env ## How far each method is from the best possible one
bundles: env ## Pack each dataset's network as a model that psfdae predict takes
benchmark stability bounds bundles:
	@case "$@ $$TARGETS" in "benchmark run") python workflow/benchmarks/commits.py compare \
	  --against "$$AGAINST" --preset "$${PRESET:-fast}" --out "$$PSFDAE_RESULTS/tables/benchmark_run.csv";; \
	*) $(LOCKED) -- $@;; esac

night: env ## Model the images of a night: IMAGES="night/*.fits", or a CSV list of images
	@set -f; sh workflow/locked.sh $(SNAKEMAKE) images="$$IMAGES" -- night

shipped: env ## Train the model that comes with the package and renew it
	@$(LOCKED) --forcerun shipped -- shipped

report: env ## Gather the figures of a finished run in results/report.html
	@mkdir -p .snakemake
	@set -f; export PYTHONWARNINGS='ignore:coroutine:RuntimeWarning'; flock .snakemake/psfdae.lock \
	  $(SNAKEMAKE) --report "$$PSFDAE_RESULTS/.report.html" -- $${TARGETS:-$(REPORTED)}
	@mv "$$PSFDAE_RESULTS/.report.html" "$$PSFDAE_RESULTS/report.html"

mlflow: env ## Compare the tracked runs in a browser (PORT=n)
	@test -f "$$PSFDAE_RESULTS/mlflow.db" || { echo "no $$PSFDAE_RESULTS/mlflow.db yet: make reproduce"; exit 1; }
	mlflow ui --workers 1 --port "$$PORT" --backend-store-uri "sqlite:///$$PSFDAE_RESULTS/mlflow.db" \
	  --artifacts-destination "$$PSFDAE_RESULTS/mlartifacts"

reference: env ## Make the finished run in results the run of record
	@sh workflow/reference.sh

notebook: env ## Run the cells of the first session anew
	python docs/notebook.py docs/first_session.ipynb

site: env ## Build the site of README and docs in site/
	NO_MKDOCS_2_WARNING=1 mkdocs build --strict

lint: env ## Check style, words and types of Python, and Snakemake files
	ruff check .
	ruff format --check .
	lint-imports --no-cache
	python workflow/house.py
	mypy
	snakefmt --check Snakefile workflow
	snakemake --lint

format: env ## Format Python and Snakemake files
	ruff check --fix .
	ruff format .
	snakefmt Snakefile workflow

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
	uv build --no-build-isolation --python $(VENV)/bin/python --out-dir dist

lock: env ## Renew the lock files from pyproject.toml and requirements; torch's CPU builds from TORCH_INDEX
	$(if $(TORCH_INDEX),$(COMPILE) --no-deps --default-index "$$TORCH_INDEX" \
	  requirements/torch.in --output-file requirements/torch-cpu.lock)
	$(COMPILE) --extra paper --extra dev --overrides requirements/no-torch.txt \
	  pyproject.toml requirements/torch-runtime.in --output-file requirements.lock
	$(COMPILE) --constraints requirements.lock \
	  requirements/build.in --output-file requirements/build.lock
	$(COMPILE) --constraints requirements.lock \
	  requirements/torch.in --output-file requirements/torch.lock

clean: ## Remove results (but not results/reference) and Snakemake's memory of them
	find results -mindepth 1 -maxdepth 1 ! -name reference -exec rm -rf {} + 2>/dev/null || true
	rm -rf .snakemake .cache
