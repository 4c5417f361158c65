"""Planar LiDAR: exact ranges to the wall polylines, by XLA (`cast`) or, for a batch on a GPU, by kernels (`fused`)."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import lax
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Bool, Float, Int

from subterra_jax import cast, fused
from subterra_jax.tunnel import Tunnel, node_at


@struct.dataclass
class LidarParams:
    """Planar LiDAR model.

    Attributes:
        range_max: Largest range, m. A beam that hits nothing reports exactly this.
        range_sigma: Standard deviation of the range noise, m.
        n_beams: Beams in one scan; fixes array shapes, so it is static.
        fused: Use the fused kernels where there is an NVIDIA GPU for them; off, XLA does it there too.
    """

    range_max: float = 30.0
    range_sigma: float = 0.05
    n_beams: int = struct.field(pytree_node=False, default=16)
    fused: bool = struct.field(pytree_node=False, default=True)


def scan(
    tunnel: Tunnel,
    position: Float[Array, "2"],
    heading: Float[Array, ""],
    station: Float[Array, ""],
    params: LidarParams,
    wanted: Bool[Array, ""] | bool = True,
) -> Float[Array, "n_beams"]:
    """True ranges of one scan: beam 0 straight ahead, the others counter-clockwise, evenly spaced over the whole turn.

    Args:
        tunnel: The tunnel.
        position: Position of the LiDAR, tunnel frame, m.
        heading: Its heading, rad.
        station: Its station, m; chooses the window of walls.
        params: The LiDAR.
        wanted: Whether anybody will look at it; where not, the ranges may be anything.

    Returns:
        Ranges without noise, m, in [0, range_max]; exactly `range_max` where a beam meets no wall within it, as when it
        leaves through a mouth.
    """
    first = tunnel.scan_first[node_at(tunnel, station)]
    take: Callable[..., Array] = _cast_fused if skips_unwanted(params) else _cast
    # Nothing that may differ within a batch but the rows themselves, or the kernels could not serve it.
    beams = dataclasses.replace(params, range_max=tunnel.reach, range_sigma=0.0)
    ranges = take(tunnel.walls, position, heading, first, jnp.asarray(wanted), beams)
    return jnp.minimum(ranges, params.range_max)


def skips_unwanted(params: LidarParams) -> bool:
    """Whether a batch of scans is cast by the fused kernels, which cost little for scans that nobody wants."""
    return params.fused and fused.supported(params.n_beams)


def _cast(
    tunnel: Tunnel,
    position: Float[Array, "2"],
    heading: Float[Array, ""],
    first: Int[Array, ""],
    wanted: Bool[Array, ""],
    params: LidarParams,
) -> Float[Array, "n_beams"]:
    """`scan` of a known window, by XLA, wanted or not."""
    del wanted
    direction = beam_directions(heading, params.n_beams)
    return jnp.minimum(cast.nearest(tunnel, first, position, direction), params.range_max)


# One scan is cast by XLA; a batch of them in one tunnel by the fused kernels, however many `vmap`s made it.
_cast_fused = custom_vmap(_cast)


@_cast_fused.def_vmap
def _cast_batch(axis_size: int, batched: Any, tunnel: Tunnel, *rest: Any) -> tuple[Array, bool]:
    rows, params = rest[:-1], rest[-1]
    if any(jax.tree.leaves((batched[0], batched[-1]))):
        by_xla: Callable[..., Array] = jax.vmap(_cast, in_axes=_axes(batched))
        return by_xla(tunnel, *rows, params), True
    return _cast_rows(tunnel, *_spread(rows, batched[1:-1], axis_size), params), True


@custom_vmap
def _cast_rows(
    tunnel: Tunnel, position: Array, heading: Array, first: Array, wanted: Array, params: LidarParams
) -> Float[Array, "n n_beams"]:
    """Many scans in one tunnel."""

    def by_kernel(
        tunnel: Tunnel, position: Array, heading: Array, first: Array, wanted: Array, params: LidarParams
    ) -> Array:
        return fused.scan(
            tunnel, position, heading, first, wanted, jnp.asarray(params.range_max), bearings(params.n_beams)
        )

    return lax.platform_dependent(
        tunnel, position, heading, first, wanted, params, cuda=by_kernel, default=_cast_by_xla
    )


@_cast_rows.def_vmap
def _cast_more_rows(axis_size: int, batched: Any, tunnel: Tunnel, *rest: Any) -> tuple[Array, bool]:
    """A further batch axis becomes part of the rows; where tunnels differ, XLA does it."""
    rows, params = rest[:-1], rest[-1]
    if any(jax.tree.leaves((batched[0], batched[-1]))):
        by_xla: Callable[..., Array] = jax.vmap(_cast_by_xla, in_axes=_axes(batched))
        return by_xla(tunnel, *rows, params), True
    flat = [row.reshape(-1, *row.shape[2:]) for row in _spread(rows, batched[1:-1], axis_size)]
    return _cast_rows(tunnel, *flat, params).reshape(axis_size, -1, params.n_beams), True


_cast_by_xla = jax.vmap(_cast, in_axes=(None, 0, 0, 0, 0, None))


def _axes(batched: Any) -> tuple[Any, ...]:
    """`in_axes` that say which arguments are batched."""
    return tuple(jax.tree.map(lambda is_batched: 0 if is_batched else None, batched))


def _spread(rows: tuple[Array, ...], batched: Any, axis_size: int) -> list[Array]:
    """All rows with a batch axis."""
    return [
        row if is_batched else jnp.broadcast_to(row, (axis_size, *row.shape))
        for row, is_batched in zip(rows, batched, strict=True)
    ]


def bearings(n_beams: int) -> Float[np.ndarray, "n_beams"]:
    """Of the beams from the heading, rad."""
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
    """Ranges as measured: true ranges plus noise, clipped to [0, range_max], m.

    A beam without a hit stays at exactly `range_max`: there is no echo for the noise to be in.

    Args:
        ranges: True ranges, m.
        noise: Standard normal numbers.
        params: The noise's size and the largest range.
    """
    noisy = jnp.clip(ranges + params.range_sigma * noise, 0.0, params.range_max)
    return jnp.where(ranges < params.range_max, noisy, params.range_max)
