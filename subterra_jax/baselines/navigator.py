"""An agent put together from a localiser, a steering and the mission; most baselines are one."""

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray

from subterra_jax.baselines import mission
from subterra_jax.baselines.agent import Action, Known, Observed
from subterra_jax.baselines.stations import Driven, Localiser
from subterra_jax.baselines.steering import Steering
from subterra_jax.state import EnvParams


@struct.dataclass
class Memory:
    """What a navigator remembers.

    Attributes:
        steering: Memory of the steering.
        localiser: Memory of the localiser.
        mission: Where in the task.
        command: Last command, m/s and rad/s.
    """

    steering: Any
    localiser: Any
    mission: mission.Mission
    command: Float[Array, "2"]


@struct.dataclass
class Navigator:
    """Localises, decides how far to go, and steers there.

    Attributes:
        localiser: Knows the station.
        steering: Keeps between the walls.
        name: Name on the leaderboard.
        uses_map: Whether the localiser needs the map.
    """

    localiser: Localiser
    steering: Steering
    name: str = struct.field(pytree_node=False, default="navigator")
    uses_map: bool = struct.field(pytree_node=False, default=False)

    @property
    def uses_lidar(self) -> bool:
        """Whether the steering, or a localiser with a map, reads the ranges."""
        return self.steering.uses_lidar or self.uses_map

    @property
    def privileged(self) -> bool:
        """Whether the localiser is told the truth."""
        return self.localiser.privileged

    def begin(self, key: PRNGKeyArray, obs: Observed, params: EnvParams) -> Memory:
        """At the believed start."""
        del key
        return Memory(
            steering=self.steering.begin(obs, params),
            localiser=self.localiser.begin(obs, params),
            mission=mission.start_mission(obs),
            command=jnp.zeros(2),
        )

    def act(
        self, key: PRNGKeyArray, memory: Memory, obs: Observed, params: EnvParams, known: Known
    ) -> tuple[Action, Memory]:
        """One control period."""
        del key
        steering = self.steering.look(memory.steering, obs, memory.command, params)
        now, raised, done = mission.watch(memory.mission, obs, params)
        driven = Driven(memory.command[0], self.steering.cosine(steering), memory.mission.direction, raised)
        steering = jax.tree.map(lambda new, old: jnp.where(done, new, old), self.steering.turned(steering), steering)
        estimate, localiser = self.localiser.update(memory.localiser, obs, driven, params, known)
        wanted = mission.wanted_speed(now, estimate, obs, params)
        command = self.steering.steer(steering, wanted, params)
        command = jnp.where(mission.turning(now), mission.turn_command(now, params), command)
        limit = jnp.stack([jnp.asarray(params.vehicle.speed_max), jnp.asarray(params.vehicle.yaw_rate_max)])
        command = jnp.clip(command, jnp.stack([jnp.zeros(()), -limit[1]]), limit)
        after = Memory(steering, localiser, mission.arrived(now, wanted, command[0], params), command)
        ahead = command[0] * params.vehicle.period * self.steering.cosine(steering)
        report = jnp.stack([estimate.station + estimate.direction * ahead, estimate.log_sigma, estimate.direction])
        return jnp.concatenate([command, report]), after
