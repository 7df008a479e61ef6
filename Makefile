# `make train` and `make test` each work alone on a machine with Python (3.10 to 3.13) and make.
PYTHON ?= python3
VENV ?= .venv
CONFIG ?= configs/one_waypoint/mo_a2c_linear.yaml
SEED ?= 0
RAY_VENV ?= .venv-ray
PEERS_VENV ?= .venv-peers
PIP = $(VENV)/bin/python -m pip --disable-pip-version-check
READY = $(VENV)/.ready
RAY_READY = $(RAY_VENV)/.ready
PEERS_READY = $(PEERS_VENV)/.ready

.PHONY: install train test test-ray test-peers test-cluster lint benchmark clean

install: $(READY)

$(READY): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(PIP) install --quiet --constraint constraints.txt --editable ".[dev]"
	touch $@

# RLlib pins an older Gymnasium, so its tests have an environment of their own.
$(RAY_READY): pyproject.toml constraints.txt constraints-ray.txt
	$(PYTHON) -m venv $(RAY_VENV)
	grep --invert-match '^gymnasium==' constraints.txt > $(RAY_VENV)/constraints.txt
	$(RAY_VENV)/bin/python -m pip --disable-pip-version-check install --quiet \
		--constraint $(RAY_VENV)/constraints.txt --constraint constraints-ray.txt --editable ".[rllib]" pytest hypothesis
	touch $@

# morl-baselines brings a solver that is compiled (against Debian's libgmp-dev and libcdd-dev) and 24 packages more.
$(PEERS_READY): pyproject.toml constraints.txt constraints-peers.txt
	$(PYTHON) -m venv $(PEERS_VENV)
	$(PEERS_VENV)/bin/python -m pip --disable-pip-version-check install --quiet \
		--constraint constraints.txt --constraint constraints-peers.txt --editable ".[peers]" pytest hypothesis
	touch $@

train: $(READY)
	$(VENV)/bin/python scripts/train.py --config $(CONFIG) --seed $(SEED)

lint: $(READY)
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/mypy

test: lint
	$(VENV)/bin/python -m pytest --numprocesses 2 --ignore tests/cluster

# Starts a Slurm of its own (Debian's slurm-wlm and munge, as root) and a Ray cluster of its own, and stops them.
test-cluster: $(READY)
	$(VENV)/bin/python -m pytest tests/cluster --numprocesses 2 --dist loadfile

test-ray: $(RAY_READY)
	$(RAY_VENV)/bin/python -m pytest tests/ray

test-peers: $(PEERS_READY)
	$(PEERS_VENV)/bin/python -m pytest tests/peers tests/mo_deepdrive/test_wrappers.py

benchmark: $(READY)
	$(VENV)/bin/python scripts/benchmark.py

clean:
	rm -rf $(VENV) $(RAY_VENV) $(PEERS_VENV) .mypy_cache .ruff_cache .pytest_cache
