"""The kernels as functions of JAX: compiled by numba, kept on disk, registered with XLA as custom calls."""

import functools
import hashlib
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

from subterra_jax.host.cache import cache_folder, make_writable
from subterra_jax.native.frames import handler_of
from subterra_jax.native.kernels import clearance_rows, scan_rows
from subterra_jax.tunnel import CONTACT_REACH, Tunnel

_config: Any = numba.core.config  # its attributes come from the environment
_alive: list[Any] = []  # machine code lives as long as the object that made it


@functools.cache
def _registered(name: str, work: Any, chunk: int) -> str:
    """Compile the answer to a custom call, keep it on disk, tell XLA its name, and return that.

    Numba numbers the files of one function in the order in which processes write them. Two processes that compile
    different versions at the same time would take the same number, and a third would run the wrong one. So each
    version of our sources, of the libraries and of the processor has its own folder.

    Args:
        name: Name of the call.
        work: As for `handler_of`.
        chunk: As there; about 20 µs of work or more, which is the cost of waking a thread.
    """
    folder, before = cache_folder("native") / _version(), _config.CACHE_DIR
    writable = make_writable(folder)
    _config.CACHE_DIR = str(folder) if writable else before
    try:
        _alive.append(handler_of(work, chunk, name, cache=writable))
    finally:
        _config.CACHE_DIR = before
    jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(_alive[-1][0].ctypes), platform="cpu")
    return name


def _version() -> str:
    """Return a digest of all that the machine code depends on."""
    package = Path(__file__).parents[1]  # the march takes constants from `lidar3d` into its code
    sources = [file.read_bytes() for room in ("native", "lidar3d") for file in sorted((package / room).glob("*.py"))]
    features = llvmlite.binding.get_host_cpu_features().flatten()
    machine = f"{numba.__version__} {jaxlib.__version__} {llvmlite.binding.get_host_cpu_name()} {features}"
    return hashlib.sha256(b"".join([*sources, machine.encode()])).hexdigest()[:32]


def scan(
    tunnel: Tunnel,
    position: Float[Array, "n 2"],
    heading: Float[Array, " n"],
    start: Int[Array, " n"],
    wanted: Bool[Array, " n"],
    range_max: Float[Array, ""],
    bearing: np.ndarray,
) -> Float[Array, "n n_beams"]:
    """`gpu.scan`; the second half of an even number of beams must oppose the first."""
    shape = jax.ShapeDtypeStruct((position.shape[0], len(bearing)), jnp.float32)
    turn = np.concatenate([np.cos(bearing), np.sin(bearing)]).astype(np.float32)
    limit = jnp.asarray(range_max, jnp.float32).reshape(1)
    call = jax.ffi.ffi_call(_registered("subterra_scan", scan_rows, 32), shape)
    return call(start, wanted.astype(jnp.int32), position, heading, tunnel.box, tunnel.wall, turn, limit)


def clearance(tunnel: Tunnel, position: Float[Array, "n 2"], start: Int[Array, " n"]) -> Float[Array, " n"]:
    """`gpu.clearance`."""
    call = jax.ffi.ffi_call(
        _registered("subterra_clearance", clearance_rows, 256), jax.ShapeDtypeStruct(position.shape[:1], jnp.float32)
    )
    return call(start, position, tunnel.box, tunnel.wall, np.full(1, CONTACT_REACH, np.float32))


def march(
    arrays: tuple[Array, ...],
    n_x: int,
    origin: Float[Array, "n 3"],
    direction: Float[Array, "n 3"],
    block: Int[Array, " n"],
    limit: Float[Array, " n"],
) -> tuple[Array, ...]:
    """`lidar3d.march.march` with the arrays of a relief; returns the rows of `Hits`."""
    from subterra_jax.native.marching import march_rows  # planar tasks do not need it

    shapes = [jax.ShapeDtypeStruct(block.shape, kind) for kind in (jnp.float32, jnp.int32, jnp.int32)]
    call = jax.ffi.ffi_call(_registered("subterra_march", march_rows, 128), shapes)
    return tuple(call(origin, direction, block, limit, *arrays, np.full(1, n_x, np.int32)))
