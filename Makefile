# Everything runs from a clean clone: Python 3.11 or newer and make, nothing by hand before.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

.DEFAULT_GOAL := help
.PHONY: help venv demo test test-all lint bench clean

help: ## show this list
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/  make \1\t\2/p' $(MAKEFILE_LIST) | expand -t 16

venv: $(STAMP) ## create .venv and install placegraph with its tools

demo: $(STAMP) ## locate three sentences in a small town and a film in a flat; see demo-out/
	$(BIN)/placegraph demo --out demo-out

test: $(STAMP) ## run the tests
	$(BIN)/python -m pytest

test-all: $(STAMP) ## run the tests, long ones too (needs ../shared)
	$(BIN)/python -m pytest -m ""

lint: $(STAMP) ## check rules, layout and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

bench: $(STAMP) ## print the benchmark tables (needs ../shared; long)
	set -e; for table in $$(ls benchmarks/*.py | grep -v kitti360pose); do $(BIN)/python $$table; done

clean: ## remove what the targets above left behind, .venv included
	rm -rf $(VENV) demo-out dist .pytest_cache .mypy_cache .ruff_cache .hypothesis .benchmark-cache
	find src lab tests benchmarks scripts -name __pycache__ -type d -prune -exec rm -rf {} +

# PyTorch is pinned here and nowhere else; kornia and timm, which would bring another one, come with
# it. Without them, training, the matcher XFeat and timm's backbones are left out, and their tests.
$(STAMP): pyproject.toml $(BIN)/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check torch==2.13.0 'kornia>=0.9' \
	  || echo "PyTorch 2.13.0 cannot be had: tests of training and of XFeat will be skipped" >&2
	$(BIN)/python -m pip install --quiet --disable-pip-version-check torch==2.13.0 \
	  torchvision==0.28.0 'timm>=1.0' 'safetensors>=0.4' \
	  || echo "timm cannot be had: tests of its backbones will be skipped" >&2
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev]' --editable ./lab
	@touch $@

# Debian ships venv apart from Python: fall back on virtualenv, or say what to install.
$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	  echo "placegraph needs Python 3.11 or newer: make PYTHON=python3.11 ..." >&2; exit 1; }
	@$(PYTHON) -m venv $(VENV) || { rm -rf $(VENV); \
	  $(PYTHON) -m virtualenv --quiet $(VENV) || { \
	    $(PYTHON) -m pip install --quiet --user virtualenv && \
	    $(PYTHON) -m virtualenv --quiet $(VENV); }; } || { rm -rf $(VENV); \
	  echo "No virtual environment could be made: apt install python3-venv" >&2; exit 1; }
