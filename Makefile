# Two commands do everything on a fresh machine: `make demo` and `make test`.
PYTHON ?= python3
VENV   ?= .venv
RUN    := $(VENV)/bin/python
# Written once the package, and then everything for tests too, is installed.
BASE   := $(VENV)/.base
STAMP  := $(VENV)/.installed
# Python compiles a file when it is first imported; most are never.
PIP    := $(RUN) -m pip install --quiet --disable-pip-version-check --no-compile
# What it has compiled is kept: the tests start many processes, and each would spend as long on it as on loading.
export PYTHONDONTWRITEBYTECODE =
WORKERS ?= 4
# Beside each other, each with a thread of its own: those of torch would wait for each other.
PYTEST := OMP_NUM_THREADS=1 $(RUN) -m pytest --dist loadfile
# Whatever people read; tests misspell on purpose.
PROSE   := README.md CONTRIBUTING.md Makefile benchmarks cluster configs docs lab msk_ray policies tune_spaces

.PHONY: help base env demo test test-fast test-all check unit gpu-test gpu-test-all site notebooks bench clean

help:                ## this list
	@grep -hE '^[a-z-]+: .*##|^[a-z-]+:  *##' $(MAKEFILE_LIST) | sed 's/:.*##/\t/' | expand -t 14

base: $(BASE)        ## a virtual environment in .venv with what the package needs, pinned by constraints.txt

env: $(STAMP)        ## the same, with what tests, checks and documentation need

$(BASE): pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit("msk_ray needs Python 3.11 or newer: make PYTHON=python3.12 ...") if sys.version_info < (3, 11) else None'
	$(PYTHON) -m venv $(VENV)
	$(PIP) -c constraints.txt -e .
	touch $@

$(STAMP): $(BASE)
	$(PIP) -c constraints.txt -e '.[dev]'
	# Its models, for tests: MyoSuite itself needs an older MuJoCo.
	$(PIP) --no-deps --upgrade --target $(VENV)/share/myosuite myosuite==2.12.2
	touch $@

demo: base           ## a real small Ray Tune sweep (GPU if there is one), ending in its table and report
	rm -rf runs/demo
	$(RUN) -m msk_ray.tune --space cartpole_smoke --name demo

test: check unit     ## everything that CI runs

test-fast: env       ## the short tests, before every commit: two minutes on two cores
	$(PYTEST) -n 2 -m 'not gpu and not gpu_slow and not slow and not long'

test-all: check      ## `test`, and tests that take long and repeat a shorter one with other values
	$(PYTEST) -n $(WORKERS) --no-loadscope-reorder -m 'not gpu and not gpu_slow'

check: env           ## formatting, lint, spelling, layers and types
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/ruff check .
	$(VENV)/bin/codespell $(PROSE)
	$(VENV)/bin/lint-imports
	$(VENV)/bin/mypy

unit: env            ## the tests that need no GPU, in as many processes as WORKERS says
	$(PYTEST) -n $(WORKERS) --no-loadscope-reorder

gpu-test: env        ## the tests that need a CUDA device, within ten minutes
	$(RUN) -m pytest -m gpu --durations 20

gpu-test-all: env    ## these, and those that take minutes and repeat one with other settings
	$(RUN) -m pytest -m 'gpu or gpu_slow' --durations 20

site: env            ## the documentation site, in build/site
	NO_MKDOCS_2_WARNING=1 $(RUN) -m mkdocs build --strict --quiet --config-file docs/site/mkdocs.yml

notebooks: env       ## run the tutorials and write their outputs, docs/tutorials/*.ipynb
	$(RUN) docs/site/notebooks.py

bench: env           ## speed tables of this machine, appended to benchmarks/results/
	$(RUN) benchmarks/epoch.py

clean:               ## remove the environment and caches, never runs/
	rm -rf $(VENV) .pytest_cache .ruff_cache .mypy_cache .import_linter_cache *.egg-info
