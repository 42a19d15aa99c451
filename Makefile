# Each command sets up what it needs in .venv. Choose an interpreter with: make test PYTHON=python3.13
PYTHON ?= python3
VENV ?= .venv
BIN = $(VENV)/bin
STAMP = $(VENV)/.installed-$(1)
PYTEST = $(BIN)/python -m pytest -n 2 --dist worksteal --durations=25

.PHONY: demo test test-all test-versions lint bench docs examples notebooks clean help

help:  ## show the commands
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/'

demo: $(call STAMP,test)  ## simulate asteroid Toutatis with 1,000 clones; writes out/toutatis.nc and .png
	@mkdir -p out
	$(BIN)/polhode run toutatis --output out/toutatis.nc

test: $(call STAMP,test)  ## run the tests but the slow ones, and one notebook
	$(PYTEST) -m 'not slow' tests

test-all: $(call STAMP,test) $(call STAMP,docs) test-versions  ## run every test, build the documentation, and the lowest and newest versions
	$(PYTEST) tests

test-versions:  ## a smoke test on the lowest and on the newest versions of what polhode needs
	$(PYTHON) tests/versions.py

lint: $(call STAMP,lint)  ## ruff, pyright, and both type checkers on the documentation's examples
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright --pythonpath $(BIN)/python
	$(BIN)/python tests/user_types.py

bench: $(call STAMP,bench)  ## the quick benchmark tables and figures, beside the peers that are installed
	$(BIN)/python -m benchmarks --quick

docs: $(call STAMP,docs)  ## build the documentation into site/, without a network; a warning is an error
	$(BIN)/python -m sphinx -W --keep-going -q -d build/doctrees docs site

examples: $(call STAMP,test)  ## execute the examples of README and documentation; store outputs and figures
	$(BIN)/python tests/page_outputs.py

notebooks: $(call STAMP,test)  ## execute the notebooks from their text forms and store the outputs
	$(BIN)/python tests/stored_outputs.py

clean:  ## remove what the commands made
	rm -rf $(VENV) .venv-lowest .venv-newest out site build jupyter_execute docs/notebooks docs/reference

$(VENV)/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "polhode needs Python 3.11 or newer, $(PYTHON) is older: make $(MAKECMDGOALS) PYTHON=/path/to/python3.11"; exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade 'pip>=25.1'

$(call STAMP,test): $(VENV)/bin/python pyproject.toml
	$(BIN)/python -m pip install --quiet --editable '.[all]' --group test
	@touch $@

$(call STAMP,lint): $(VENV)/bin/python pyproject.toml
	$(BIN)/python -m pip install --quiet --editable '.[all]' --group test --group lint
	@touch $@

$(call STAMP,bench): $(VENV)/bin/python pyproject.toml
	$(BIN)/python -m pip install --quiet --editable '.[all]' --group test
	$(BIN)/python -m pip install --quiet --group bench || for peer in numba heyoka mujoco; do \
		$(BIN)/python -m pip install --quiet $$peer || echo "not installed: $$peer"; done
	@touch $@

$(call STAMP,docs): $(VENV)/bin/python pyproject.toml
	$(BIN)/python -m pip install --quiet --editable '.[all]' --group docs
	@touch $@
