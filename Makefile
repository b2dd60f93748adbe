# Everything works from a fresh clone: the virtual environment is made on first use.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

.DEFAULT_GOAL := help
.PHONY: help install demo test lint format bench lock clean

help:  ## this list
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 14

$(STAMP): pyproject.toml requirements/workstation.txt
	@$(PYTHON) -c 'import sys; assert sys.version_info[:2] >= (3, 11)' 2>/dev/null || \
		{ echo "make: Python 3.11 or newer is needed; name it with PYTHON=/path/to/python" >&2; exit 2; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --constraint requirements/workstation.txt --editable '.[dev]'
	@touch $@

install: $(STAMP)  ## the virtual environment with the locked dependencies

demo: $(STAMP)  ## train with a human's guidance, export, and drive through a separate edge runtime
	$(BIN)/python -m hil_tests demo

test: $(STAMP)  ## every test, with real processes and real Zenoh sessions
	$(BIN)/python -m pytest

lint: $(STAMP)  ## ruff, mypy, and what the board's Python 3.8 would refuse
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy edge_runtime bridge trainer deploy hil_tests
	$(BIN)/vermin --quiet --no-tips --violations -t=3.8- --exclude tomllib edge_runtime

format: $(STAMP)  ## mend what ruff can
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bench: $(STAMP)  ## learner, environment and training speed as JSON
	$(BIN)/python -m trainer bench --out runs/bench.json

lock: $(STAMP)  ## rewrite the lock from what is installed
	$(BIN)/python -m pip freeze --exclude-editable | grep -v '^torch==' > requirements/workstation.txt.new
	echo 'torch==2.13.0' >> requirements/workstation.txt.new
	mv requirements/workstation.txt.new requirements/workstation.txt

clean:  ## remove caches and the virtual environment; trained runs stay
	rm -rf $(VENV) build *.egg-info edge_runtime/build edge_runtime/*.egg-info .mypy_cache .ruff_cache .pytest_cache
