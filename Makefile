PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready

.PHONY: help demo test results clean

help:  ## list the targets
	@sed -n 's/^\([a-z]*\):.*## \(.*\)/make \1|\2/p' $(MAKEFILE_LIST) | awk -F'|' '{ printf "%-14s %s\n", $$1, $$2 }'

demo: $(READY)  ## build a small scene with known truth, segment it and show how well that went
	$(BIN)/gsseg demo --out demo_out

test: $(READY)  ## lint, check the types and run the tests
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/python -m pytest -W error

results: $(READY)  ## measure again what docs/results.md shows
	$(BIN)/python benchmarks/results.py

clean:  ## remove the environment, the caches and the demo's output
	rm -rf $(VENV) build demo_out results_out gsseg.egg-info .hypothesis .mypy_cache .pytest_cache .ruff_cache
	find gsseg_core tests -name __pycache__ -prune -exec rm -rf {} +

# setuptools first, so that the build uses the pinned one too.
$(READY): setup.py pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt setuptools
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --no-build-isolation --editable '.[dev]'
	touch $@
