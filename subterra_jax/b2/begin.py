"""How an episode of walking begins, and everything that is drawn for it."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from subterra_jax.b2 import constants as b2
from subterra_jax.b2 import driver, gait, legs, rotation
from subterra_jax.b2.driver import Place
from subterra_jax.b2.feel import feel
from subterra_jax.b2.params import VarietyParams, WalkParams, WalkResetNoise, WalkState, WalkStepNoise
from subterra_jax.b2.physics import Body, Build

_LATERAL, _HEADING, _MARGIN = 0.2, 0.2, 25.0  # m, rad, m
N_SENSOR = 30


def draw_reset(key: PRNGKeyArray, batch: tuple[int, ...]) -> WalkResetNoise:
    """Random numbers for a batch of resets; row i does not depend on the size of the batch."""
    uniform = jax.random.uniform(key, (*batch, 38 + N_SENSOR), minval=-1.0)
    return WalkResetNoise(
        place=uniform[..., :5], build=uniform[..., 5:34], command=uniform[..., 34:38], sensor=uniform[..., 38:]
    )


def draw_step(key: PRNGKeyArray, batch: tuple[int, ...]) -> WalkStepNoise:
    """Random numbers for one step of a batch; row i does not depend on the size of the batch."""
    uniform = jax.random.uniform(key, (*batch, N_SENSOR + 8), minval=-1.0)
    return WalkStepNoise(sensor=uniform[..., :N_SENSOR], command=uniform[..., N_SENSOR:-3], push=uniform[..., -3:])


def begin(noise: WalkResetNoise, params: WalkParams) -> WalkState:
    """State at the start of an episode: standing at a sleeper, near the axis, facing either way along the tunnel."""
    along, lateral, heading, way, phase = noise.place
    facing = jnp.where(way < 0.0, -1.0, 1.0)
    anchor = _anywhere(along, params)
    turned = params.track.quaternion[anchor]
    turn = _HEADING * heading + jnp.where(facing < 0.0, jnp.pi, 0.0)
    # The feet stand on the tops of the sleepers, or fall the little way to the ballast.
    position = rotation.rotate(turned, jnp.stack([0.0, _LATERAL * lateral, b2.STAND_HEIGHT]))
    quaternion = rotation.times(turned, rotation.yaw_only(turn))
    pose, _ = legs.standing()
    body = Body(jnp.concatenate([position, quaternion, pose]), jnp.zeros(18), jnp.zeros(18))
    walking = gait.begin(0.5 * (phase + 1.0))
    wanted = driver.wish(noise.command, params.command)
    return WalkState(
        body=body,
        anchor=anchor,
        gait=walking,
        command=driver.keep(wanted, driver.locate(body, turned), facing, params.command),
        wish=wanted,
        facing=facing,
        action=jnp.zeros(12),
        feeling=feel(body, noise.sensor, jnp.zeros(2), walking, params.sensor, params.gait),
        build=_build(noise.build, params.variety),
        furthest=params.track.station[anchor],
        steps=jnp.zeros((), jnp.int32),
    )


def drive(
    state: WalkState, place: Place, noise: WalkStepNoise, period: float, params: WalkParams
) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
    """Wish and command of the next control period."""
    comes = 0.5 * (noise.command[4] + 1.0) < period / params.command.hold
    wanted = jnp.where(comes, driver.wish(noise.command[:4], params.command), state.wish)
    return wanted, driver.keep(wanted, place, state.facing, params.command)


def _anywhere(along: Float[Array, ""], params: WalkParams) -> Int[Array, ""]:
    """A sleeper from which the ends of the track are 25 m away, or a quarter of it where it is shorter than 100 m."""
    station = params.track.station
    count, last = station.shape[0], station.shape[0] - 1
    margin = jnp.minimum(_MARGIN / (station[last] - station[0]), 0.25)
    share = margin + 0.5 * (along + 1.0) * (1.0 - 2.0 * margin)
    return jnp.clip((share * count).astype(jnp.int32), 0, last)


def _build(noise: Float[Array, "29"], params: VarietyParams) -> Build:
    """One robot."""

    def between(limits: Any, share: Float[Array, "..."]) -> Float[Array, "..."]:
        return limits[0] + 0.5 * (share + 1.0) * (limits[1] - limits[0])

    return Build(
        friction=between(params.friction, noise[0]),
        mass=between(params.mass, noise[1]),
        shift=jnp.asarray(params.shift) * noise[2:5],
        stiffness=between(params.gain, noise[5:17]),
        damping=between(params.gain, noise[17:29]),
    )
