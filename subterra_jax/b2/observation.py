"""What the policy sees of a robot, and what only a critic may know."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from subterra_jax.b2 import driver, payment
from subterra_jax.b2.state import WalkState
from subterra_jax.b2.track import SPACING, Track

_PARTS = {
    "rates": 3, "gravity": 3, "velocity": 2, "asked": 3, "told": 3, "trim": 3, "clock": 3, "angles": 12,
    "speeds": 12, "action": 12,
}  # fmt: skip
_FURTHER = {"true_velocity": 3, "fall_speed": 1, "place": 4, "friction": 1, "mass": 1, "phase_of_track": 2}


def sizes(privileged: bool) -> dict[str, int]:
    """Numbers in each named part of an observation, in their order."""
    return {**_PARTS, **(_FURTHER if privileged else {})}


def felt(state: WalkState) -> Float[Array, "56"]:
    """What the robot feels, what it was told, where its gait is, and what it did last."""
    turn, feeling = 2.0 * jnp.pi * state.gait.phase, state.feeling
    clock = jnp.stack([jnp.cos(turn), jnp.sin(turn), state.gait.stride])
    return jnp.concatenate(
        [
            feeling.rates, feeling.gravity, feeling.velocity, state.command, state.gait.velocity, state.gait.trim,
            clock, feeling.angles, feeling.speeds, state.action,
        ]
    )  # fmt: skip


def truth(state: WalkState, track: Track) -> Float[Array, "12"]:
    """True velocity, speed of falling, place on the track, friction, mass, and where among the sleepers."""
    body, build = state.body, state.build
    place = driver.locate(body, track.quaternion[state.anchor])
    turn = 2.0 * jnp.pi * place.ahead / SPACING
    own = jnp.stack([place.lateral, place.height, place.forward[0], place.forward[1]])
    between = jnp.stack([jnp.cos(turn), jnp.sin(turn)])
    single = jnp.stack([build.friction, build.mass])
    return jnp.concatenate([payment.true_velocity(body), body.qvel[2:3], own, single, between])
