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
LOWEST_VENV ?= .venv-lowest
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
LOWEST_READY = $(LOWEST_VENV)/.ready
SPHINX = $(DOCS_VENV)/bin/python -m sphinx -W --keep-going --quiet $(SPHINX_OPTIONS)
# The tests that need nothing but the development environment.
HERE = --ignore tests/browser --ignore tests/cluster --ignore tests/cuda --ignore tests/install --ignore tests/integrations

.PHONY: install train test tests test-fast test-processes test-ray test-peers test-integrations test-cluster test-browser \
	test-cuda test-gpu test-install test-lowest mutants lint benchmark docs linkcheck page-data clean

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

# The lowest versions that pyproject.toml allows, which only uv finds: without UV, pip installs it. Only PyTorch is the usual
# one, since its CPU builds are not on PyPI; with PyTorch's index, LOWEST_TORCH="torch==2.5.0+cpu" is its lowest.
LOWEST_TORCH ?= $(shell grep '^torch==' constraints.txt)
LOWEST_UV = $(or $(UV),$(LOWEST_VENV)/bin/uv) pip install --quiet --python $(LOWEST_VENV)/bin/python
$(LOWEST_READY): pyproject.toml constraints.txt
	$(PYTHON) -m venv --clear $(LOWEST_VENV)
	$(if $(UV),,$(call install_in,$(LOWEST_VENV)) uv)
	$(LOWEST_UV) $(LOWEST_TORCH)
	$(LOWEST_UV) --resolution lowest-direct --only-binary :all: --no-binary mo-deepdrive \
		--editable ".[train,wandb,sweep,momaland,minari]"
	$(LOWEST_UV) --constraint constraints.txt pytest hypothesis
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

test: lint tests

tests: $(READY)
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

# Compiles the kernels for a GPU, on a machine that may have none.
test-cuda: $(READY)
	$(VENV)/bin/python -m pytest tests/cuda --numprocesses 2 --dist worksteal

# What needs a GPU: the trajectories of its worlds are those of the CPU, and what is trained there.
test-gpu: $(READY)
	$(VENV)/bin/python -c "import sys, torch; torch.cuda.is_available() or sys.exit('PyTorch finds no CUDA device')"
	$(VENV)/bin/python -m pytest tests/mo_deepdrive tests/algorithms -m gpu

# Builds sdist and wheel, installs the wheel in a new environment, and runs every command there, outside the checkout.
test-install: $(READY)
	$(VENV)/bin/python -m pytest tests/install

# With the lowest versions: environments and their APIs, short training with each algorithm, evaluation, checkpoints, a
# table. Versions of Numba do not share a cache.
LOWEST_TESTS = $(addprefix tests/,mo_deepdrive/envs mo_deepdrive/evaluation algorithms/test_agent.py algorithms/test_pcn.py \
	algorithms/test_mocac.py algorithms/test_mappo.py algorithms/test_conditioned_mo_ppo.py \
	algorithms/learning/test_checkpoints.py scripts/test_keys.py \
	algorithms/runs/test_loggers.py mo_deepdrive/test_utilities.py scripts/test_table.py)
test-lowest: $(LOWEST_READY)
	NUMBA_CACHE_DIR=$(abspath $(LOWEST_VENV))/numba $(LOWEST_VENV)/bin/python -m pytest $(LOWEST_TESTS) \
		-m "not slow and not processes" --hypothesis-profile fast

test-ray: $(RAY_READY)
	$(RAY_VENV)/bin/python -m pytest tests/ray

test-peers: $(PEERS_READY)
	$(PEERS_VENV)/bin/python -m pytest tests/peers tests/mo_deepdrive/test_wrappers.py

# Other libraries on our environments, and the examples of docs/use_with.md that need one.
test-integrations: $(INTEGRATIONS_READY)
	$(INTEGRATIONS_VENV)/bin/python -m pytest tests/integrations --numprocesses 2 --dist worksteal
	$(INTEGRATIONS_VENV)/bin/python -m pytest tests/test_documentation.py -k 'example_runs and use_with'

# Which small changes of the last commit the tests notice: the sample of docs/results/mutants.csv, or with SAMPLE= all
# mutants of the groups in MUTANTS. Each group has a clone of its own, so `make --jobs 2 mutants` uses two cores.
SAMPLE = 1
MUTANTS = advantages pareto scenarios simulation sweeps
mutants: $(MUTANTS:%=mutants-%)
	$(if $(SAMPLE),$(MUTANTS_VENV)/bin/python -m tests.mutation.sample record $(MUTANTS:%=$(MUTANTS_VENV)/%.sqlite))

mutants-%: $(MUTANTS_READY)
	rm -rf $(MUTANTS_VENV)/clone-$* $(MUTANTS_VENV)/$*.sqlite
	git clone --quiet . $(MUTANTS_VENV)/clone-$*
	cd $(MUTANTS_VENV)/clone-$* && export PYTHONPATH="$$PWD" PATH="$(abspath $(MUTANTS_VENV))/bin:$$PATH" && \
		cosmic-ray init tests/mutation/$*.toml ../$*.sqlite && \
		cr-filter-operators ../$*.sqlite tests/mutation/operators.toml && \
		$(if $(SAMPLE),python -m tests.mutation.sample keep ../$*.sqlite &&) \
		cosmic-ray baseline tests/mutation/$*.toml && \
		cosmic-ray exec tests/mutation/$*.toml ../$*.sqlite

benchmark: $(READY)
	$(VENV)/bin/python scripts/benchmark.py

# The documentation site, in docs/_build/html, with the tutorials run. Warnings and broken local links are errors.
docs: $(DOCS_READY)
	$(SPHINX) -b html -d docs/_build/doctrees docs docs/_build/html

# Links to other sites; needs the internet. Links within the site are checked by `make docs`.
linkcheck: $(DOCS_READY)
	$(SPHINX) -b linkcheck -d docs/_build/doctrees docs docs/_build/linkcheck

# What the page ships with: worlds as WebAssembly, policies, and what others have earned. It needs wasm-ld (Debian's lld).
page-data: $(READY)
	$(VENV)/bin/python scripts/page_data.py

clean:
	rm -rf $(VENV) $(RAY_VENV) $(PEERS_VENV) $(INTEGRATIONS_VENV) $(MUTANTS_VENV) $(DOCS_VENV) $(LOWEST_VENV) \
		docs/_build docs/_static/explore_*.html \
		.mypy_cache .ruff_cache .pytest_cache
