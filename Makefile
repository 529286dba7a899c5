# make demo | tradeoff | test | lint | bench | numerics | hard-cases | recipes | faults | fuzz | clean. Each sets up what
# it needs in .venv.
PYTHON ?= python3
VENV ?= .venv
BIN = $(VENV)/bin

.PHONY: demo tradeoff test lint bench numerics hard-cases recipes faults fuzz clean

$(VENV)/.base: pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --upgrade pip
	$(BIN)/pip install --quiet --editable .
	touch $@

$(VENV)/.test: $(VENV)/.base
	$(BIN)/pip install --quiet --editable '.[test]'
	touch $@

$(VENV)/.lint: $(VENV)/.test
	$(BIN)/pip install --quiet --editable '.[lint]'
	touch $@

$(VENV)/.bench: $(VENV)/.base
	$(BIN)/pip install --quiet --editable '.[bench]'
	touch $@

demo: $(VENV)/.base  ## the main job on a built-in scene; leaves demo/index.html
	$(MAKE) --no-print-directory -C recipes/demo RELIGHTCLI=$(abspath $(BIN))/relightcli PYTHON=$(abspath $(BIN))/python OUT=$(abspath demo)

tradeoff: $(VENV)/.base  ## what accuracy costs on the built-in scene; leaves tradeoff/report/index.html
	$(MAKE) --no-print-directory -C recipes/tradeoff RELIGHTCLI=$(abspath $(BIN))/relightcli PYTHON=$(abspath $(BIN))/python OUT=$(abspath tradeoff)

test: $(VENV)/.test
	$(BIN)/python -m pytest -q -n auto --dist worksteal --durations 25

lint: $(VENV)/.lint
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

bench: $(VENV)/.bench
	$(BIN)/python -m benchmarks

numerics: $(VENV)/.test  ## the digits that every numerical kernel loses, as a table; leaves build/numerics.json
	$(BIN)/python -m benchmarks.numerics

hard-cases: $(VENV)/.test  ## the hard cases with their figures, into docs/hard-cases.md
	$(BIN)/python -m tests.hard.document

recipes: $(VENV)/.base  ## every recipe end to end; each ends in a check
	for r in recipes/*/Makefile; do \
	  $(MAKE) --no-print-directory -C $$(dirname $$r) RELIGHTCLI=$(abspath $(BIN))/relightcli PYTHON=$(abspath $(BIN))/python OUT=$(abspath build/recipes)/$$(basename $$(dirname $$r)) || exit 1; \
	done

SEED ?= 0
KILLS ?= 500
CORRUPTIONS ?= 500
OTHERS ?= 250
MINUTES ?= 10

faults: $(VENV)/.test  ## every command killed, starved and damaged; goes on where it stopped
	$(BIN)/python -m tests.faults.campaign --kills $(KILLS) --corruptions $(CORRUPTIONS) --others $(OTHERS) --seed $(SEED) --results build/faults/seed-$(SEED).jsonl

fuzz: $(VENV)/.test  ## files of strangers: every parser on mutated files
	$(BIN)/python -m tests.faults.fuzz --minutes $(MINUTES) --seed $(SEED) --results build/fuzz.json

clean:
	rm -rf $(VENV) demo tradeoff build
	find relightcli -name '*.nb[ic]' -delete  # compiled loops: a change in another file does not renew them
