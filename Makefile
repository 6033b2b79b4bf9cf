# make demo   denoise the examples           make test   linters, types, and the tests against the built wheel
# make bench  speed against error on the examples, as a table, a plot and a page in build/bench, against results.json
# All make their own virtual environment in .venv and need nothing before them but Python 3.11 or newer.
SHELL := /bin/bash
.SHELLFLAGS := -euo pipefail -c
.DELETE_ON_ERROR:
.ONESHELL:

PYTHON ?= python3
VENV := .venv
BIN := $(abspath $(VENV))/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check --quiet --quiet
SOURCES := $(shell find deep_io lbmc_cli model pipelines -type f -not -path '*/__pycache__/*')
TESTBED := build/testbed

.PHONY: demo bench bench-keep test lint clean
.DEFAULT_GOAL := demo

$(VENV)/made:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || {
	  echo "ERROR: Python 3.11 or newer is needed, this is $$($(PYTHON) --version); try: make PYTHON=python3.12" >&2
	  exit 1
	}
	$(PYTHON) -m venv --clear $(VENV)
	$(PIP) install -c constraints.txt setuptools
	touch $@

build/wheel: $(VENV)/made setup.cfg pyproject.toml README.md $(SOURCES)
	rm -rf build/wheel build/lib build/bdist.*
	$(PIP) wheel --no-deps --no-build-isolation --wheel-dir build/wheel .

# The wheel itself is put in anew each time (same version, new contents); what it depends on stays.
$(VENV)/runtime: build/wheel constraints.txt
	wheel=$$(echo build/wheel/*.whl)
	$(PIP) install -c constraints.txt "$$wheel[train]"
	$(PIP) install --no-deps --force-reinstall "$$wheel"
	touch $@

$(VENV)/tested: build/wheel constraints.txt
	wheel=$$(echo build/wheel/*.whl)
	$(PIP) install -c constraints.txt "$$wheel[test]"
	$(PIP) install --no-deps --force-reinstall "$$wheel"
	touch $@

demo: $(VENV)/runtime
	@PATH=$(BIN):$$PATH examples/demo.sh build/demo

bench: $(VENV)/tested
	@$(BIN)/python benchmarks/readme.py

# The same, and its results become the repository's: results.json, the README's table and the charts.
bench-keep: $(VENV)/tested
	@$(BIN)/python benchmarks/readme.py --keep

lint: $(VENV)/tested
	$(BIN)/ruff check .
	$(BIN)/mypy

# The tests run beside a copy of themselves, not beside the sources: what they import is the installed wheel.
test: lint
	rm -rf $(TESTBED) && mkdir -p $(TESTBED)
	for item in tests examples benchmarks docs README.md results.json pyproject.toml constraints.txt; do
	  if [ -e "$$item" ]; then cp -r "$$item" $(TESTBED)/; fi
	done
	cd $(TESTBED) && env -u PYTHONPATH $(BIN)/python -P -m pytest

clean:
	rm -rf build $(VENV)
