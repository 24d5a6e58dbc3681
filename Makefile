# `make demo` and `make test` do all set-up themselves; set-up runs again when pyproject.toml changes.
# Arguments for the command behind a target: make test ARGS="-k geometry", make demo ARGS="--port 9000".

VENV := .venv
BIN := $(VENV)/bin
ARGS ?=

.DEFAULT_GOAL := help
.PHONY: help demo test check format clean

help:
	@echo "make demo    live four-camera intersection in the browser"
	@echo "make test    all tests"
	@echo "make check   lint, format, types, import contract"
	@echo "make format  put the code into form"
	@echo "make clean   drop the virtual environment and caches"

demo: $(VENV)/.ready-demo
	@$(BIN)/quadlift demo $(ARGS)

test: $(VENV)/.ready-dev
	@$(BIN)/python -m pytest -n auto --maxprocesses 4 --dist loadfile $(ARGS)

check: $(VENV)/.ready-dev
	@scripts/check

format: $(VENV)/.ready-dev
	@$(BIN)/ruff check --fix .
	@$(BIN)/ruff format .

clean:
	rm -rf $(VENV) build dist *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache

$(VENV)/.ready-demo: pyproject.toml scripts/setup
	@scripts/setup demo

$(VENV)/.ready-dev: pyproject.toml scripts/setup
	@scripts/setup dev
