"""From a planar state to a standing robot, and from a walking robot to what is seen of it from above."""

import dataclasses

import jax.numpy as jnp
from jaxtyping import Array, Float

from subterra_jax.b2 import constants as b2
from subterra_jax.b2 import draws, observation
from subterra_jax.b2.kinematics import compose, rotate, standing_pose, yaw_quaternion
from subterra_jax.b2.params import Body, WalkParams, WalkResetNoise, WalkState
from subterra_jax.parts.unicycle import wrap
from subterra_jax.state import State


def stand(plane: State, noise: WalkResetNoise, walk: WalkParams) -> WalkState:
    """Make a robot that stands where a planar state says, on the sleepers, with no command.

    Args:
        plane: Position, heading, station and lateral offset.
        noise: What else is drawn of the robot: how it is built, the clock of its gait, its first readings.
        walk: The robot and its track.
    """
    track = walk.track
    anchor = jnp.argmin(jnp.abs(track.station - plane.station)).astype(jnp.int32)
    turned = track.quaternion[anchor]
    ahead = plane.station - track.station[anchor]
    place = rotate(turned, jnp.stack([ahead, plane.lateral, jnp.float32(b2.STAND_HEIGHT)]))
    facing = compose(turned, yaw_quaternion(wrap(plane.heading - yaw(turned))))
    pose, _ = standing_pose()
    body = Body(jnp.concatenate([place, facing, pose]), jnp.zeros(18), jnp.zeros(18))
    drawn = draws.begin(noise, walk)
    return dataclasses.replace(
        drawn,
        body=body,
        anchor=anchor,
        command=jnp.zeros(3),
        drawn_command=jnp.zeros(3),
        facing=jnp.ones(()),
        proprioception=observation.measure(body, noise.sensor, jnp.zeros(2), drawn.gait, walk.sensor, walk.gait),
        furthest=plane.station,
    )


def seen_from_above(walk: WalkState, params: WalkParams) -> tuple[Float[Array, "2"], Float[Array, ""]]:
    """Position of the trunk's middle (tunnel frame, m) and its heading (rad)."""
    position = params.track.position[walk.anchor, :2] + walk.body.qpos[:2]
    return position, yaw(walk.body.qpos[3:7])


def yaw(quaternion: Float[Array, "4"]) -> Float[Array, ""]:
    """Direction of the turned x axis, seen from above, rad."""
    x, y, _ = rotate(quaternion, jnp.array([1.0, 0.0, 0.0]))
    return jnp.arctan2(y, x)
