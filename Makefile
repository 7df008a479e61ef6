# `make train` and `make test` each work on a machine with nothing but Python (3.10 to 3.13) and make.
PYTHON ?= python3
VENV ?= .venv
CONFIG ?= configs/one_waypoint/quickstart.yaml
SEED ?= 0
RAY_VENV ?= .venv-ray
PEERS_VENV ?= .venv-peers
INTEGRATIONS_VENV ?= .venv-integrations
MUTANTS_VENV ?= .venv-mutants
DOCS_VENV ?= .venv-docs
# `make install UV=uv` is faster: uv unpacks a package once for all environments, pip once for each.
UV ?=
install_in = $(if $(UV),$(UV) pip install --quiet --python $(1)/bin/python,\
	$(1)/bin/python -m pip --disable-pip-version-check install --quiet)
READY = $(VENV)/.ready
TRAIN_READY = $(VENV)/.ready-train
RAY_READY = $(RAY_VENV)/.ready
PEERS_READY = $(PEERS_VENV)/.ready
INTEGRATIONS_READY = $(INTEGRATIONS_VENV)/.ready
MUTANTS_READY = $(MUTANTS_VENV)/.ready
DOCS_READY = $(DOCS_VENV)/.ready
SPHINX = $(DOCS_VENV)/bin/python -m sphinx -W --keep-going --quiet $(SPHINX_OPTIONS)
# The tests that need nothing but the development environment.
HERE = --ignore tests/browser --ignore tests/cluster --ignore tests/install --ignore tests/integrations

.PHONY: install train test test-fast test-processes test-ray test-peers test-integrations test-cluster test-browser test-install \
	mutants lint benchmark docs linkcheck clean

install: $(READY)

$(READY): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(call install_in,$(VENV)) --constraint constraints.txt --editable ".[dev]"
	touch $@

# What training needs, without the development tools.
$(TRAIN_READY): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(call install_in,$(VENV)) --constraint constraints.txt --editable ".[train]"
	touch $@

# RLlib pins an older Gymnasium, so its tests run in a separate environment.
$(RAY_READY): pyproject.toml constraints.txt constraints-ray.txt
	$(PYTHON) -m venv $(RAY_VENV)
	grep --invert-match '^gymnasium==' constraints.txt > $(RAY_VENV)/constraints.txt
	$(call install_in,$(RAY_VENV)) \
		--constraint $(RAY_VENV)/constraints.txt --constraint constraints-ray.txt --editable ".[rllib,train]" pytest hypothesis
	touch $@

# morl-baselines compiles a solver (against Debian's libgmp-dev and libcdd-dev) and installs 24 further packages.
$(PEERS_READY): pyproject.toml constraints.txt constraints-peers.txt
	$(PYTHON) -m venv $(PEERS_VENV)
	$(call install_in,$(PEERS_VENV)) \
		--constraint constraints.txt --constraint constraints-peers.txt --editable ".[peers]" pytest hypothesis
	touch $@

# Tianshou needs older releases of two packages.
$(INTEGRATIONS_READY): pyproject.toml constraints.txt constraints-peers.txt constraints-integrations.txt
	$(PYTHON) -m venv $(INTEGRATIONS_VENV)
	grep --no-filename --invert-match --extended-regexp '^(filelock|pandas)==' constraints.txt constraints-peers.txt \
		> $(INTEGRATIONS_VENV)/constraints.txt
	$(call install_in,$(INTEGRATIONS_VENV)) \
		--constraint $(INTEGRATIONS_VENV)/constraints.txt --constraint constraints-integrations.txt \
		--editable ".[integrations]" pytest pytest-xdist hypothesis
	touch $@

# Cosmic Ray installs 16 further packages.
$(MUTANTS_READY): pyproject.toml constraints.txt constraints-mutants.txt
	$(PYTHON) -m venv $(MUTANTS_VENV)
	$(call install_in,$(MUTANTS_VENV)) \
		--constraint constraints.txt --constraint constraints-mutants.txt --editable ".[dev]" cosmic-ray
	touch $@

# Sphinx and a Jupyter kernel for the tutorials: 53 further packages.
$(DOCS_READY): pyproject.toml constraints.txt constraints-docs.txt
	$(PYTHON) -m venv $(DOCS_VENV)
	$(call install_in,$(DOCS_VENV)) \
		--constraint constraints.txt --constraint constraints-docs.txt --editable ".[docs]"
	touch $@

train: $(TRAIN_READY)
	$(VENV)/bin/python scripts/train.py --config $(CONFIG) --seed $(SEED)

lint: $(READY)
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/mypy
	$(VENV)/bin/codespell

test: lint
	$(VENV)/bin/python -m pytest --numprocesses 2 --dist worksteal $(HERE) -m "not processes"

# For the inner loop: no lint, nothing that takes longer than a second, and few examples per property.
test-fast: $(READY)
	$(VENV)/bin/python -m pytest --numprocesses 2 --dist worksteal $(HERE) \
		-m "not slow and not cluster and not browser" --hypothesis-profile fast

# Worker pools, sweeps, and scripts that train in processes of their own. Some are interrupted and killed, and the
# results must be the same.
test-processes: $(READY)
	$(VENV)/bin/python -m pytest --numprocesses 2 --dist worksteal $(HERE) -m processes

# Starts and stops a temporary Slurm (Debian's slurm-wlm and munge, as root) and temporary Ray clusters.
test-cluster: $(READY)
	$(VENV)/bin/python -m pytest tests/cluster --numprocesses 2 --dist loadfile

# The explorer of fronts in an installed Chromium (Debian's chromium and chromium-driver); skipped where there is none.
test-browser: $(READY)
	$(VENV)/bin/python -m pytest tests/browser

# Builds sdist and wheel, installs the wheel in a new environment, and runs every command there, outside the checkout.
test-install: $(READY)
	$(VENV)/bin/python -m pytest tests/install

test-ray: $(RAY_READY)
	$(RAY_VENV)/bin/python -m pytest tests/ray

test-peers: $(PEERS_READY)
	$(PEERS_VENV)/bin/python -m pytest tests/peers tests/mo_deepdrive/test_wrappers.py

# Other libraries on our environments; the table of docs/compatibility.md is what these tests declare.
test-integrations: $(INTEGRATIONS_READY)
	$(INTEGRATIONS_VENV)/bin/python -m pytest tests/integrations --numprocesses 2 --dist worksteal

# Which small changes of the code the tests notice; more options in MUTANTS, such as MUTANTS="--workers 2 --resume".
mutants: $(MUTANTS_READY)
	$(MUTANTS_VENV)/bin/python -m tests.mutation.mutants $(MUTANTS)

benchmark: $(READY)
	$(VENV)/bin/python scripts/benchmark.py

# The documentation site, in docs/_build/html, with the tutorials run. Warnings and broken local links are errors.
docs: $(DOCS_READY)
	$(SPHINX) -b html -d docs/_build/doctrees docs docs/_build/html

# Links to other sites; needs the internet. Links within the site are checked by `make docs`.
linkcheck: $(DOCS_READY)
	$(SPHINX) -b linkcheck -d docs/_build/doctrees docs docs/_build/linkcheck

clean:
	rm -rf $(VENV) $(RAY_VENV) $(PEERS_VENV) $(INTEGRATIONS_VENV) $(MUTANTS_VENV) $(DOCS_VENV) docs/_build docs/_pictures docs/_static/explore_*.html \
		.mypy_cache .ruff_cache .pytest_cache
