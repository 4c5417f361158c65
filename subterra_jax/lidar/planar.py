"""Planar LiDAR: exact ranges to the wall polylines, by XLA (`cast`) or, for a batch, by kernels (`gpu`, `native`)."""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from subterra_jax import constants
from subterra_jax.lidar import cast, gpu, kernels
from subterra_jax.rows import rowwise, slope_along, vary_like
from subterra_jax.tunnel import Tunnel, node_at


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
    return jnp.minimum(cast.nearest(tunnel, tunnel.scan_first[node], position, direction), params.range_max)


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
    block, vertex = cast.met(tunnel, tunnel.scan_first[node], position, beam_directions(heading, params.n_beams))
    ranges = _true_ranges(by_kernels, *primals)

    def measured(tunnel: Tunnel, position: Array, heading: Array) -> Array:
        return cast.to_segment(tunnel, block, vertex, position, beam_directions(heading, params.n_beams))

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
