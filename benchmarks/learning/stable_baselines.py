"""PPO of Stable-Baselines3 on one Gymnasium environment, four frames stacked, observations and rewards normalised."""

import time
from typing import Any

import gymnasium
import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize

from benchmarks.learning.curve import Curve
from train.run.episodes import WINDOW

NAME = "SB3 PPO, 1 environment"
_FRAMES, _DISCOUNT = 4, 0.98  # as ours


class _Episodes(BaseCallback):
    """Notes every finished episode; stops once the goal has been met."""

    def __init__(self) -> None:
        super().__init__()
        self.rows: list[tuple[int, float, float, bool]] = []
        self.began = time.perf_counter()

    def _on_training_start(self) -> None:
        self.began = time.perf_counter()

    def _on_step(self) -> bool:
        for done, info in zip(self.locals["dones"], self.locals["infos"], strict=True):
            if done:
                seconds = time.perf_counter() - self.began
                self.rows.append((self.num_timesteps, seconds, float(info["coverage"]), bool(info["success"])))
        return len(self.rows) < WINDOW or self.curve().reached() is None

    def curve(self) -> Curve:
        step, seconds, coverage, success = zip(*self.rows, strict=True) if self.rows else ((), (), (), ())
        return Curve(
            NAME, np.array(step, int), np.array(seconds, float), np.array(coverage, float), np.array(success, bool)
        )


def train(task: str, steps: int, seed: int, tunnel: Any = None) -> Curve:
    """Trains with the library's defaults but for discount and the size of a rollout.

    Args:
        task: Task id.
        steps: Environment steps, at most.
        seed: Of everything.
        tunnel: As for `st.make`.
    """
    envs = DummyVecEnv([lambda: gymnasium.make(f"subterra_jax:{task}", tunnel=tunnel, flat=True)])
    envs.seed(seed)
    envs.reset()
    envs.step(np.zeros((1, 2), np.float32))  # compiled before the clock runs
    normal = VecNormalize(VecFrameStack(envs, _FRAMES), gamma=_DISCOUNT)
    model = PPO("MlpPolicy", normal, n_steps=2048, batch_size=64, gamma=_DISCOUNT, seed=seed, device="cpu")
    episodes = _Episodes()
    model.learn(steps, callback=episodes)
    envs.close()
    return episodes.curve()
