"""The robot: a unicycle that moves along exact arcs, and its distance to the walls."""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from subterra_jax import constants
from subterra_jax.lidar import gpu, kernels
from subterra_jax.parts.part import Drive, Motion, Moved
from subterra_jax.rows import rowwise, slope_along, vary_like
from subterra_jax.state import EnvParams, State
from subterra_jax.tunnel import CONTACT_REACH, Tunnel, node_at


@struct.dataclass
class VehicleParams:
    """Unicycle with a round footprint.

    Attributes:
        speed_max: Largest forward speed, m/s; the robot cannot reverse.
        yaw_rate_max: Largest yaw rate to either side, rad/s.
        radius: Radius of the footprint, m; at most 0.8, the distance at which walls are looked for, and at least 0.2 m
            more than the motion of one step, so that contact is noticed before the LiDAR is in a wall.
        period: Control period, s.
    """

    speed_max: float = constants.SPEED_MAX
    yaw_rate_max: float = constants.YAW_RATE_MAX
    radius: float = constants.RADIUS
    period: float = constants.PERIOD


def clip_action(action: Float[Array, "2"], params: VehicleParams) -> Float[Array, "2"]:
    """Clip a command, m/s and rad/s counter-clockwise, to the robot's limits; a NaN is read as 0."""
    limit = jnp.stack([params.speed_max, params.yaw_rate_max])
    floor = jnp.stack([jnp.zeros_like(limit[0]), -limit[1]])
    return jnp.clip(jnp.where(jnp.isnan(action), 0.0, action), floor, limit)


def wrap(angle: Float[Array, ""]) -> Float[Array, ""]:
    """Bring an angle into [-π, π], rad, for angles less than a turn outside."""
    turn = 2.0 * jnp.pi
    return jnp.where(angle > jnp.pi, angle - turn, jnp.where(angle < -jnp.pi, angle + turn, angle))


def follow_arc(
    position: Float[Array, "2"], heading: Float[Array, ""], command: Float[Array, "2"], period: Float[Array, ""]
) -> tuple[Float[Array, "2"], Float[Array, ""]]:
    """Return position (m) and heading (rad) after the exact arc of a constant command, m/s and rad/s, for a period, s.

    Speed 0 turns on the spot; yaw rate 0 is a straight line, not a division by 0.
    """
    half_turn = 0.5 * command[1] * period
    small = jnp.abs(half_turn) < 1e-2
    ratio = jnp.where(small, 1.0 - half_turn * half_turn / 6.0, jnp.sin(half_turn) / jnp.where(small, 1.0, half_turn))
    chord = command[0] * period * ratio
    direction = heading + half_turn
    moved = jnp.stack([position[0] + chord * jnp.cos(direction), position[1] + chord * jnp.sin(direction)])
    return moved, wrap(heading + 2.0 * half_turn)


def clearance(tunnel: Tunnel, position: Float[Array, "2"], station: Float[Array, ""]) -> Float[Array, ""]:
    """Measure the distance from a point (m, at a station, m) to the nearest wall or furniture, m.

    It is exact up to 0.8 m, and exactly that where the truth is beyond.
    """
    node = node_at(tunnel, station)
    # The kernels know 32 bits.
    by_kernel = kernels.present() and position.dtype == jnp.float32 and tunnel.packed is not None
    return _measured_gap(by_kernel, tunnel.walls, position, node)


def nearest_wall(tunnel: Tunnel, position: Float[Array, "2"], station: Float[Array, ""]) -> Float[Array, "2"]:
    """Return the vector from a point to the nearest point of a wall, m; as exact as `clearance`."""
    x, y = (part.reshape(-1) for part in _nearest_points(tunnel.walls, position, node_at(tunnel, station)))
    nearest = jnp.argmin(x * x + y * y)
    return jnp.stack([x[nearest], y[nearest]])


def _gap(tunnel: Tunnel, position: Float[Array, "2"], node: Int[Array, ""]) -> Float[Array, ""]:
    """Compute `clearance` from a known node, by XLA."""
    near_x, near_y = _nearest_points(tunnel, position, node)
    return jnp.minimum(jnp.sqrt(jnp.min(near_x * near_x + near_y * near_y)), CONTACT_REACH)


def _nearest_points(
    tunnel: Tunnel, position: Float[Array, "2"], node: Int[Array, ""]
) -> tuple[Float[Array, "n_contact n_segments"], Float[Array, "n_contact n_segments"]]:
    """Return x and y of the nearest point of each segment in the window of a node, from a position, m."""
    window = tunnel.contact_first[node] + jnp.arange(tunnel.n_contact, dtype=jnp.int32)
    vertex = (tunnel.box[:2, window].T - position[None])[:, :, None] + tunnel.wall[window]
    x0, y0, x1, y1 = vertex[:, 0, :-1], vertex[:, 1, :-1], vertex[:, 0, 1:], vertex[:, 1, 1:]
    edge_x, edge_y = x1 - x0, y1 - y0
    size = edge_x * edge_x + edge_y * edge_y
    # Padding repeats a vertex: a segment of length 0, whose nearest point is its start.
    fraction = jnp.clip(-(x0 * edge_x + y0 * edge_y) / jnp.where(size > 0.0, size, 1.0), 0.0, 1.0)
    return x0 + fraction * edge_x, y0 + fraction * edge_y


def _by(kernel: Callable[..., Array]) -> Callable[..., Array]:
    """A kernel whose distances vary like the points."""
    return lambda tunnel, position, node: vary_like(kernel(tunnel, position, tunnel.visit_first[node]), position, node)


_gap_rows = kernels.fastest(
    jax.vmap(_gap, in_axes=(None, 0, 0)), _by(gpu.clearance), _by(kernels.compiled_by_numba("clearance"))
)
_gap_by_kernel = rowwise(_gap, _gap_rows)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _measured_gap(
    by_kernel: bool, tunnel: Tunnel, position: Float[Array, "2"], node: Int[Array, ""]
) -> Float[Array, ""]:
    """Compute `clearance` from a known node, differentiable by the position and by the walls."""
    take: Callable[..., Array] = _gap_by_kernel if by_kernel else _gap
    return take(tunnel, position, node)


def _gap_slope(by_kernel: bool, primals: Any, tangents: Any) -> tuple[Array, Array]:
    """Return the clearance, and how it changes: the nearest point stays the nearest."""
    gap = _measured_gap(by_kernel, *primals)
    node = primals[2]
    x, y = _nearest_points(*primals)
    nearest = jnp.argmin((x * x + y * y).reshape(-1))

    def measured(tunnel: Tunnel, position: Array) -> Array:
        x, y = (part.reshape(-1)[nearest] for part in _nearest_points(tunnel, position, node))
        size = x * x + y * y
        return jnp.sqrt(jnp.where(size > 0.0, size, 1.0))

    return gap, jnp.where(gap < CONTACT_REACH, slope_along(measured, primals[:2], tangents[:2]), 0.0)


_measured_gap.defjvp(_gap_slope, symbolic_zeros=True)


def in_contact(
    tunnel: Tunnel, clear: Float[Array, ""], station: Float[Array, ""], params: VehicleParams
) -> Bool[Array, ""]:
    """Tell whether the footprint touches anything, or lies wholly outside one of the mouths.

    Contact is judged at the end of each control period. In one period the robot moves at most half its radius, so it
    cannot pass through a wall unseen. Leaving through a mouth counts as contact, because no wall goes on there.

    Args:
        clear: Distance from the middle of the robot to the nearest obstacle, m.
        station: Station of the robot, m.
    """
    outside = (station < -params.radius) | (station > tunnel.length + params.radius)
    return (clear < params.radius) | outside


@dataclasses.dataclass(frozen=True)
class Unicycle(Motion):
    """A robot on wheels that does what its wheels do."""

    name: ClassVar[str] = "vehicle"

    def defaults(self) -> dict[str, Any]:
        return {"vehicle": VehicleParams()}

    def obey(self, action: Float[Array, "n_action"], state: State, params: EnvParams) -> Float[Array, "2"]:
        return clip_action(action[:2], params.vehicle)

    def move(self, state: State, drive: Drive, noise: Any, tunnel: Tunnel, params: EnvParams) -> Moved:
        position, heading = follow_arc(state.position, state.heading, drive.motion, jnp.asarray(params.vehicle.period))
        return Moved(position, heading, drive, (), jnp.inf, False, False, {})
