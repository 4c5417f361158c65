"""The reward of walking, as named terms."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from subterra_jax.b2 import feel, gait, legs, rotation
from subterra_jax.b2.gait import GaitParams, GaitState
from subterra_jax.b2.params import WalkRewardParams
from subterra_jax.b2.physics import Body


def true_velocity(body: Body) -> Float[Array, "3"]:
    """Velocity forward and to the left, level (m/s), and yaw rate about the trunk's z (rad/s)."""
    gravity = feel.gravity_seen(body)
    own = rotation.rotate(rotation.inverse(body.qpos[3:7]), body.qvel[:3])
    return jnp.concatenate([feel.level(own, gravity), body.qvel[5:6]])


def terms(
    body: Body,
    walking: GaitState,
    torque: Float[Array, "12"],
    action: Float[Array, "12"],
    before: Float[Array, "12"],
    fallen: Bool[Array, ""],
    params: WalkRewardParams,
    trot: GaitParams,
    period: float,
) -> dict[str, Float[Array, ""]]:
    """What one control period pays, by term.

    Args:
        body: At its end.
        walking: The gait, which says what velocity was asked for and which feet are to stand.
        torque: Of the servos, N m.
        action: Taken.
        before: The action before that.
        fallen: Whether the robot has fallen.
        params: Weights.
        trot: The gait.
        period: Length of the control period, s.
    """
    gravity, error = feel.gravity_seen(body), true_velocity(body) - walking.velocity
    width = params.width * params.width
    change = action - before
    rate = {
        "velocity": params.velocity * jnp.exp(-(error[0] * error[0] + error[1] * error[1]) / width),
        "yaw_rate": params.yaw_rate * jnp.exp(-error[2] * error[2] / width),
        "alive": jnp.asarray(params.alive),
        "bounce": params.bounce * body.qvel[2] * body.qvel[2],
        "roll": params.roll * (body.qvel[3] * body.qvel[3] + body.qvel[4] * body.qvel[4]),
        "tilt": params.tilt * (gravity[0] * gravity[0] + gravity[1] * gravity[1]),
        "effort": params.effort * jnp.sum(torque * torque),
        "jerk": params.jerk * jnp.sum(change * change),
        "action": params.action * jnp.sum(action * action),
        "slip": params.slip * _slip(body, gravity, walking, trot),
    }
    # A robot that comes to harm moves at any speed; what it is fined for that has an end.
    paid = {f"reward_{name}": jnp.clip(value, -10.0, 10.0) * period for name, value in rate.items()}
    return {**paid, "reward_fall": jnp.where(fallen, params.fall, 0.0)}


def _slip(body: Body, gravity: Float[Array, "3"], walking: GaitState, trot: GaitParams) -> Float[Array, ""]:
    """Sum over the feet that are meant to stand of the squared difference of their speed from the trunk's, m²/s²."""
    angles, speeds = body.qpos[7:], body.qvel[6:]
    standing = gait.stance(walking, trot)
    told = [
        feel.leg_speed(body.qvel[3:6], gravity, angles, speeds, jnp.zeros(4).at[leg].set(1.0))
        for leg in range(len(legs.SIDE))
    ]
    off = jnp.stack(told) - true_velocity(body)[:2]
    return jnp.sum(standing * jnp.sum(off * off, axis=1))
