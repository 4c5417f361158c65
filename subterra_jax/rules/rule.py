"""What a rule is given and what it decides."""

import abc
import dataclasses
from typing import ClassVar

import numpy as np
from jaxtyping import Array, Bool, Float

from subterra_jax.state import EnvParams, GoalState, ResetNoise, State
from subterra_jax.tunnel import Foot, Tunnel

Bounds = tuple[float | np.ndarray, float | np.ndarray]


@dataclasses.dataclass(frozen=True)
class Step:
    """One step, after the motion.

    Attributes:
        before: State before the step.
        tunnel: The tunnel the robot is in.
        place: Where along the tunnel it has come to.
        heading: Its heading, tunnel frame, rad.
        furthest: Furthest station so far, m.
        contact: Whether it touches a wall or an obstacle.
        command: The command it obeyed, m/s and rad/s.
        motion: What it really did, m/s and rad/s.
        moved: True distance of this step, m.
        report: Estimated station (m), log of its standard deviation, direction (of growing station: above 0); zeros
            where the action has none.
    """

    before: State
    tunnel: Tunnel
    place: Foot
    heading: Float[Array, ""]
    furthest: Float[Array, ""]
    contact: Bool[Array, ""]
    command: Float[Array, "2"]
    motion: Float[Array, "2"]
    moved: Float[Array, ""]
    report: Float[Array, "3"]


@dataclasses.dataclass(frozen=True)
class Verdict:
    """What a rule makes of a step.

    Attributes:
        success: The task was achieved at this step.
        ended: The episode is over for good, for a reason other than contact.
        terms: Named terms of the reward.
        goal: State of the goal afterwards.
        told: Further entries of `info`.
    """

    success: Bool[Array, ""]
    ended: Bool[Array, ""]
    terms: dict[str, Float[Array, ""]]
    goal: GoalState | None
    told: dict[str, Array]


class Rule(abc.ABC):
    """One task's rule: static, hashable, without state of its own.

    Attributes:
        has_goal: Params, state and noise have the parts that belong to a goal.
        reports: The action holds an estimate that counts.
    """

    has_goal: ClassVar[bool] = False
    reports: ClassVar[bool] = False

    @abc.abstractmethod
    def begin(self, noise: ResetNoise, tunnel: Tunnel, params: EnvParams) -> tuple[Array, Array, GoalState | None]:
        """Station of the start (m), 0 or 1 for a robot facing backwards, and the goal."""

    def fields(self, params: EnvParams) -> dict[str, Bounds]:
        """Names and bounds of the numbers that are observed beside ranges and odometry; none unless a rule says so."""
        del params
        return {}

    def observe(self, state: State, tunnel: Tunnel) -> list[Float[Array, ""]]:
        """Those numbers, in the order of `fields`."""
        del state, tunnel
        return []

    @abc.abstractmethod
    def judge(self, step: Step, params: EnvParams) -> Verdict:
        """Success, end, reward."""
