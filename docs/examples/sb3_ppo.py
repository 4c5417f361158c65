"""PPO of Stable-Baselines3 on a batch of environments; `pip install 'subterra-jax[sb3]'`."""

import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecNormalize
from watch import Act, OnHost, Watch

from subterra_jax.adapters.sb3 import SubterraVecEnv


def train(watch: Watch, steps: int, seed: int) -> None:
    """Trains until the watch says enough."""
    envs = VecNormalize(SubterraVecEnv(64, watch.task, flat=True, **watch.options), gamma=0.98)
    model = PPO(
        "MlpPolicy", envs, n_steps=128, batch_size=1024, n_epochs=4, learning_rate=1e-3, gamma=0.98, seed=seed,
        device="cpu",
    )  # fmt: skip

    def act(obs: np.ndarray) -> np.ndarray:
        return model.predict(envs.normalize_obs(obs), deterministic=True)[0]

    agent = Act(OnHost(act))

    class Look(BaseCallback):
        """Asks the watch before each rollout but the first."""

        def _on_step(self) -> bool:
            return not watch.reached

        def _on_rollout_start(self) -> None:
            if self.num_timesteps:
                watch(self.num_timesteps, agent)

    model.learn(steps, callback=Look())
    watch(model.num_timesteps, agent)
