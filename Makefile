# make        everything needed, in .venv        make test   style, types and the fast tests
# make demo   record a drive, map it, score it   make lint   style and types only
# make explore      a simulated robot maps a room by itself
# make test-slow    the tests left out of make test        make site   the documentation, in site/
# make test-noble   the tests with the versions of Ubuntu 24.04, in .venv-noble
# PYTHON=/path/to/python chooses the interpreter (3.10 or newer), PYTHON312=... that of test-noble.

CANDIDATES := $(PYTHON) python3 python3.12 python3.11 python3.13 python3.10
OLD_ENOUGH := import sys, venv, ensurepip; sys.exit(not (3, 10) <= sys.version_info < (3, 14))
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
TF := $(VENV)/.tf2_msgs
NOBLE := .venv-noble
NOBLE_CANDIDATES := $(PYTHON312) python3.12 $(wildcard $(HOME)/.pyenv/versions/3.12.*/bin/python)
# What processes and links do to each other does not depend on the four libraries.
APART_FROM := nodes/test_faults nodes/test_restarts nodes/test_two_hosts nodes/test_tf nodes/test_reset \
  nodes/test_lifecycle nodes/test_on_demand nodes/test_diagnoses nodes/test_pipeline test_package \
  nodes/test_launched nodes/test_losses nodes/test_lossless nodes/test_middleware \
  nodes/test_ros2_commands
IS_312 := import sys, venv, ensurepip; sys.exit(sys.version_info[:2] != (3, 12))
# Tests of one module stay together where they can: its fixtures are made once.
PARALLEL := -n 2 --dist worksteal
CODE := segfloor_ros test launch_configs docs tools .ci setup.py

# The tests start many processes, which need not compile the same modules again.
export PYTHONDONTWRITEBYTECODE :=

.PHONY: all test fast-tests test-slow test-noble noble-python demo explore lint format docs site clean

all: $(STAMP) $(TF)

$(VENV)/bin/python:
	@for python in $(CANDIDATES); do \
	  if "$$python" -c '$(OLD_ENOUGH)' 2>/dev/null; then \
	    echo "making $(VENV) with $$python"; exec "$$python" -m venv --clear $(VENV); \
	  fi; \
	done; \
	echo 'no Python 3.10 to 3.13 with venv was found (Debian, Ubuntu: apt-get install python3-venv);' \
	  'name one: make PYTHON=/path/to/python' >&2; \
	exit 1

$(STAMP): constraints.txt setup.py setup.cfg pyproject.toml | $(VENV)/bin/python
	$(BIN)/python -m pip install -q --disable-pip-version-check -c constraints.txt pip setuptools
	$(BIN)/python -m pip install -q --disable-pip-version-check -c constraints.txt \
	  --no-build-isolation -e '.[ros,evaluate,sim,cluster,dev]'
	@touch $@

# The message of /tf, which the wheels lack; where it cannot be built, one line says why.
$(TF): $(wildcard tools/tf2_msgs/*) $(STAMP)
	@$(BIN)/python tools/tf2_msgs/build.py
	@touch $@

# Types are checked beside the tests: mypy uses one processor.
test: $(STAMP) $(TF)
	@$(MAKE) --no-print-directory -j 2 lint fast-tests

fast-tests: $(STAMP) $(TF)
	$(BIN)/python -m pytest $(PARALLEL) -m 'not slow'

test-slow: $(STAMP) $(TF)
	$(BIN)/python -m pytest $(PARALLEL) -m slow

test-noble: $(NOBLE)/.installed
	$(NOBLE)/bin/python -m pytest $(PARALLEL) -m 'not slow' $(APART_FROM:%=--ignore=test/%.py)

noble-python:
	@for python in $(NOBLE_CANDIDATES); do \
	  if "$$python" -c '$(IS_312)' 2>/dev/null; then echo "$$python"; exit 0; fi; \
	done; \
	echo 'no Python 3.12 with venv was found; name one: make test-noble PYTHON312=/path/to/it' >&2; \
	exit 1

# These packages come in the versions of Ubuntu 24.04, everything else as in .venv.
$(NOBLE)/.installed: constraints-noble.txt constraints.txt setup.py setup.cfg pyproject.toml
	@python="$$($(MAKE) -s noble-python)" && "$$python" -m venv --clear $(NOBLE)
	@{ cat constraints-noble.txt; grep -vE \
	  "^($$(sed -n 's/==.*//p' constraints-noble.txt | paste -sd '|'))==" constraints.txt; \
	} > $(NOBLE)/constraints.txt
	$(NOBLE)/bin/python -m pip install -q --disable-pip-version-check \
	  -c $(NOBLE)/constraints.txt pip setuptools
	$(NOBLE)/bin/python -m pip install -q --disable-pip-version-check \
	  -c $(NOBLE)/constraints.txt --no-build-isolation -e '.[ros,evaluate,sim,cluster,test]'
	@$(NOBLE)/bin/python tools/tf2_msgs/build.py
	@touch $@

demo: $(STAMP) $(TF)
	$(BIN)/segfloor demo

explore: $(STAMP) $(TF)
	$(BIN)/segfloor explore complex_room --out segfloor_explored

lint: $(STAMP)
	$(BIN)/ruff check $(CODE)
	$(BIN)/ruff format --check $(CODE)
	$(BIN)/mypy segfloor_ros tools

format: $(STAMP)
	$(BIN)/ruff check --fix $(CODE)
	$(BIN)/ruff format $(CODE)

docs: $(STAMP)
	$(BIN)/python docs/generate.py

# NO_MKDOCS_2_WARNING: the theme's notice of its successor is not a warning of these pages.
site: $(STAMP)
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict -q

clean:
	rm -rf $(VENV) $(NOBLE) build install log site .mypy_cache .pytest_cache .ruff_cache *.egg-info
