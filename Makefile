# make demo | test | slow | check | bench | publish | docs | dist | clean. Each installs what it needs into .venv first.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# torch's OpenMP threads would otherwise spin after each op and slow the next kernel.
export OMP_WAIT_POLICY := passive

.PHONY: demo test slow check bench publish docs dist clean
.DEFAULT_GOAL := test

$(VENV)/installed: pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 10) <= sys.version_info[:2] < (3, 14))' \
		|| { echo "make: $(PYTHON) must be Python 3.10 to 3.13; name another with: make PYTHON=python3.11"; exit 2; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[dev]'
	@touch $@

demo: $(VENV)/installed
	$(BIN)/python -m train demo --out demo

# Two processes, because compiling kernels keeps one core busy: 8 minutes instead of 11 on two cores. A file's tests stay
# together, they share kernels and trained runs.
test: $(VENV)/installed
	$(BIN)/python -m pytest -n 2 --dist loadfile

slow: $(VENV)/installed
	$(BIN)/python -m pytest -m slow --timeout 3600

check: $(VENV)/installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright
	$(BIN)/lint-imports

$(VENV)/peers: $(VENV)/installed
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[train,bench]' \
		|| echo "make: not every peer can be installed here; the bench runs without them"
	@touch $@

# PARTS="races sweep" runs some parts, ARGS="--quick" or ARGS="--only chamfer" less of them; see benchmarks --help.
bench: $(VENV)/peers
	$(BIN)/python -m benchmarks $(PARTS) $(ARGS)

# Puts the tables of the last bench on this machine into README.md and docs/performance.md.
publish: $(VENV)/installed
	$(BIN)/python -m benchmarks publish

docs: $(VENV)/installed
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[docs]'
	$(BIN)/python -m sphinx -q -W --keep-going docs docs/_build
	@echo "open docs/_build/index.html"

# What is uploaded for a release (docs/releasing.md): built, checked, and installed into an empty environment.
dist: $(VENV)/installed
	rm -rf dist
	$(BIN)/python -m build --outdir dist
	$(BIN)/python -m twine check --strict dist/*
	$(BIN)/python -m pytest -m slow tests/test_wheel.py

clean:
	rm -rf $(VENV) docs/_build dist .pytest_cache .ruff_cache .hypothesis
