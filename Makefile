# `make demo` and `make test` are all the set-up there is: each installs into .venv first, quietly, once,
# and compiles the kernels while it is at it.
PYTHON ?= python3
BIN := .venv/bin
STAMP := .venv/.installed

.PHONY: install demo test lint clean

install: $(STAMP)

$(STAMP): pyproject.toml
	@test -x $(BIN)/python || $(PYTHON) -m venv .venv
	@$(BIN)/python -m pip install -qq --disable-pip-version-check --upgrade pip
	@$(BIN)/python -m pip install -qq --disable-pip-version-check --editable '.[test]'
	@$(BIN)/elpd check >.venv/check.log || { cat .venv/check.log; exit 1; }
	@touch $@

demo: install
	@$(BIN)/elpd demo

test: install
	@tools/packages
	@$(BIN)/python -m pytest -n auto --dist worksteal

lint: install
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/mypy
	@$(BIN)/lint-imports

clean:
	@rm -rf .venv dist build .mypy_cache .ruff_cache .hypothesis
