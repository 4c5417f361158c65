"""Inputs of a policy network, made from the named entries of an observation; training and driving both call `look`.

What the agent is given and what it senses goes in, and nothing else: start and goal as reported, odometer, ranges, its
own last command. Sizes come from the params. Every number is of order 1, so that nothing has to be normalised.
"""

import dataclasses

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float

from subterra_jax.baselines.agent import LIDAR_ENTRIES, Observed
from subterra_jax.baselines.stations import reported_start
from subterra_jax.baselines.steering import Corridor
from subterra_jax.parts.unicycle import wrap
from subterra_jax.state import EnvParams

_NEAR = 3.0  # m; ranges below this are resolved finely
_SCALES = (1.0, 4.0, 20.0)  # m; scales of the way to go
FAR = 100.0  # m; the largest scale
_TURN = 3.0  # 1/rad; unit of an angle to the walls
_AROUND = 2.2  # rad; who has turned so far since the flag drives back
_KNOWN = LIDAR_ENTRIES | {"odometry", "goal", "ring_pitch", "start", "flag"}


@struct.dataclass
class Reckoned:
    """Dead reckoning from one observation to the next."""

    command: Float[Array, "2"]  # last command, m/s and rad/s
    flag: Float[Array, ""]  # 1 once the goal's flag has been seen
    distance: Float[Array, ""]  # odometer's distance at the flag, or at the start, m
    heading: Float[Array, ""]  # odometer's heading there, rad
    obeyed: Float[Array, ""]  # distance commanded since then, m
    turned: Bool[Array, ""]  # true once the robot has turned round after the flag, wherever the tunnel bends later


def begin(obs: Observed) -> Reckoned:
    """Returns the reckoning at the first observation of an episode."""
    zero, no = jnp.zeros(()), jnp.zeros((), bool)
    return Reckoned(jnp.zeros(2), zero, jnp.asarray(obs.distance), jnp.asarray(obs.heading), zero, no)


def see(before: Reckoned, obs: Observed) -> Reckoned:
    """Returns the reckoning with an observation; at the flag it begins anew."""
    raised = (obs.flag > 0.5) & (before.flag < 0.5)
    anew = lambda new, old: jnp.where(raised, new, old)  # noqa: E731
    flag = jnp.maximum(before.flag, jnp.asarray(obs.flag, jnp.float32))
    heading = anew(obs.heading, before.heading)
    return dataclasses.replace(
        before,
        flag=flag,
        distance=anew(obs.distance, before.distance),
        heading=heading,
        obeyed=anew(0.0, before.obeyed),
        turned=before.turned | ((flag > 0.5) & (jnp.abs(wrap(obs.heading - heading)) > _AROUND)),
    )


def obey(now: Reckoned, command: Float[Array, "2"], period: Float[Array, ""] | float) -> Reckoned:
    """Returns the reckoning after a command, m/s and rad/s, of one period, s."""
    return dataclasses.replace(now, command=command, obeyed=now.obeyed + command[0] * period)


def way_to_go(now: Reckoned, obs: Observed, params: EnvParams) -> Float[Array, ""]:
    """Returns the distance still to drive by dead reckoning, m: to the goal, and after its flag back to the start.

    Without a goal it is the length of the tunnel less the distance driven.
    """
    driven = obs.distance - now.distance
    if params.goal_kind in ("cover", "report"):
        return params.tunnel.length - driven
    out = obs.goal - reported_start(obs, params)
    if params.goal_kind != "return":
        return out - driven
    return jnp.where(now.flag > 0.5, out - params.goal.flag_reach - driven, out - driven)


def look(
    now: Reckoned, obs: Observed, way: Float[Array, ""], params: EnvParams, relief: bool = False
) -> Float[Array, "n"]:
    """Returns the inputs.

    Args:
        now: Reckoning, with this observation.
        way: Distance still to drive, m, reckoned or estimated.
        relief: Show what a memory can add up: how far each beam ends beyond the wall beside the robot, the phase of
            the rings, and how far the commands are ahead of the odometer.
    """
    reach = params.lidar.range_max
    ranges, vehicle = obs.ranges, params.vehicle
    turned = obs.heading - now.heading
    parts = [
        scaled_way(way),
        jnp.tanh(ranges / _NEAR),
        ranges / reach,
        now.command / jnp.stack([jnp.asarray(vehicle.speed_max), jnp.asarray(vehicle.yaw_rate_max)]),
        now.flag * jnp.stack([jnp.ones(()), jnp.sin(turned), jnp.cos(turned)]),
    ]
    if relief:
        ahead = now.obeyed - (obs.distance - now.distance)
        parts += [_relief(ranges), _phase(obs, now), scaled_way(ahead)]
    further = [jnp.ravel(value) for name, value in sorted(obs.entries.items()) if name not in _KNOWN]
    return jnp.concatenate([*parts, *(jnp.arcsinh(value.astype(jnp.float32)) for value in further)])


def beside(walls: Corridor) -> Float[Array, "3"]:
    """Returns offset from the middle, half width and angle of walls that were tracked through lost beams and dust."""
    return jnp.stack([walls.offset, (walls.left + walls.right) / (2.0 * _NEAR), _TURN * walls.angle])


def scaled_way(way: Float[Array, "*batch"]) -> Float[Array, "*batch 4"]:
    """Returns a distance at several scales, from decimetres on."""
    return jnp.stack([*(jnp.tanh(way / scale) for scale in _SCALES), way / FAR], axis=-1)


N_WALLS = 3  # numbers of `beside`
WAY_AT = len(_SCALES)  # place of the way to go over `FAR` among the inputs of one observation


def _relief(ranges: Float[Array, "n"]) -> Float[Array, "n"]:
    """Returns how far each beam ends beyond the wall straight beside the robot, in units of 0.3 m, at most 3."""
    n = ranges.shape[0]
    bearing = 2.0 * jnp.pi * jnp.arange(n) / n
    across = ranges * jnp.abs(jnp.sin(bearing))
    beside = jnp.where(jnp.sin(bearing) > 0.0, ranges[n // 4], ranges[-(n // 4)])
    return jnp.clip((across - beside) / 0.3, -3.0, 3.0)


def _phase(obs: Observed, now: Reckoned) -> Float[Array, "2"]:
    """Returns sine and cosine of the odometer's distance over the ring length; 0 where there are no rings."""
    pitch = jnp.asarray(obs.ring_pitch, jnp.float32)
    turn = 2.0 * jnp.pi * (obs.distance - now.distance) / jnp.maximum(pitch, 0.5)
    return jnp.where(pitch > 0.0, 1.0, 0.0) * jnp.stack([jnp.sin(turn), jnp.cos(turn)])
