"""The 3-D LiDAR as one fused kernel for NVIDIA GPUs: a warp marches 32 rays, one in each lane, in registers."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from subterra_jax.lidar.kernels import fma, load_words, reciprocal
from subterra_jax.lidar3d.march import march
from subterra_jax.lidar3d.meeting import Hits, Point, Tools, normals
from subterra_jax.lidar3d.relief import ARRAYS, Relief

# Rays of one program: one warp, one ray a lane.
ROWS = 32
PAIRS = ("cell", "vertex")


def find(
    relief: Relief,
    origin: Float[Array, "n 3"],
    direction: Float[Array, "n 3"] | Float[Array, "n rows columns 3"],
    block: Int[Array, n],
    limit: Float[Array, n],
) -> tuple[Hits, Point]:
    """Find the first triangle that each ray meets, and its normal, as `march.march` and `meeting.normals`.

    Rays have a place each, or the images of `n` scans, each of a multiple of 32 rays, one; results are shaped likewise.
    A scan's place is read by its programs, and not written down for each of its rays. They take the image tile by
    tile: rays of a few azimuths go about as far, those of a whole ring do not, and a warp waits for the longest.
    """
    from jax.experimental import pallas as pl
    from jax.experimental.pallas import triton

    shape, count = direction.shape[:-1], direction.size // 3
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
    kinds = (jnp.float32, jnp.int32, jnp.int32, *(jnp.float32,) * 3)
    out = pl.pallas_call(
        partial(_kernel, image=image),
        grid=(ways[0].shape[0] // ROWS,),
        in_specs=[row] * 3 + [place] * 5 + [whole] * len(ARRAYS),
        out_specs=[row] * len(kinds),
        out_shape=[jax.ShapeDtypeStruct(ways[0].shape, kind) for kind in kinds],
        compiler_params=triton.CompilerParams(num_warps=1, num_stages=1),
        interpret=jax.default_backend() != "gpu",
    )(*ways, *places, *(getattr(relief, name).reshape(-1) for name in ARRAYS))
    parts = tuple(part[:count].reshape(shape) for part in out)
    return Hits(*parts[:3]), parts[3:]


def _kernel(*refs: Any, image: tuple[int, int] | None) -> None:
    """March 32 rays, those of an image by tiles."""
    from jax.experimental import pallas as pl
    from jax.experimental.pallas import triton

    mine = None if image is None else _rays_of(image, pl.program_id(0))
    arrays = dict(zip(ARRAYS, refs[8 : 8 + len(ARRAYS)], strict=True))

    def load(name: str, index: Array, mask: Array | None = None) -> Any:
        if name in PAIRS:
            return load_words(arrays[name], 2 * index, 2)
        return triton.load(arrays[name].at[index], mask=mask, other=None if mask is None else 0)

    tools = Tools(load, fma, reciprocal)
    # The place of a scan is one for all lanes.
    dx, dy, dz = (ref[...] if mine is None else triton.load(ref.at[mine]) for ref in refs[:3])
    ox, oy, oz, block, limit = (jnp.broadcast_to(ref[...], (ROWS,)) for ref in refs[3:8])
    origin, direction = (ox, oy, oz), (dx, dy, dz)
    hits = march(tools, origin, direction, block, limit)
    parts = (*hits, *normals(tools, origin, direction, hits))
    for ref, part in zip(refs[8 + len(ARRAYS) :], parts, strict=True):
        if mine is None:
            ref[...] = part
        else:
            triton.store(ref.at[mine], part)


def _tile(image: tuple[int, int]) -> tuple[int, int]:
    """Return the rows and columns of a tile of 32 rays: columns are near one another in images with many of them."""
    fits = [k for k in (1, 2, 4, 8, 16, 32) if image[0] % k == 0 and image[1] % (ROWS // k) == 0]
    tall = max((k for k in fits if k <= (16 if image[1] < 512 else 4)), default=fits[0])
    return tall, ROWS // tall


def _rays_of(image: tuple[int, int], program: Array) -> Int[Array, ROWS]:
    """Return the rays of a program, those of one tile of an image, column by column."""
    (rows, columns), (tall, wide) = image, _tile(image)
    lane, tiles, across = jax.lax.broadcasted_iota(jnp.int32, (ROWS,), 0), rows * columns // ROWS, columns // wide
    scan, tile = program // tiles, program % tiles
    row, column = tile // across * tall + lane % tall, tile % across * wide + lane // tall
    return (scan * rows + row) * columns + column
