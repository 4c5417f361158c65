"""What the robot feels of itself: inertial sensors, joints, and the speed that its standing legs tell."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from subterra_jax.b2 import gait, legs, rotation
from subterra_jax.b2.gait import GaitParams, GaitState
from subterra_jax.b2.params import Feeling, SensorParams
from subterra_jax.b2.physics import Body

_FOLLOW = 0.35  # share of a new reading in the smoothed speed


def gravity_seen(body: Body) -> Float[Array, "3"]:
    """Direction of gravity in the trunk's axes."""
    return rotation.rotate(rotation.inverse(body.qpos[3:7]), jnp.array([0.0, 0.0, -1.0]))


def feel(
    body: Body,
    noise: Float[Array, "30"],
    before: Float[Array, "2"],
    walking: GaitState,
    params: SensorParams,
    trot: GaitParams,
) -> Feeling:
    """The sensors' readings, and the speed made of them.

    Args:
        body: The truth.
        noise: In [-1, 1), of rates, gravity, angles and speeds.
        before: The speed as it was last told, m/s.
        walking: Which feet are meant to stand.
        params: Size of the noise.
        trot: The gait.
    """
    rates = body.qvel[3:6] + params.rate * noise[:3]
    gravity = gravity_seen(body) + params.gravity * noise[3:6]
    angles = body.qpos[7:] + params.angle * noise[6:18]
    speeds = body.qvel[6:] + params.speed * noise[18:]
    told = leg_speed(rates, gravity, angles, speeds, gait.stance(walking, trot))
    return Feeling(rates, gravity, angles, speeds, before + _FOLLOW * (told - before))


def leg_speed(
    rates: Float[Array, "3"],
    gravity: Float[Array, "3"],
    angles: Float[Array, "12"],
    speeds: Float[Array, "12"],
    standing: Float[Array, "4"],
) -> Float[Array, "2"]:
    """Speed of the trunk over ground, forward and to the left and level, m/s, if the standing feet do not slip."""
    places = legs.HIPS + legs.feet(angles.reshape(4, 3))
    motion = legs.foot_motion(angles.reshape(4, 3), speeds.reshape(4, 3))
    spin_x = rates[1] * places[:, 2] - rates[2] * places[:, 1]
    spin_y = rates[2] * places[:, 0] - rates[0] * places[:, 2]
    spin_z = rates[0] * places[:, 1] - rates[1] * places[:, 0]
    share = standing / jnp.maximum(jnp.sum(standing), 1e-3)
    x, y, z = (-jnp.sum(share * (motion[:, i] + spin)) for i, spin in enumerate((spin_x, spin_y, spin_z)))
    return level(jnp.stack([x, y, z]), gravity)


def level(velocity: Float[Array, "3"], gravity: Float[Array, "3"]) -> Float[Array, "2"]:
    """A velocity in the trunk's axes, along the level directions nearest to its forward and left, m/s."""
    size = jnp.sqrt(jnp.maximum(gravity[0] * gravity[0] + gravity[2] * gravity[2], 1e-6))
    # Forward, made perpendicular to gravity by turning about the trunk's y; then left, which is up × forward.
    forward = jnp.stack([-gravity[2], 0.0, gravity[0]]) / size
    up = -gravity
    left = jnp.stack(
        [
            up[1] * forward[2] - up[2] * forward[1],
            up[2] * forward[0] - up[0] * forward[2],
            up[0] * forward[1] - up[1] * forward[0],
        ]
    )
    return jnp.stack([jnp.sum(velocity * forward), jnp.sum(velocity * left)])
