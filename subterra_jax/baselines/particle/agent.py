"""The particle filter as one agent for every task: it relocalises where the start is not told."""

from typing import Any

from flax import struct
from jaxtyping import PRNGKeyArray

from subterra_jax.baselines.agent import Action, Known, Observed
from subterra_jax.baselines.navigator import Navigator
from subterra_jax.baselines.particle.localiser import particle_filter
from subterra_jax.baselines.particle.relocate import Relocaliser
from subterra_jax.state import EnvParams


@struct.dataclass
class ParticleAgent:
    """A filter that is told the start, and one that is not; the errand of the task chooses between them.

    Attributes:
        told: For tasks that begin at a known station.
        lost: For relocalisation.
    """

    told: Navigator
    lost: Relocaliser
    name: str = struct.field(pytree_node=False, default="particle-filter")
    uses_lidar: bool = struct.field(pytree_node=False, default=True)
    uses_map: bool = struct.field(pytree_node=False, default=True)
    privileged: bool = struct.field(pytree_node=False, default=False)

    @classmethod
    def of(cls, params: EnvParams) -> "ParticleAgent":
        """For a task: its map and its nominal errors."""
        return cls(particle_filter(params), Relocaliser.of(params))

    def begin(self, key: PRNGKeyArray, obs: Observed, params: EnvParams) -> Any:
        """Memory of the one that drives."""
        return self._driver(params).begin(key, obs, params)

    def act(self, key: PRNGKeyArray, memory: Any, obs: Observed, params: EnvParams, known: Known) -> tuple[Action, Any]:
        """What it does."""
        return self._driver(params).act(key, memory, obs, params, known)

    def _driver(self, params: EnvParams) -> Navigator | Relocaliser:
        return self.lost if params.errand == "report" else self.told
