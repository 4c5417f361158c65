"""Stable-Baselines3: a `VecEnv` over the batch, `PPO("MlpPolicy", SubterraVecEnv(256))`."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode

from subterra_jax.adapters.kernel import Observation, as_observation
from subterra_jax.adapters.vector import SubterraVectorEnv
from subterra_jax.host.errors import MissingLibraryError

try:
    from stable_baselines3.common.vec_env.base_vec_env import VecEnv
except ImportError as missing:
    raise MissingLibraryError(__name__, "stable-baselines3") from missing


class SubterraVecEnv(VecEnv):
    """A batch of environments that reset themselves, each with a fresh draw.

    A finished environment's `info` has `terminal_observation`, and `TimeLimit.truncated` marks the horizon. Environment
    i seeded with s + i does what a single `SubterraEnv` seeded with s + i does, up to rounding.

    Args:
        num_envs: Number of environments.
        task: Id of the task. A task that adds to the paper's observation returns a dict, for `MultiInputPolicy`.
        flat: Return a plain vector for every task, for `MlpPolicy`.
        **options: As for `SubterraEnv`.
    """

    def __init__(self, num_envs: int, task: str = "Subterra/Traverse-v1", flat: bool = False, **options: Any):
        self._envs = SubterraVectorEnv(num_envs, AutoresetMode.SAME_STEP, task, flat=flat, **options)
        self._action = np.zeros((0,), np.float32)
        super().__init__(num_envs, self._envs.single_observation_space, self._envs.single_action_space)
        self.metadata["render_fps"] = self._envs.metadata["render_fps"]

    def reset(self) -> Observation:
        """Begin an episode everywhere; seeds given by `seed` are used once."""
        obs, _ = self._envs.reset(seed=list(self._seeds))
        self.reset_infos = [{} for _ in range(self.num_envs)]
        self._reset_seeds()
        return obs

    def step_async(self, actions: np.ndarray) -> None:
        self._action = actions

    def step_wait(self) -> tuple[Observation, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Return observations to act on next, rewards (float32), dones and one `info` for each environment."""
        obs, reward, terminated, truncated, step = self._envs.advance(self._action)
        columns = {name: values.tolist() for name, values in step.info.items()}
        columns["TimeLimit.truncated"] = (truncated & ~terminated).tolist()
        infos = [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
        done = terminated | truncated
        for index in np.flatnonzero(done):
            infos[index]["terminal_observation"] = as_observation(np.array(step.obs[index]), self._envs.task.fields)
        return obs, np.array(reward), done, infos

    def close(self) -> None:
        self._envs.close()

    def get_images(self) -> Sequence[np.ndarray | None]:
        return self._envs.render() or [None] * self.num_envs

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return an attribute of `SubterraVectorEnv`, which all environments share."""
        return [getattr(self._envs, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Keep a value for `get_attr`; the simulator ignores it."""
        setattr(self._envs, attr_name, value)

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        """Refuse: the environments of a batch have no methods of their own."""
        raise AttributeError(f"an environment of a batch has no method {method_name!r}")

    def env_is_wrapped(self, wrapper_class: type[Any], indices: Any = None) -> list[bool]:
        """Return False for each environment: only the batch as a whole is wrapped."""
        return [False for _ in self._get_indices(indices)]
