"""Tunnels of the open world, kept on disk once they have been made."""

import contextlib
import functools
import hashlib
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

from subterra_jax.host.cache import cache_folder, make_writable
from subterra_jax.host.files import replace_file
from subterra_jax.tunnel.tunnel import Tunnel

MOST = 2_000_000_000  # bytes of tunnels kept; of more, those not used for longest go
_MADE_BY = ("procedural", "tunnel", "lidar3d")  # packages whose code a tunnel's arrays depend on


def keep(make: Callable[[], Tunnel], *content: Any) -> Tunnel:
    """Return a tunnel from the cache, or make it and keep it there; where no folder can be written, just make it.

    Args:
        make: Makes the tunnel.
        *content: All that the tunnel depends on beside the code: its name, lining, piece.
    """
    folder = cache_folder("tunnels")
    if not make_writable(folder):
        return make()
    file = folder / f"{hashlib.sha256(repr((_code(), *content)).encode()).hexdigest()[:40]}.pickle"
    with contextlib.suppress(OSError, EOFError, pickle.UnpicklingError):
        content_bytes = file.read_bytes()
        file.touch()  # it was used
        return jax.device_put(pickle.loads(content_bytes))
    made = make()
    with contextlib.suppress(OSError):
        with replace_file(file) as fresh:
            fresh.write_bytes(pickle.dumps(jax.device_get(made)))
        _shrink(folder)
    return made


@functools.cache
def _code() -> str:
    """Return a digest of the code that makes tunnels and of the library that it computes with."""
    root = Path(__file__).parents[1]
    files = [file for name in _MADE_BY for file in sorted((root / name).glob("*.py"))]
    sources = b"".join(file.read_bytes() for file in files)
    return hashlib.sha256(sources + np.__version__.encode()).hexdigest()


def _shrink(folder: Path) -> None:
    """Remove the tunnels that were not used for longest until no more than `MOST` bytes are left."""
    kept = sorted(((file.stat(), file) for file in folder.glob("*.pickle")), key=lambda one: -one[0].st_mtime)
    total = 0
    for facts, file in kept:
        total += facts.st_size
        if total > MOST:
            file.unlink(missing_ok=True)
