"""LiDAR and clearance as machine code for the CPU, where numba is installed (`pip install subterra-jax[cpu]`).

Numba compiles the code at its first use and keeps it on disk. Without numba XLA does the same work in about four times
the time.
"""

import functools
import os
import re
import sys
import warnings
from pathlib import Path

import jax

# Versions of XLA's custom-call interface that `frames.py` was written for: 0.2 in jaxlib 0.9 to 0.5 in jaxlib 0.12.
FFI_MAJOR, FFI_FIRST_MINOR, FFI_LAST_MINOR = 0, 2, 5


@functools.cache
def supported() -> bool:
    """Return whether this process computes on a CPU for which kernels can be compiled.

    Warns once, and returns False, where only the version of XLA's custom-call interface stands in the way.
    """
    # `frames.py` reads XLA's structs as a 64-bit POSIX system lays them out.
    if jax.default_backend() != "cpu" or os.name != "posix" or sys.maxsize < 2**32:
        return False
    try:
        import numba  # noqa: F401
    except ImportError:
        return False
    if problem := version_problem(Path(jax.ffi.include_dir()) / "xla" / "ffi" / "api" / "c_api.h"):
        warnings.warn(problem, RuntimeWarning, stacklevel=2)
        return False
    return True


def version_problem(header: Path) -> str | None:
    """Return one sentence if jaxlib's custom-call interface is not one that `frames.py` knows; `None` if it is.

    Args:
        header: `c_api.h` of the installed jaxlib, which states the version.
    """
    known = f"{FFI_MAJOR}.{FFI_FIRST_MINOR} to {FFI_MAJOR}.{FFI_LAST_MINOR}"
    try:
        text = header.read_text(encoding="utf-8")
    except OSError:
        text = ""
    numbers = [re.search(rf"#define XLA_FFI_API_{part} (\d+)", text) for part in ("MAJOR", "MINOR")]
    if numbers[0] is None or numbers[1] is None:
        problem = f"jaxlib does not state the version of its custom-call interface in {header}"
    else:
        major, minor = int(numbers[0][1]), int(numbers[1][1])
        if major == FFI_MAJOR and FFI_FIRST_MINOR <= minor <= FFI_LAST_MINOR:
            return None
        problem = f"jaxlib has version {major}.{minor} of the custom-call interface"
    return f"{problem}, and the CPU kernels are written for {known}: XLA casts the LiDAR instead, about 4 times slower"
