"""Gives memory back to the system: what was freed, not what is in use, would otherwise decide how much a run needs."""

import ctypes
import gc


def give_back() -> None:
    """Frees what only refers to itself and returns what the allocator keeps for later.

    Meshes and their rays refer to each other, so that only the collector frees them; and glibc keeps the heap between
    two blocks in use: after the metrics of a bore of 36 m that is half of the process. Without glibc the second part is
    left out.
    """
    gc.collect()
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)
