# Everything works from a fresh clone: the virtual environment is made on first use.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
MUTATION := .venv-mutation
MUTATION_STAMP := $(MUTATION)/.installed
BENCH := results/bench

.DEFAULT_GOAL := help
.PHONY: help install demo accept test test-ray test-board lint format bench \
	recording mutate lock clean

help:  ## this list
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 14

$(STAMP): pyproject.toml requirements/workstation.txt
	@$(PYTHON) -c 'import sys; assert sys.version_info[:2] >= (3, 11)' 2>/dev/null || \
		{ echo "make: Python 3.11 or newer is needed; name it with PYTHON=/path/to/python" >&2; exit 2; }
	@echo "make: installs what requirements/workstation.txt locks into $(VENV): 2.7 GB, about two minutes" >&2
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install $$(test -t 2 || echo --quiet) --constraint requirements/workstation.txt --editable '.[dev]'
	@touch $@

install: $(STAMP)  ## the virtual environment with the locked dependencies

demo: $(STAMP)  ## train with a human's guidance, export, and drive through a separate edge runtime
	$(BIN)/python -m hil_tests demo

# Tests often wait for processes, so that two cores serve four workers. A test's networks are small:
# where each process computes with all cores, threads only wait for each other. And each process
# would compile all modules anew where the environment forbids to keep them.
test: $(STAMP)  ## with real processes and real Zenoh sessions; all but Ray's and the board's
	OMP_NUM_THREADS=1 PYTHONDONTWRITEBYTECODE= $(BIN)/python -m pytest -n 4 --dist loadfile --no-loadscope-reorder

test-ray: $(STAMP)  ## experiments on a local Ray cluster of several nodes
	$(BIN)/python -m pip install --quiet --constraint requirements/workstation.txt --editable '.[ray]'
	$(BIN)/python -m pytest -m ray trainer

test-board: $(STAMP)  ## whole bundles installed, with every fault, and the tutorials that train; minutes, root
	$(BIN)/python -m pytest -m board

lint: $(STAMP)  ## ruff, mypy, and what the board's Python 3.8 would refuse
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy edge_runtime bridge trainer deploy hil_tests
	$(BIN)/vermin --quiet --no-tips --violations -t=3.8- --exclude tomllib edge_runtime deploy/installer

format: $(STAMP)  ## mend what ruff can
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bench: $(STAMP)  ## speed of learner, environments and training, as JSON in results/bench
	for threads in 1 2; do \
		$(BIN)/python -m trainer bench --threads $$threads --out $(BENCH)/threads_$$threads.json || exit; \
	done

# One call for each policy; after ^C it goes on.
ACCEPT := $(BIN)/python -m hil_tests accept --public-key results/policies/policy.pub \
	--vehicle mock --link 50ms+-10ms,loss=1%
accept: $(STAMP)  ## may the shipped policies drive? a page for each in runs/accept
	$(ACCEPT) --policy results/policies/left_turn.onnx --env left_turn \
		--config hil_tests/recordings/accept.toml --out runs/accept/left_turn
	$(ACCEPT) --policy results/policies/congestion.onnx --env congestion --out runs/accept/congestion

recording: $(STAMP)  ## drive and record anew what the next release is replayed against
	$(BIN)/python hil_tests/tests/make_recording.py

$(MUTATION_STAMP): requirements/mutation.txt
	$(PYTHON) -m venv $(MUTATION)
	$(MUTATION)/bin/python -m pip install --quiet --requirement requirements/mutation.txt
	$(MUTATION)/bin/python -m pip install --quiet --no-deps --editable .
	@touch $@

# On a copy: a run that is killed must change no source.
mutate: $(MUTATION_STAMP)  ## change the safety core in every small way, and show what no test notices
	rm -rf build/mutation && mkdir -p build/mutation && cp -r edge_runtime hil_tests build/mutation
	export PATH="$(CURDIR)/$(MUTATION)/bin:$$PATH" && cd build/mutation && for part in core hunter; do \
		configuration=hil_tests/mutation/$$part.toml && cosmic-ray init $$configuration $$part.sqlite && \
		cr-filter-operators $$part.sqlite $$configuration && cosmic-ray baseline $$configuration && \
		cosmic-ray exec $$configuration $$part.sqlite && \
		cr-report --surviving-only --show-diff $$part.sqlite || exit; \
	done

lock: $(STAMP)  ## rewrite the lock from what is installed
	$(BIN)/python -m pip freeze --exclude-editable | sed 's/^\(torch==[^+]*\)+.*/\1/' > requirements/workstation.txt.new
	mv requirements/workstation.txt.new requirements/workstation.txt

clean:  ## remove caches and the virtual environments; trained runs stay
	rm -rf $(VENV) $(MUTATION) build *.egg-info edge_runtime/build edge_runtime/*.egg-info .mypy_cache .ruff_cache .pytest_cache
