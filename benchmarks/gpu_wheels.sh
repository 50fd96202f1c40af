#!/usr/bin/env bash
# Wheels of what benchmarks/gpu.sh needs beside PyTorch, Triton, Lightning and what these machines have with them, into
# .whl (ignored by git; carry it). beartype is for the tests alone.
set -eu
cd "$(dirname "$0")/.."
python=${PYTHON:-python3}
$python -m pip download -q --no-deps --only-binary=:all: -d .whl 'hydra-core>=1.3.8,<1.4' 'omegaconf>=2.3,<2.4' beartype
# a source package; it is pure Python, and so its wheel is
$python -m pip wheel -q --no-deps -w .whl antlr4-python3-runtime==4.9.3
ls -l .whl
