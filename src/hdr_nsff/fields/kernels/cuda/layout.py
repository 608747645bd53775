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
ADAM_TABLES = 8  # whose rows one launch moves
ADAM_VECTORS = 16  # that one launch moves: arguments have 4 KiB at most
MAX_KNOTS = 256  # of a response curve
PICTURE_SUMS = 6  # that the kernel `losses` adds up
MAX_BLOCKS = 512  # of kernels whose threads take several pixels each
