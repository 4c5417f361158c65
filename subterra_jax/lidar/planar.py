"""Planar LiDAR: exact ranges to the wall polylines, by XLA or, for a batch, by kernels (`gpu`, `native`).

Walls come in short blocks, each in a thin box. XLA tests every beam against all boxes of a window with a few products,
and then meets the true segments of the few blocks that the beam enters first, and of further ones as long as these do
not decide. Nothing about the walls is approximated; the cost depends neither on the tunnel's length nor, much, on its
pockets.
"""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from subterra_jax import constants
from subterra_jax.lidar import gpu, kernels
from subterra_jax.rows import rowwise, slope_along, vary_like
from subterra_jax.tunnel import Tunnel, node_at

_NOTHING = np.int32(2**31 - 1)


@struct.dataclass
class LidarParams:
    """Planar LiDAR model.

    Attributes:
        range_max: Largest range, m. A beam that hits nothing reports exactly this.
        range_sigma: Standard deviation of the range noise, m.
        n_beams: Beams in one scan; fixes array shapes, so it is static.
        fused: Use kernels where there are any, for NVIDIA GPUs and for CPUs with numba; off, XLA does it everywhere.
        intensity: Observe intensities too, of a wall without pockets.
        texture: Dial of the walls' texture, 0 to 1; `None` has none, and costs nothing.
    """

    range_max: float = constants.RANGE_MAX
    range_sigma: float = constants.RANGE_SIGMA
    n_beams: int = struct.field(pytree_node=False, default=constants.N_BEAMS)
    fused: bool = struct.field(pytree_node=False, default=True)
    intensity: bool = struct.field(pytree_node=False, default=False)
    texture: Float[Array, ""] | float | None = None


def scan(
    tunnel: Tunnel,
    position: Float[Array, "2"],
    heading: Float[Array, ""],
    station: Float[Array, ""],
    params: LidarParams,
    needed: Bool[Array, ""] | bool = True,
) -> Float[Array, "n_beams"]:
    """True ranges of one scan: beam 0 straight ahead, the others counter-clockwise, evenly spaced over the whole turn.

    Args:
        position: Position of the LiDAR, tunnel frame, m.
        heading: Its heading, rad.
        station: Its station, m; chooses the window of walls.
        needed: Someone will read the scan; where not, the ranges may be anything.

    Returns:
        Ranges without noise, m, in [0, range_max]; exactly `range_max` where a beam meets no wall within it, as when it
        leaves through a mouth.
    """
    node = node_at(tunnel, station)
    # Nothing that may differ within a batch but the rows themselves, or the kernels could not serve it.
    beams = dataclasses.replace(params, range_max=tunnel.reach, range_sigma=0.0)
    # The kernels know 32 bits.
    by_kernels = params.fused and kernels.present() and position.dtype == jnp.float32 and tunnel.packed is not None
    ranges = _true_ranges(by_kernels, (tunnel.walls, beams), position, heading, node, jnp.asarray(needed))
    return jnp.minimum(ranges, params.range_max)


def skips_unneeded(params: LidarParams) -> bool:
    """Tell whether the fused kernels cast a batch of scans; they cost little for scans that nobody wants."""
    return params.fused and kernels.on_nvidia()


def _cast(
    what: tuple[Tunnel, LidarParams],
    position: Float[Array, "2"],
    heading: Float[Array, ""],
    node: Int[Array, ""],
    needed: Bool[Array, ""],
) -> Float[Array, "n_beams"]:
    """`scan` from a known node, by XLA, needed or not."""
    del needed
    tunnel, params = what
    direction = beam_directions(heading, params.n_beams)
    return jnp.minimum(nearest(tunnel, tunnel.scan_first[node], position, direction), params.range_max)


def _by(kernel: Callable[..., Array]) -> Callable[..., Array]:
    """A kernel for many scans in one tunnel, with the arguments of `_cast`."""

    def cast_rows(
        what: tuple[Tunnel, LidarParams], position: Array, heading: Array, node: Array, needed: Array
    ) -> Array:
        tunnel, params = what
        limit = jnp.asarray(params.range_max)
        start = tunnel.visit_first[node]
        ranges = kernel(tunnel, position, heading, start, needed, limit, bearings(params.n_beams))
        return vary_like(ranges, position, heading, node)

    return cast_rows


_cast_rows = kernels.fastest(
    jax.vmap(_cast, in_axes=(None, 0, 0, 0, 0)), _by(gpu.scan), _by(kernels.compiled_by_numba("scan"))
)
# One scan is cast by XLA; a batch of them in one tunnel by the kernels, however many `vmap`s made it.
_cast_by_kernels = rowwise(_cast, lambda what, *rows: _cast_rows(what, *rows))


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _true_ranges(
    by_kernels: bool,
    what: tuple[Tunnel, LidarParams],
    position: Float[Array, "2"],
    heading: Float[Array, ""],
    node: Int[Array, ""],
    needed: Bool[Array, ""],
) -> Float[Array, "n_beams"]:
    """`scan` from a known node, differentiable by the pose and by the walls."""
    take: Callable[..., Array] = _cast_by_kernels if by_kernels else _cast
    return take(what, position, heading, node, needed)


def _range_slopes(by_kernels: bool, primals: Any, tangents: Any) -> tuple[Array, Array]:
    """Ranges, and how they change: the wall that a beam meets stays the same."""
    (tunnel, params), position, heading, node, _ = primals
    (along_tunnel, _), *along_pose = tangents[:3]
    block, vertex = _met(tunnel, tunnel.scan_first[node], position, beam_directions(heading, params.n_beams))
    ranges = _true_ranges(by_kernels, *primals)

    def measured(tunnel: Tunnel, position: Array, heading: Array) -> Array:
        return _to_segment(tunnel, block, vertex, position, beam_directions(heading, params.n_beams))

    slope = slope_along(measured, (tunnel, position, heading), (along_tunnel, *along_pose))
    return ranges, jnp.where(ranges < params.range_max, slope, 0.0)


_true_ranges.defjvp(_range_slopes, symbolic_zeros=True)


def bearings(n_beams: int) -> Float[np.ndarray, "n_beams"]:
    """Return the angles of the beams from the heading, rad."""
    return np.arange(n_beams) * (2.0 * np.pi / n_beams)


def beam_directions(heading: Float[Array, ""], n_beams: int) -> Float[Array, "n_beams 2"]:
    """Unit vectors of the beams in the tunnel frame."""
    bearing = bearings(n_beams)
    # Rotating constants keeps more digits than adding a bearing to a heading in float32.
    cos, sin = jnp.cos(heading), jnp.sin(heading)
    along, across = np.float32(np.cos(bearing)), np.float32(np.sin(bearing))
    return jnp.stack([cos * along - sin * across, sin * along + cos * across], axis=-1)


def add_noise(
    ranges: Float[Array, "n_beams"], noise: Float[Array, "n_beams"], params: LidarParams
) -> Float[Array, "n_beams"]:
    """Ranges as measured: true ranges plus noise, made of standard normal numbers, clipped to [0, range_max], m.

    A beam without a hit stays at exactly `range_max`: there is no echo for the noise to be in.
    """
    noisy = jnp.clip(ranges + params.range_sigma * noise, 0.0, params.range_max)
    return jnp.where(ranges < params.range_max, noisy, params.range_max)


def nearest(
    tunnel: Tunnel, first: Int[Array, ""], position: Float[Array, "2"], direction: Float[Array, "n_beams 2"]
) -> Float[Array, "n_beams"]:
    """Distance at which each beam first meets a wall, m; `inf` where it meets none.

    Args:
        first: First block of the window.
        position: Origin of the beams, tunnel frame, m.
        direction: Their unit vectors; if their number is even, the second half must oppose the first.
    """
    return _search(tunnel, first, position, direction, which=False).distance


class _Found(NamedTuple):
    """Nearest walls after some rounds of a search."""

    distance: Float[Array, "n_beams"]  # to the nearest wall so far along each beam, m
    block: Int[Array, "n_beams"]  # the block that it is of
    last: Int[Array, "n_beams"]  # key of the farthest box looked into, as `_entries` makes it
    open: Bool[Array, "n_beams"]  # a nearer wall may stand in a box not yet looked into


def _search(
    tunnel: Tunnel,
    first: Int[Array, ""],
    position: Float[Array, "2"],
    direction: Float[Array, "n_beams 2"],
    which: bool,
) -> _Found:
    """Look into boxes in the order in which each beam enters them, a few a round, until none is left before its wall.

    One round is enough for nearly every scan, but not beside a row of deep recesses, whose thick boxes a beam along the
    wall enters one after another. The blocks are found only if `which`.
    """
    n_beams, n_bits = direction.shape[0], (tunnel.n_scan - 1).bit_length()

    def look(found: _Found) -> _Found:
        key = _following(tunnel, first, position, direction, found.last)
        block = first + (key & jnp.int32((1 << n_bits) - 1))
        # A beam that enters fewer boxes gets arbitrary blocks for the rest: a hit on any wall is a hit.
        block = jnp.minimum(block, tunnel.box.shape[1] - 1)
        each = _hits(tunnel, block, position, direction)
        last, distance = key[:, -1], jnp.minimum(found.distance, jnp.min(each, axis=-1))
        met = jnp.take_along_axis(block, jnp.argmin(each, axis=-1)[:, None], axis=-1)[:, 0]
        entry = lax.bitcast_convert_type(last & jnp.int32(-(1 << n_bits)), jnp.float32)
        met = jnp.where(distance < found.distance, met, found.block) if which else found.block
        return _Found(distance, met, last, (last != _NOTHING) & (entry <= distance))

    start = _Found(
        jnp.full(n_beams, jnp.inf, direction.dtype),
        jnp.zeros(n_beams, jnp.int32),
        jnp.full(n_beams, -1, jnp.int32),
        jnp.ones(n_beams, bool),
    )
    start = vary_like(start, tunnel.box, first, position, direction)
    return lax.while_loop(lambda found: jnp.any(found.open), look, start)


def _following(
    tunnel: Tunnel,
    first: Int[Array, ""],
    position: Float[Array, "2"],
    direction: Float[Array, "n_beams 2"],
    last: Int[Array, "n_beams"],
) -> Int[Array, "n_beams n_candidates"]:
    """Return the keys of the boxes that each beam enters next after the `last`, nearest first; then `_NOTHING`.

    With m the middle of a box and e its half axis, both from the LiDAR, a line along d crosses the box if
    |d × m| ≤ |d × e| + thickness, and does so at the distance (m × e) / (d × e), whose numerator all beams share.
    """
    n_beams, n_bits = direction.shape[0], (tunnel.n_scan - 1).bit_length()
    # Opposite beams share a line, and so everything but its sense.
    n_lines = n_beams if n_beams % 2 else n_beams // 2
    # Without the planes: a batch copies its windows.
    box = lax.dynamic_slice_in_dim(tunnel.box[:6], first, tunnel.n_scan, axis=1)
    number = jnp.arange(tunnel.n_scan, dtype=jnp.int32)
    senses = _entries(box, number, n_bits, position, direction[:n_lines])
    following = []
    for sense in range(n_beams // n_lines):
        rest, found = senses[sense], [last[sense * n_lines : (sense + 1) * n_lines]]
        for _ in range(tunnel.n_candidates):
            rest = jnp.where(rest > found[-1][None], rest, _NOTHING)
            found.append(jnp.min(rest, axis=0))
        following.append(jnp.stack(found[1:], axis=-1))
    return jnp.concatenate(following)


def _entries(
    box: Float[Array, "6 k"],
    number: Int[Array, "k"],
    n_bits: int,
    position: Float[Array, "2"],
    lines: Float[Array, "m 2"],
) -> tuple[Int[Array, "k m"], Int[Array, "k m"]]:
    """For each box and line, the distance of the crossing and the box's number in one sortable integer.

    Returns:
        Crossings ahead, and crossings behind; `_NOTHING` where there is none. Distances lose their last `n_bits` to the
        number, which makes them less by up to a few millimetres, never more.
    """
    box, number = box[:, :, None], number[:, None]
    m_x, m_y, thickness = box[0] - position[0], box[1] - position[1], box[4]
    turn = m_x * box[3] - m_y * box[2]
    # With e turned so that m × e ≥ 0, the sign of d × e tells whether the crossing lies ahead or behind.
    e_x, e_y = jnp.where(turn < 0.0, -box[2], box[2]), jnp.where(turn < 0.0, -box[3], box[3])
    to_face = jnp.abs(turn) - thickness * box[5]
    # Looking along a wall, from between the two faces of its box, one may meet it ahead or behind.
    outside = to_face > 0.0
    to_face, least = jnp.where(outside, to_face, 0.0), jnp.where(outside, 0.0, -jnp.inf)
    d_x, d_y = lines[None, :, 0], lines[None, :, 1]
    beside = jnp.abs(d_x * m_y - d_y * m_x)
    facing = d_x * e_y - d_y * e_x
    distance = to_face / (jnp.abs(facing) + 1e-20)
    # Distances are not negative, so their bits sort like integers, and the last bits can carry the block's number: one
    # minimum finds the nearest box and which it is.
    key = lax.bitcast_convert_type(distance.astype(jnp.float32), jnp.int32) & jnp.int32(-(1 << n_bits)) | number
    key = jnp.where(beside <= jnp.abs(facing) + thickness, key, _NOTHING)
    return jnp.where(facing > least, key, _NOTHING), jnp.where(-facing > least, key, _NOTHING)


def _hits(
    tunnel: Tunnel,
    block: Int[Array, "n_beams n_blocks"],
    position: Float[Array, "2"],
    direction: Float[Array, "n_beams 2"],
) -> Float[Array, "n_beams n_blocks"]:
    """Distance at which each beam meets the nearest wall of each of a few blocks, m; `inf` where it meets none."""
    distance = _distances(tunnel, block, position, direction)
    # As integers, because a minimum of floats must look out for NaN, which costs a quarter of this function on a CPU.
    as_bits = jnp.dtype(f"int{8 * distance.dtype.itemsize}")
    bits = lax.bitcast_convert_type(distance, as_bits)
    return lax.bitcast_convert_type(jnp.min(bits, axis=-1), distance.dtype)


def _distances(
    tunnel: Tunnel,
    block: Int[Array, "n_beams n_blocks"],
    position: Float[Array, "2"],
    direction: Float[Array, "n_beams 2"],
) -> Float[Array, "n_beams n_blocks n_segments"]:
    """Distance at which each beam meets each segment of its blocks, m; `inf` where it does not."""
    m_x, m_y = tunnel.box[0, block] - position[0], tunnel.box[1, block] - position[1]
    d_x, d_y = direction[:, 0, None], direction[:, 1, None]
    # Middle first, then vertices from it: large coordinates cancel before anything is rounded.
    middle_left, middle_ahead = d_x * m_y - d_y * m_x, d_x * m_x + d_y * m_y
    x, y = tunnel.wall[block, 0], tunnel.wall[block, 1]
    d_x, d_y = d_x[..., None], d_y[..., None]
    left = middle_left[..., None] + (d_x * y - d_y * x)
    ahead = middle_ahead[..., None] + (d_x * x + d_y * y)
    a, b = left[..., :-1], left[..., 1:]
    # A beam through the joint of two blocks must meet one of them although their ends are rounded apart.
    joint = (2e-7 * (1.0 + jnp.abs(middle_ahead)))[..., None]
    meets = (jnp.minimum(a, b) <= joint) & (jnp.maximum(a, b) >= -joint)
    fraction = jnp.clip(a / jnp.where(a == b, 1.0, a - b), 0.0, 1.0)
    distance = ahead[..., :-1] + fraction * (ahead[..., 1:] - ahead[..., :-1])
    return jnp.where(meets & (distance >= 0.0), distance, jnp.inf)


def _met(
    tunnel: Tunnel, first: Int[Array, ""], position: Float[Array, "2"], direction: Float[Array, "n_beams 2"]
) -> tuple[Int[Array, "n_beams"], Int[Array, "n_beams"]]:
    """Block and first vertex of the segment that each beam meets first; any segment for a beam that meets none."""
    block = _search(tunnel, first, position, direction, which=True).block
    distance = _distances(tunnel, block[:, None], position, direction)[:, 0]
    return block, jnp.argmin(distance, axis=-1).astype(jnp.int32)


def _to_segment(
    tunnel: Tunnel,
    block: Int[Array, "n_beams"],
    vertex: Int[Array, "n_beams"],
    position: Float[Array, "2"],
    direction: Float[Array, "n_beams 2"],
) -> Float[Array, "n_beams"]:
    """Distance from the LiDAR to the line through a given segment, along each beam, m.

    Its derivatives are those of a range. With the wall's normal n, that by the position is -n / (n · direction).
    """
    middle = tunnel.box[:2, block].T - position[None]
    a, b = middle + tunnel.wall[block, :, vertex], middle + tunnel.wall[block, :, vertex + 1]
    edge = b - a
    beside = direction[:, 0] * edge[:, 1] - direction[:, 1] * edge[:, 0]
    return (a[:, 0] * edge[:, 1] - a[:, 1] * edge[:, 0]) / jnp.where(beside == 0.0, 1.0, beside)
