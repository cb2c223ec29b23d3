# Every target makes what it needs by itself: a bare machine has only Python 3.11+, make, a C compiler and a package
# index.
# Another interpreter: make env PYTHON=python3.12

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check
PACKAGES := $(VENV)/.packages
INSTALLED := $(VENV)/.installed
UV_VERSION := 0.13.9
CODE = $(wildcard src tests tools benchmarks hatch_build.py)

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help env demo test test-slow test-hardware lint format types bench bench-smoke bench-compare soak fanout fuzz faults accuracy accuracy-page peers table1 schema lock clean

help:  ## list the targets
	@awk -F ':.*## ' '/^[a-z0-9-]+:.*## / { printf "  make %-12s %s\n", $$1, $$2 }' Makefile

env: $(INSTALLED)  ## make the environment .venv from requirements/dev.lock

# Cleared first: a half-finished or older environment leaves nothing behind. The stamp is written last.
$(PACKAGES): requirements/dev.lock
	@command -v "$(PYTHON)" >/dev/null || { \
	  echo "make: there is no '$(PYTHON)': install Python 3.11 or newer, or name it: make env PYTHON=/path/to/python3.12" >&2; exit 1; }
	@"$(PYTHON)" -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	  echo "make: '$(PYTHON)' is $$("$(PYTHON)" --version 2>&1 | head -n 1); needletrack needs 3.11 or newer: name one that is installed, e.g. make env PYTHON=python3.12" >&2; exit 1; }
	@"$(PYTHON)" -c 'import ensurepip, venv' 2>/dev/null || { \
	  echo "make: '$(PYTHON)' lacks venv or ensurepip: on Debian and Ubuntu, apt-get install python3-venv" >&2; exit 1; }
	@echo "Installing the pinned packages into $(VENV) (about 200 MB to fetch, once) ..."
	@"$(PYTHON)" -m venv --clear $(VENV)
	@$(PIP) install --no-deps --require-hashes -r requirements/dev.lock >$(VENV)/install.log 2>&1 || { \
	  tail -n 40 $(VENV)/install.log >&2; echo "make: the packages could not be installed; the whole log: $(VENV)/install.log" >&2; exit 1; }
	@touch $@

# The kernels are compiled by the installation.
$(INSTALLED): $(PACKAGES) pyproject.toml hatch_build.py $(wildcard src/needletrack/kernels/*.[ch])
	@$(PIP) install --quiet --no-deps --no-build-isolation --editable .
	@touch $@

demo: $(INSTALLED)  ## track the bundled recording, watch it arrive over Zenoh, leave pictures in build/demo
	@$(BIN)/needletrack demo tests/data/recordings/steer-b --output build/demo

# As many processes as cores, one file in one of them; more than four only wait for the disk and for one another.
PARALLEL = -n logical --maxprocesses 4 --dist loadgroup

test: $(INSTALLED)  ## the quick tests, with coverage
	$(BIN)/python -m pytest -m "not slow" $(PARALLEL) --cov --cov-report=term

test-slow: $(INSTALLED)  ## the tests marked slow
	@$(BIN)/python -m pytest -m slow || { code=$$?; [ $$code -eq 5 ] && echo "No test is marked slow." || exit $$code; }

# The emulator's AVX2 is not to be trusted: NumPy's exp of float32 dies of it.
test-hardware: $(INSTALLED)  ## the tests on the kernel's test cameras, in a guest (root, Debian 12, apt)
	OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 OPENCV_FOR_THREADS_NUM=1 \
	  tests/hardware/guest.sh --loopback 2 --cpu Nehalem --timeout 1200 -- $(BIN)/python -m pytest -q -p no:cacheprovider tests/hardware

lint: $(INSTALLED)  ## ruff and hadolint
	$(BIN)/ruff check --output-format concise .
	$(BIN)/ruff format --check .
	$(BIN)/hadolint Dockerfile

format: $(INSTALLED)  ## let ruff lay out the code and mend what it can
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

types: $(INSTALLED)  ## mypy --strict
	$(BIN)/mypy --strict $(CODE)

bench: $(INSTALLED)  ## time, latency, throughput, memory, start, each beside its bar; kept in build/bench
	@$(BIN)/python -m benchmarks $(ARGS)

bench-smoke: $(INSTALLED)  ## the same on a few pairs: does the benchmark still run?
	@$(BIN)/python -m benchmarks --smoke

bench-compare: $(INSTALLED)  ## the core figures of this tree beside another commit's (make bench-compare BASE=HEAD~1)
	@test -n "$(BASE)" || { echo "make: name the commit to compare with: make bench-compare BASE=HEAD~1" >&2; exit 1; }
	@$(BIN)/python -m benchmarks.compare $(BASE) $(ARGS)

soak: $(INSTALLED)  ## ten minutes of the live loop at 60 pairs/s with a recorder (make soak ARGS="--minutes 1")
	@$(BIN)/python -m benchmarks.live $(ARGS)

fanout: $(INSTALLED)  ## what other subscribers do to a pose, on loopback and across namespaces (make fanout ARGS="--rounds 1")
	@$(BIN)/python -m benchmarks.fanout $(ARGS)

fuzz: $(INSTALLED)  ## damaged files at every parser, led by coverage, a minute each (make fuzz ARGS="--seconds 600 rig mcap")
	@$(BIN)/python -m tests.hostile.fuzz $(ARGS)

faults: $(INSTALLED)  ## inject every fault that can be, watch from another process (make faults ARGS="--update docs/reliability.md")
	@$(BIN)/python -m benchmarks.faults $(ARGS)

accuracy: $(INSTALLED)  ## errors against exact truth, beside other methods (make accuracy ARGS="--peers RECORDING ...")
	@$(BIN)/python -m benchmarks.accuracy $(ARGS)

accuracy-page: $(INSTALLED) peers  ## measure anew what docs/accuracy.md shows (a quarter of an hour)
	@$(BIN)/python -m benchmarks.accuracy --peers --update docs/accuracy.md ../shared/captures/* tests/data/recordings/*

# Other people's methods, for comparison only: in an environment of their own, and no dependency of the package.
peers: build/peers/.installed  ## make the peers' environment build/peers from requirements/peers.txt (several GB)

build/peers/.installed: requirements/peers.txt
	@"$(PYTHON)" -m venv --clear build/peers
	@build/peers/bin/python -m pip --disable-pip-version-check install --quiet -r requirements/peers.txt
	@touch $@

table1: $(INSTALLED)  ## repeat Table 1 of the 2017 paper
	@$(BIN)/needletrack table1

schema: $(INSTALLED)  ## write the wire's JSON Schema into docs/
	@$(BIN)/python -m needletrack.publish.schema docs/wire

# uv lives in an environment of its own, so that the locks can be made while .venv is missing or broken.
LOCK = build/lock/bin/uv pip compile --quiet --universal --python-version 3.11 --fork-strategy fewest \
  --generate-hashes --no-emit-index-url --no-emit-find-links --no-header $(UPGRADE)
lock: build/lock/bin/uv  ## bring the lock files up to pyproject.toml (to the newest of all: make lock UPGRADE=--upgrade)
	$(LOCK) pyproject.toml --output-file requirements/runtime.lock
	$(LOCK) --group build -c requirements/runtime.lock --output-file requirements/build.lock
	$(LOCK) pyproject.toml --group dev -c requirements/runtime.lock -c requirements/build.lock --output-file requirements/dev.lock

build/lock/bin/uv: Makefile
	@"$(PYTHON)" -m venv --clear build/lock
	@build/lock/bin/python -m pip --disable-pip-version-check install --quiet uv==$(UV_VERSION)
	@touch $@

clean:  ## remove the environment and everything generated
	rm -rf $(VENV) build dist .coverage .mypy_cache .pytest_cache .ruff_cache .hypothesis
	find src tests tools benchmarks -name __pycache__ -type d -prune -exec rm -rf {} + 2>/dev/null || true
