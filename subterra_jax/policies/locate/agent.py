"""A learnt localiser in the written controller: it keeps to the middle and stops where it believes the goal to be.

One that has learnt to take a map gets the one of the task by `with_map`, and drives without one too (`without_map`).
Round boxes it steers by the written avoidance: what is learnt is where the robot is.
"""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import jax
from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray

from subterra_jax.baselines.agent import Action, Known, Observed, n_ranges
from subterra_jax.baselines.avoidance import steering_of
from subterra_jax.baselines.navigator import Memory, Navigator
from subterra_jax.baselines.steering import CentreLine, PacedSteering, Steering
from subterra_jax.policies.files import Conditions, PolicyError
from subterra_jax.policies.locate import memory
from subterra_jax.policies.locate.locator import Locator
from subterra_jax.policies.locate.map_strip import MapStrip, map_strip
from subterra_jax.policies.locate.ways import TwoWays
from subterra_jax.policies.trained import Tensors, Trained, flat, nested
from subterra_jax.state import EnvParams
from subterra_jax.tunnel_env import TunnelEnv

KIND = "locate"
ERRANDS = ("stop", "return")


@struct.dataclass
class Locating(Trained):
    """Drives to a goal by a learnt localiser.

    Attributes:
        tensors: Weights by name, parts of the name between dots.
        low: Smallest action, m/s and rad/s.
        high: Largest action, m/s and rad/s.
        network: Memory behind the front end, of `memory.NETWORKS`.
        speed: Speed at which it drives at most, m/s; None is that of the vehicle.
        map: The map; None has none.
        hides_map: Take no map: `with_map` changes nothing.
        blind: Cut what the walls tell: the ablation of the learnt estimate.
        name: Name on the leaderboard.
        conditions: Conditions of its training; None: any.
    """

    kind: ClassVar[str] = KIND
    learns_errand: ClassVar[bool] = False
    uses_lidar = True
    tensors: Tensors
    low: Float[Array, "2"]
    high: Float[Array, "2"]
    network: str = struct.field(pytree_node=False, default="transformer")
    speed: float | None = struct.field(pytree_node=False, default=None)
    map: MapStrip | None = None
    hides_map: bool = struct.field(pytree_node=False, default=False)
    blind: bool = struct.field(pytree_node=False, default=False)
    name: str = struct.field(pytree_node=False, default=KIND)
    conditions: Conditions | None = struct.field(pytree_node=False, default=None)

    @classmethod
    def of_layout(cls, layout: Mapping[str, Any], **common: Any) -> "Locating":
        """Makes the agent of a layout with `network`, and `speed` if it has one."""
        speed = layout.get("speed")
        return cls(
            **common,
            network=str(layout["network"]),
            speed=None if speed is None else float(speed),
        )

    def try_out(self) -> None:
        """Compares names and shapes of the tensors with the network's."""
        check_tensors(self)

    def check_task(self, env: TunnelEnv, params: EnvParams, source: str | Path) -> None:
        """Refuses a task without a goal on the way, and beams that are no multiple of 16."""
        if (errand := env.rule.errand) not in ERRANDS:
            raise PolicyError(f"{source}: a localiser on its way to a goal, without a map; {env.id} asks to {errand}")
        if (n := n_ranges(params)) % 16:
            raise PolicyError(f"{source}: needs 16 level beams or a multiple of them, {env.id} has {n}")

    @property
    def uses_map(self) -> bool:
        """True once it has a map."""
        return self.map is not None

    @property
    def takes_map(self) -> bool:
        """True where it has learnt to take a map."""
        return any(name.startswith(f"{memory.MAP}.") for name in self.tensors)

    def with_map(self, params: EnvParams) -> "Locating":
        """Returns the agent with the map of a task if it takes one; runs on the host. A way back is driven without."""
        if not self.takes_map or self.hides_map or self.blind or params.errand != "stop":
            return self
        return dataclasses.replace(self, map=map_strip(params.tunnel))

    def without_map(self) -> "Locating":
        """Returns the agent with the same weights, and no map."""
        return dataclasses.replace(self, map=None, hides_map=True, name=f"{self.name}, no map")

    def without_walls(self) -> "Locating":
        """Returns the agent with its learnt estimate cut out: the same weights, and nothing that the walls tell."""
        return dataclasses.replace(self, map=None, blind=True, name=f"{self.name}, cut")

    def begin(self, key: PRNGKeyArray, obs: Observed, params: EnvParams) -> Memory:
        """Begins at the believed start."""
        return self._navigator(params).begin(key, obs, params)

    def act(
        self, key: PRNGKeyArray, memory: Memory, obs: Observed, params: EnvParams, known: Known
    ) -> tuple[Action, Memory]:
        """Returns command and estimate of one control period, and the memory after it."""
        return self._navigator(params).act(key, memory, obs, params, known)

    def _navigator(self, params: EnvParams) -> Navigator:
        locator = Locator(nested(self.tensors), self.network, self.map, self.blind)
        localiser = TwoWays(locator) if params.errand == "return" else locator
        steered: Steering = steering_of(params, CentreLine())
        if self.speed is not None:
            steered = PacedSteering(steered, self.speed)
        return Navigator(localiser, steered, name=self.name)


def check_tensors(agent: Locating) -> None:
    """Refuses tensors that are missing or misshapen.

    Raises:
        KeyError: One is missing.
        ValueError: There is no such network, or a tensor has another shape or name.
    """
    front = memory.front_of(agent.tensors)
    shapes = jax.eval_shape(lambda key: memory.init(agent.network, front, key, agent.takes_map), jax.random.key(0))
    wanted = flat(shapes)
    for name, leaf in wanted.items():
        if agent.tensors[name].shape != leaf.shape:
            raise ValueError(f"{name} is {agent.tensors[name].shape}, not {leaf.shape}")
    if further := sorted(set(agent.tensors) - set(wanted)):
        raise ValueError(f"{further[0]} is of no {agent.network}")
