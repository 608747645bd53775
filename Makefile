# make demo   footage to HDR on the clip in demo/, results in demo/out
# make test   the tests
# make docs   the documentation, in docs/_build
# Each does its own set-up first, and none where that is done. Settings:
#   VENV=.venv            the virtual environment
#   PYTHON=python3.11     the Python that makes it, 3.11 or 3.12
#   WORKERS=2             processes of `make test`

VENV ?= .venv
WORKERS ?= 2
SUITABLE = import sys; sys.exit(sys.version_info[:2] not in ((3, 11), (3, 12)))
PYTHON ?= $(shell for p in python3.11 python3.12 python3; do $$p -c '$(SUITABLE)' 2> /dev/null && echo $$p && break; done)

# Without a CUDA device torch stays at the version whose CPU build is known to work.
CONSTRAINTS := $(if $(shell command -v nvidia-smi),,-c constraints-cpu.txt)
INSTALL = $(VENV)/bin/python -m pip install --disable-pip-version-check $(CONSTRAINTS)

# The compiler of the CUDA kernels, for the CUDA version that torch brings.
GPU_EXTRA = import torch; print("gpu12" if (torch.version.cuda or "").startswith("12.") else "gpu")

# One thread per test process: they share the cores already.
ONE_THREAD = OMP_NUM_THREADS=1 MKL_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 NUMBA_NUM_THREADS=1
# The commands that tests start find the package compiled, even where the environment says otherwise.
BYTECODE = PYTHONDONTWRITEBYTECODE=

.DEFAULT_GOAL := help
.PHONY: help demo test docs

help:
	@sed -n '1,/^$$/s/^# \{0,1\}//p' Makefile

demo: $(VENV)/.ready-demo
	$(VENV)/bin/hdr-nsff run demo/clip.mp4 demo/out --truth demo/truth

test: $(VENV)/.ready-dev
	$(ONE_THREAD) $(BYTECODE) $(VENV)/bin/python -m pytest -n $(WORKERS) --dist loadfile --durations=20

docs: $(VENV)/.ready-docs
	$(VENV)/bin/sphinx-build -W --keep-going -b html docs docs/_build/html
	@echo "open docs/_build/html/index.html"

$(VENV)/bin/pip:
	@"$(PYTHON)" -c '$(SUITABLE)' 2> /dev/null || { \
	  echo "'$(PYTHON)' is not Python 3.11 or 3.12; install one of them, or say where it is: make PYTHON=/path/to/python3.12" >&2; exit 1; }
	"$(PYTHON)" -m venv $(VENV)

$(VENV)/.ready-demo: EXTRAS = eval
$(VENV)/.ready-dev: EXTRAS = dev
$(VENV)/.ready-docs: EXTRAS = docs

$(VENV)/.ready-%: pyproject.toml constraints-cpu.txt | $(VENV)/bin/pip
	@echo "installing into $(VENV); the first time this downloads about a gigabyte"
	$(INSTALL) -e '.[$(EXTRAS)]'
	$(if $(and $(shell command -v nvidia-smi),$(filter demo,$*)),$(INSTALL) -e ".[$$($(VENV)/bin/python -c '$(GPU_EXTRA)')]")
	@touch $@
