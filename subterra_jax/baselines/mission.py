"""What each task asks of a driver who knows its station: go on, stop, turn and come back, report."""

import dataclasses

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float

from subterra_jax.baselines.agent import Observed
from subterra_jax.baselines.stations import Station
from subterra_jax.state import EnvParams

# A robot that stands for a second has stopped, and that ends the episode: it creeps while it turns.
TURN_SPEED = 0.1
_TURN_RATE = 1.5
_TURNED = 0.1  # rad; what is left is for the steering
_FAR = 1e6


@struct.dataclass
class Mission:
    """Where in its task an agent is.

    Attributes:
        direction: 1 on the way out, -1 on the way back.
        flagged: The flag has been seen.
        to_turn: Angle still to turn, rad; 0 while it drives.
        heading: Last reading of the odometer's heading, rad.
        stopped: It has arrived, and stays.
    """

    direction: Float[Array, ""]
    flagged: Bool[Array, ""]
    to_turn: Float[Array, ""]
    heading: Float[Array, ""]
    stopped: Bool[Array, ""]


def start_mission(obs: Observed) -> Mission:
    """Outbound."""
    no = jnp.zeros((), bool)
    return Mission(jnp.ones(()), no, jnp.zeros(()), obs.heading, no)


def turning(mission: Mission) -> Bool[Array, ""]:
    """Whether it is turning round."""
    return mission.to_turn > 0.0


def wanted_speed(mission: Mission, estimate: Station, obs: Observed, params: EnvParams) -> Float[Array, ""]:
    """Speed to drive at, m/s: the largest, and in the last period what just reaches the target.

    Args:
        mission: Where in the task.
        estimate: Where along the tunnel.
        obs: The observation.
        params: The task.
    """
    speed_max = jnp.asarray(params.vehicle.speed_max)
    if params.errand == "cover":
        return speed_max
    if params.errand == "report":
        return jnp.zeros(())  # stand and report
    target = obs.goal
    if params.errand == "return":
        home = jnp.asarray(params.start.station, jnp.float32)
        # Out to the flag, wherever one believes the goal to be.
        target = jnp.where(mission.direction > 0.0, _FAR, home)
    to_go = mission.direction * (target - estimate.station)
    return jnp.where(mission.stopped, 0.0, jnp.clip(to_go / params.vehicle.period, 0.0, speed_max))


def arrived(mission: Mission, wanted: Float[Array, ""], driven: Float[Array, ""], params: EnvParams) -> Mission:
    """The mission after a command: the last period's command, if it is obeyed in full, is the arrival."""
    if params.errand == "cover":
        return mission
    there = (wanted < params.vehicle.speed_max) & (driven >= wanted) & ~turning(mission)
    return dataclasses.replace(mission, stopped=mission.stopped | there)


def watch(mission: Mission, obs: Observed, params: EnvParams) -> tuple[Mission, Bool[Array, ""], Bool[Array, ""]]:
    """Look at the flag and at how far one has turned.

    Returns:
        The mission, whether the flag has just been raised, and whether the turn has just been finished.
    """
    if params.errand != "return":
        no = jnp.zeros((), bool)
        return mission, no, no
    raised = (obs.flag > 0.5) & ~mission.flagged
    was_turning = turning(mission)
    change = jnp.mod(obs.heading - mission.heading + jnp.pi, 2.0 * jnp.pi) - jnp.pi
    left = jnp.where(was_turning, mission.to_turn - change, mission.to_turn)
    done = was_turning & (left < _TURNED)
    left = jnp.where(raised, jnp.pi, jnp.where(done, 0.0, left))
    after = dataclasses.replace(
        mission,
        direction=jnp.where(done, -1.0, mission.direction),
        flagged=mission.flagged | raised,
        to_turn=left,
        heading=obs.heading,
    )
    return after, raised, done


def turn_command(mission: Mission, params: EnvParams) -> Float[Array, "2"]:
    """Creeping round on the spot."""
    rate = jnp.minimum(_TURN_RATE, mission.to_turn / params.vehicle.period)
    return jnp.stack([jnp.full_like(rate, TURN_SPEED), rate])
