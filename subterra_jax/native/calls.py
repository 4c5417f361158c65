"""The kernels as functions of JAX: compiled by numba, kept on disk, registered with XLA as custom calls."""

import contextlib
import hashlib
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, no_type_check

import jax
import jax.numpy as jnp
import jaxlib
import llvmlite.binding
import numba
import numba.core.config
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from numba import cfunc, njit, types

from subterra_jax.native.frames import argument, capsule, floats, ints, result, run_on_all_threads, size, wants_work
from subterra_jax.native.kernels import clearance_rows, scan_rows
from subterra_jax.tunnel import CONTACT_REACH, Tunnel

config: Any = numba.core.config  # its attributes come from the environment


@contextlib.contextmanager
def code_cache() -> Iterator[bool]:
    """Let numba keep machine code in a folder for this version; yields False if no folder can be written.

    Numba numbers the files of one function in the order in which processes write them. Two processes that compile
    different versions at the same time would take the same number, and a third would run the wrong one. So each
    version of our sources, of the libraries and of the processor has its own folder.
    """
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    folder = base / "subterra" / "native" / _version()
    before = config.CACHE_DIR
    try:
        folder.mkdir(parents=True, exist_ok=True)
        writable = os.access(folder, os.W_OK)
    except OSError:
        writable = False
    if not writable:
        yield False
        return
    config.CACHE_DIR = str(folder)
    try:
        yield True
    finally:
        config.CACHE_DIR = before


def _version() -> str:
    """Return a digest of all that the machine code depends on."""
    here = Path(__file__).parent  # the march takes constants from `lidar3d` into its code
    files = [*sorted(here.glob("*.py")), *sorted((here.parent / "lidar3d").glob("*.py"))]
    sources = [file.read_bytes() for file in files]
    features = llvmlite.binding.get_host_cpu_features().flatten()
    machine = f"{numba.__version__} {jaxlib.__version__} {llvmlite.binding.get_host_cpu_name()} {features}"
    return hashlib.sha256(b"".join([*sources, machine.encode()])).hexdigest()[:32]


# Machine code lives as long as the object that made it.
_alive: list[Any] = []


def register(name: str, handler: Callable[..., int]) -> None:
    """Compile the answer to a custom call, keep it on disk, and tell XLA its name."""
    with code_cache() as writable:
        _alive.append(cfunc(types.intp(types.intp), cache=writable)(handler))
    jax.ffi.register_ffi_target(name, capsule(_alive[-1].address), platform="cpu")


SCAN, CLEARANCE = "subterra_scan", "subterra_clearance"


@njit
@no_type_check
def _scan(frame, begin, end):
    """Take rows of a scan call: start, wanted, position, heading, box, wall, turn, limit to ranges."""
    wall = argument(frame, 5)
    scan_rows(
        begin,
        end,
        ints(argument(frame, 0)),
        ints(argument(frame, 1)),
        floats(argument(frame, 2)),
        floats(argument(frame, 3)),
        floats(argument(frame, 4)),
        floats(wall),
        np.uint64(size(wall, 2)),
        floats(argument(frame, 6)),
        floats(argument(frame, 7))[0],
        floats(result(frame, 0)),
    )


@njit
@no_type_check
def _clearance(frame, begin, end):
    """Take rows of a clearance call: start, position, box, wall, reach to distances."""
    wall = argument(frame, 3)
    clearance_rows(
        begin,
        end,
        ints(argument(frame, 0)),
        floats(argument(frame, 1)),
        floats(argument(frame, 2)),
        floats(wall),
        np.uint64(size(wall, 2)),
        floats(argument(frame, 4))[0],
        floats(result(frame, 0)),
    )


# Chunks of about 20 µs of work, which is the cost of waking a thread.
_scan_all = run_on_all_threads(_scan, 32, "subterra_scan_helper")
_clearance_all = run_on_all_threads(_clearance, 256, "subterra_clearance_helper")


@no_type_check
def _scan_handler(frame):
    """Answer XLA's call of the scan."""
    if wants_work(frame):
        _scan_all(frame, size(result(frame, 0), 0))
    return 0


@no_type_check
def _clearance_handler(frame):
    """Answer XLA's call of the clearance."""
    if wants_work(frame):
        _clearance_all(frame, size(result(frame, 0), 0))
    return 0


register(SCAN, _scan_handler)
register(CLEARANCE, _clearance_handler)


def scan(
    tunnel: Tunnel,
    position: Float[Array, "n 2"],
    heading: Float[Array, " n"],
    start: Int[Array, " n"],
    wanted: Bool[Array, " n"],
    range_max: Float[Array, ""],
    bearing: np.ndarray,
) -> Float[Array, "n n_beams"]:
    """Return the true ranges of many scans in one tunnel.

    Args:
        tunnel: The tunnel, one for all.
        position: Positions of the LiDAR, tunnel frame, m.
        heading: Headings of the LiDAR, rad.
        start: First block that each scan visits.
        wanted: Scans to take; the others cost nothing and hold arbitrary numbers.
        range_max: Largest range, m.
        bearing: Of each beam from the heading, rad; if their number is even, the second half opposes the first.

    Returns:
        Ranges, m, as `lidar.scan`.
    """
    shape = jax.ShapeDtypeStruct((position.shape[0], len(bearing)), jnp.float32)
    return jax.ffi.ffi_call(SCAN, shape)(
        start,
        wanted.astype(jnp.int32),
        position,
        heading,
        tunnel.box,
        tunnel.wall,
        np.concatenate([np.cos(bearing), np.sin(bearing)]).astype(np.float32),
        jnp.asarray(range_max, jnp.float32).reshape(1),
    )


def clearance(tunnel: Tunnel, position: Float[Array, "n 2"], start: Int[Array, " n"]) -> Float[Array, " n"]:
    """Return the distances from many points in one tunnel to its nearest wall or furniture.

    Args:
        tunnel: The tunnel, one for all.
        position: The points, tunnel frame, m.
        start: First block that each point visits.

    Returns:
        Distances, m; exact up to `CONTACT_REACH`, and exactly that where the true distance is larger.
    """
    shape = jax.ShapeDtypeStruct(position.shape[:1], jnp.float32)
    return jax.ffi.ffi_call(CLEARANCE, shape)(
        start,
        position,
        tunnel.box,
        tunnel.wall,
        np.full(1, CONTACT_REACH, np.float32),
    )
