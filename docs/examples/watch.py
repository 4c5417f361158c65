"""The watch that times a trainer: it scores policies on episodes that no trainer sees, and says when to stop."""

import dataclasses
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray

import subterra_jax as st
from subterra_jax.baselines.agent import Action, Agent, Known, Observed, observed
from subterra_jax.episode import in_tunnel
from subterra_jax.evaluation import evaluate, listed_episodes
from subterra_jax.evaluation.records import summarise
from subterra_jax.policies import inputs
from subterra_jax.state import EnvParams
from subterra_jax.tunnel_env import TunnelEnv

GOAL = 0.9
N_FRESH, FIRST_FRESH = 100, 10_000  # episodes of a score while training, and their first seed
TURN = 0.1  # fraction of the yaw rate that eased actions reach
_BATCH = 500


def features(env: TunnelEnv, params: EnvParams) -> Callable[[Array], Array]:
    """Returns a function from an observation `(n_obs,)` to numbers of order 1: the ranges, and the way to go.

    A goal to within 0.25 m is not learnt from stations of kilometres.
    """
    here = in_tunnel(env, params, 0)

    def look(flat: Float[Array, "n_obs"]) -> Float[Array, "n"]:
        obs = observed(env, here, flat)
        zero = jnp.zeros(())
        now = dataclasses.replace(
            inputs.begin(obs), flag=jnp.asarray(obs.flag, jnp.float32), distance=zero, heading=zero
        )
        return inputs.look(now, obs, inputs.way_to_go(now, obs, here), here)

    return look


def eased(action: Float[Array, "2"], low: Array, high: Array) -> Float[Array, "2"]:
    """Returns the command of an action in [-1, 1]: the robot stands in half of it, and turns gently.

    Noise that throws a robot against the wall teaches it to end there, and it seldom stands still where it must be at
    the end of a range to do so.
    """
    ahead, turn = jnp.clip(action, -1.0, 1.0)
    return jnp.stack([low[0] + jnp.maximum(ahead, 0.0) * (high[0] - low[0]), TURN * turn * high[1]])


@struct.dataclass
class Act(Agent):
    """An agent without memory: a function of weights and observation, in JAX.

    Attributes:
        function: Weights and observation `(n_obs,)` to speed (m/s) and yaw rate (rad/s). The same object at each score,
            or the drive is compiled anew.
        weights: Any pytree of arrays.
    """

    name = "trained elsewhere"
    uses_lidar = True
    function: Callable[[Any, Array], Array] = struct.field(pytree_node=False)
    weights: Any = ()

    def begin(self, key: PRNGKeyArray, obs: Observed, params: EnvParams) -> tuple[()]:
        """Returns no memory."""
        del key, obs, params
        return ()

    def act(
        self, key: PRNGKeyArray, memory: tuple[()], obs: Observed, params: EnvParams, known: Known
    ) -> tuple[Action, tuple[()]]:
        """Returns the function's command and no estimate."""
        del key, params, known
        command = self.function(self.weights, obs.flat)
        return jnp.concatenate([command.astype(jnp.float32), jnp.array([jnp.nan, 0.0, 0.0])]), memory


class OnHost:
    """An agent's function in NumPy or torch: observations `(n, n_obs)` to commands `(n, 2)`.

    Attributes:
        function: The function; it may be exchanged between scores.
    """

    def __init__(self, function: Callable[[np.ndarray], np.ndarray]) -> None:
        self.function = function

    def __call__(self, weights: Any, flat: Float[Array, "n_obs"]) -> Float[Array, "2"]:
        """Calls the function for a whole batch at once."""
        del weights
        shape = jax.ShapeDtypeStruct((2,), jnp.float32)
        return jax.pure_callback(self._call, shape, flat, vmap_method="broadcast_all")

    def _call(self, flat: Any) -> np.ndarray:
        flat = np.asarray(flat, np.float32)
        command = self.function(flat.reshape(-1, flat.shape[-1]))
        return np.asarray(command, np.float32).reshape(*flat.shape[:-1], 2)


@dataclasses.dataclass(frozen=True)
class Score:
    """One look at a policy.

    Attributes:
        steps: Environment steps trained so far.
        seconds: Wall-clock time of training so far, compiling included and scoring not, s.
        cpu_seconds: Processor time of this process alike, s.
        success: Fraction of the fresh episodes that succeeded.
    """

    steps: int
    seconds: float
    cpu_seconds: float
    success: float


class Watch:
    """Scores a policy on fresh episodes while it is trained, and says whether it has reached the goal.

    Args:
        task: Task id.
        goal: Fraction of episodes that must succeed.
        every: Least number of steps between two scores.
        report: Called with each score.
        **options: As for `st.make`.
    """

    def __init__(
        self,
        task: str,
        goal: float = GOAL,
        every: int = 0,
        report: Callable[[Score], None] = lambda score: None,
        **options: Any,
    ) -> None:
        self.task, self.goal, self.every, self.report, self.options = task, goal, every, report, options
        self.env, self.params = st.make(task, **options)
        self.scores: list[Score] = []
        self.agent: Agent | None = None
        self._scoring = self._scoring_cpu = 0.0
        self._began, self._began_cpu = time.perf_counter(), time.process_time()

    @property
    def reached(self) -> Score | None:
        """First score at the goal."""
        return next((score for score in self.scores if score.success >= self.goal), None)

    def __call__(self, steps: int, agent: Agent) -> bool:
        """Scores a policy unless that was done just before; returns whether training may end.

        Args:
            steps: Environment steps trained so far, all environments together.
            agent: The policy so far, without exploration noise.
        """
        if self.reached or (self.scores and steps - self.scores[-1].steps < self.every):
            return self.reached is not None
        jax.block_until_ready(agent)  # JAX returns before the work is done
        began, began_cpu = time.perf_counter(), time.process_time()
        seconds, cpu_seconds = began - self._began - self._scoring, began_cpu - self._began_cpu - self._scoring_cpu
        seeds = np.arange(FIRST_FRESH, FIRST_FRESH + N_FRESH, dtype=np.uint32)
        episodes = dataclasses.replace(listed_episodes(self.env, self.params, N_FRESH), seed=seeds)
        success = float(np.mean(evaluate(self.env, self.params, agent, episodes, N_FRESH).success))
        self.agent = agent
        self.scores.append(Score(steps, seconds, cpu_seconds, success))
        self.report(self.scores[-1])
        self._scoring += time.perf_counter() - began
        self._scoring_cpu += time.process_time() - began_cpu
        return self.reached is not None

    def listed(self, n: int = 500) -> dict[str, Any]:
        """Returns the summary of the last scored policy on the first `n` listed episodes."""
        assert self.agent is not None, "no policy has been scored"
        episodes = listed_episodes(self.env, self.params, n)
        return summarise(evaluate(self.env, self.params, self.agent, episodes, _BATCH))
