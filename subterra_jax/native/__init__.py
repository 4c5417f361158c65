"""LiDAR and clearance as machine code for the CPU, where numba is installed (`pip install subterra-jax[cpu]`).

Subterra needs no compiler to install: numba makes the code when it is first used and keeps it on disk. Without it XLA
does the same work in about four times the time.
"""

import functools
import os
import sys

import jax


@functools.cache
def supported() -> bool:
    """Whether this process computes on a CPU whose kernels can be made."""
    # The frames and threads of XLA are read as a 64-bit POSIX system lays them out.
    if jax.default_backend() != "cpu" or os.name != "posix" or sys.maxsize < 2**32:
        return False
    try:
        import numba  # noqa: F401
    except ImportError:
        return False
    return True
