# Two commands do everything on a fresh machine with Python 3.11 or newer:
#   make demo   set up, render small scenes, train, evaluate, write pictures and tables
#   make test   set up, run the tests
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin

.PHONY: setup demo test lint dashboard clean

setup: $(VENV)/.installed

$(VENV)/.installed: pyproject.toml
	$(PYTHON) -c 'import sys; sys.exit(0 if sys.version_info >= (3, 11) else "Python 3.11 or newer is needed: make PYTHON=python3.11")'
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --editable '.[dev,fid]'
	touch $@

demo: setup
	$(BIN)/python src/demo.py

test: setup lint
	$(BIN)/python -m pytest

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

dashboard: setup
	$(BIN)/tensorboard --logdir runs

clean:
	rm -rf runs/demo data/demo
