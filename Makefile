# Two commands do everything on a fresh machine with Python 3.11 or newer:
#   make demo   set up, render small scenes, train, evaluate, write pictures and tables
#   make test   set up, run the tests
# and two more help: make dashboard looks at what ran (LOGDIR=… for one sweep), make docs builds the documentation.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
LOGDIR ?= runs

# What is installed: the versions of the lock file, compared with its hashes. LOCKED=0 takes the newest that suit.
LOCK := requirements.lock
LOCKED ?= 1
# Without an NVIDIA GPU: PyTorch's CPU build, where pip's own indexes offer it; TORCH=cpu asks PyTorch's index, too, and
# TORCH=cuda never takes it. Those wheels are not in the lock file; the rest is.
TORCH ?= $(if $(shell command -v nvidia-smi),cuda,auto)
CPU_INDEX ?= https://download.pytorch.org/whl/cpu
CPU_BUILD := $(shell sed -nE 's/^((torch|torchvision)==[^ ]+).*/\1+cpu/p' $(LOCK))
GPU_ONLY := torch|torchvision|nvidia-.*|cuda-.*

.PHONY: setup lock browser demo test faults lint dashboard notebooks docs clean

setup: $(VENV)/.installed

$(VENV)/.installed: pyproject.toml $(LOCK)
	$(PYTHON) -c 'import sys; sys.exit(0 if sys.version_info >= (3, 11) else "Python 3.11 or newer is needed: make PYTHON=python3.11")'
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	cp $(LOCK) $(VENV)/lock.txt
	@test $(TORCH) = cuda || { \
		$(BIN)/python -m pip install --quiet --no-deps --retries 1 $(if $(filter cpu,$(TORCH)),--extra-index-url $(CPU_INDEX)) $(CPU_BUILD) 2>$(VENV)/cpu.log && \
		awk '/^[^ ]/ { gpu = /^($(GPU_ONLY))==/ } !gpu' $(LOCK) >$(VENV)/lock.txt && echo "PyTorch's CPU build: $(CPU_BUILD)"; } || { \
		echo "no CPU build of this PyTorch on the indexes that were asked ($(VENV)/cpu.log)"; test $(TORCH) = auto && \
		echo "taking the usual one, which runs on a CPU, too (make setup TORCH=cpu would ask PyTorch's own index)"; }
	@test $(LOCKED) = 0 || $(BIN)/python -m pip install --quiet --require-hashes --requirement $(VENV)/lock.txt 2>$(VENV)/lock.log || { \
		cat $(VENV)/lock.log; ! grep -q 'DO NOT MATCH THE HASHES' $(VENV)/lock.log && \
		echo 'WARNING: the versions of $(LOCK) cannot be installed here; taking the newest that pyproject.toml allows'; }
	$(BIN)/python -m pip install --quiet --editable '.[dev]'
	touch $@

# After a change of dependencies. Versions that still suit stay; UPGRADE=--upgrade takes the newest. (uv does not read pip's settings.)
lock:
	$(BIN)/python -m pip install --quiet uv
	$(BIN)/uv pip compile pyproject.toml --extra dev --universal --python-version 3.11 --generate-hashes \
		--no-annotate --no-header --quiet --output-file $(LOCK) $(UPGRADE)

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

# Their outputs, which are committed: a quarter of an hour on two cores.
notebooks: setup
	$(BIN)/python notebooks/execute.py

docs: setup
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --quiet --strict --site-dir build/docs
	@echo 'open build/docs/index.html'

clean:
	rm -rf runs/demo data/demo
