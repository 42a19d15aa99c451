# Each command sets up what it needs in .venv. Choose an interpreter with: make test PYTHON=python3.13
PYTHON ?= python3
VENV ?= .venv
BIN = $(VENV)/bin
STAMP = $(VENV)/.installed-$(1)

.PHONY: demo test lint bench notebooks clean help

help:  ## show the commands
	@grep -E '^[a-z]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/'

demo: $(call STAMP,test)  ## simulate asteroid Toutatis with 1,000 clones; writes out/toutatis.nc and .png
	@mkdir -p out
	$(BIN)/polhode run scenes/toutatis.toml --output out/toutatis.nc

test: $(call STAMP,test)  ## run the test suite, notebooks included
	$(BIN)/python -m pytest -n 2 --dist worksteal --nbmake --nbmake-timeout=300 tests notebooks

lint: $(call STAMP,lint)  ## ruff and pyright
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright

bench: $(call STAMP,bench)  ## the quick benchmark tables and figures, beside the peers that are installed
	$(BIN)/python -m benchmarks --quick

notebooks: $(call STAMP,test)  ## execute the notebooks from their text forms, outputs kept
	cd notebooks && for script in *.py; do ../$(BIN)/jupytext --to ipynb --execute $$script || exit 1; done

clean:  ## remove what the commands made
	rm -rf $(VENV) out

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
