# noack: `make demo` and `make test` need nothing but Python >= 3.11; `make help` explains the rest.

.DEFAULT_GOAL := help
SHELL := /bin/bash

PYTHON ?= $(shell for p in python3 python3.14 python3.13 python3.12 python3.11; do \
	$$p -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && echo $$p && break; done)
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes
# Says what is being done, and every 8 s that it goes on; with --late only then.
SAY := $(BIN)/python tools/with_progress.py
EDITABLE := $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e netem -e .

SCENARIO ?= scenarios/lane_following.toml
CAMPAIGN ?= mb_vs_zoh
SETTLING ?= 14
SESSION ?= default
RUNS ?=
MINUTES ?= 10
N ?= 1000000
ARGS ?=
LIVE ?=
SETTABLE := PYTHON VENV CC SCENARIO CAMPAIGN SETTLING SESSION RUNS MINUTES N ARGS LIVE
UNKNOWN := $(foreach v,$(filter-out $(SETTABLE) SHELL MAKE% -%,$(.VARIABLES)),$(if $(filter command,$(origin $v)),$v))
$(if $(strip $(UNKNOWN)),$(error no such variable: $(strip $(UNKNOWN)); there are $(SETTABLE)))
C_FILES := $(wildcard native/*/*.[ch] extensions/*/*/*.c)
EXTENSIONS := $(patsubst %/pyproject.toml,%,$(wildcard extensions/*/pyproject.toml))
GIVEN_DRAWS := $(strip $(if $(filter file,$(origin N)),,--number $(N)) $(if $(filter file,$(origin MINUTES)),,--minutes $(MINUTES)))
override FLAGS := $(if $(filter-out 0 no,$(LIVE)),--live) $(ARGS)

.PHONY: help
help: ## List the targets
	@awk 'BEGIN {FS = ":.*## "} /^##@/ {printf "\n%s\n", substr($$0, 5)} \
		/^[a-z-]+:.*## / {printf "  make %-12s %s\n", $$1, $$2}' $(MAKEFILE_LIST)
	@printf '\nVariables: SCENARIO=NAME or FILE  CAMPAIGN=NAME or FILE  LIVE=1 (live viewer)  ARGS="--set speed=2"  SESSION=NAME\n'

##@ Run
.PHONY: lab doctor demo demo-zoh run simulate view summary replay compare report certify adversary campaign design
lab: setup $(VENV)/.installed-lab ## Open the lab page: drag settings, see the loop change, run it live
	@$(BIN)/noack lab "$(SCENARIO)" $(ARGS)

doctor: setup ## Check this machine for SCENARIO: real-time settings, timers, ports, disk
	@$(BIN)/noack doctor "$(SCENARIO)" $(ARGS)

demo: setup ## Run the paper's lane-following example live (20 s)
	@$(BIN)/noack demo $(FLAGS)

demo-zoh: setup ## The same with a zero-order hold instead of a model
	@$(BIN)/noack demo --zoh $(FLAGS)

run: setup ## Run SCENARIO live
	@$(BIN)/noack run "$(SCENARIO)" $(FLAGS)

simulate: setup ## Run SCENARIO in virtual time (some seconds)
	@$(BIN)/noack simulate "$(SCENARIO)" $(ARGS)

view: setup ## Show the last run in the rerun viewer
	@$(BIN)/noack view $(ARGS)

summary: setup ## Show the last run's summary
	@$(BIN)/noack summary $(ARGS)

replay: setup ## Replay the last run's inputs; compare the outputs bit for bit
	@$(BIN)/noack replay $(ARGS)

compare: setup ## Compare RUNS="runs/A runs/B": key numbers, and curves overlaid
	@$(BIN)/noack compare $(RUNS) $(ARGS)

report: setup ## Print the path of the last run's report (a page with all figures)
	@$(BIN)/noack report $(ARGS)

certify: setup ## Compute the guaranteed bounds of SCENARIO and their conditions
	@$(BIN)/noack certify "$(SCENARIO)" $(ARGS)

adversary: setup ## Search for the worst losses that SCENARIO's network may cause
	@$(BIN)/noack adversary "$(SCENARIO)" $(ARGS)

campaign: setup ## Run CAMPAIGN: many random draws over a grid of settings
	@$(BIN)/noack campaign "$(CAMPAIGN)" $(ARGS)

design: setup ## Choose SCENARIO's trigger: fewest transmissions, settled within SETTLING seconds
	@$(BIN)/noack design "$(SCENARIO)" --settling $(SETTLING) $(ARGS)

##@ One terminal per process (start `make record` first, then the others in any order)
.PHONY: record plant sensor controller netem
record: setup ## Open a run of SCENARIO and record it
	@$(BIN)/noack record "$(SCENARIO)" --session $(SESSION) $(FLAGS)

plant: setup ## The plant: integrates the state x
	@$(BIN)/noack plant --session $(SESSION) $(ARGS)

sensor: setup ## The sensor: model x_s and trigger
	@$(BIN)/noack sensor --session $(SESSION) $(ARGS)

controller: setup ## The controller: model x_c, input u = K x_c
	@$(BIN)/noack controller --session $(SESSION) $(ARGS)

netem: setup ## The network: loses at most mansd packets in a row
	@$(BIN)/noack netem --session $(SESSION) $(ARGS)

##@ Work on noack
.PHONY: setup setup-dev test test-system test-deep witnesses proofs fuzz attack soak check format bench screenshots schema docs docs-serve lock dist clean
setup: $(VENV)/.installed ## Create the environment in .venv (the other targets do this if needed)

setup-dev: $(VENV)/.installed-dev

# The levels are in tests/README.md. The extensions' tests are a process of their own: noack finds kinds of
# scenarios in packages when it is imported, and the core is tested without them.
PYTEST := $(BIN)/python -m pytest
OF_EXTENSIONS := extensions --override-ini=cache_dir=.pytest_cache/extensions
AT_ONCE := --numprocesses=$(shell nproc 2>/dev/null || echo 2) --dist=loadscope
# $(call LEVEL,MARKERS): tests at once on all processors, then live tests one by one, with nothing beside them.
# Exit status 5 of pytest: no test has these markers.
define LEVEL
	@trap 'exit 130' INT; failed=0; run() { $(PYTEST) "$$@" || [ $$? = 5 ] || failed=1; }; \
	run -m "($(1)) and not live" $(AT_ONCE); \
	run $(OF_EXTENSIONS) -m "($(1)) and not live" $(AT_ONCE); \
	run -m "($(1)) and live" tests/integration; \
	run $(OF_EXTENSIONS) -m "($(1)) and live"; \
	exit $$failed
endef

test: setup-dev ## Run the tests: 6 minutes on two processors (ARGS are pytest's, e.g. ARGS="-k mansd")
	$(if $(ARGS),$(PYTEST) -m "not system and not deep" $(ARGS),$(call LEVEL,not system and not deep))

test-system: setup-dev ## Test what needs a browser, root or another build, and what the documentation shows: 4 minutes
	$(if $(ARGS),$(PYTEST) -m system $(ARGS),$(call LEVEL,system and not deep))

test-deep: setup-dev ## Masses of random inputs, long searches, an hour of fuzz and one of soak; MINUTES=5 for less
	$(call LEVEL,deep)
	$(PYTEST) tests/fuzz --hypothesis-profile search $(AT_ONCE)
	$(MAKE) --no-print-directory fuzz soak MINUTES=$(if $(filter file,$(origin MINUTES)),60,$(MINUTES))

proofs: setup ## Search the proofs of the shipped scenarios again; fail if a bound grew by more than 3 % (an hour)
	$(BIN)/python tools/write_proofs.py $(ARGS)

witnesses: setup-dev ## Search the tests' witnesses again; fail if a bound grew by more than 3 %
	$(BIN)/python -m tests.checker.write_witnesses $(ARGS)

# With ARGS only the parsers, with N or MINUTES only whole scenarios.
fuzz: setup-dev ## New inputs for every parser, and random whole scenarios: N=2000 of them, or for MINUTES=60
	$(if $(GIVEN_DRAWS),,$(BIN)/python -m pytest tests/fuzz --hypothesis-profile search --numprocesses=2 $(ARGS))
	$(if $(ARGS),,$(BIN)/python -m tests.fuzz.scenarios --seed $$(date +%s) $(GIVEN_DRAWS))

attack: setup-dev ## Send N=1000000 hostile datagrams to each port of a run (5 minutes)
	$(BIN)/python -m tests.attacks --number $(N) $(ARGS)

soak: setup-dev ## Soak test: one hour, then a simulated day at speed 48; MINUTES=5 for a short test
	$(BIN)/python -m benchmarks soak $(if $(filter file,$(origin MINUTES)),,--set minutes=$(MINUTES)) $(ARGS)

check: setup-dev ## Lint, format, strict types, import rules; the core in C without a warning
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(SAY) --late "checking types" $(BIN)/mypy
	$(SAY) --late "checking imports" $(BIN)/lint-imports
	$(BIN)/clang-format --dry-run --Werror $(C_FILES)
	$(BIN)/python native/build.py --check

format: setup-dev ## Format the code
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .
	$(BIN)/clang-format -i $(C_FILES)

bench: setup-dev ## Run the benchmarks and print tables
	$(BIN)/python -m benchmarks $(ARGS)

screenshots: setup-dev ## Make docs/run.png; needs Chromium
	@$(BIN)/noack simulate lane_following --no-report
	@$(BIN)/python tools/screenshot_recording.py runs/latest/recording.rrd docs/run.png --size 1600x900

schema: export NOACK_NO_EXTENSIONS = 1
schema: setup ## Write the JSON Schemas of scenario, campaign and links files to docs/
	$(BIN)/noack schema > docs/scenario.schema.json
	$(BIN)/noack schema --campaign > docs/campaign.schema.json
	$(BIN)/noack schema --netem > docs/netem.schema.json

docs: setup-dev ## Build the documentation site into site/; a warning is an error
	$(SAY) "building the site" $(BIN)/sphinx-build -b html -E -W --keep-going --jobs auto --quiet docs site
	@echo site/index.html

docs-serve: docs ## Build the site and serve it on http://127.0.0.1:8000
	$(BIN)/python -m http.server --bind 127.0.0.1 --directory site 8000

lock: setup-dev ## Update the pinned dependencies
	$(SAY) "resolving dependencies" $(BIN)/uv pip compile -q --universal --python-version 3.11 --generate-hashes --no-emit-index-url \
		--no-header --no-emit-package noack-netem pyproject.toml --extra viewer --group build -o requirements.lock
	$(BIN)/python tools/extension_requirements.py | \
		$(SAY) "resolving dependencies" $(BIN)/uv pip compile -q --universal --python-version 3.11 --generate-hashes --no-emit-index-url \
		--no-header --no-emit-package noack-netem pyproject.toml - --extra viewer --group build --group dev --group docs -c requirements.lock -o requirements-dev.lock
	$(BIN)/python tools/extension_requirements.py noack-lab | \
		$(SAY) "resolving dependencies" $(BIN)/uv pip compile -q --universal --python-version 3.11 --generate-hashes --no-emit-index-url \
		--no-header --no-emit-package noack-netem pyproject.toml - --extra viewer -c requirements-dev.lock -o requirements-lab.lock
	$(SAY) "resolving dependencies" $(BIN)/uv pip compile -q --universal --python-version 3.11 --generate-hashes --no-emit-index-url \
		--no-header --group compiler -o requirements-compiler.lock

dist: setup-dev ## Build the sdists, and from them the wheels, into dist/
	@rm -rf dist
	@$(SAY) "installing the compiler for all platforms" $(PIP) -r requirements-compiler.lock
	@$(SAY) "building noack's sdist" $(BIN)/uv build --quiet --sdist --no-build-isolation --out-dir dist .
	@$(SAY) "building noack-netem's sdist" $(BIN)/uv build --quiet --sdist --no-build-isolation --out-dir dist netem
	@set -- $$($(BIN)/python native/build.py --platforms); number=0; \
	for platform; do number=$$((number + 1)); for sdist in dist/*.tar.gz; do \
		NOACK_PLATFORM=$$platform $(SAY) "building a wheel of $$sdist, $$number of $$#, for $$platform" \
			$(BIN)/uv build --quiet --wheel --no-build-isolation --out-dir dist $$sdist || exit; done; done
	@ls -s --block-size=K dist/*

clean: ## Remove the environment and caches, not runs/
	rm -rf $(VENV) site .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache \
		{netem/core/libnetem,noack/core/libnoack}.so {netem,noack}/core/_core_header.py

$(VENV)/bin/python:
	@test -n "$(PYTHON)" || { echo "noack needs Python >= 3.11; none found (set PYTHON=...)" >&2; exit 2; }
	@$(PYTHON) tools/with_progress.py "making $(VENV) with $(PYTHON)" $(PYTHON) -m venv $(VENV) || { rm -rf $(VENV); \
		echo "noack needs Python's venv module (Debian: apt-get install python3-venv)" >&2; exit 2; }

# It builds if a source has changed, else it does nothing. Exit status 3: there is no C compiler.
define BUILD_CORE
	$(SAY) --late "building the core" $(BIN)/python native/build.py $(1) || { status=$$?; [ $$status = 3 ] || exit $$status; \
		$(SAY) "no C compiler here: installing ziglang, which has one" $(PIP) --no-compile -r requirements-compiler.lock && \
		$(SAY) --late "building the core" $(BIN)/python native/build.py $(1); }
endef

$(VENV)/.dependencies: requirements.lock | $(VENV)/bin/python
	@# On another core meanwhile the libraries in C; the target core reports what fails of it.
	@# pip would compile the modules on one core. Nobody runs the packages' own tests.
	@{ $(call BUILD_CORE,--library-alone); } 2> /dev/null & \
		$(SAY) "installing pinned dependencies" $(PIP) --no-compile -r requirements.lock && \
		{ $(SAY) "compiling their modules" $(BIN)/python -m compileall -q -q -j 0 -x '/tests/' $(VENV)/lib || true; }; \
		status=$$?; wait; exit $$status
	@touch $@

.PHONY: core
core: $(VENV)/.dependencies
	@$(BUILD_CORE)

$(VENV)/.installed: $(VENV)/.dependencies pyproject.toml netem/pyproject.toml | core
	@$(SAY) --late "installing noack" $(EDITABLE)
	@# Else each process compiles its modules anew where PYTHONDONTWRITEBYTECODE is set.
	@$(SAY) --late "compiling modules" $(BIN)/python -m compileall -q -j 0 noack netem cosim plant_server sensor_node controller_node
	@touch $@

$(VENV)/.installed-lab: requirements-lab.lock $(VENV)/.installed
	@$(SAY) "installing the lab page" $(PIP) -r requirements-lab.lock
	@$(SAY) --late "installing the lab page" $(EDITABLE) -e extensions/noack-lab
	@touch $@

$(VENV)/.installed-dev: requirements-dev.lock $(EXTENSIONS:=/pyproject.toml) $(VENV)/.installed
	@# A tool's modules are compiled when it first runs: most never are.
	@$(SAY) "installing development tools" $(PIP) --no-compile -r requirements-dev.lock
	@$(SAY) "installing the extensions" $(EDITABLE) $(addprefix -e ,$(EXTENSIONS))
	@touch $@
