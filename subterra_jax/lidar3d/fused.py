"""The 3-D LiDAR as one fused kernel for NVIDIA GPUs: a warp marches 32 rays, one in each lane, in registers."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from subterra_jax.lidar3d.march import march
from subterra_jax.lidar3d.meeting import Hits, Point, Tools, normals
from subterra_jax.lidar3d.relief import ARRAYS, Relief

# Rays of one program: one warp, one ray a lane.
_ROWS = 32
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


def _launch(relief: Relief, origin: Array, direction: Array, block: Array, limit: Array, *, facing: bool) -> Any:
    """March rays, 32 by a program; return the rows of `Hits`, and of normals if asked."""
    from jax.experimental import pallas as pl
    from jax.experimental.pallas import triton

    count, on_gpu = len(block), jax.default_backend() == "gpu"
    rows = [jnp.pad(row, (0, -count % _ROWS), mode="edge") for row in (*origin.T, *direction.T, block, limit)]
    row = pl.BlockSpec((_ROWS,), lambda i: (i,))
    whole = pl.BlockSpec(memory_space=pl.ANY)
    kinds = (jnp.float32, jnp.int32, jnp.int32, *(jnp.float32,) * 3 * facing)
    out = pl.pallas_call(
        partial(_kernel, n_x=relief.n_x, on_gpu=on_gpu, facing=facing),
        grid=(rows[0].shape[0] // _ROWS,),
        in_specs=[row] * 8 + [whole] * len(ARRAYS),
        out_specs=[row] * len(kinds),
        out_shape=[jax.ShapeDtypeStruct(rows[0].shape, kind) for kind in kinds],
        compiler_params=triton.CompilerParams(num_warps=1, num_stages=1),
        interpret=not on_gpu,
    )(*rows, *(getattr(relief, name).reshape(-1) for name in ARRAYS))
    return tuple(part[:count] for part in out)


def _kernel(*refs: Any, n_x: int, on_gpu: bool, facing: bool) -> None:
    """March 32 rays."""
    from jax.experimental.pallas import triton

    *rows, block_ref, limit_ref = refs[:8]
    arrays = dict(zip(ARRAYS, refs[8 : 8 + len(ARRAYS)], strict=True))

    def load(name: str, index: Array, mask: Array | None = None) -> Any:
        if name not in PAIRS:
            return triton.load(arrays[name].at[index], mask=mask, other=None if mask is None else 0)
        # Both numbers by one instruction.
        column = jax.lax.broadcasted_iota(jnp.int32, (*index.shape, 2), 1)
        both = triton.load(arrays[name].at[2 * index[:, None] + column])
        return tuple(jnp.sum(jnp.where(column == i, both, 0), axis=1) for i in range(2))

    tools = Tools(load, *((_fma, _reciprocal) if on_gpu else (lambda a, b, c: a * b + c, lambda a: 1.0 / a)))
    ox, oy, oz, dx, dy, dz = (ref[...] for ref in rows)
    origin, direction = (ox, oy, oz), (dx, dy, dz)
    hits = march(tools, n_x, origin, direction, block_ref[...], limit_ref[...])
    parts = (*hits, *(normals(tools, origin, direction, hits) if facing else ()))
    for ref, part in zip(refs[8 + len(ARRAYS) :], parts, strict=True):
        ref[...] = part


def _fma(a: Array, b: Any, c: Any) -> Array:
    """Return a · b + c by one instruction: XLA keeps Triton from joining the two."""
    return _instruction("fma.rn.f32 $0, $1, $2, $3;", "=f,f,f,f", a, b, c)


def _reciprocal(a: Array) -> Array:
    """Return 1 / a, off by a last bit at most, and 0 for what is not a normal number."""
    return _instruction("rcp.approx.ftz.f32 $0, $1;", "=f,f", a)


def _instruction(text: str, constraints: str, *numbers: Any) -> Array:
    from jax.experimental.pallas import triton

    shape = jnp.broadcast_shapes(*(jnp.shape(number) for number in numbers))
    arguments = [jnp.broadcast_to(jnp.asarray(number, jnp.float32), shape) for number in numbers]
    out = jax.ShapeDtypeStruct(shape, jnp.float32)
    (result,) = triton.elementwise_inline_asm(
        text, args=arguments, constraints=constraints, pack=1, result_shape_dtypes=[out]
    )
    return result
