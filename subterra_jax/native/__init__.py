"""LiDAR and clearance as machine code for the CPU, where numba is installed (`pip install subterra-jax[cpu]`).

Numba compiles the code at its first use and keeps it on disk. Without numba XLA does the same work in about four times
the time.
"""

import functools
import importlib.util
import os
import re
import sys
import warnings
from pathlib import Path

import jax

# Versions of XLA's custom-call interface that `frames.py` was written for: 0.2 in jaxlib 0.9 to 0.5 in jaxlib 0.12.
FFI_VERSIONS = ((0, 2), (0, 3), (0, 4), (0, 5))


@functools.cache
def supported() -> bool:
    """Return whether this process computes on a CPU for which kernels can be compiled.

    Warns once, and returns False, where only the version of XLA's custom-call interface stands in the way.
    """
    # `frames.py` reads XLA's structs as a 64-bit POSIX system lays them out.
    if jax.default_backend() != "cpu" or os.name != "posix" or sys.maxsize < 2**32:
        return False
    if importlib.util.find_spec("numba") is None:
        return False
    version = _ffi_version(Path(jax.ffi.include_dir()) / "xla" / "ffi" / "api" / "c_api.h")
    if version not in FFI_VERSIONS:
        warnings.warn(
            f"jaxlib has version {version} of XLA's custom-call interface, and the CPU kernels know "
            f"{FFI_VERSIONS[0]} to {FFI_VERSIONS[-1]}: XLA casts the LiDAR instead, about 4 times slower",
            RuntimeWarning,
            stacklevel=2,
        )
        return False
    return True


def _ffi_version(header: Path) -> tuple[int, ...]:
    """Return the version of the interface that jaxlib's header states; empty if it states none."""
    text = header.read_text(encoding="utf-8") if header.is_file() else ""
    return tuple(int(number) for number in re.findall(r"#define XLA_FFI_API_(?:MAJOR|MINOR) (\d+)", text))
