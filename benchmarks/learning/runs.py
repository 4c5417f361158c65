"""Trains PPO until the last hundred episodes meet the goal: ours, and that of Stable-Baselines3."""

import dataclasses
import time
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

import subterra_jax as st
from train import ppo
from train.config import ConfigError, make_config
from train.curve import GOAL, rolling
from train.snapshot import WINDOW, Snapshot

_FRAMES, _DISCOUNT = 4, 0.98  # as in ours


@dataclasses.dataclass(frozen=True)
class Curve:
    """Finished episodes of one training run.

    Attributes:
        name: Name of the trainer.
        step: Environment steps at the end of each episode, `(episodes,)`.
        seconds: Wall-clock time at the end of each episode, from the first step on, s, `(episodes,)`.
        coverage: Share of the tunnel covered by each episode, `(episodes,)`.
        success: True for each successful episode, `(episodes,)`.
        compiling: Time before the first step, s.
    """

    name: str
    step: Int[np.ndarray, "episodes"]
    seconds: Float[np.ndarray, "episodes"]
    coverage: Float[np.ndarray, "episodes"]
    success: Bool[np.ndarray, "episodes"]
    compiling: float = 0.0

    def reached(self) -> dict[str, float] | None:
        """Returns episodes, steps and seconds until the last hundred cover 90 % and all succeed; `None` if never."""
        holds = (rolling(self.coverage) >= GOAL) & (rolling(self.success.astype(float)) >= 1.0)
        holds[: WINDOW - 1] = False
        if not holds.any():
            return None
        first = int(np.argmax(holds))
        return {"episodes": first + 1, "steps": int(self.step[first]), "seconds": float(self.seconds[first])}

    def rate(self) -> float:
        """Returns steps per second, with learning and without compiling."""
        return float(self.step[-1] / self.seconds[-1]) if len(self.step) else 0.0


def train_ours(task: str, steps: int, seed: int, preset: str, tunnel: Any = None, **settings: Any) -> Curve:
    """Trains our PPO with a machine's preset, as `train.navigate` does, until the goal is met.

    Args:
        task: Task id.
        steps: Largest number of environment steps.
        seed: Seed for everything.
        preset: `cpu` or `gpu`.
        tunnel: As for `st.make`.
        **settings: Fields of `PPOConfig` to use instead of the preset's.
    """
    env, params = st.make(task, tunnel=tunnel)
    changes = {"seed": seed, "steps": steps, "stop_patience": 1, **settings}
    config = dataclasses.replace(make_config(task, preset), **changes)
    rows, timing = [], []

    def watch(now: Snapshot) -> None:
        rows.append(now.rows)
        times = now.record["timing"]
        timing.append((len(now.rows), times["seconds"] - times["compile_seconds"], times["compile_seconds"]))

    ppo.train(env, params, config, watch=watch)
    every = np.concatenate(rows)
    # Episodes that ended in one iteration come to the host together, at its end.
    seconds = np.concatenate([np.full(count, at) for count, at, _ in timing])
    name = f"ours, {config.n_envs} environments"
    return Curve(name, every["step"], seconds, every["coverage"].astype(float), every["success"], timing[-1][2])


def require_stable_baselines() -> None:
    """Checks that Stable-Baselines3 is installed.

    Raises:
        ConfigError: It is not.
    """
    try:
        import stable_baselines3  # noqa: F401
    except ImportError as missing:
        raise ConfigError("stable-baselines3 is not installed: pip install 'subterra-jax[sb3]'") from missing


def train_stable_baselines(task: str, steps: int, seed: int, tunnel: Any = None) -> Curve:
    """Trains Stable-Baselines3's PPO on one Gymnasium environment until the goal is met.

    Four frames are stacked, observations and rewards are normalised; all but discount and size of a rollout are the
    library's defaults.

    Args:
        task: Task id.
        steps: Largest number of environment steps.
        seed: Seed for everything.
        tunnel: As for `st.make`.
    """
    import gymnasium
    from stable_baselines3 import PPO
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize

    class Episodes(BaseCallback):
        """Records every finished episode; stops once the goal is met."""

        def __init__(self) -> None:
            super().__init__()
            self.rows: list[tuple[int, float, float, bool]] = []
            self.started = time.perf_counter()

        def _on_training_start(self) -> None:
            self.started = time.perf_counter()

        def _on_step(self) -> bool:
            for done, info in zip(self.locals["dones"], self.locals["infos"], strict=True):
                if done:
                    seconds = time.perf_counter() - self.started
                    self.rows.append((self.num_timesteps, seconds, float(info["coverage"]), bool(info["success"])))
            return len(self.rows) < WINDOW or self.curve().reached() is None

        def curve(self) -> Curve:
            """Returns the episodes so far."""
            step, seconds, coverage, success = zip(*self.rows, strict=True) if self.rows else ((), (), (), ())
            numbers = np.array(step, int), np.array(seconds, float), np.array(coverage, float)
            return Curve("SB3 PPO, 1 environment", *numbers, np.array(success, bool))

    envs = DummyVecEnv([lambda: gymnasium.make(f"subterra_jax:{task}", tunnel=tunnel, flat=True)])
    envs.seed(seed)
    envs.reset()
    envs.step(np.zeros((1, 2), np.float32))  # compiled before the clock runs
    normal = VecNormalize(VecFrameStack(envs, _FRAMES), gamma=_DISCOUNT)
    model = PPO("MlpPolicy", normal, n_steps=2048, batch_size=64, gamma=_DISCOUNT, seed=seed, device="cpu")
    episodes = Episodes()
    model.learn(steps, callback=episodes)
    envs.close()
    return episodes.curve()
