"""The LiDAR as two fused kernels for NVIDIA GPUs.

The same boxes and the same segments as in `cast`, with nothing written to memory in between but a few block numbers a
beam: for 65,536 environments XLA moves about a gigabyte a step where this moves 25 MB. `cast` stays the reference, and
is what runs everywhere else.

Robots in different tunnels read different blocks, which a chip's cache does not hold, so time goes by waiting for
memory. A few neighbouring threads therefore serve one robot, and read its boxes and vertices side by side; each robot
reads those that it needs and no further ones; see `tunnel.packed`.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from subterra_jax.lidar import nvidia
from subterra_jax.lidar.boxes import MOST_LINES, ROWS, Beams, boxes_kernel
from subterra_jax.lidar.hits import hits_kernel
from subterra_jax.tunnel import Tunnel
from subterra_jax.tunnel.packed import packed_blocks


def supported(n_beams: int) -> bool:
    """Tell whether the kernels can run: on an NVIDIA GPU, with an even number of beams (opposite ones share a line)."""
    return n_beams % 2 == 0 and nvidia.present()


def scan(
    tunnel: Tunnel,
    position: Float[Array, "n 2"],
    heading: Float[Array, " n"],
    first: Int[Array, " n"],
    wanted: Bool[Array, " n"],
    range_max: Float[Array, ""],
    bearing: np.ndarray,
) -> Float[Array, "n n_beams"]:
    """True ranges of many scans in one tunnel.

    Args:
        tunnel: The tunnel, one for all.
        position: Positions of the LiDAR, tunnel frame, m.
        heading: Its headings, rad.
        first: First block of each window.
        wanted: Which scans to take. Where none of 4 neighbours is wanted they cost next to nothing, and hold anything.
        range_max: Largest range, m.
        bearing: Of each beam from the heading, rad; the second half opposes the first.

    Returns:
        As `lidar.scan`.
    """
    from jax.experimental import pallas as pl
    from jax.experimental.pallas import triton

    interpret = jax.default_backend() != "gpu"
    n_rows = 8 * ROWS if interpret else ROWS  # the interpreter takes programs one after another
    count, n_beams, n_best = position.shape[0], len(bearing), tunnel.n_candidates
    rows = [
        jnp.pad(row, (0, -count % n_rows), mode="edge")
        for row in (first, wanted.astype(jnp.int32), *position.T, heading)
    ]
    n, n_lines = rows[0].shape[0], n_beams // 2
    width = max(w for w in range(1, MOST_LINES + 1) if n_lines % w == 0)
    turn = jnp.asarray(np.concatenate([np.cos(bearing), np.sin(bearing)]), jnp.float32)
    packed = packed_blocks(tunnel)
    box, walls = packed.box.reshape(-1), (jnp.asarray(packed.start), packed.wall.reshape(-1))
    beams = Beams(n, n_beams, n_best, tunnel.n_scan, tunnel.box.shape[1], (tunnel.wall.shape[2] + 1) // 2, n_rows)
    whole = pl.BlockSpec(memory_space=pl.ANY)
    call = partial(
        pl.pallas_call,
        out_specs=whole,
        compiler_params=triton.CompilerParams(num_warps=1, num_stages=1),
        interpret=interpret,
    )
    key = call(
        partial(boxes_kernel, beams=beams, width=width),
        grid=(n // n_rows, n_lines // width),
        in_specs=[whole] * 7,
        out_shape=jax.ShapeDtypeStruct((n * n_beams * beams.n_words,), jnp.int32),
    )(*rows, turn, box)
    ranges = call(
        partial(hits_kernel, beams=beams),
        grid=(n // n_rows,),
        in_specs=[whole] * 11,
        out_shape=jax.ShapeDtypeStruct((n_beams * n,), jnp.float32),
    )(key, *rows, turn, jnp.asarray(range_max, jnp.float32).reshape(1), box, *walls)
    return ranges.reshape(n_beams, n)[:, :count].T
