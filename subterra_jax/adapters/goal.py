"""Goal-conditioned T1, for hindsight: the goal is taken out of the observation and may be exchanged afterwards.

No observation holds the true station, so neither may `achieved_goal`, which networks read: it is the station by the
odometer, an estimate that drifts. Rewards are judged by the truth, which stands in `info` for the learner alone.
"""

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from subterra_jax.adapters.packing import as_vector
from subterra_jax.host.errors import SubterraError

GoalObservation = dict[str, np.ndarray]


class GoalError(SubterraError, ValueError):
    """A task cannot be conditioned on a goal, or a reward not be judged."""


class GoalConditioned(gymnasium.Wrapper[GoalObservation, np.ndarray, Any, np.ndarray]):
    """An environment of a task that stops at a goal, with `observation`, `achieved_goal` and `desired_goal`.

    `achieved_goal` is the believed start and the dead-reckoned distance, m, `(1,)`. Reward is 1 for a stop within the
    tolerance of the goal and else 0, so that it can be computed for another goal.

        env = GoalConditioned(gymnasium.make("subterra_jax:Subterra/StopAtShort-v1"))
        SAC("MultiInputPolicy", env, replay_buffer_class=HerReplayBuffer, replay_buffer_kwargs={"copy_info_dict": True})

    Args:
        env: The environment, from `gymnasium.make`.

    Raises:
        GoalError: The task asks for something other than a stop at a goal.
    """

    def __init__(self, env: gymnasium.Env[Any, np.ndarray]):
        super().__init__(env)
        inner: Any = env.unwrapped
        task, params = getattr(inner, "task_env", None), getattr(inner, "task_params", None)
        if task is None or params is None or task.rule.errand != "stop":
            name = getattr(env.spec, "id", type(inner).__name__)
            raise GoalError(f"{name} does not ask for a stop at a goal, so that no goal can be exchanged")
        fields = task.fields(params)
        self._tolerance, self._prior_start = float(params.goal.tolerance), float(params.start.station)
        self._start = fields["start"].start if "start" in fields else None
        self._goal, self._distance = fields["goal"].start, fields["odometry"].start
        self._rest = [at for name, where in fields.items() if name != "goal" for at in range(where.start, where.stop)]
        box, end = task.observation_space(params), float(np.max(np.asarray(params.tunnel.length)))
        space: Any = spaces.Dict(
            {
                "observation": spaces.Box(box.low[self._rest], box.high[self._rest], dtype=np.float32),
                "achieved_goal": spaces.Box(-np.inf, np.inf, (1,), np.float32),
                "desired_goal": spaces.Box(0.0, end, (1,), np.float32),
            }
        )
        self.observation_space = space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[GoalObservation, dict[str, Any]]:
        """Begin an episode; `options={"goal": ...}` chooses the goal."""
        obs, info = self.env.reset(seed=seed, options=options)
        return self._split(obs), info

    def step(self, action: np.ndarray) -> tuple[GoalObservation, float, bool, bool, dict[str, Any]]:
        """Take one step; the task's own reward is in `info["task_reward"]`."""
        flat, reward, terminated, truncated, info = self.env.step(action)
        obs, info = self._split(flat), {**info, "task_reward": reward}
        own = self.compute_reward(obs["achieved_goal"], obs["desired_goal"], info)
        return obs, float(own), terminated, truncated, info

    def compute_reward(self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: Any) -> Any:
        """Return what a step would have been worth with another goal.

        Args:
            achieved_goal: Not used: it is an estimate.
            desired_goal: Station of that goal, m, `(1,)` or `(n, 1)`.
            info: Info of the step, or a sequence of `n` of them: `station` is the truth.

        Returns:
            1 for a stop within the tolerance, else 0: one number, or `(n,)` float32.

        Raises:
            GoalError: The infos are missing, which Stable-Baselines3 keeps with `copy_info_dict=True`.
        """
        infos = [info] if isinstance(info, dict) else list(info)
        if any("station" not in one or "stopped" not in one for one in infos):
            raise GoalError("a goal is judged by the true station in info: keep it, with copy_info_dict=True for SB3")
        off, stopped = (np.array([one[name] for one in infos]) for name in ("station", "stopped"))
        off = off - np.asarray(desired_goal).reshape(-1)
        reward = (stopped & (np.abs(off) <= self._tolerance)).astype(np.float32)
        return reward[0] if isinstance(info, dict) else reward

    def _split(self, obs: Any) -> GoalObservation:
        flat = as_vector(obs)
        start = self._prior_start if self._start is None else flat[self._start]
        achieved = np.array([start + flat[self._distance]], np.float32)
        return {"observation": flat[self._rest], "achieved_goal": achieved, "desired_goal": flat[[self._goal]]}
