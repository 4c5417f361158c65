"""LiDAR and clearance as machine code for the CPU, where numba is installed (`pip install subterra-jax[cpu]`).

Numba compiles the code at its first use and keeps it on disk. Without numba a step of 1,024 robots takes three to four
times as long.
"""

import functools
import importlib.util
import os
import sys

import jax


@functools.cache
def supported() -> bool:
    """Return whether this process computes on a CPU for which kernels can be compiled."""
    # `threads.py` takes the addresses of a 64-bit POSIX system.
    posix = os.name == "posix" and sys.maxsize > 2**32
    return jax.default_backend() == "cpu" and posix and importlib.util.find_spec("numba") is not None
