#!/usr/bin/env bash
# On a CUDA machine: check that the field agrees with the CPU, then time `paper` (float32 and bfloat16) and `grid`; JSON lines to the
# file named first. Usage: benchmarks/gpu.sh OUT.json SCENE
set -euo pipefail
cd "$(dirname "$0")/.."
out=$1 scene=$2
export PYTHONPATH=src${PYTHONPATH:+:$PYTHONPATH}
python3 -m pytest -q tests/test_fields.py tests/test_nsff.py
{
  python3 benchmarks/speed.py "$scene" --preset paper --device cuda --steps 200
  python3 benchmarks/speed.py "$scene" --preset paper --device cuda --steps 200 --bf16
  python3 benchmarks/speed.py "$scene" --preset grid --device cuda --steps 200
} | tee "$out"
