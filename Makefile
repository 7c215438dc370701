# make demo: install, certify the pendulum, diagnose its recording.    make test: install, run the daily part of the tests.
# make test-all: every test.    make slowest: what the last run's tests cost, longest first.
SHELL := /bin/bash
.DELETE_ON_ERROR:
.DEFAULT_GOAL := demo
.PHONY: demo test test-all slowest lint types docs check dist clean

# The hundreds of processes that tests start would each compile again all that they import.
unexport PYTHONDONTWRITEBYTECODE

PYTHON ?= $(shell for p in python3.11 python3; do $$p -c '' 2>/dev/null && echo $$p && break; done)
VENV := .venv
BIN := $(VENV)/bin
STARTED := $(shell date +%s)
PIP := $(BIN)/python -m pip --disable-pip-version-check install --quiet -c constraints.txt

demo: $(VENV)/.demo
	@echo "installation: $$(( $$(date +%s) - $(STARTED) )) s"
	@TIMEFORMAT='run: %R s (%U s of CPU in user mode, %S s in the kernel)'; time { \
	  $(BIN)/gapcert run specs/pendulum.yaml && $(BIN)/gapcert diagnose specs/diagnose/pendulum.yaml; }

# SELECT, FLAGS and RECORD are .ci/run's: which tests of these, how, and where their CPU seconds are written.
test: SELECT ?= not exam
test-all: SELECT ?=
RECORD ?= build/durations.tsv
test test-all: $(VENV)/.test
	@$(BIN)/python tests/support/warm.py
	$(BIN)/python -m pytest -n 2 --dist worksteal -m "$(SELECT)" --record=$(RECORD) $(FLAGS)

slowest:
	@$(BIN)/python tests/support/durations.py slowest $(firstword $(wildcard $(RECORD)) tests/durations.tsv)

lint: $(VENV)/.test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports

types: $(VENV)/.test
	$(BIN)/mypy

docs: $(VENV)/.test
	$(BIN)/python -m sphinx -W --keep-going --quiet -b html docs docs/_build/html

check: lint types docs test-all

dist: $(VENV)/.test
	.ci/dist

clean:
	rm -rf $(VENV) build dist docs/_build .mypy_cache .pytest_cache .ruff_cache .import_linter_cache

# A stamp is younger than what it was installed from, so a second `make` installs nothing.
$(VENV)/.demo: $(VENV)/bin/python pyproject.toml constraints.txt
	$(PIP) -e '.[all]'
	@touch $@

$(VENV)/.test: $(VENV)/bin/python pyproject.toml constraints.txt
	$(PIP) -e '.[all,dev]'
	@touch $(VENV)/.demo $@

$(VENV)/bin/python:
	@[ -n "$(PYTHON)" ] || { echo "Gapcert needs Python 3.11 or newer, and no python3 was found; install python3.11 and python3.11-venv." >&2; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "Gapcert needs Python 3.11 or newer, and $(PYTHON) is $$($(PYTHON) --version); install python3.11 or name another one: make PYTHON=python3.12." >&2; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || { echo "Gapcert needs Python's venv module, and $(PYTHON) has none; on Debian and Ubuntu: apt-get install python3-venv." >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)
