# noack: `make demo` and `make test` need nothing but Python >= 3.11; `make help` explains the rest.

.DEFAULT_GOAL := help
SHELL := /bin/bash

PYTHON ?= $(shell for p in python3 python3.14 python3.13 python3.12 python3.11; do \
	$$p -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && echo $$p && break; done)
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes
EDITABLE := $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .

SCENARIO ?= scenarios/lane_following.toml
CAMPAIGN ?= mb_vs_zoh
SETTLING ?= 14
SESSION ?= default
RUNS ?=
MINUTES ?= 10
N ?= 1000000
ARGS ?=
LIVE ?=
override FLAGS := $(if $(filter-out 0 no,$(LIVE)),--live) $(ARGS)

.PHONY: help
help: ## Explain the targets
	@awk 'BEGIN {FS = ":.*## "} /^##@/ {printf "\n%s\n", substr($$0, 5)} \
		/^[a-z-]+:.*## / {printf "  make %-12s %s\n", $$1, $$2}' $(MAKEFILE_LIST)
	@printf '\nVariables: SCENARIO=FILE  CAMPAIGN=NAME  LIVE=1 (show it live)  ARGS="--set speed=2"  SESSION=NAME\n'

##@ Run
.PHONY: doctor demo demo-zoh run simulate view summary replay fidelity compare report certify adversary paper campaign design
doctor: setup ## Say what this machine grants, and what that means for a run of SCENARIO
	@$(BIN)/noack doctor "$(SCENARIO)" $(ARGS)

demo: setup ## Run the paper's lane-following example live (20 s)
	@$(BIN)/noack demo $(FLAGS)

demo-zoh: setup ## The same with zero-order hold instead of a model
	@$(BIN)/noack demo --zoh $(FLAGS)

run: setup ## Run SCENARIO=FILE, all processes at once
	@$(BIN)/noack run "$(SCENARIO)" $(FLAGS)

simulate: setup ## Run SCENARIO=FILE in virtual time (a second or so)
	@$(BIN)/noack simulate "$(SCENARIO)" $(ARGS)

view: setup ## Open the last recording in the rerun viewer
	@$(BIN)/noack view $(ARGS)

summary: setup ## Show the last run's summary again
	@$(BIN)/noack summary $(ARGS)

replay: setup ## Feed the last run's machines their inputs again; compare bit for bit
	@$(BIN)/noack replay $(ARGS)

fidelity: setup ## Compare the last run with the ideal loop, effect by effect
	@$(BIN)/noack fidelity $(ARGS)

compare: setup ## Compare RUNS="runs/A runs/B": numbers side by side, curves overlaid
	@$(BIN)/noack compare $(RUNS) $(ARGS)

report: setup ## Write the last run's report anew, a page with all figures; print its path
	@$(BIN)/noack report $(ARGS)

certify: setup ## Say what is guaranteed of SCENARIO, under which conditions
	@$(BIN)/noack certify "$(SCENARIO)" $(ARGS)

adversary: setup ## Search the worst losses that SCENARIO's network may make
	@$(BIN)/noack adversary "$(SCENARIO)" $(ARGS)

paper: setup ## Reproduce the paper's Section V over 1,000 draws into docs/ (3 minutes)
	@$(BIN)/noack paper --out docs $(ARGS)

campaign: setup ## Run CAMPAIGN=NAME or FILE: many runs over a grid of settings, with figures
	@$(BIN)/noack campaign "$(CAMPAIGN)" $(ARGS)

design: setup ## Choose SCENARIO's trigger for the fewest transmissions; SETTLING=SECONDS
	@$(BIN)/noack design "$(SCENARIO)" --settling $(SETTLING) $(ARGS)

##@ Five terminals, one process each (start `make record` in one, the others in any order)
.PHONY: record plant sensor controller netem
record: setup ## Open a run of SCENARIO and record it
	@$(BIN)/noack record "$(SCENARIO)" --session $(SESSION) $(FLAGS)

plant: setup ## The plant: owns the true state x
	@$(BIN)/noack plant --session $(SESSION) $(ARGS)

sensor: setup ## The sensor: owns the model x_s and the trigger
	@$(BIN)/noack sensor --session $(SESSION) $(ARGS)

controller: setup ## The controller: owns the model x_c, sends u = K x_c
	@$(BIN)/noack controller --session $(SESSION) $(ARGS)

netem: setup ## The network: loses packets, at most M - 1 in a row
	@$(BIN)/noack netem --session $(SESSION) $(ARGS)

##@ Work on noack
.PHONY: setup setup-dev test pytest fuzz attack soak check format bench screenshots schema docs docs-serve lock dist clean
setup: $(VENV)/.installed $(if $(filter setup,$(MAKECMDGOALS)),$(VENV)/.compiled) ## Make the environment in .venv (the other targets do it by themselves)

setup-dev: $(VENV)/.installed-dev

test: check pytest ## Lint, types, import rules, and all tests (ARGS are pytest's, e.g. ARGS="-k mansd")

pytest: setup-dev
	$(BIN)/python -m pytest $(or $(ARGS),--numprocesses=3 --dist=loadfile)

fuzz: setup-dev ## Fuzz every parser, MINUTES=10 in all; exit status 1 if something is found
	$(BIN)/python -m tests.fuzz run --minutes $(MINUTES) $(ARGS)

attack: setup-dev ## Send N=1000000 hostile datagrams to each port of a run (5 minutes); 1 if any gets in
	$(BIN)/python -m tests.attacks --number $(N) $(ARGS)

soak: setup-dev ## Watch a run for an hour, then a day at speed 48; MINUTES=5 is a short one
	$(BIN)/python -m benchmarks.soak $(if $(filter file,$(origin MINUTES)),,--minutes $(MINUTES)) $(ARGS)

check: setup-dev ## Lint, format, strict types, import rules
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

format: setup-dev ## Format the code
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bench: setup-dev ## Measure against the alternatives, in one run; prints tables
	$(BIN)/python -m benchmarks $(ARGS)

screenshots: setup ## Make docs/run.png, light as the page it is on; needs Chromium
	@$(BIN)/noack simulate lane_following --no-report
	@$(BIN)/python tools/screenshot_recording.py runs/latest/recording.rrd docs/run.png --size 1600x900

schema: setup ## Write the JSON Schemas of scenario, campaign and links files to docs/
	$(BIN)/noack schema > docs/scenario.schema.json
	$(BIN)/noack schema --campaign > docs/campaign.schema.json
	$(BIN)/noack schema --netem > docs/netem.schema.json

docs: setup-dev ## Build the documentation site into site/; a warning is an error
	$(BIN)/sphinx-build -b html -E -W --keep-going --jobs auto --quiet docs site
	@echo site/index.html

docs-serve: docs ## Build it, and serve it on http://127.0.0.1:8000
	$(BIN)/python -m http.server --bind 127.0.0.1 --directory site 8000

lock: setup-dev ## Pin the dependencies anew
	$(BIN)/uv pip compile -q --universal --python-version 3.11 --generate-hashes --no-emit-index-url \
		--no-header pyproject.toml --extra vehicle --group build -o requirements.lock
	$(BIN)/uv pip compile -q --universal --python-version 3.11 --generate-hashes --no-emit-index-url \
		--no-header pyproject.toml --group build --group dev --group docs -c requirements.lock -o requirements-dev.lock

dist: setup-dev ## Build the sdist, and the wheel from it, into dist/
	@rm -rf dist
	$(BIN)/uv build --quiet --no-build-isolation --out-dir dist .
	@ls dist/*

clean: ## Remove the environment and caches; keep runs/
	rm -rf $(VENV) site .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache

$(VENV)/bin/python:
	@test -n "$(PYTHON)" || { echo "noack needs Python >= 3.11; none found (set PYTHON=...)" >&2; exit 2; }
	@echo "making $(VENV) with $(PYTHON) ..."
	@$(PYTHON) -m venv $(VENV) || { rm -rf $(VENV); \
		echo "noack needs Python's venv module (Debian: apt-get install python3-venv)" >&2; exit 2; }

$(VENV)/.installed: requirements.lock pyproject.toml | $(VENV)/bin/python
	@echo "installing pinned dependencies ..."
	@$(PIP) -r requirements.lock
	@$(EDITABLE)
	@touch $@

# For `make setup` alone: a run of the loop needs none of it, and the first start would compile it, too.
COMPILED := noack/impairments/*.py noack/impairments/*/*.py netem/*.py netem/rules/*.py netem/engine/*.py netem/engine/pump/*.py netem/capture/*.py
$(VENV)/.compiled: $(VENV)/.installed $(wildcard $(COMPILED))
	@$(BIN)/noack netem --compile
	@touch $@

$(VENV)/.installed-dev: requirements-dev.lock $(VENV)/.installed
	@echo "installing development tools ..."
	@$(PIP) -r requirements-dev.lock
	@touch $@
