"""One environment of a batch, for those who ask after its attributes."""

from typing import Any

import numpy as np

from subterra_jax.adapters.vector import SubterraVectorEnv
from subterra_jax.env import TunnelEnv
from subterra_jax.state import EnvParams, State


class EnvRow:
    """What a batch knows of one of its environments; further attributes may be set on it.

    Args:
        envs: The batch.
        index: Which environment.
    """

    def __init__(self, envs: SubterraVectorEnv, index: int):
        self._envs, self._index = envs, index
        self.render_mode = envs.render_mode
        self.observation_space, self.action_space = envs.single_observation_space, envs.single_action_space
        self.spec = envs.spec

    @property
    def unwrapped(self) -> "EnvRow":
        """Itself."""
        return self

    @property
    def task(self) -> str:
        """Id of the task."""
        return self.env.id

    @property
    def env(self) -> TunnelEnv:
        """The JAX environment, shared by the batch."""
        return self._envs.batch.env

    @property
    def params(self) -> EnvParams:
        """Its params, shared by the batch."""
        return self._envs.batch.params

    @property
    def state(self) -> State | None:
        """State, on the host; None before the first reset."""
        return self._envs.batch.state(self._index)

    def render(self) -> np.ndarray | None:
        """A picture, `(480, 480, 3)` uint8; None without `rgb_array`."""
        return None if self.render_mode is None else self._envs.picture(self._index)

    def has_wrapper_attr(self, name: str) -> bool:
        """Whether there is such an attribute."""
        return hasattr(self, name)

    def get_wrapper_attr(self, name: str) -> Any:
        """An attribute by its name."""
        return getattr(self, name)
