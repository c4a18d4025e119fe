# Everything runs from a clean clone: Python 3.11 or newer and make, nothing by hand before.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
CORE := $(VENV)/.core
TOOLS := $(VENV)/.tools
# Bytecode is written when a module is first imported, and most of what is installed never is.
unexport PYTHONDONTWRITEBYTECODE
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile
PLUGINS := io serve ros scale learn
PYTEST := $(BIN)/python -m pytest -n auto

# Debian's browser for the tests of pages, where it may be installed without a password.
AS_ROOT := $$(test "$$(id -u)" = 0 || echo "sudo -n")
CHROMIUM := command -v chromium || { command -v apt-get && $(AS_ROOT) apt-get update && \
  $(AS_ROOT) env DEBIAN_FRONTEND=noninteractive apt-get install -y --no-install-recommends chromium; }

.DEFAULT_GOAL := help
.PHONY: help venv demo test test-all lint docs bench release clean

help: ## show this list
	@awk -F':.*## ' '/^[a-z-]+:.*## /{printf "  make %-9s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

demo: $(CORE) ## locate three sentences in a small town and a film in a flat; see demo-out/
	$(BIN)/placegraph demo --out demo-out

venv: $(TOOLS) ## create .venv and install placegraph, placegraph-lab and the tools

test: $(TOOLS) ## run the tests on every core, in minutes; PACKAGE=placegraph-ros: those of one package
	$(PYTEST) $(if $(PACKAGE),$(or $(wildcard packages/$(PACKAGE)/tests),tests))

test-all: $(TOOLS) ## run every test, the long ones too, with more examples of each property
	$(PYTEST) -m "all or not all" --hypothesis-profile thorough

lint: $(TOOLS) ## check rules, layout, spelling, wording, workflows, who imports whom, and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/typos
	$(BIN)/check-jsonschema --quiet --builtin-schema vendor.github-workflows .github/workflows/*.yml
	$(BIN)/zizmor --offline --quiet .github
	$(BIN)/lint-imports
	$(BIN)/python tools/check_words.py
	$(BIN)/python tools/check_sentences.py
	$(BIN)/mypy || $(BIN)/mypy --num-workers 0  # a busy machine starts no worker in the three seconds it is given

docs: $(TOOLS) ## build the documentation into site/
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

bench: $(TOOLS) ## print the benchmark tables but KITTI360Pose (needs ../shared; long)
	set -e; for table in $$($(BIN)/placegraph-lab table --list | cut -d" " -f1 | grep -v kitti360pose); do $(BIN)/placegraph-lab table $$table; done

release: $(TOOLS) ## build all wheels and sdists into dist/, check them, and write what they stand on (SBOM)
	$(PIP) 'build>=1.2' 'cyclonedx-bom>=7' 'twine>=6'
	rm -rf dist
	for part in . $(addprefix packages/placegraph-,$(PLUGINS)); do $(BIN)/python -m build --outdir dist $$part || exit 1; done
	$(BIN)/twine check --strict dist/*.whl dist/*.tar.gz
	$(BIN)/python -m venv dist/empty
	dist/empty/bin/python -m pip install --quiet --disable-pip-version-check dist/*.whl
	dist/empty/bin/placegraph --compiled dist/empty/compiled demo --out dist/empty/demo
	$(BIN)/cyclonedx-py environment --pyproject pyproject.toml --output-reproducible -o dist/placegraph.cdx.json dist/empty/bin/python
	rm -rf dist/empty

clean: ## remove what the targets above left behind, .venv included
	rm -rf $(VENV) demo-out dist site .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache .benchmark-cache
	find src packages lab tests docs examples -name __pycache__ -type d -prune -exec rm -rf {} +

$(CORE): pyproject.toml $(BIN)/python
	$(PIP) --editable .
	@touch $@

# PyTorch is pinned here and nowhere else; kornia and timm, which would bring another one, come with
# it. Without them, training, the matcher XFeat and timm's backbones are left out, and their tests.
# The browser is fetched meanwhile: pip keeps one processor busy.
$(TOOLS): pyproject.toml lab/pyproject.toml $(wildcard packages/*/pyproject.toml) $(BIN)/python
	@{ $(CHROMIUM); } >/dev/null 2>&1 & browser=$$!; \
	$(PIP) torch==2.13.0 'kornia>=0.9' \
	  || echo "PyTorch 2.13.0 cannot be had: tests of training and of XFeat will be skipped" >&2; \
	$(PIP) torch==2.13.0 torchvision==0.28.0 'timm>=1.0' 'safetensors>=0.4' \
	  || echo "timm cannot be had: tests of its backbones will be skipped" >&2; \
	$(PIP) --editable '.[dev,docs]' $(addprefix --editable ./packages/placegraph-,$(PLUGINS)) --editable ./lab || exit 1; \
	wait $$browser || echo "No chromium: tests of pages will be skipped" >&2
	@touch $(CORE) $@

# Debian ships venv apart from Python: fall back on virtualenv, or say what to install.
$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	  echo "placegraph needs Python 3.11 or newer: make PYTHON=python3.11 ..." >&2; exit 1; }
	@$(PYTHON) -m venv $(VENV) || { rm -rf $(VENV); \
	  $(PYTHON) -m virtualenv --quiet $(VENV) || { \
	    $(PYTHON) -m pip install --quiet --user virtualenv && \
	    $(PYTHON) -m virtualenv --quiet $(VENV); }; } || { rm -rf $(VENV); \
	  echo "No virtual environment could be made: apt install python3-venv" >&2; exit 1; }
