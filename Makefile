# make demo    a material from height map to report, in minutes
# make test    everything that must pass before a change is merged
# Each makes its own virtual environment in .venv; only Python 3.11 or newer and pip must be there.

SHELL := bash
.SHELLFLAGS := -euo pipefail -c
.DEFAULT_GOAL := help

VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/installed-from-pyproject
PIP := $(BIN)/python -m pip --disable-pip-version-check --no-input --retries 8 --timeout 60

.PHONY: help install demo test lint format test-slow docs assets clean

help:
	@sed -n '1,3p' Makefile | cut -c3-
	@echo "also: install lint format test-slow docs assets clean"

install: $(INSTALLED)

# One pip command resolves everything together, so that the pins of pyproject.toml hold for all of it.
$(INSTALLED): pyproject.toml setup.py $(wildcard mbtf_fit/native/src/*)
	@python=""; \
	for candidate in "$${PYTHON:-}" python3.11 python3.12 python3.13 python3 python; do \
	  if [ -n "$$candidate" ] && "$$candidate" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then \
	    python="$$candidate"; break; \
	  fi; \
	done; \
	if [ -z "$$python" ]; then \
	  echo "error: no Python 3.11 or newer was found; name one: make PYTHON=/path/to/python3" >&2; exit 2; \
	fi; \
	if [ ! -x $(BIN)/python ]; then \
	  echo "making $(VENV) with $$("$$python" --version)"; \
	  "$$python" -m venv $(VENV) || { rm -rf $(VENV); \
	    echo "error: no virtual environment could be made; on Debian: apt install python3-venv" >&2; exit 2; }; \
	fi
	@echo "installing the project and its dependencies into $(VENV) (some minutes the first time)"
	@$(PIP) install --quiet --progress-bar off --editable '.[dev]' torch==2.13.0 || { \
	  echo "error: pip could not install the project (its reason stands above)" >&2; \
	  echo "  check the network and run the same command again; what was downloaded is kept" >&2; exit 2; }
	@touch $@

demo: $(INSTALLED)
	$(BIN)/mbtf-pipeline run pipelines/quickstart.yaml

lint: $(INSTALLED)
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy

format: $(INSTALLED)
	$(BIN)/ruff check --fix
	$(BIN)/ruff format

docs: $(INSTALLED)
	$(BIN)/python -m sphinx --fail-on-warning --keep-going --quiet -b html docs docs/_build/html
	@echo "documentation: docs/_build/html/index.html"

test: lint
	$(BIN)/python -m pytest -q -m "not slow" -n auto --maxprocesses 8 --dist worksteal
	$(BIN)/mbtf-pipeline run pipelines/ci.yaml --force --quiet
	$(MAKE) docs

test-slow: $(INSTALLED)
	$(BIN)/python -m pytest -q -m slow

assets: $(INSTALLED)
	$(BIN)/python assets/make_assets.py

clean:
	rm -rf $(VENV) out build docs/_build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache
