"""An agent made of a localiser, a steering and a mission, and what the mission asks: cover, stop, return, report."""

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from subterra_jax.baselines.agent import Action, Known, Observed
from subterra_jax.baselines.stations import Driven, Localiser, Station, reported_start
from subterra_jax.baselines.steering import Steering
from subterra_jax.state import EnvParams

# A robot that stands for a second has stopped, which ends the episode: it creeps while it turns.
TURN_SPEED = 0.1  # m/s
_TURN_RATE = 1.5  # rad/s
_TURNED = 0.1  # rad; the steering corrects what is left of a turn
_FAR = 1e6  # m
_FURTHEST = 0.9  # of the distance in which to report: the rest covers the error of dead reckoning
_MOUTH_BEAMS = (1, -1)  # the slanting beams ahead: without an echo on either side a mouth is some metres away


@struct.dataclass
class Mission:
    """Progress of an agent in its task."""

    direction: Float[Array, ""]  # 1 on the way out, -1 on the way back
    flagged: Bool[Array, ""]  # true once the flag has been seen
    to_turn: Float[Array, ""]  # angle still to turn, rad; 0 while it drives
    heading: Float[Array, ""]  # last reading of the odometer's heading, rad
    stopped: Bool[Array, ""]  # true once it has arrived, or knows where it is; it then stands
    travelled: Float[Array, ""]  # distance commanded, m
    sure: Float[Array, ""]  # distance over which it has been sure of its place, m


def start_mission(obs: Observed) -> Mission:
    """Returns the mission at the start: on the way out."""
    zero, no = jnp.zeros(()), jnp.zeros((), bool)
    return Mission(jnp.ones(()), no, zero, obs.heading, no, zero, zero)


def is_turning(mission: Mission) -> Bool[Array, ""]:
    """Tells whether the robot is turning round."""
    return mission.to_turn > 0.0


def target_speed(mission: Mission, estimate: Station, obs: Observed, params: EnvParams) -> Float[Array, ""]:
    """Returns the speed to drive at, m/s: the largest, and in the last period what just reaches the target."""
    speed_max = jnp.asarray(params.vehicle.speed_max)
    if params.goal_kind == "cover":
        return speed_max
    if params.goal_kind == "report":
        return jnp.where(mission.stopped, 0.0, speed_max)
    target = obs.goal
    if params.goal_kind == "return":
        home = reported_start(obs, params)
        # Out until the flag is raised, wherever the goal is believed to be.
        target = jnp.where(mission.direction > 0.0, _FAR, home)
    to_go = mission.direction * (target - estimate.station)
    return jnp.where(mission.stopped, 0.0, jnp.clip(to_go / params.vehicle.period, 0.0, speed_max))


def check_arrival(mission: Mission, target: Float[Array, ""], driven: Float[Array, ""], params: EnvParams) -> Mission:
    """Returns the mission after a command: the target speed of the last period, driven in full, is the arrival."""
    if params.goal_kind in ("cover", "report"):
        return mission
    there = (target < params.vehicle.speed_max) & (driven >= target) & ~is_turning(mission)
    return dataclasses.replace(mission, stopped=mission.stopped | there)


def search(
    mission: Mission, estimate: Station, moved: Float[Array, ""], obs: Observed, params: EnvParams, sure_for: float
) -> Mission:
    """Returns the mission of one that looks for its place: it stops once it has been sure for a while, or has to.

    Args:
        mission: Mission, with the distance up to this observation.
        estimate: Estimate of the station; sure is one whose standard deviation is below half the task's tolerance.
        moved: Distance commanded since the last observation, m.
        sure_for: Distance over which the estimate must be sure, m.
    """
    is_sure = jnp.exp(estimate.log_sigma) < 0.5 * params.goal.tolerance
    sure = jnp.where(is_sure, mission.sure + moved, 0.0)
    mouth = jnp.all(obs.ranges[jnp.asarray(_MOUTH_BEAMS)] >= params.lidar.range_max)
    must = (mission.travelled >= _FURTHEST * params.goal.travel_max) | mouth
    stopped = mission.stopped | (sure >= sure_for) | must
    return dataclasses.replace(mission, stopped=stopped, sure=sure)


def watch(mission: Mission, obs: Observed, params: EnvParams) -> tuple[Mission, Bool[Array, ""], Bool[Array, ""]]:
    """Checks the flag and the turn.

    Returns:
        The mission, true where the flag has just been raised, and true where the turn has just ended.
    """
    if params.goal_kind != "return":
        no = jnp.zeros((), bool)
        return mission, no, no
    raised = (obs.flag > 0.5) & ~mission.flagged
    was_turning = is_turning(mission)
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
    """Returns the command of a turn on the spot, m/s and rad/s."""
    rate = jnp.minimum(_TURN_RATE, mission.to_turn / params.vehicle.period)
    return jnp.stack([jnp.full_like(rate, TURN_SPEED), rate])


@struct.dataclass
class Memory:
    """Memory of a navigator."""

    steering: Any  # memory of the steering
    localiser: Any  # memory of the localiser
    mission: Mission  # progress in the task
    command: Float[Array, "2"]  # last command, m/s and rad/s


@struct.dataclass
class Navigator:
    """An agent that localises itself, decides how far to go, and steers there.

    Asked to report where it is, it drives until its map has shown it; without a map it reports at once.
    """

    localiser: Localiser  # estimates the station
    steering: Steering  # keeps between the walls
    name: str = struct.field(pytree_node=False, default="navigator")  # name on the board
    uses_map: bool = struct.field(pytree_node=False, default=False)  # the localiser needs the map
    # distance over which it must be sure of its place before it reports, m
    sure_for: float = struct.field(pytree_node=False, default=30.0)
    cruise: float = struct.field(pytree_node=False, default=math.inf)  # largest speed towards a goal, m/s

    @property
    def uses_lidar(self) -> bool:
        return self.steering.uses_lidar or self.uses_map

    @property
    def privileged(self) -> bool:
        return self.localiser.privileged

    def begin(self, key: PRNGKeyArray, obs: Observed, params: EnvParams) -> Memory:
        return Memory(
            steering=self.steering.begin(obs, params),
            localiser=self.localiser.begin(obs, params),
            mission=start_mission(obs),
            command=jnp.zeros(2),
        )

    def act(
        self, key: PRNGKeyArray, memory: Memory, obs: Observed, params: EnvParams, known: Known
    ) -> tuple[Action, Memory]:
        steering = self.steering.look(memory.steering, obs, memory.command, params)
        now, raised, done = watch(memory.mission, obs, params)
        moved = memory.command[0] * params.vehicle.period
        now = dataclasses.replace(now, travelled=now.travelled + moved)
        driven = Driven(memory.command[0], self.steering.cosine(steering), memory.mission.direction, raised, steering)
        mirrored = self.steering.turn_round(steering)
        steering = jax.tree.map(lambda new, old: jnp.where(done, new, old), mirrored, steering)
        estimate, localiser = self.localiser.update(memory.localiser, obs, driven, params, known)
        if params.goal_kind == "report":
            sure_for = self.sure_for if self.uses_map else 0.0
            now = search(now, estimate, moved, obs, params, sure_for)
        target = target_speed(now, estimate, obs, params)
        paced = target if params.goal_kind == "cover" else jnp.minimum(target, self.cruise)
        command = self.steering.steer(steering, paced, params)
        command = jnp.where(is_turning(now), turn_command(now, params), command)
        limit = jnp.stack([jnp.asarray(params.vehicle.speed_max), jnp.asarray(params.vehicle.yaw_rate_max)])
        command = jnp.clip(command, jnp.stack([jnp.zeros(()), -limit[1]]), limit)
        after = Memory(steering, localiser, check_arrival(now, target, command[0], params), command)
        ahead = command[0] * params.vehicle.period * self.steering.cosine(steering)
        report = jnp.stack([estimate.station + estimate.direction * ahead, estimate.log_sigma, estimate.direction])
        return jnp.concatenate([command, report]), after
