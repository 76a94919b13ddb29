# `make explore` and `make test` do the whole set-up on a fresh machine: a virtual environment in .venv
# with the versions of requirements.lock. Options for the command itself: make explore ARGS="--seed 7".

PYTHON_RANGE := 3.11 to 3.14
PYTHON ?= $(shell for p in python3 python3.14 python3.13 python3.12 python3.11; do \
	$$p -c 'import sys, venv, ensurepip; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 14))' 2>/dev/null \
	&& echo $$p && break; done)

VENV := .venv
READY := $(VENV)/.ready
TESTABLE := $(VENV)/.testable
PIP := $(VENV)/bin/python -m pip --disable-pip-version-check

.PHONY: explore test lint cluster clean
.DELETE_ON_ERROR:

explore: $(READY)
	$(VENV)/bin/python scripts/explore_and_optimize.py $(ARGS)

test: $(TESTABLE)
	$(VENV)/bin/python -m pytest -n auto $(ARGS)

lint: $(READY)
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .

# Dask, for scripts/sweep.py --dask and for the workers that it uses.
cluster: $(READY)
	$(PIP) install --quiet --no-deps -r requirements-cluster.lock
	$(PIP) check

# The stamp is written last, and the environment is built anew from nothing: an interrupted set-up starts over.
$(READY): requirements.lock pyproject.toml
	@if [ -z "$(PYTHON)" ]; then \
	echo "no Python $(PYTHON_RANGE) with venv was found; install one, or say make PYTHON=/path/to/python3" >&2; exit 1; fi
	$(PYTHON) -m venv --clear $(VENV)
	$(PIP) install --quiet --no-deps -r requirements.lock
	$(PIP) install --quiet --no-deps --no-build-isolation -e .
	$(PIP) check
	touch $@

# What only tests need: evo, another evaluation of trajectories, whose figures ours must equal.
$(TESTABLE): $(READY) requirements-test.lock
	$(PIP) install --quiet --no-deps -r requirements-test.lock
	$(PIP) check
	touch $@

clean:
	rm -rf $(VENV) build *.egg-info .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
