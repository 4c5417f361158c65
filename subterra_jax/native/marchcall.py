"""The march as a function of JAX: compiled by numba, kept on disk, registered with XLA as a custom call."""

from typing import no_type_check

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from numba import njit

from subterra_jax.lidar3d.meeting import Hits
from subterra_jax.lidar3d.relief import Relief
from subterra_jax.native.calls import register
from subterra_jax.native.frames import argument, floats, ints, result, run_on_all_threads, size, wants_work
from subterra_jax.native.marching import march_rows

MARCH = "subterra_march"


@njit
@no_type_check
def _march(frame, begin, end):
    """Take rays of a march call: origin, direction, block, limit, the relief's arrays, n_x to hits."""
    march_rows(
        begin,
        end,
        floats(argument(frame, 0)),
        floats(argument(frame, 1)),
        ints(argument(frame, 2)),
        floats(argument(frame, 3)),
        floats(argument(frame, 4)),
        ints(argument(frame, 5)),
        ints(argument(frame, 6)),
        ints(argument(frame, 7)),
        ints(argument(frame, 8)),
        floats(argument(frame, 9)),
        ints(argument(frame, 10))[0],
        floats(result(frame, 0)),
        ints(result(frame, 1)),
        ints(result(frame, 2)),
    )


# Chunks of some 100 µs of work.
_march_all = run_on_all_threads(_march, 128, "subterra_march_helper")


@no_type_check
def _march_handler(frame):
    """Answer XLA's call of the march."""
    if wants_work(frame):
        _march_all(frame, size(result(frame, 0), 0))
    return 0


register(MARCH, _march_handler)


def find(
    relief: Relief,
    origin: Float[Array, "n 3"],
    direction: Float[Array, "n 3"],
    block: Int[Array, "n"],
    limit: Float[Array, "n"],
) -> Hits:
    """Find the first triangle that each ray meets, as `lidar3d.march.march`."""
    shape = lambda dtype: jax.ShapeDtypeStruct(block.shape, dtype)  # noqa: E731
    call = jax.ffi.ffi_call(MARCH, (shape(jnp.float32), shape(jnp.int32), shape(jnp.int32)))
    arrays = (relief.frame, relief.link, relief.cell, relief.entry, relief.vertex, relief.box)
    return Hits(*call(origin, direction, block, limit, *arrays, np.full(1, relief.n_x, np.int32)))
