"""A learnt localiser in the written controller: it keeps to the middle and stops where it believes the goal to be.

One that has learnt to take a map gets the one of the task by `with_map`, and drives without one too (`without_map`).
Round boxes it steers by the written avoidance: what is learnt is where the robot is.
"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray

from subterra_jax.baselines.agent import Action, Known, Observed, n_ranges
from subterra_jax.baselines.navigator import Memory, Navigator
from subterra_jax.baselines.steering import CentreLine, steering_of
from subterra_jax.policies.files import Conditions, PolicyError
from subterra_jax.policies.locate.map_strip import MapStrip
from subterra_jax.policies.trained import Tensors, Trained
from subterra_jax.state import EnvParams
from subterra_jax.tunnel_env import TunnelEnv

KIND = "locate"
GOAL_KINDS = ("stop", "return")


@struct.dataclass
class Locating(Trained):
    """Drives to a goal by a learnt localiser."""

    kind: ClassVar[str] = KIND
    prefix: ClassVar[str] = ""
    uses_lidar = True
    learns_goal_kind: ClassVar[bool] = False
    tensors: Tensors  # weights by name, parts of the name between dots
    low: Float[Array, "2"]  # smallest action, m/s and rad/s
    high: Float[Array, "2"]  # largest action, m/s and rad/s
    # speed at which it drives at most, m/s; None is that of the vehicle
    speed: float | None = struct.field(pytree_node=False, default=None)
    map: MapStrip | None = None
    hides_map: bool = struct.field(pytree_node=False, default=False)
    blind: bool = struct.field(pytree_node=False, default=False)
    name: str = struct.field(pytree_node=False, default=KIND)  # name on the board
    # conditions of its training; None: any
    conditions: Conditions | None = struct.field(pytree_node=False, default=None)

    @classmethod
    def of_layout(cls, layout: Mapping[str, Any], **common: Any) -> "Locating":
        speed = layout.get("speed")
        return cls(**common, speed=None if speed is None else float(speed))

    def try_out(self) -> None:
        """Compares names and shapes of the tensors with the network's."""
        self.check_tensors(self.localiser_shapes())

    def check_task(self, env: TunnelEnv, params: EnvParams, source: str | Path) -> None:
        """Refuses a task without a goal on the way, and beams that are no multiple of 16."""
        if (goal_kind := env.rule.goal_kind) not in GOAL_KINDS:
            raise PolicyError(
                f"{source}: a localiser on its way to a goal, without a map; {env.id} asks to {goal_kind}"
            )
        if (n := n_ranges(params)) % 16:
            raise PolicyError(f"{source}: needs 16 level beams or a multiple of them, {env.id} has {n}")

    def begin(self, key: PRNGKeyArray, obs: Observed, params: EnvParams) -> Memory:
        return self._navigator(params).begin(key, obs, params)

    def act(
        self, key: PRNGKeyArray, memory: Memory, obs: Observed, params: EnvParams, known: Known
    ) -> tuple[Action, Memory]:
        """Returns command and estimate of one control period, and the memory after it."""
        return self._navigator(params).act(key, memory, obs, params, known)

    def _navigator(self, params: EnvParams) -> Navigator:
        cruise, steering = math.inf if self.speed is None else self.speed, steering_of(params, CentreLine())
        return Navigator(self.given.localiser(params), steering, name=self.name, cruise=cruise)
