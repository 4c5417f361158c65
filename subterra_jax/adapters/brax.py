"""Brax: a `brax.envs.base.Env` for Brax's trainers, and a wrapper that begins each episode with a fresh draw.

Brax's own `AutoResetWrapper` restores the first state at every reset. The draws of an episode (the start pose, the
odometer's bias, the goal) would then never change. Use `wrap` from here instead of `brax.envs.training.wrap`; both run.
Brax up to 0.14.2 calls `jax.device_put_replicated`, which JAX 0.10 removed: its trainers run inside `jax_for_brax()`.
"""

import contextlib
import io
from collections.abc import Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from subterra_jax.adapters.kernel import take_key
from subterra_jax.host.errors import MissingLibraryError
from subterra_jax.state import EnvParams
from subterra_jax.tasks import make

try:
    # Importing Brax loads MuJoCo, which may print to stdout, which belongs to the caller.
    with contextlib.redirect_stdout(io.StringIO()):
        from brax.envs.base import Env, State, Wrapper
        from brax.envs.wrappers.training import EpisodeWrapper, VmapWrapper
except ImportError as missing:
    raise MissingLibraryError(__name__, "brax", "brax") from missing

_MISSED = "device_put_replicated"


class SubterraBraxEnv(Env):
    """One environment for Brax's trainers and wrappers.

    Observations are flat vectors. `done` marks an end before the horizon; the horizon is Brax's `episode_length`, which
    its `EpisodeWrapper` counts, so that `info["truncation"]` is right. The environment's own info is in `metrics`, as
    float32. Brax passes no key to a step: each environment's stream of keys is in `info["rng"]`.

    Args:
        task: Id of the task.
        params: Params to use in place of those made from `options`.
        **options: As for `subterra_jax.make`.

    Attributes:
        sys: The params under the name by which Brax's domain randomisation takes and replaces them.
        backend: Name of the simulator, which is none of Brax's.
    """

    backend = "subterra"

    def __init__(self, task: str = "Subterra/Traverse-v1", params: EnvParams | None = None, **options: Any):
        self.env, made = make(task, **options)
        self.sys = made if params is None else params

    @property
    def params(self) -> EnvParams:
        return self.sys

    @property
    def observation_size(self) -> int:
        """Numbers in one observation."""
        return self.env.observation_size(self.sys)

    @property
    def action_size(self) -> int:
        """Numbers in one action; `action_bounds` has their bounds."""
        return self.env.action_size

    @property
    def action_bounds(self) -> tuple[jax.Array, jax.Array]:
        """Least and largest action; `RescaleAction` maps [-1, 1] to this range."""
        space = self.env.action_space(self.sys)
        return jnp.asarray(space.low), jnp.asarray(space.high)

    @property
    def episode_length(self) -> int:
        """Horizon of the task, steps."""
        return int(self.sys.horizon)

    def reset(self, rng: jax.Array) -> State:
        """Begin an episode; `rng` may be a key of either kind."""
        key, stream = take_key(jax.random.bits(rng, (2,), jnp.uint32))
        obs, state = self.env.reset(key, self.sys)
        # Brax wants the metrics of every step at a reset too: they are 0.
        *_, info = jax.eval_shape(self.env.step, key, state, jnp.zeros(self.action_size, jnp.float32), self.sys)
        metrics = {name: jnp.zeros(leaf.shape, jnp.float32) for name, leaf in info.items()}
        zero = jnp.zeros((), jnp.float32)
        return State(pipeline_state=state, obs=obs, reward=zero, done=zero, metrics=metrics, info={"rng": stream})

    def step(self, state: State, action: jax.Array) -> State:
        """Take one step of 0.1 s; the action is clipped."""
        key, stream = take_key(state.info["rng"])
        obs, after, reward, terminated, _, info = self.env.step(key, state.pipeline_state, action, self.sys)
        own = {name: jnp.asarray(value, jnp.float32) for name, value in info.items()}
        return state.replace(
            pipeline_state=after,
            obs=obs,
            reward=reward,
            done=terminated.astype(jnp.float32),
            # What wrappers have put there stays: Brax's `EvalWrapper` keeps the reward among the metrics.
            metrics={**state.metrics, **own},
            info={**state.info, "rng": stream},
        )


class RescaleAction(Wrapper):
    """Maps actions in [-1, 1], as of Brax's policies, to the bounds of the task."""

    def step(self, state: State, action: jax.Array) -> State:
        """Take one step; the environment clips actions beyond [-1, 1]."""
        low, high = self.unwrapped.action_bounds
        return self.env.step(state, low + 0.5 * (action + 1.0) * (high - low))


class FreshResetWrapper(Wrapper):
    """Resets finished episodes with a fresh draw, in place of Brax's `AutoResetWrapper`.

    `info["final_observation"]` is the observation of the episode's own last state.
    """

    def reset(self, rng: jax.Array) -> State:
        """Begin an episode in each environment, each with its own key of either kind."""
        # Brax takes the shape of a batch from its keys less one axis, so it accepts raw keys only.
        state = self.env.reset(jax.random.key_data(rng) if jnp.issubdtype(rng.dtype, jax.dtypes.prng_key) else rng)
        state.info["final_observation"] = state.obs
        return state

    def step(self, state: State, action: jax.Array) -> State:
        """Take one step and reset finished episodes; reward, done and metrics are those of the step."""
        if "steps" in state.info:
            state.info.update(steps=jnp.where(state.done, jnp.zeros_like(state.info["steps"]), state.info["steps"]))
        stepped = self.env.step(state.replace(done=jnp.zeros_like(state.done)), action)
        done, now = stepped.done, (stepped.pipeline_state, stepped.obs, stepped.info["rng"])

        def pick(new: jax.Array, old: jax.Array) -> jax.Array:
            return jnp.where(done.reshape(done.shape + (1,) * (old.ndim - done.ndim)) > 0.0, new, old)

        def reset_finished() -> Any:
            fresh = self.env.reset(stepped.info["rng"])
            return jax.tree.map(pick, (fresh.pipeline_state, fresh.obs, fresh.info["rng"]), now)

        # A reset costs a scan of every environment; most steps need none.
        pipeline_state, obs, rng = jax.lax.cond(jnp.any(done > 0.0), reset_finished, lambda: now)
        info = {**stepped.info, "rng": rng, "final_observation": stepped.obs}
        return stepped.replace(pipeline_state=pipeline_state, obs=obs, info=info)


def wrap(
    env: SubterraBraxEnv,
    episode_length: int | None = None,
    action_repeat: int = 1,
    randomization_fn: None = None,
) -> Wrapper:
    """Wrap an environment as `brax.envs.training.wrap` does, with a fresh draw at each reset.

    Brax's trainers take it as `wrap_env_fn`.

    Args:
        env: One environment, or a wrapper around one.
        episode_length: Steps after which an episode is truncated; `None` is the task's horizon.
        action_repeat: Steps for which each action is held.
        randomization_fn: None, which Brax's trainers pass.

    Raises:
        ValueError: Params are to be randomised, which `subterra_jax.randomize` does for an `AutoReset`.
    """
    if randomization_fn is not None:
        raise ValueError("Brax's randomization leaves out wrappers: take subterra_jax.randomize with AutoReset")
    length = env.unwrapped.episode_length if episode_length is None else episode_length
    return FreshResetWrapper(EpisodeWrapper(VmapWrapper(env), length, action_repeat))


@contextlib.contextmanager
def jax_for_brax() -> Iterator[None]:
    """Lend JAX the function that Brax's trainers miss, and take it back at the end of the `with` block.

        with jax_for_brax():
            ppo.train(environment=env, wrap_env_fn=wrap, episode_length=env.episode_length, ...)

    Where JAX has it, nothing changes. Inside the block every thread of the process sees the function.
    """
    if hasattr(jax, _MISSED):
        yield
        return
    setattr(jax, _MISSED, _put_replicated)
    try:
        yield
    finally:
        delattr(jax, _MISSED)


def _put_replicated(tree: Any, devices: Sequence[jax.Device]) -> Any:
    """Return a pytree whose leaves have the devices as a new first axis, one copy on each."""
    mesh = jax.sharding.Mesh(np.array(devices), ("devices",))
    split = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec("devices"))
    return jax.tree.map(lambda leaf: jax.device_put(jnp.stack([jnp.asarray(leaf)] * len(devices)), split), tree)
