#!/usr/bin/env bash
# Everything that this program claims of a GPU, measured on the GPU of this machine in
# under 9 minutes. Stopped, it goes on where it was. Options: see benchmarks/gpu.py.
#
#     benchmarks/gpu.sh            # in the environment of `make demo`, or PYTHON=...
set -euo pipefail
cd "$(dirname "$0")/.."
python="${PYTHON:-.venv/bin/python}"
if ! "$python" -c "import torch" 2> /dev/null; then
  echo "benchmarks/gpu.sh: $python has no torch; run 'make demo' first, or set PYTHON" >&2
  exit 2
fi
exec "$python" benchmarks/gpu.py "$@"
