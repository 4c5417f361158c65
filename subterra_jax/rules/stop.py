"""T1: stop at a station. T3 and T4 ask the same, among boxes and under faults."""

import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from subterra_jax import constants
from subterra_jax.parts.part import Batch, Bounds, Keys, Step
from subterra_jax.rules.rule import Choice, Rule, Start, Terms, Verdict, chosen, jerk, spread
from subterra_jax.state import EnvParams, State
from subterra_jax.tunnel import Tunnel


@struct.dataclass
class GoalParams:
    """Goals, and what counts as having reached one.

    Attributes:
        low: Least distance of a goal from the start, m.
        high: Largest distance of a goal from the start, m.
        margin: Least distance of starts and goals from both mouths, m.
        tolerance: Largest error of success, m.
        still_speed: Speed below which a robot stands, m/s.
        still_yaw: Yaw rate from which it does not stand, rad/s: to turn on the spot is not to stop.
        still_steps: Steps of standing that make a stop, which ends the episode.
        flag_reach: Distance to the goal at which the flag is raised, m.
        travel_max: Distance after which a robot that has not reported has failed, m.
    """

    low: float = constants.GOAL_LOW
    high: float = constants.GOAL_HIGH
    margin: float = constants.GOAL_MARGIN
    tolerance: float = constants.TOLERANCE
    still_speed: float = constants.STILL_SPEED
    still_yaw: float = constants.STILL_YAW
    still_steps: int = constants.STILL_STEPS
    flag_reach: float = constants.FLAG_REACH
    travel_max: float = constants.TRAVEL_MAX


@struct.dataclass
class GoalRewardParams:
    """Weights of the reward of tasks with a goal.

    Attributes:
        terminal: Reward of success, once.
        precision: Reward at a stop, times exp(-error / tolerance).
        miss: Cost of each metre of error, at a stop or a contact.
        crash: Cost of a contact, and of not reporting in time.
        progress: Reward of each metre by which the way to go has become shorter.
        time: Cost of every step.
        lateral: Cost of the distance from the centreline over the half-width.
        jerk: Cost of the change of command, m/s and rad/s alike.
    """

    terminal: float = constants.GOAL_TERMINAL
    precision: float = constants.GOAL_PRECISION
    miss: float = constants.GOAL_MISS
    crash: float = constants.GOAL_CRASH
    progress: float = constants.GOAL_PROGRESS
    time: float = constants.GOAL_TIME
    lateral: float = constants.GOAL_LATERAL
    jerk: float = constants.GOAL_JERK


@struct.dataclass
class ReportParams:
    """Errors of what an agent is given."""

    # relative error of the ring length reported against that of the tunnel's drawings, 1; for ablations
    pitch_error: float = 0.0


@struct.dataclass
class GoalState:
    """Goal of one episode."""

    station: Float[Array, ""]  # station of the goal, m
    still: Int[Array, ""]  # steps that the robot has stood


@struct.dataclass
class StopState(GoalState):
    """Goal of one episode, and what is reported."""

    reported: Float[Array, ""]  # station of the start as reported, m
    pitch: Float[Array, ""]  # ring length as reported, m; 0 where there are no rings


class GoalRule(Rule):
    """The base of the rules that end with a stop."""

    streams: ClassVar[tuple[int, ...]] = (0, 4, 5)

    def defaults(self) -> dict[str, Any]:
        return {**super().defaults(), "goal": GoalParams(), "reward": GoalRewardParams()}

    def draw_reset(self, key: Keys, batch: Batch, params: EnvParams) -> tuple[Array, Array, Array]:
        """Draw numbers for `spread`, three in [0, 1) for goal, place and direction, and a normal one for the start."""
        return (
            super().draw_reset(key[0], batch, params),
            jax.random.uniform(key[1], (*batch, 3), jnp.float32),
            jax.random.normal(key[2], batch, jnp.float32),
        )

    def privileged(self, state: State) -> dict[str, Array]:
        """Return the way to the goal, m, and how long the robot has stood, as a fraction of a stop."""
        return {"to_goal": state.goal.station - state.station, "still": state.goal.still}

    def tolerance(self, params: EnvParams) -> Any:
        return params.goal.tolerance


@dataclasses.dataclass(frozen=True)
class StopAt(GoalRule):
    """Success is a stop within the tolerance of the goal; any stop ends the episode.

    The episode starts further than `goal.margin` from both mouths, with a goal ahead. The believed start is observed as
    `start`; the true one is off by a normal number of `start.station_sigma`, cut off at three of them.
    """

    key: ClassVar[str] = "stop"
    goal_kind: ClassVar[str] = "stop"

    def defaults(self) -> dict[str, Any]:
        return {**super().defaults(), "reported": ReportParams()}

    def start(self, draw: tuple[Array, Array, Array], tunnel: Tunnel, params: EnvParams) -> Start:
        """Draw the distance, then the start in the room that is left, then how far the true start is off."""
        reported, goal = draw_stations(draw[1], tunnel, params.goal)
        offset = params.start.station_sigma * jnp.clip(draw[2], -3.0, 3.0)
        pitch = tunnel.ring_pitch * (1.0 + params.reported.pitch_error)
        own = StopState(goal, jnp.zeros((), jnp.int32), reported, pitch)
        return Start(reported + offset, **spread(draw[0], params), own=own)

    def place(self, start: Start, choice: Choice) -> Start:
        """Return a start with a chosen place, which is reported as it is, and goal; a drawn goal keeps its distance."""
        own = start.own
        reported = chosen(choice.station, own.reported)
        goal = chosen(choice.goal, own.station + reported - own.reported)
        start = super().place(start, choice)
        return dataclasses.replace(start, own=dataclasses.replace(own, station=goal, reported=reported))

    def space(self, params: EnvParams) -> dict[str, Bounds]:
        """Station of the goal, nominal ring length (0 where there are no rings), and the believed start, m."""
        return {"goal": (0.0, np.inf), "ring_pitch": (0.0, np.inf), "start": (0.0, np.inf)}

    def observe(self, state: State, tunnel: Tunnel) -> dict[str, Array]:
        own = state.goal
        return {"goal": own.station, "ring_pitch": own.pitch, "start": own.reported}

    def judge(self, step: Step, params: EnvParams) -> Verdict:
        goal = step.before.goal
        still, stopped = count_still(step, params.goal)
        error = step.place.station - goal.station
        success = stopped & (jnp.abs(error) <= params.goal.tolerance)
        nearer = jnp.abs(step.before.station - goal.station) - jnp.abs(error)
        terms = goal_terms(
            step, params, success=success, stopped=stopped, failed=step.contact, error=error, nearer=nearer
        )
        after = dataclasses.replace(goal, still=still)
        return Verdict(success, stopped, terms, after, {"goal_error": error, "stopped": stopped})

    def shortest_way(self, state: State, tunnel: Tunnel, params: EnvParams) -> Float[Array, ""]:
        return jnp.abs(state.goal.station - state.station)

    def least_length(self, params: EnvParams) -> float:
        return float(np.max(params.goal.low) + 2.0 * np.max(params.goal.margin))


def draw_stations(
    draw: Float[Array, "3"], tunnel: Tunnel, goal: GoalParams
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Draw the stations of start and goal, m, as far apart as the tunnel has room for.

    Args:
        draw: Uniform numbers in [0, 1): of the distance, and of the start.
        goal: Bounds of the distance, and the least distance from a mouth.
    """
    room = jnp.maximum(tunnel.length - 2.0 * goal.margin, 0.0)
    high = jnp.minimum(goal.high, room)
    low = jnp.minimum(goal.low, high)
    distance = low + (high - low) * draw[0]
    start = goal.margin + (room - distance) * draw[1]
    return start, start + distance


def count_still(step: Step, goal: GoalParams) -> tuple[Int[Array, ""], Bool[Array, ""]]:
    """Count the steps that the robot has stood, and tell whether that is a stop."""
    speed, yaw_rate = step.drive.motion
    stands = (speed < goal.still_speed) & (jnp.abs(yaw_rate) < goal.still_yaw)
    still = jnp.where(stands, step.before.goal.still + 1, 0).astype(jnp.int32)
    return still, (still >= goal.still_steps) & ~step.contact


def goal_terms(
    step: Step,
    params: EnvParams,
    *,
    success: Bool[Array, ""],
    stopped: Bool[Array, ""],
    failed: Bool[Array, ""],
    error: Float[Array, ""],
    nearer: Float[Array, ""],
) -> Terms:
    """Return the terms of one step's reward in a task with a goal.

    Args:
        params: The task, with the weights.
        success: The task was achieved at this step.
        stopped: The robot has come to a stop, right or wrong.
        failed: The robot touched something, or did not report in time.
        error: Error of a stop, m.
        nearer: Length by which the way to go has become shorter, m.
    """
    weights, size = params.reward, jnp.abs(error)
    succeeds, stops, fails, ends = (flag.astype(size.dtype) for flag in (success, stopped, failed, stopped | failed))
    return {
        "reward_terminal": weights.terminal * succeeds,
        "reward_precision": weights.precision * stops * jnp.exp(-size / jnp.asarray(params.goal.tolerance)),
        "reward_miss": -weights.miss * ends * size,
        "reward_crash": -weights.crash * fails,
        "reward_progress": weights.progress * nearer,
        "reward_time": -weights.time * jnp.ones_like(size),
        "reward_lateral": -weights.lateral * jnp.abs(step.place.lateral) / step.place.half_width,
        "reward_jerk": -weights.jerk * jerk(step.command, step.before.command),
    }
