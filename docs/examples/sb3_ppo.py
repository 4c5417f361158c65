"""PPO of Stable-Baselines3 on a batch of environments; `pip install 'subterra-jax[sb3]'`."""

from collections.abc import Callable
from typing import Any

import gymnasium
import jax
import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnvWrapper, VecNormalize
from watch import Act, OnHost, Watch, features

from subterra_jax.adapters.sb3 import SubterraVecEnv


class Look(VecEnvWrapper):
    """Shows features in place of observations."""

    def __init__(self, venv: SubterraVecEnv, look: Callable[[Any], Any]) -> None:
        n = look(venv.observation_space.sample()[None]).shape[1]
        super().__init__(venv, gymnasium.spaces.Box(-np.inf, np.inf, (n,)))
        self.look = look

    def reset(self) -> np.ndarray:
        """Begins episodes."""
        return np.asarray(self.look(self.venv.reset()))

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Ends a step; the last observation of an episode that is over is in its info."""
        obs, reward, done, infos = self.venv.step_wait()
        for info in infos:
            if "terminal_observation" in info:
                info["terminal_observation"] = np.asarray(self.look(info["terminal_observation"][None]))[0]
        return np.asarray(self.look(obs)), reward, done, infos


def train(watch: Watch, steps: int, seed: int) -> None:
    """Trains until the watch says enough."""
    look = jax.jit(jax.vmap(features(watch.env, watch.params)))
    envs = VecNormalize(Look(SubterraVecEnv(64, watch.task, flat=True, **watch.options), look), gamma=0.997)
    model = PPO(
        "MlpPolicy", envs, n_steps=128, batch_size=1024, n_epochs=4, learning_rate=1e-3, gamma=0.997, seed=seed,
        device="cpu",
    )  # fmt: skip

    def act(obs: np.ndarray) -> np.ndarray:
        return model.predict(envs.normalize_obs(np.asarray(look(obs))), deterministic=True)[0]

    agent = Act(OnHost(act))

    class Ask(BaseCallback):
        """Asks the watch before each rollout but the first."""

        def _on_step(self) -> bool:
            return not watch.reached

        def _on_rollout_start(self) -> None:
            if self.num_timesteps:
                watch(self.num_timesteps, agent)

    model.learn(steps, callback=Ask())
    watch(model.num_timesteps, agent)
