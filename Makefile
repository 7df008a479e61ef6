# `make train` and `make test` each work alone on a machine with Python (3.10 to 3.13) and make.
PYTHON ?= python3
VENV ?= .venv
CONFIG ?= configs/one_waypoint/mo_a2c_linear.yaml
SEED ?= 0
PIP = $(VENV)/bin/python -m pip --disable-pip-version-check
READY = $(VENV)/.ready

.PHONY: install train test lint benchmark clean

install: $(READY)

$(READY): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(PIP) install --quiet --constraint constraints.txt --editable ".[dev]"
	touch $@

train: $(READY)
	$(VENV)/bin/python scripts/train.py --config $(CONFIG) --seed $(SEED)

lint: $(READY)
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/mypy

test: lint
	$(VENV)/bin/python -m pytest --numprocesses 2

benchmark: $(READY)
	$(VENV)/bin/python scripts/benchmark.py

clean:
	rm -rf $(VENV) .mypy_cache .ruff_cache .pytest_cache
