"""What the robot perceives: ranges and dead reckoning, through obstacles and faults where a task has them."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from subterra_jax import faults, lidar, obstacles
from subterra_jax.state import EnvParams, State, StepNoise
from subterra_jax.tunnel import Tunnel, at_station


def perceive(
    state: State, tunnel: Tunnel, noise: StepNoise, params: EnvParams, wanted: Bool[Array, ""] | bool
) -> Float[Array, "n"]:
    """Noisy ranges (m), dead-reckoned distance (m) and heading (rad).

    Args:
        state: The state.
        tunnel: The tunnel that the robot is in.
        noise: Random numbers of the step.
        params: The task.
        wanted: Whether anybody will look at it; where not, the ranges may be anything.
    """
    position, heading, station = state.position, state.heading, state.station
    reading = jnp.stack([state.odometry.distance, state.odometry.heading])
    if state.faults is not None and params.faults is not None:
        seen = faults.observed(state.faults, params.faults)
        position, heading, station, reading = seen[:2], seen[2], seen[3], seen[4:]
    ranges = lidar.scan(tunnel, position, heading, station, params.lidar, wanted)
    if state.obstacles is not None and params.obstacles is not None:
        boxes = obstacles.boxes_near(
            state.obstacles, station, obstacles.REACH, obstacles.N_SLOTS, tunnel, params.obstacles
        )
        directions = lidar.beam_directions(heading, params.lidar.n_beams)
        ranges = jnp.minimum(ranges, obstacles.distance_along(boxes, position, directions))
    if state.faults is not None and params.faults is not None and noise.faults is not None:
        range_max = jnp.asarray(params.lidar.range_max)
        ranges = faults.spoil(ranges, state.faults, noise.faults, range_max, params.faults)
    return jnp.concatenate([lidar.add_noise(ranges, noise.ranges, params.lidar), reading])


def privileged(state: State, tunnel: Tunnel) -> dict[str, Float[Array, ""]]:
    """What only a teacher or a critic may know; no observation holds any of it.

    Returns:
        Station and lateral offset (m), offset over half-width, sine and cosine of the heading against the axis, the
        odometer's biases, and, where the task has them, goal less station (m), slip and severity.
    """
    _, _, tangent_x, tangent_y, half_width = at_station(tunnel, state.station)
    cos, sin = jnp.cos(state.heading), jnp.sin(state.heading)
    known = {
        "station": state.station,
        "lateral": state.lateral,
        "offset": state.lateral / half_width,
        "heading_sin": sin * tangent_x - cos * tangent_y,
        "heading_cos": cos * tangent_x + sin * tangent_y,
        "distance_bias": state.odometry.distance_bias,
        "heading_bias": state.odometry.heading_bias,
    }
    if state.goal is not None:
        known["to_goal"] = state.goal.station - state.station
    if state.slip is not None:
        known |= {"slip": state.slip.gain + state.slip.wander, "yaw_slip": state.slip.yaw}
    if state.faults is not None:
        known["severity"] = state.faults.severity
    return known
