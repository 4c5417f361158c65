"""Distances from points to the nearest wall as one fused kernel for NVIDIA GPUs."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from subterra_jax.lidar.fused import all_if_full, length_of, packed_blocks, unpack
from subterra_jax.tunnel import CONTACT_REACH, Tunnel
from subterra_jax.tunnel.packed import ALL_PAIRS, WORDS

# Points of one program and pairs of vertices that are looked at together: one warp.
_POINTS, _PAIRS = 4, 8
# Distance to a box from which its walls are left out, m: beyond the reach by more than rounding and a lid's depth.
_FAR = CONTACT_REACH + 0.25


def supported() -> bool:
    """Tell whether the kernel can run: on an NVIDIA GPU."""
    return jax.default_backend() == "gpu" and "nvidia" in jax.devices()[0].device_kind.lower()


def clearance(tunnel: Tunnel, position: Float[Array, "n 2"], first: Int[Array, " n"]) -> Float[Array, " n"]:
    """Measure the distances from many points in one tunnel to the nearest segment.

    Args:
        tunnel: The tunnel, one for all.
        position: The points, tunnel frame, m.
        first: First block of each contact window.

    Returns:
        As `unicycle.clearance`.
    """
    from jax.experimental import pallas as pl
    from jax.experimental.pallas import triton

    count, on_gpu, packed = len(first), jax.default_backend() == "gpu", packed_blocks(tunnel)
    rows = [jnp.pad(row, (0, -count % _POINTS), mode="edge") for row in (first, *position.T)]
    whole = pl.BlockSpec(memory_space=pl.ANY)
    gap = pl.pallas_call(
        partial(_kernel, n_contact=tunnel.n_contact, n_numbers=packed.wall.shape[1]),
        grid=(len(rows[0]) // _POINTS,),
        in_specs=[whole] * 5,
        out_specs=pl.BlockSpec((_POINTS,), lambda i: (i,)),
        out_shape=jax.ShapeDtypeStruct(rows[0].shape, jnp.float32),
        compiler_params=triton.CompilerParams(num_warps=1, num_stages=1),
        interpret=not on_gpu,
    )(*rows, packed.box.reshape(-1), packed.wall.reshape(-1))
    return gap[:count]


def _kernel(first_ref, x_ref, y_ref, box_ref, wall_ref, gap_ref, *, n_contact: int, n_numbers: int):
    """Look into the blocks of the windows whose boxes are near, a pair of vertices of one point in each lane."""
    from jax.experimental import pallas as pl
    from jax.experimental.pallas import triton

    shape = _POINTS, _PAIRS
    point = pl.program_id(0) * _POINTS + lax.broadcasted_iota(jnp.int32, shape, 0)
    lane = lax.broadcasted_iota(jnp.int32, shape, 1)
    first, x, y = (triton.load(ref.at[point]) for ref in (first_ref, x_ref, y_ref))

    def look(number, nearest):
        block = first + number
        words = tuple(triton.load(box_ref.at[WORDS * block + i]) for i in range(WORDS))
        m_x, m_y, e_x, e_y, thickness, pairs, _ = unpack(words)
        m_x, m_y = m_x - x, m_y - y
        length = length_of(e_x, e_y)
        near = (thickness > 0.0) & (jnp.abs(m_x * e_y - m_y * e_x) <= (thickness + _FAR) * length + 1e-6)
        near = near & (jnp.abs(m_x * e_x + m_y * e_y) <= (length + thickness + _FAR) * length + 1e-6)
        pairs = jnp.where(near, all_if_full(pairs, ALL_PAIRS, n_numbers // WORDS), 0)

        def measure():
            least = nearest
            for begin in range(0, n_numbers // WORDS, _PAIRS):
                least = _measure(wall_ref, block * n_numbers, begin + lane, pairs, m_x, m_y, least)
            return least

        return lax.cond(jnp.max(pairs) > 0, measure, lambda: nearest)

    nearest = lax.fori_loop(0, n_contact, look, jnp.full(shape, CONTACT_REACH * CONTACT_REACH, jnp.float32))
    gap_ref[...] = jnp.minimum(jnp.sqrt(jnp.min(nearest, axis=1)), CONTACT_REACH)


def _measure(wall_ref, start, pair, pairs, m_x, m_y, nearest):
    """The least square of the distance to the segments that begin in a pair of vertices, if less than `nearest`."""
    from jax.experimental.pallas import triton

    here, next_ = pair < pairs, pair + 1 < pairs

    def vertex(i):
        mask = here if i < 2 else next_
        x, y = (triton.load(wall_ref.at[start + WORDS * pair + 2 * i + j], mask=mask, other=0.0) for j in range(2))
        return m_x + x, m_y + y

    vertices = [vertex(i) for i in range(3)]
    for i, there in enumerate((here, next_)):
        (x0, y0), (x1, y1) = vertices[i], vertices[i + 1]
        edge_x, edge_y = x1 - x0, y1 - y0
        size = edge_x * edge_x + edge_y * edge_y
        share = jnp.clip(-(x0 * edge_x + y0 * edge_y) / jnp.where(size > 0.0, size, 1.0), 0.0, 1.0)
        near_x, near_y = x0 + share * edge_x, y0 + share * edge_y
        nearest = jnp.where(there, jnp.minimum(nearest, near_x * near_x + near_y * near_y), nearest)
    return nearest
