# Two commands from a fresh clone: `make demo` and `make test`. Both set up .venv by themselves.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
STAMP  := $(VENV)/.installed
DEMO   := $(VENV)/.installed-demo
INSTALL = $(BIN)/pip install --quiet --disable-pip-version-check --constraint .ci/constraints.txt --editable
export XLA_PYTHON_CLIENT_PREALLOCATE ?= false

.PHONY: demo test test-slow doors reproduce arena docs lint setup tunnels clean help

help:            ## this list
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## */\t/' | expand -t 16

demo: $(DEMO)    ## survey -> bag -> scene -> training -> out/demo/report.html; about 2 minutes on 2 cores after set-up
	$(BIN)/python -m benchmarks.demo --out out/demo

test: lint       ## linter, type checker, and every test that is not marked slow
	$(BIN)/python -m pytest --numprocesses 2 --dist worksteal

test-slow: $(STAMP)  ## the tests that take minutes
	XLA_FLAGS= $(BIN)/python -m pytest -m slow

doors: $(STAMP)    ## modes of JAX, adapters, policies and training; a part of the tests
	$(BIN)/python -m pytest -m 'door and not slow'

AGAIN := out/reproduce
reproduce: $(STAMP)  ## speed, dirty clouds and cells of the board again, on a CPU in about 10 minutes; says what differs from the records
	$(BIN)/python -m benchmarks.throughput --n 1 1024 --peers none --poses 200000 --out $(AGAIN)/speed
	test ! -e $(SHARED)/data/dirty_clouds || $(BIN)/python -m benchmarks.dirty $(SHARED)/data/dirty_clouds --out $(AGAIN)/dirty
	$(BIN)/python -m benchmarks.board --tasks StopAt --start given --splits test-unseen --agents dead-reckoning fused scan-matching --out $(AGAIN)/board
	$(BIN)/python -m benchmarks.records compare $(AGAIN)/*/records.json

arena: $(STAMP)    ## eighteen drives for SLAM programs into out/arena, 5 minutes and 3.3 GB; goes on where it stopped
	$(BIN)/python -m benchmarks.slam arena --jobs 2 --out out/arena

docs: $(STAMP)   ## the documentation into build/site, its tables checked against the records, warnings as errors
	$(BIN)/python -m benchmarks.records check
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict

lint: $(STAMP)   ## ruff and mypy
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

setup: $(STAMP)  ## .venv with everything in it

$(VENV)/bin/python:
	@command -v $(PYTHON) >/dev/null || { echo "error: $(PYTHON) is missing; install Python 3.11 or newer, or run make PYTHON=..."; exit 2; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "error: $(PYTHON) is $$($(PYTHON) -V); Python 3.11 or newer is needed, run make PYTHON=..."; exit 2; }
	@$(PYTHON) -c 'import venv, ensurepip' 2>/dev/null || { echo "error: $(PYTHON) lacks venv; on Debian or Ubuntu: apt-get install python3-venv"; exit 2; }
	@$(PYTHON) -m venv $(VENV)

$(DEMO): pyproject.toml | $(VENV)/bin/python
	@$(INSTALL) '.[demo]'
	@touch $@

$(STAMP): pyproject.toml | $(VENV)/bin/python
	@$(INSTALL) '.[dev]'
	@touch $(DEMO) $@

SHARED ?= ../shared
tunnels: $(STAMP)  ## build the packaged tunnels anew, about 15 minutes on 2 idle cores; SHARED names the folder that holds data/metro_asbuilt
	$(BIN)/python -m scene.survey --truth metro --length 351 --seed 0 --sensors avia os1 --scan-every 10 --out build/survey-351
	$(BIN)/python -m scene.build build/survey-351/survey.bag --trajectory build/survey-351/groundtruth.tum \
		--provenance simulated --name subterra-351 --date $$(date +%F) --out build/subterra-351
	$(BIN)/python -m scene.build $(SHARED)/data/metro_asbuilt --name metro --date $$(date +%F) --track standard --lining standard \
		--reconstruct.lining.kind universal --reconstruct.lining.seed 0 --out build/metro
	for name in subterra-351 metro; do \
		cp build/$$name/tunnel.npz subterra_jax/data/$$name.npz; \
		cp build/$$name/manifest.json subterra_jax/data/$$name.json; \
	done

clean:           ## remove what was built
	rm -rf $(VENV) build dist out *.egg-info
