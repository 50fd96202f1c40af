# Two commands do everything on a fresh machine with Python 3.11 or newer:
#   make demo   set up, render small scenes, train, evaluate, write pictures and tables
#   make test   set up, run the tests
# and a third one looks at what ran: make dashboard (LOGDIR=… for one sweep)
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
LOGDIR ?= runs

.PHONY: setup browser demo test faults lint dashboard clean

setup: $(VENV)/.installed

$(VENV)/.installed: pyproject.toml
	$(PYTHON) -c 'import sys; sys.exit(0 if sys.version_info >= (3, 11) else "Python 3.11 or newer is needed: make PYTHON=python3.11")'
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --editable '.[dev,fid]'
	touch $@

demo: setup
	$(BIN)/python src/demo.py

# The chart's page is tested in headless Chromium. Where there is none and it cannot be installed, its tests are skipped.
browser:
	@command -v chromium >/dev/null || command -v chromium-browser >/dev/null || command -v google-chrome >/dev/null || { \
		test "$$(id -u)" = 0 && command -v apt-get >/dev/null && apt-get update -qq && \
		DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends chromium >/dev/null; } || \
		echo "no Chromium: the tests of the chart's page will be skipped"

# A process for every core, of which each takes about 1.5 GB; one that has nothing left takes over half of another's tests.
test: setup lint browser
	$(BIN)/python -m pytest --numprocesses logical --maxprocesses 4 --dist worksteal

# Kills, full disks, power cuts, damaged bytes and fuzzed values, for minutes; docs/reliability.md has the numbers.
faults: setup
	$(BIN)/python -m pytest tests/faults -m faults

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

dashboard: setup
	( sleep 5; $(BIN)/python -m webbrowser 'http://localhost:6006/#custom_scalars' ) & \
	$(BIN)/tensorboard --logdir $(LOGDIR) --port 6006 --samples_per_plugin images=100

clean:
	rm -rf runs/demo data/demo
