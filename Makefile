# `make demo` and `make test` need Python 3.11+ and make only; everything else is installed as wheels into .venv/.
PYTHON ?= python3
BIN := .venv/bin
STAMP := .venv/.installed
MINIMUM := .venv/minimum
PIP_OPTIONS := --quiet --disable-pip-version-check --only-binary=:all:
TEST_DATA := $(wildcard ../shared/data)
ifneq ($(TEST_DATA),)
export ZLOCUS_TEST_DATA ?= $(abspath $(TEST_DATA))
endif

# `make measure city hills` is `make measure ROW="city hills"`: the words after `measure` are rows, not targets.
ifeq (measure,$(firstword $(MAKECMDGOALS)))
ROW ?= $(wordlist 2,$(words $(MAKECMDGOALS)),$(MAKECMDGOALS))
WORDS := $(wordlist 2,$(words $(MAKECMDGOALS)),$(MAKECMDGOALS))
endif

.PHONY: demo docs test test-fast test-minimum audit lint qgis-plugin qgis-there test-qgis bench peers acceptance \
    acceptance-all measure measure-all figures stale numbers release-check clean
.DEFAULT_GOAL := test

# Modules are compiled by all cores, which pip would do with one; a few files of packages are templates and cannot be.
$(STAMP): pyproject.toml
	$(PYTHON) -c 'import sys; sys.exit(None if sys.version_info >= (3, 11) else "zlocus needs Python 3.11 or newer: make PYTHON=python3.11")'
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install $(PIP_OPTIONS) --no-compile --editable '.[dev]'
	$(BIN)/python -m compileall -qq -j 0 .venv/lib || true
	touch $@

ifneq (,$(WORDS))
.PHONY: $(WORDS)
$(WORDS): measure
	@:
endif

ifeq (,$(filter demo,$(WORDS)))
demo: $(STAMP)
	$(BIN)/zlocus demo
endif

# The site, with its notebooks run; opens without a server: build/docs/index.html.
docs: $(STAMP)
	$(BIN)/python -m sphinx -W --keep-going -E -q -b html -d build/doctrees docs build/docs

# Kernels are compiled first: processes of tests would each compile them.
test: lint
	$(BIN)/python -m zlocus.pipeline.execution.precompile
	$(BIN)/python -m pytest -n 2 --dist worksteal

# Tests of single modules, for use while editing: under two minutes on two cores. tests/conftest.py lists what is left out.
test-fast: $(STAMP)
	$(BIN)/python -m pytest -n 2 -m "not slow"

# The oldest versions that pyproject.toml allows for this Python, in an environment of their own.
test-minimum: $(STAMP)
	$(PYTHON) -m venv $(MINIMUM)
	$(BIN)/python tests/support/lowest_versions.py \
	    "$$($(MINIMUM)/bin/python -c 'import sys; print(*sys.version_info[:2], sep=".")')" > $(MINIMUM)/versions.txt
	$(MINIMUM)/bin/python -m pip install $(PIP_OPTIONS) --constraint $(MINIMUM)/versions.txt --editable '.[test]'
	$(MINIMUM)/bin/python -m zlocus.pipeline.execution.precompile
	$(MINIMUM)/bin/python -m pytest -n 2 --dist worksteal

# Known vulnerabilities of what is installed, from the package registry.
audit: $(STAMP)
	$(BIN)/python benchmarks/audit.py

# On a busy machine the processes of mypy may not find each other in time; then one process checks the types.
lint: $(STAMP)
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy || $(BIN)/mypy --num-workers 0
	$(BIN)/lint-imports

# The plugin of QGIS as an archive, for its `Install from ZIP`.
qgis-plugin:
	$(PYTHON) qgis/package.py build/zlocus_processing.zip

# The plugin and the styles in QGIS without a window. ZLOCUS_QGIS_PICTURES names a folder for pictures to look at.
test-qgis: qgis-there $(STAMP)
	$(BIN)/python -m pytest -n 0 qgis/tests

qgis-there:
	@command -v qgis_process > /dev/null || { echo "QGIS is missing: apt-get install --no-install-recommends qgis python3-qgis"; exit 1; }

bench: $(STAMP)
	$(BIN)/python -m pytest benchmarks --benchmark-enable --benchmark-only

# Other programs on the same scenes, in environments of their own below build/peers: hours. S2P, MICMAC, SETSM: commands of builds.
ifeq (,$(filter peers,$(WORDS)))
peers: $(STAMP)
	$(BIN)/python benchmarks/peers $(if $(S2P),--s2p $(S2P)) $(if $(MICMAC),--micmac $(MICMAC)) $(if $(SETSM),--setsm $(SETSM))
endif

acceptance: $(STAMP)
	$(BIN)/python benchmarks/acceptance.py

acceptance-all: $(STAMP)
	$(BIN)/python benchmarks/acceptance.py --slow

# Measures rows and writes their results files: make measure city, or make measure ROW=city.
measure: $(STAMP)
	$(if $(strip $(ROW)),,$(error Which row? make measure city. benchmarks/rows/registry.py lists the rows))
	$(BIN)/python benchmarks/acceptance.py $(ROW) --record

# All rows but the peers, a night on two cores. Rows that fail are told at the end.
measure-all: $(STAMP)
	$(BIN)/python benchmarks/acceptance.py --slow --record

# Writes the figures of the pages from benchmarks/results: seconds, without scenes.
figures: $(STAMP)
	$(BIN)/python benchmarks/pages

# Lists the results that are older than the code that they measure; release-check fails where there are any.
stale: $(STAMP)
	$(BIN)/python benchmarks/pages --stale

release-check: $(STAMP)
	$(BIN)/python benchmarks/pages --stale --fail

# Accepts the numbers of the pages that are no measured figures, after a review of what changed.
numbers: $(STAMP)
	$(BIN)/python benchmarks/pages --numbers

clean:
	rm -rf .venv .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache .benchmarks build dist demo
	find src tests benchmarks -name __pycache__ -prune -exec rm -rf {} +
