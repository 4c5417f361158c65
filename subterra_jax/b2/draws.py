"""Random draws of the walking task: an episode's start, the robot's build, and the velocity commands."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from subterra_jax.b2 import constants as b2
from subterra_jax.b2.gait import standing_gait
from subterra_jax.b2.kinematics import standing_pose
from subterra_jax.b2.observation import TrackPose, locate, measure
from subterra_jax.b2.params import (
    CommandParams,
    RandomisationParams,
    WalkParams,
    WalkResetNoise,
    WalkState,
    WalkStepNoise,
)
from subterra_jax.physics.engine import Body, Build
from subterra_jax.physics.riding import place_on
from subterra_jax.physics.rotations import compose, rotate, yaw_quaternion
from subterra_jax.state import State

_LATERAL, _HEADING, _MARGIN = 0.2, 0.2, 25.0  # of starts: m, rad, m
_TURN, _SIDESTEP, _AIM, _FREE = 1.5, 1.0, 1.5, 0.5  # of steering: 1/s, 1/s, rad/m, rad


def begin(noise: WalkResetNoise, params: WalkParams, plane: State | None = None) -> WalkState:
    """Return the start of an episode: standing at a sleeper, near the axis, facing either way along the tunnel.

    Args:
        plane: Position, heading, station and lateral offset at which it stands instead, with no command.
    """
    along, lateral, heading, way, phase = noise.place
    if plane is None:
        facing, command = jnp.where(way < 0.0, -1.0, 1.0), draw_command(noise.command, params.command)
        anchor = _start_sleeper(along, params)
        along_track, station = params.track.quaternion[anchor], params.track.station[anchor]
        turn = _HEADING * heading + jnp.where(facing < 0.0, jnp.pi, 0.0)
        # The feet stand on the tops of the sleepers, or fall the little way to the ballast.
        position = rotate(along_track, jnp.stack([0.0, _LATERAL * lateral, b2.STAND_HEIGHT]))
        placed = jnp.concatenate([position, compose(along_track, yaw_quaternion(turn))])
    else:
        facing, command, station = jnp.ones(()), jnp.zeros(3), plane.station
        placed, anchor = place_on(params.track, plane, b2.STAND_HEIGHT)
    body = Body(jnp.concatenate([placed, standing_pose()[0]]), jnp.zeros(18), jnp.zeros(18))
    gait, pose = standing_gait(0.5 * (phase + 1.0)), locate(body, params.track.quaternion[anchor])
    return WalkState(
        body=body,
        anchor=anchor,
        gait=gait,
        command=keep_on_track(command, pose, facing, params.command),
        drawn_command=command,
        facing=facing,
        action=jnp.zeros(12),
        proprioception=measure(body, noise.sensor, jnp.zeros(2), gait, params.sensor, params.gait),
        build=_draw_build(noise.build, params.randomisation),
        furthest=station,
        steps=jnp.zeros((), jnp.int32),
    )


def _start_sleeper(along: Float[Array, ""], params: WalkParams) -> Int[Array, ""]:
    """A sleeper at least 25 m from the ends of the track, or a quarter of a track shorter than 100 m."""
    station = params.track.station
    count, last = station.shape[0], station.shape[0] - 1
    margin = jnp.minimum(_MARGIN / (station[last] - station[0]), 0.25)
    fraction = margin + 0.5 * (along + 1.0) * (1.0 - 2.0 * margin)
    return jnp.clip((fraction * count).astype(jnp.int32), 0, last)


def _between(limits: Any, fraction: Float[Array, "..."]) -> Float[Array, "..."]:
    """Number between two limits, for a fraction in [-1, 1)."""
    return limits[0] + 0.5 * (fraction + 1.0) * (limits[1] - limits[0])


def _draw_build(noise: Float[Array, "29"], params: RandomisationParams) -> Build:
    return Build(
        friction=_between(params.friction, noise[0]),
        mass=_between(params.mass, noise[1]),
        shift=jnp.asarray(params.shift) * noise[2:5],
        stiffness=_between(params.gain, noise[5:17]),
        damping=_between(params.gain, noise[17:29]),
    )


def next_command(
    state: WalkState, pose: TrackPose, noise: WalkStepNoise, period: float, params: WalkParams
) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
    """Return the drawn command of the next control period, and the one that keeps the robot on the track."""
    arrives = 0.5 * (noise.command[4] + 1.0) < period / params.command.hold
    drawn = jnp.where(arrives, draw_command(noise.command[:4], params.command), state.drawn_command)
    return drawn, keep_on_track(drawn, pose, state.facing, params.command)


def draw_command(noise: Float[Array, "4"], params: CommandParams) -> Float[Array, "3"]:
    """Draws a command: uniform, or to stand.

    Args:
        noise: Uniform in [-1, 1): for the three velocities, and for standing.
        params: Limits of the commands.
    """
    drawn = _between((jnp.asarray(params.low), jnp.asarray(params.high)), noise[:3])
    return jnp.where(0.5 * (noise[3] + 1.0) < params.still, 0.0, drawn)


def keep_on_track(
    drawn: Float[Array, "3"], pose: TrackPose, facing: Float[Array, ""], params: CommandParams
) -> Float[Array, "3"]:
    """Changes a command that would lead off the track; a command to stand stays.

    Args:
        drawn: Forward and to the left (m/s), yaw rate (rad/s).
        pose: Pose of the robot on the track.
        facing: 1 where it should face growing station, -1 the other way.
        params: Limits of the commands.
    """
    offset = facing * pose.lateral
    heading = jnp.arctan2(facing * pose.forward[1], facing * pose.forward[0])
    direction = jnp.where(drawn[0] < 0.0, -1.0, 1.0)
    aim = direction * jnp.clip(-_AIM * offset, -0.5, 0.5)
    yaw_rate = jnp.clip(drawn[2], _TURN * (aim - _FREE - heading), _TURN * (aim + _FREE - heading))
    limit = params.corridor
    left = jnp.clip(drawn[1], _SIDESTEP * (-limit - offset), _SIDESTEP * (limit - offset))
    kept = jnp.clip(jnp.stack([drawn[0], left, yaw_rate]), jnp.asarray(params.low), jnp.asarray(params.high))
    return jnp.where(jnp.all(drawn == 0.0), 0.0, kept)
