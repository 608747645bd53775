"""HDR-NSFF: alternating-exposure video in, dynamic HDR radiance field out."""

import os

from hdr_nsff.core.process import keep_memory

# torch and numba each keep a pool of OpenMP threads; while one works, the other's idle
# threads would spin on the same cores. Measured on 2 loaded cores: a training step took
# 3.7 s spinning, 0.35 s with waiting threads asleep. Read when OpenMP starts.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
keep_memory()

__version__ = "0.2.0.dev0"
