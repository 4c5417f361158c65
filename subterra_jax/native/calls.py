"""The kernels as functions of JAX: compiled by numba, kept on disk, registered with XLA as custom calls."""

import functools
import hashlib
import os
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import jaxlib
import llvmlite.binding
import numba
import numba.core.config
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from subterra_jax.host.files import cache_folder, make_writable
from subterra_jax.native.kernels import clearance_rows, scan_rows
from subterra_jax.native.threads import API_VERSION, handler_of, sizes_of
from subterra_jax.tunnel import CONTACT_REACH, Tunnel

_config: Any = numba.core.config  # its attributes come from the environment
_alive: list[Any] = []  # machine code lives as long as the object that made it


@functools.cache
def _registered(name: str, work: Any) -> str:
    """Compile the answer to a custom call, keep it on disk, tell XLA its name, and return that.

    Numba numbers the files of one function in the order in which processes write them. Two processes that compile
    different versions at the same time would take the same number, and a third would run the wrong one. So each
    version of our sources, of the libraries and of the processor has its own folder.
    """
    folder, before = cache_folder("native") / _version(), _config.CACHE_DIR
    writable = make_writable(folder)
    _config.CACHE_DIR = str(folder) if writable else before
    try:
        _alive.append(handler_of(work, name, max(1, cores() - 1), cache=writable))
    finally:
        _config.CACHE_DIR = before
    jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(_alive[-1][0].ctypes), platform="cpu", api_version=0)
    return name


def _version() -> str:
    """Return a digest of all that the machine code depends on."""
    package = Path(__file__).parents[1]  # the march takes constants from `lidar3d` into its code
    sources = [file.read_bytes() for room in ("native", "lidar3d") for file in sorted((package / room).glob("*.py"))]
    features = llvmlite.binding.get_host_cpu_features().flatten()
    machine = f"{numba.__version__} {jaxlib.__version__} {llvmlite.binding.get_host_cpu_name()} {features}"
    return hashlib.sha256(b"".join([*sources, machine.encode()])).hexdigest()[:32]


def _call(name: str, work: Any, chunk: int, results: Any, *arguments: Any) -> Any:
    """Call a kernel.

    Args:
        work: As for `handler_of`.
        chunk: Rows that a thread takes at a time: some 50 µs of work, or waking it does not pay.
        results: Shapes and types of its results.
        arguments: Arrays of 32-bit numbers; the first axis of the first counts rows.
    """
    rows = arguments[0].shape[0]
    call = jax.ffi.ffi_call(_registered(name, work), results, custom_call_api_version=API_VERSION)
    return call(sizes_of(rows, min(cores(), rows // chunk), chunk, arguments), *arguments)


def cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def scan(
    tunnel: Tunnel,
    position: Float[Array, "n 2"],
    heading: Float[Array, " n"],
    start: Int[Array, " n"],
    needed: Bool[Array, " n"],
    range_max: Float[Array, ""],
    bearing: np.ndarray,
) -> Float[Array, "n n_beams"]:
    """`gpu.scan`; the second half of an even number of beams must oppose the first."""
    shape = jax.ShapeDtypeStruct((position.shape[0], len(bearing)), jnp.float32)
    turn = np.concatenate([np.cos(bearing), np.sin(bearing)]).astype(np.float32)
    limit = jnp.asarray(range_max, jnp.float32).reshape(1)
    rows = start, needed.astype(jnp.int32), position, heading
    return _call("subterra_scan", scan_rows, 64, shape, *rows, tunnel.box, tunnel.wall, turn, limit)


def clearance(tunnel: Tunnel, position: Float[Array, "n 2"], start: Int[Array, " n"]) -> Float[Array, " n"]:
    """`gpu.clearance`."""
    shape, reach = jax.ShapeDtypeStruct(position.shape[:1], jnp.float32), np.full(1, CONTACT_REACH, np.float32)
    return _call("subterra_clearance", clearance_rows, 1024, shape, start, position, tunnel.box, tunnel.wall, reach)


def march(
    arrays: tuple[Array, ...],
    origin: Float[Array, "n 3"],
    direction: Float[Array, "n 3"],
    block: Int[Array, " n"],
    limit: Float[Array, " n"],
) -> tuple[Array, ...]:
    """`lidar3d.march.march` with the arrays of a relief; returns the rows of `Hits`."""
    from subterra_jax.native.marching import march_rows  # planar tasks do not need it

    shapes = [jax.ShapeDtypeStruct(block.shape, kind) for kind in (jnp.float32, jnp.int32, jnp.int32)]
    return tuple(_call("subterra_march", march_rows, 128, shapes, origin, direction, block, limit, *arrays))
