"""How the CUDA rasterizer cuts up its work: numbers that both the kernels and those who
launch them need.
"""

from __future__ import annotations

TILE = 16  # pixels on a side
PIXELS = TILE * TILE  # of a tile, and threads of its block
BATCH = 16  # Gaussians that the backward pass takes at a time: one per row of threads
CHANNELS = 8  # features that one block composites
THREADS = 128  # of a block, in kernels with one thread per Gaussian
ELLIPSE = 6  # numbers of a projected Gaussian: pixel center, conic, opacity
POSE = 16  # numbers of a basis at a time: a 3x4 matrix and a quaternion
ADAM_TABLES = 8  # whose rows one launch moves
TERMS = 8  # of the field's own, that the kernel `cloud` adds up
NUMBERS = 27  # that it takes of the time
MAX_LOG_RADIANCE = 16.0  # of a Gaussian, as in `splat/gaussians.py`
MAX_KNOTS = 256  # of a response curve
PICTURE_SUMS = 6  # that the kernel `losses` adds up
MAX_BLOCKS = 512  # of kernels whose threads take several pixels each
