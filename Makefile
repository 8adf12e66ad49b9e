# One command each: `make demo` shows what memory did, `make test` passes the tests. Every target builds .venv if it is missing.
#
#   PYTHON=python3.12 make install     another interpreter (3.11, 3.12 or 3.13)
#   make test WORKERS=4                more test processes
#   make demo ARGS="--help"            ARGS goes to the command behind demo, bench, gpu, test and test-slow
#   make install GPU=1                 JAX for an NVIDIA card too (GPU=12: for torch with CUDA 12)

PYTHON  ?= python3
WORKERS ?= 2
ARGS    ?=
GPU     ?=
DEVICE  ?= cuda
OUT     ?= build/gpu-$(DEVICE)
PAGE    ?= $(if $(filter cuda,$(DEVICE)),results,$(OUT))/gpu.md

VENV := .venv
OLDEST := .venv-oldest
NEWEST := .venv-newest
SUITES := .venv-suites
AOT := .venv-aot
OLDEST_TESTS := $(addprefix tests/,arcade_torch/test_dlpack.py arcade_torch/test_env_errors.py arcade_torch/test_env.py \
  models/test_memory_models.py agents/runs/test_checkpoint.py agents/test_runs_of_all_algorithms.py tools/test_cli.py)
NEWEST_TESTS := $(addprefix tests/,contracts agents/test_identities.py agents/test_torchrl_batches.py \
  agents/test_runs_of_all_algorithms.py models/test_memory_module.py arcade_torch/test_env.py arcade_torch/test_collector.py \
  arcade_torch/test_torchrl_pipelines.py arcade_torch/test_torchrl_gym.py arcade_torch/test_torchrl_releases.py \
  arcade_torch/test_replay_equals_rollout.py)
# The build of torch for a CPU; any other is several GB. torchrl: the newest release, or torchrl-nightly.
NEWEST_TORCH ?= torch==2.13.0
NEWEST_TORCHRL ?= torchrl-nightly
RUN  := $(VENV)/bin/python
GPU_EXTRA := $(if $(GPU),$(if $(filter 12,$(GPU)),gpu-cuda12,gpu))
GPU_PYTHON := $(if $(wildcard $(RUN)),$(RUN),$(PYTHON))
PIP  := $(RUN) -m pip install --quiet -c constraints.txt
# Two test processes share two cores: one thread each is faster than two that fight.
ONE_THREAD := OMP_NUM_THREADS=1 MKL_NUM_THREADS=1

.PHONY: help install demo test test-slow test-oldest test-newest test-suites test-triton lint bench gpu gpu-aot parity bench-parity docs clean distclean
.DELETE_ON_ERROR:

help:
	@echo "make install    build $(VENV) with the versions of constraints.txt"
	@echo "                (make install GPU=1: with JAX for an NVIDIA card, several GB; GPU=12 where torch has CUDA 12)"
	@echo "make demo       a small study of memory, ending in an HTML report"
	@echo "make test       the tests (make test-slow: the long ones)"
	@echo "                (make test-triton: the Triton kernels on the CPU; installs triton, 1 GB, into $(VENV))"
	@echo "make test-oldest  a part of the tests with the oldest supported versions, in $(OLDEST)"
	@echo "make test-newest  the contracts, the bridge, the losses and a run with the newest versions there are, in $(NEWEST)"
	@echo "                (NEWEST_TORCHRL=torchrl: its newest release in the place of its nightly build)"
	@echo "make test-suites  from_jax on gymnax and Craftax, memories of ncps, mambapy and minGRU-pytorch, scans of fla-core, in $(SUITES)"
	@echo "make lint       ruff and mypy"
	@echo "make bench      every benchmark into results/bench.json and results/bench.md, about ten minutes"
	@echo "make gpu        what needs a GPU, eight minutes a call; goes on when called again (OUT=folder for CSV and logs)"
	@echo "                (make gpu DEVICE=cpu: a rehearsal of it, five to ten minutes)"
	@echo "make gpu-aot    compiles the games for an H100 without one: kernels, bytes and an estimate into results/gpu-aot.md; 2 GB in $(AOT)"
	@echo "make parity     step by step against popgym-arcade 0.0.7, which it installs into $(VENV)"
	@echo "                (make bench-parity: the ratio of speed to it, game by game)"
	@echo "make docs       the documentation as a site in build/docs, API reference included"
	@echo "make clean      remove build output and caches (make distclean: and $(VENV))"

install: $(VENV)/.installed $(addprefix $(VENV)/.,$(GPU_EXTRA))

# The stamp is written last: an interrupted installation is taken up again, a finished one is not repeated.
$(VENV)/.installed: setup.cfg pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] < (3, 14))' || { \
	  echo "arcade-torch needs Python 3.11, 3.12 or 3.13, and '$(PYTHON)' is not one: run 'make $(MAKECMDGOALS) PYTHON=python3.12'" >&2; exit 2; }
	@echo "installing into $(VENV), a minute or more ..."
	@$(RUN) -m pip --version > /dev/null 2>&1 || $(PYTHON) -m venv $(VENV)
	$(PIP) torch==2.13.0 setuptools wheel
	$(PIP) --no-build-isolation -e '.[tools,dev]'
	@touch $@

$(VENV)/.gpu $(VENV)/.gpu-cuda12: $(VENV)/.%: $(VENV)/.installed
	$(PIP) --no-build-isolation -e '.[$*]'
	@touch $@

$(VENV)/.docs: $(VENV)/.installed
	$(PIP) --no-build-isolation -e '.[docs]'
	@touch $@

$(VENV)/.triton: $(VENV)/.installed
	$(PIP) --no-build-isolation -e '.[triton]'
	@touch $@

# Not in $(VENV): popgym-arcade brings another package of the name gymnax.
$(SUITES)/.installed: setup.cfg pyproject.toml
	@$(SUITES)/bin/python -m pip --version > /dev/null 2>&1 || $(PYTHON) -m venv $(SUITES)
	$(SUITES)/bin/python -m pip install --quiet torch==2.13.0 setuptools wheel
	$(SUITES)/bin/python -m pip install --quiet --no-build-isolation -e '.[suites]' hypothesis pytest pytest-timeout
	@touch $@

test-suites: $(SUITES)/.installed
	$(ONE_THREAD) JAX_COMPILATION_CACHE_DIR=$(SUITES)/jax-cache SUITES_ARE_THERE=1 \
	  $(SUITES)/bin/python -m pytest --timeout=3600 -k "not popgym" \
	  tests/contracts/test_jax_suites.py tests/contracts/test_memories_of_others.py $(ARGS)
	SUITES_ARE_THERE=1 $(ONE_THREAD) $(SUITES)/bin/python -m pytest \
	  tests/models -k flash_linear_attention

$(VENV)/.parity: $(VENV)/.installed
	$(PIP) --no-build-isolation -e '.[parity]'
	@touch $@

demo: install
	$(VENV)/bin/arcade-torch demo $(ARGS)

test: install
	$(ONE_THREAD) $(RUN) -m pytest -n $(WORKERS) --dist loadfile --max-worker-restart=1 $(ARGS)

test-slow: install
	$(ONE_THREAD) $(RUN) -m pytest -m slow --timeout=3600 $(ARGS)

test-triton: $(VENV)/.triton
	TRITON_INTERPRET=1 $(ONE_THREAD) $(RUN) -m pytest -m triton --timeout=3600 tests/models/test_scan_triton.py $(ARGS)

$(OLDEST)/.installed: setup.cfg pyproject.toml constraints-oldest.txt
	@$(OLDEST)/bin/python -m pip --version > /dev/null 2>&1 || $(PYTHON) -m venv $(OLDEST)
	$(OLDEST)/bin/python -m pip install --quiet -c constraints-oldest.txt torch==2.13.0 setuptools wheel
	$(OLDEST)/bin/python -m pip install --quiet -c constraints-oldest.txt --no-build-isolation -e '.[tools]' hypothesis pytest pytest-timeout
	@touch $@

test-oldest: $(OLDEST)/.installed
	$(ONE_THREAD) JAX_COMPILATION_CACHE_DIR=$(OLDEST)/jax-cache $(OLDEST)/bin/python -m pytest $(OLDEST_TESTS) $(ARGS)

# TorchRL without its dependencies: its nightly build asks for that of tensordict and would bring another torch.
$(NEWEST)/.installed: setup.cfg pyproject.toml
	@$(NEWEST)/bin/python -m pip --version > /dev/null 2>&1 || $(PYTHON) -m venv $(NEWEST)
	$(NEWEST)/bin/python -m pip install --quiet --upgrade $(NEWEST_TORCH) setuptools wheel
	$(NEWEST)/bin/python -m pip install --quiet --upgrade --no-deps $(NEWEST_TORCHRL)
	$(NEWEST)/bin/python -m pip install --quiet --upgrade $(NEWEST_TORCH) tensordict hoptorch lazy-importer cloudpickle packaging \
	  jax gymnasium stable-baselines3 numpy safetensors filelock tyro rich matplotlib jinja2 hydra-core hypothesis pytest pytest-timeout
	$(NEWEST)/bin/python -m pip install --quiet --no-build-isolation --no-deps -e .
	@touch $@

test-newest: $(NEWEST)/.installed
	@$(NEWEST)/bin/python -m pip list 2> /dev/null | grep -iE '^(torch|torchrl|tensordict|jax|jaxlib|gymnasium|numpy|stable)'
	$(ONE_THREAD) JAX_COMPILATION_CACHE_DIR=$(NEWEST)/jax-cache $(NEWEST)/bin/python -m pytest $(NEWEST_TESTS) $(ARGS)

lint: install
	$(RUN) -m ruff check .
	$(RUN) -m ruff format --check --quiet .
	$(RUN) -m mypy

bench: install
	$(VENV)/bin/arcade-torch bench all $(ARGS)

# With the interpreter at hand where there is no $(VENV): torch and JAX for a GPU are the machine's own.
gpu:
	PYTHONPATH="$(CURDIR)$${PYTHONPATH:+:$$PYTHONPATH}" $(GPU_PYTHON) -m tests.gpu.stages $(OUT) --device $(DEVICE) --page $(PAGE) $(ARGS)

# JAX of constraints.txt with its plugin for CUDA, without the libraries of a GPU; ptxas and nvdisasm come with triton.
$(AOT)/.installed: constraints.txt
	@$(AOT)/bin/python -m pip --version > /dev/null 2>&1 || $(PYTHON) -m venv $(AOT)
	@version=$$(sed -n 's/^jaxlib==//p' constraints.txt) && { \
	  $(AOT)/bin/python -m pip install --quiet -c constraints.txt jax jaxlib numpy && \
	  $(AOT)/bin/python -m pip install --quiet --no-deps jax-cuda13-plugin==$$version jax-cuda13-pjrt==$$version triton; \
	  } || { echo "gpu-aot could not install jax, jax-cuda13-plugin and jax-cuda13-pjrt $$version, and triton into $(AOT)" >&2; exit 2; }
	@touch $@

gpu-aot: $(AOT)/.installed
	$(AOT)/bin/python -m tests.gpu.aot results/gpu-aot.md $(ARGS)

parity: $(VENV)/.parity
	$(ONE_THREAD) PARITY_TABLE=results/parity.md $(RUN) -m pytest -m parity --timeout=3600 tests/parity $(ARGS)
	SUITES_ARE_THERE=1 $(ONE_THREAD) $(RUN) -m pytest tests/contracts/test_jax_suites.py -k popgym

bench-parity: $(VENV)/.parity
	$(RUN) -m tests.parity.bench $(ARGS)

docs: $(VENV)/.docs
	NO_MKDOCS_2_WARNING=1 $(ONE_THREAD) $(RUN) -m mkdocs build --strict --site-dir build/docs
	@echo "documentation: $(CURDIR)/build/docs/index.html (to search it: $(PYTHON) -m http.server -d build/docs --bind 127.0.0.1)"

clean:
	rm -rf build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -not -path './$(VENV)/*' -prune -exec rm -rf {} +

distclean: clean
	rm -rf $(VENV) $(OLDEST) $(NEWEST) $(SUITES) $(AOT)
