"""Observations of the walking task: proprioception with noise, the robot's pose on the track, and privileged truth."""

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from subterra_jax.b2 import gait, kinematics
from subterra_jax.b2.gait import GaitParams, GaitState
from subterra_jax.b2.params import Proprioception, SensorParams, WalkState
from subterra_jax.physics.engine import Body
from subterra_jax.physics.ground import SPACING, Track
from subterra_jax.physics.rotations import inverse, rotate

_FOLLOW = 0.35  # fraction of a new reading in the smoothed speed
FIELDS = {
    "rates": 3, "gravity": 3, "velocity": 2, "asked": 3, "commanded": 3, "trim": 3, "clock": 3, "angles": 12,
    "speeds": 12, "action": 12,
}  # fmt: skip
PRIVILEGED = {"true_velocity": 3, "fall_speed": 1, "place": 4, "friction": 1, "mass": 1, "phase_of_track": 2}


@struct.dataclass
class TrackPose:
    """Pose of the robot on the track."""

    ahead: Float[Array, ""]  # distance ahead of the anchor, m
    lateral: Float[Array, ""]  # offset to the left of the axis, m
    height: Float[Array, ""]  # height of the trunk's middle over the tops of the sleepers, m
    forward: Float[Array, "2"]  # direction of the trunk's x axis: components along the track and to its left


def locate(body: Body, quaternion: Float[Array, "4"]) -> TrackPose:
    """Computes the pose of a robot on the track.

    Args:
        body: The robot, its position from the anchor.
        quaternion: Rotation of the anchor.
    """
    to_track = inverse(quaternion)
    ahead, lateral, height = rotate(to_track, body.qpos[:3])
    forward = rotate(to_track, rotate(body.qpos[3:7], jnp.array([1.0, 0.0, 0.0])))
    return TrackPose(ahead, lateral, height, forward[:2])


def gravity_direction(body: Body) -> Float[Array, "3"]:
    """Return the direction of gravity in the trunk's axes."""
    return rotate(inverse(body.qpos[3:7]), jnp.array([0.0, 0.0, -1.0]))


def true_velocity(body: Body) -> Float[Array, "3"]:
    """Return the velocity forward and to the left, level (m/s), and the yaw rate about the trunk's z (rad/s)."""
    gravity = gravity_direction(body)
    velocity = rotate(inverse(body.qpos[3:7]), body.qvel[:3])
    return jnp.concatenate([level_velocity(velocity, gravity), body.qvel[5:6]])


def measure(
    body: Body,
    noise: Float[Array, "30"],
    last_velocity: Float[Array, "2"],
    gait_state: GaitState,
    params: SensorParams,
    gait_params: GaitParams,
) -> Proprioception:
    """Simulates the readings of the robot's own sensors, and estimates its velocity from them.

    Args:
        body: True state.
        noise: Noise in [-1, 1) of rates, gravity, angles and speeds.
        last_velocity: Smoothed velocity of the last readings, m/s.
        gait_state: The gait, which says which feet should stand.
        params: Size of the noise.
        gait_params: Parameters of the gait.
    """
    rates = body.qvel[3:6] + params.rate * noise[:3]
    gravity = gravity_direction(body) + params.gravity * noise[3:6]
    angles = body.qpos[7:] + params.angle * noise[6:18]
    speeds = body.qvel[6:] + params.speed * noise[18:]
    velocity = leg_velocity(rates, gravity, angles, speeds, gait.stance(gait_state, gait_params))
    return Proprioception(rates, gravity, angles, speeds, last_velocity + _FOLLOW * (velocity - last_velocity))


def leg_velocity(
    rates: Float[Array, "3"],
    gravity: Float[Array, "3"],
    angles: Float[Array, "12"],
    speeds: Float[Array, "12"],
    standing: Float[Array, "4"],
) -> Float[Array, "2"]:
    """Estimates the level velocity of the trunk, forward and to the left, m/s; exact if standing feet do not slip."""
    feet = kinematics.HIPS + kinematics.foot_positions(angles.reshape(4, 3))
    motion = kinematics.foot_velocities(angles.reshape(4, 3), speeds.reshape(4, 3))
    fraction = standing / jnp.maximum(jnp.sum(standing), 1e-3)
    return level_velocity(-jnp.sum(fraction[:, None] * (motion + jnp.cross(rates, feet)), axis=0), gravity)


def level_velocity(velocity: Float[Array, "3"], gravity: Float[Array, "3"]) -> Float[Array, "2"]:
    """Projects a velocity in the trunk's axes onto the level directions nearest to its forward and left, m/s."""
    size = jnp.sqrt(jnp.maximum(gravity[0] * gravity[0] + gravity[2] * gravity[2], 1e-6))
    # Forward, made perpendicular to gravity by turning about the trunk's y; then left, which is up × forward.
    forward = jnp.stack([-gravity[2], 0.0, gravity[0]]) / size
    return jnp.stack([jnp.sum(velocity * forward), jnp.sum(velocity * jnp.cross(-gravity, forward))])


def observe_self(state: WalkState) -> Float[Array, "56"]:
    """Return the observation of the policy: proprioception, command, state of the gait, and last action."""
    turn, sensors = 2.0 * jnp.pi * state.gait.phase, state.proprioception
    clock = jnp.stack([jnp.cos(turn), jnp.sin(turn), state.gait.stride])
    return jnp.concatenate(
        [
            sensors.rates, sensors.gravity, sensors.velocity, state.command, state.gait.velocity, state.gait.trim,
            clock, sensors.angles, sensors.speeds, state.action,
        ]
    )  # fmt: skip


def observe_truth(state: WalkState, track: Track) -> Float[Array, "12"]:
    """Return the privileged truth: velocity, speed of falling, pose, friction, mass, and phase between sleepers."""
    body, build = state.body, state.build
    pose = locate(body, track.quaternion[state.anchor])
    turn = 2.0 * jnp.pi * pose.ahead / SPACING
    on_track = jnp.stack([pose.lateral, pose.height, pose.forward[0], pose.forward[1]])
    phase = jnp.stack([jnp.cos(turn), jnp.sin(turn)])
    properties = jnp.stack([build.friction, build.mass])
    return jnp.concatenate([true_velocity(body), body.qvel[2:3], on_track, properties, phase])
