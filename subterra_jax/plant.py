"""What a command does to the robot and to what it carries: slip, wet rail, the odometer, faults that come and go."""

import dataclasses

import jax.numpy as jnp
from jaxtyping import Array, Float

from subterra_jax import faults, obstacles, odometry, slip, vehicle
from subterra_jax.faults import FaultState
from subterra_jax.odometry import OdometryState
from subterra_jax.slip import SlipState
from subterra_jax.state import EnvParams, ResetNoise, State, StepNoise
from subterra_jax.tunnel import Tunnel


def begin_slip(noise: ResetNoise, params: EnvParams) -> SlipState | None:
    """Slip of a new episode, if the plant slips."""
    if params.slip is None or noise.slip is None:
        return None
    return slip.start_slip(noise.slip, params.slip)


def begin_faults(
    noise: ResetNoise,
    position: Float[Array, "2"],
    heading: Float[Array, ""],
    station: Float[Array, ""],
    reading: OdometryState,
    params: EnvParams,
) -> FaultState | None:
    """Faults of a new episode, if there are any."""
    if params.faults is None or noise.seed is None or noise.severity is None:
        return None
    seen = faults.sight(position, heading, station, reading)
    return faults.start_faults(noise.severity, noise.seed[1], seen, params.faults)


def motion(state: State, command: Float[Array, "2"], params: EnvParams) -> tuple[Float[Array, "2"], Float[Array, "2"]]:
    """What the robot really does, and what its wheels make of it, m/s and rad/s; they differ on wet rail."""
    wheels = command if state.slip is None else slip.true_motion(command, state.slip)
    if state.faults is None or params.faults is None:
        return wheels, wheels
    grip = faults.grip(state.faults, state.station, params.faults)
    return jnp.stack([wheels[0] * grip, wheels[1]]), wheels


def clearance(
    tunnel: Tunnel, position: Float[Array, "2"], station: Float[Array, ""], state: State, params: EnvParams
) -> Float[Array, ""]:
    """Distance to the nearest wall, furniture or obstacle, m; exact up to 0.8 m."""
    clear = vehicle.clearance(tunnel, position, station)
    if state.obstacles is None or params.obstacles is None:
        return clear
    return jnp.minimum(clear, obstacles.clearance(state.obstacles, station, position, tunnel, params.obstacles))


def read_odometer(
    state: State, wheels: Float[Array, "2"], tangent: Float[Array, "2"], noise: StepNoise, params: EnvParams
) -> OdometryState:
    """The odometer after a step; while it is frozen its readings stay where they are and its errors go on."""
    period = jnp.asarray(params.vehicle.period)
    backward = jnp.cos(state.heading) * tangent[0] + jnp.sin(state.heading) * tangent[1] < 0.0
    reading = odometry.advance_odometry(state.odometry, wheels, period, noise.odometry, params.odometry, backward)
    if state.faults is None:
        return reading
    frozen = faults.frozen(state.faults)
    return dataclasses.replace(
        reading,
        distance=jnp.where(frozen, state.odometry.distance, reading.distance),
        heading=jnp.where(frozen, state.odometry.heading, reading.heading),
    )


def advance_slip(state: State, moved: Float[Array, ""], noise: StepNoise, params: EnvParams) -> SlipState | None:
    """The slip after a true distance, m."""
    if state.slip is None or params.slip is None or noise.slip is None:
        return None
    return slip.advance_slip(state.slip, moved, noise.slip, params.slip)


def advance_faults(
    state: State,
    position: Float[Array, "2"],
    heading: Float[Array, ""],
    station: Float[Array, ""],
    reading: OdometryState,
    noise: StepNoise,
    params: EnvParams,
) -> FaultState | None:
    """The faults after a step that led to a pose and a reading."""
    if state.faults is None or params.faults is None or noise.faults is None:
        return None
    seen = faults.sight(position, heading, station, reading)
    return faults.advance_faults(state.faults, seen, noise.faults, params.lidar.n_beams, params.faults)
