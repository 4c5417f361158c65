"""The 3-D LiDAR as one fused kernel for NVIDIA GPUs: a warp marches 32 rays, one in each lane, in registers."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from subterra_jax.lidar.nvidia import fma, reciprocal
from subterra_jax.lidar3d.march import march
from subterra_jax.lidar3d.meeting import Hits, Point, Tools, normals
from subterra_jax.lidar3d.relief import ARRAYS, Relief

# Rays of one program: one warp, one ray a lane.
ROWS = 32
PAIRS = ("cell", "vertex")


def supported() -> bool:
    """Tell whether the kernel can run: on an NVIDIA GPU."""
    return jax.default_backend() == "gpu" and "nvidia" in jax.devices()[0].device_kind.lower()


def find(
    relief: Relief,
    origin: Float[Array, "n 3"],
    direction: Float[Array, "n 3"],
    block: Int[Array, n],
    limit: Float[Array, n],
) -> Hits:
    """Find the first triangle that each ray meets, as `march.march`."""
    return Hits(*_launch(relief, origin, direction, block, limit, facing=False))


def find_facing(
    relief: Relief,
    origin: Float[Array, "n 3"],
    direction: Float[Array, "n 3"],
    block: Int[Array, n],
    limit: Float[Array, n],
) -> tuple[Hits, Point]:
    """Find the first triangle that each ray meets, and its normal, as `march.march` and `meeting.normals`."""
    rows = _launch(relief, origin, direction, block, limit, facing=True)
    return Hits(*rows[:3]), rows[3:]


def find_facing_from(
    relief: Relief,
    origin: Float[Array, "s 3"],
    direction: Float[Array, "s rows columns 3"],
    block: Int[Array, s],
    limit: Float[Array, s],
) -> tuple[Hits, Point]:
    """`find_facing` of the rays of some scans, each from one place and a multiple of 32; results are images.

    A scan's place is read by its programs, and not written down for each of its rays. They take the image column by
    column: rays of a few azimuths go about as far, those of a whole ring do not, and a warp waits for the longest.
    """
    rows = _launch(relief, origin, direction, block, limit, facing=True)
    return Hits(*rows[:3]), rows[3:]


def _launch(relief: Relief, origin: Array, direction: Array, block: Array, limit: Array, *, facing: bool) -> Any:
    """March rays, 32 by a program; return the rows of `Hits`, and of normals if asked.

    Rays have a place each, or those of a scan one, and then `direction` has two further axes.
    """
    from jax.experimental import pallas as pl
    from jax.experimental.pallas import triton

    shape, on_gpu = direction.shape[:-1], jax.default_backend() == "gpu"
    count = direction.size // 3
    ways = [jnp.pad(row, (0, -count % ROWS), mode="edge") for row in direction.reshape(-1, 3).T]
    row = pl.BlockSpec((ROWS,), lambda i: (i,))
    whole = pl.BlockSpec(memory_space=pl.ANY)
    if len(shape) == 3:
        programs = shape[1] * shape[2] // ROWS  # of a scan
        places, place = [*origin.T, block, limit], pl.BlockSpec((1,), lambda i: (i // programs,))
        row, image = whole, shape[1:]
    else:
        places = [jnp.pad(row, (0, -count % ROWS), mode="edge") for row in (*origin.T, block, limit)]
        place, image = row, None
    kinds = (jnp.float32, jnp.int32, jnp.int32, *(jnp.float32,) * 3 * facing)
    out = pl.pallas_call(
        partial(_kernel, n_x=relief.n_x, on_gpu=on_gpu, facing=facing, image=image),
        grid=(ways[0].shape[0] // ROWS,),
        in_specs=[row] * 3 + [place] * 5 + [whole] * len(ARRAYS),
        out_specs=[row] * len(kinds),
        out_shape=[jax.ShapeDtypeStruct(ways[0].shape, kind) for kind in kinds],
        compiler_params=triton.CompilerParams(num_warps=1, num_stages=1),
        interpret=not on_gpu,
    )(*ways, *places, *(getattr(relief, name).reshape(-1) for name in ARRAYS))
    return tuple(part[:count].reshape(shape) for part in out)


def _kernel(*refs: Any, n_x: int, on_gpu: bool, facing: bool, image: tuple[int, int] | None) -> None:
    """March 32 rays, those of an image column by column."""
    from jax.experimental import pallas as pl
    from jax.experimental.pallas import triton

    mine = None if image is None else _rays_of(image, pl.program_id(0))
    arrays = dict(zip(ARRAYS, refs[8 : 8 + len(ARRAYS)], strict=True))

    def load(name: str, index: Array, mask: Array | None = None) -> Any:
        if name not in PAIRS:
            return triton.load(arrays[name].at[index], mask=mask, other=None if mask is None else 0)
        # Both numbers by one instruction.
        column = jax.lax.broadcasted_iota(jnp.int32, (*index.shape, 2), 1)
        both = triton.load(arrays[name].at[2 * index[:, None] + column])
        return tuple(jnp.sum(jnp.where(column == i, both, 0), axis=1) for i in range(2))

    tools = Tools(load, *((fma, reciprocal) if on_gpu else (lambda a, b, c: a * b + c, lambda a: 1.0 / a)))
    # The place of a scan is one for all lanes.
    dx, dy, dz = (ref[...] if mine is None else triton.load(ref.at[mine]) for ref in refs[:3])
    ox, oy, oz, block, limit = (jnp.broadcast_to(ref[...], (ROWS,)) for ref in refs[3:8])
    origin, direction = (ox, oy, oz), (dx, dy, dz)
    hits = march(tools, n_x, origin, direction, block, limit)
    parts = (*hits, *(normals(tools, origin, direction, hits) if facing else ()))
    for ref, part in zip(refs[8 + len(ARRAYS) :], parts, strict=True):
        if mine is None:
            ref[...] = part
        else:
            triton.store(ref.at[mine], part)


def _rays_of(image: tuple[int, int], program: Array) -> Int[Array, ROWS]:
    """Return the rays of a program, images of so many rows and columns being cut into 32 rays column by column."""
    ray = program * ROWS + jax.lax.broadcasted_iota(jnp.int32, (ROWS,), 0)
    scan, within = ray // (image[0] * image[1]), ray % (image[0] * image[1])
    return scan * (image[0] * image[1]) + within % image[0] * image[1] + within // image[0]
