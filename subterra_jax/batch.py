"""Many environments at once: reset by themselves with a fresh draw, and step in one compiled program."""

import dataclasses
from collections.abc import Callable
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from subterra_jax.compiled import compiled, hashable
from subterra_jax.env import Env, Info
from subterra_jax.rows import for_some

# Those of a `TunnelEnv`, or of another `Env`: the walking robot's, say.
EnvParams: TypeAlias = Any
State: TypeAlias = Any
StepNoise: TypeAlias = Any
Obs = Float[Array, "n_envs n_obs"]
Policy: TypeAlias = Any  # a callable of key and observations, or a `subterra_jax.policies.Policy` with memory


@dataclasses.dataclass(frozen=True)
class AutoReset:
    """A batch of environments in which a finished one begins anew within the same step.

    One key serves the whole batch, and what environment i draws from it does not depend on how many there are.

    Attributes:
        env: The environment.
        params_axes: `in_axes` of the params for `vmap`: None (the default) shares one set of params, 0 gives each
            environment its own, a pytree of the two mixes them.
        axes: Names of the axes along which batches are vmapped themselves. They then agree on what is to be computed
            in a step; batches that do not would have all of it computed in every step.
    """

    env: Env
    params_axes: Any = None
    axes: tuple[str, ...] = ()

    @compiled("n_envs")
    def reset(self, key: PRNGKeyArray, params: EnvParams, n_envs: int) -> tuple[Obs, State]:
        """Begin an episode in each of `n_envs` environments.

        Returns:
            Observations `(n_envs, n_obs)` and the batched state.

        Raises:
            ValueError: `n_envs` is no whole number, or less than 1.
        """
        if not isinstance(n_envs, int | np.integer) or n_envs < 1:
            raise ValueError(f"n_envs must be a whole number, at least 1, got {n_envs!r}")
        start_key, scan_key = jax.random.split(key)
        state = self._vmap(self.env.begin, 1)(self.env.draw_reset(start_key, (n_envs,), params), params)
        noise = self.env.draw_step(scan_key, (n_envs,), params)
        return self._vmap(self.env.observe, 2)(state, noise, params), state

    @compiled()
    def step(
        self, key: PRNGKeyArray, state: State, action: Float[Array, "n_envs n_action"], params: EnvParams
    ) -> tuple[Obs, State, Float[Array, "n_envs"], Bool[Array, "n_envs"], Bool[Array, "n_envs"], Info]:
        """Step every environment; begin a new episode, with a fresh draw, in those that finished.

        Args:
            key: One key for the whole batch.
            action: Speeds (m/s) and yaw rates (rad/s), and what `TunnelEnv.action_size` adds.
            params: The task; batched as `params_axes` says.

        Returns:
            As `TunnelEnv.step`, batched. Observation and state are those of the new episode where one began. Reward,
            flags and info are those of the step taken; `info["final_observation"]` is what that step's own state looks
            like, and equals the observation wherever no episode ended.

        Raises:
            ValueError: The actions have another shape, seen when the step is traced.
        """
        action = self._checked(action, state)
        step_key, start_key = jax.random.split(key)
        n_envs = action.shape[0]
        noise = self.env.draw_step(step_key, (n_envs,), params)
        stepped, reward, terminated, truncated, info = self._vmap(self.env.advance, 3)(state, action, noise, params)
        # A consumer's sum would draw the whole step into its kernel, which sums with few threads; also below.
        terminated, truncated = jax.lax.optimization_barrier((terminated, truncated))
        fresh = self._vmap(self.env.begin, 1)(self.env.draw_reset(start_key, (n_envs,), params), params)
        done = terminated | truncated
        merged = jax.tree.map(
            lambda new, old: jnp.where(done.reshape(-1, *[1] * (old.ndim - 1)), new, old), fresh, stepped
        )
        obs, info["final_observation"] = self._observe(done, merged, stepped, noise, params)
        shown = jax.lax.optimization_barrier((obs, merged, reward, terminated, truncated))
        return *shown, info

    def _checked(self, action: Any, state: State) -> Array:
        action, n_envs = jnp.asarray(action), jax.tree.leaves(state)[0].shape[0]
        if action.ndim != 2 or action.shape[0] != n_envs:
            needed = f"({n_envs}, {getattr(self.env, 'action_size', 'n_action')})"
            raise ValueError(
                f"actions of {n_envs} environments must have shape {needed}, got an array of shape {action.shape}"
            )
        return action

    def _observe(
        self,
        done: Bool[Array, "n_envs"],
        merged: State,
        stepped: State,
        noise: StepNoise,
        params: EnvParams,
    ) -> tuple[Obs, Obs]:
        """Observations after and before any reset.

        Of those before, only finished environments are cast again. The fused kernels take all scans in one go and skip
        those that nobody wants.
        """
        if self.env.skips_unneeded(params):
            twice = lambda one, other: jnp.concatenate([one, other])  # noqa: E731
            both_states, both_noises = jax.tree.map(twice, (merged, noise), (stepped, noise))
            both_params = self._of_batched(params, lambda leaf: twice(leaf, leaf))
            needed = twice(jnp.ones_like(done), done)
            observe = jax.vmap(self.env.observe, in_axes=(0, 0, self.params_axes, 0))
            obs, final = jnp.split(observe(both_states, both_noises, both_params, needed), 2)
            # A barrier of its own: whoever does not read it does not pay for it.
            return obs, jax.lax.optimization_barrier(jnp.where(done[:, None], final, obs))
        obs = self._vmap(self.env.observe, 2)(merged, noise, params)

        def again(pick: Callable[[Any], Any]) -> Obs:
            return self._vmap(self.env.observe, 2)(pick(stepped), pick(noise), self._of_batched(params, pick))

        return obs, for_some(done, again, obs, self.axes)

    def _of_batched(self, params: EnvParams, change: Callable[[Any], Any]) -> EnvParams:
        """Params with `change` applied to those that differ among environments; their batch axis is the first."""
        return jax.tree.map(
            lambda axis, part: part if axis is None else jax.tree.map(change, part),
            self.params_axes,
            params,
            is_leaf=lambda axis: axis is None,
        )

    def _vmap(self, function: Callable[..., Any], n_batched: int) -> Callable[..., Any]:
        """`function` over a batch: its first `n_batched` arguments are batched, the params as `params_axes` says."""
        return jax.vmap(function, in_axes=(*[0] * n_batched, self.params_axes))


def rollout(
    env: AutoReset,
    policy: Policy,
    key: PRNGKeyArray,
    obs: Obs,
    state: State,
    params: EnvParams,
    n_steps: int,
    memory: Any = None,
) -> tuple[Obs, State, dict[str, Any]]:
    """Let a policy drive for a number of steps, in one compiled program.

    The program is kept: a further call with the same batch, shapes and policy compiles nothing. What a plain function
    takes from outside is part of the program, as with `jax.jit`; weights that change belong into
    `jax.tree_util.Partial(function, weights)`.

    Args:
        policy: Key and observations to actions `(n_envs, n_action)`, pure; or a policy with memory, from `load_policy`
            or of one's own after `subterra_jax.policies.Policy`. Its memory begins anew with every episode.
        key: Source of the policy's and the environments' randomness.
        n_steps: Steps to take.
        memory: Memory to begin with, `memory` of an earlier call; None where the episodes begin here.

    Returns:
        Last observations, last state, and every step's `obs` (before the step), `action`, `reward`, `terminated`,
        `truncated` and `info`, each with the steps as first axis. Of a policy with memory also `memory`, the one after
        the last step.

    Raises:
        ValueError: `n_steps` is no whole number, or less than 0.
    """
    if not isinstance(n_steps, int | np.integer) or n_steps < 0:
        raise ValueError(f"n_steps must be a whole number, at least 0, got {n_steps!r}")
    leaves, tree = jax.tree.flatten(policy)
    arrays = [leaf if isinstance(leaf, jax.Array | np.ndarray | int | float) else None for leaf in leaves]
    fixed = env, n_steps, tree, tuple(leaf for leaf, array in zip(leaves, arrays, strict=True) if array is None)
    run = _roll_compiled if hashable(fixed) else _roll
    return run(fixed, arrays, key, obs, state, params, memory)


def _roll(
    fixed: tuple[AutoReset, int, Any, tuple[Any, ...]],
    arrays: list[Any],
    key: PRNGKeyArray,
    obs: Obs,
    state: State,
    params: EnvParams,
    memory: Any,
) -> tuple[Obs, State, dict[str, Any]]:
    env, n_steps, tree, others = fixed
    rest = iter(others)
    policy = jax.tree.unflatten(tree, [next(rest) if array is None else array for array in arrays])
    remembers = hasattr(policy, "initial_memory")
    if remembers and memory is None:
        memory = policy.initial_memory(jax.random.fold_in(key, n_steps), obs.shape[0])

    def one_step(carry: tuple[Obs, State, Any], step_key: PRNGKeyArray) -> tuple[tuple[Obs, State, Any], Any]:
        obs, state, memory = carry
        policy_key, env_key = jax.random.split(step_key)
        action, memory = policy(obs, memory, state) if remembers else (policy(policy_key, obs), memory)
        next_obs, state, reward, terminated, truncated, info = env.step(env_key, state, action, params)
        memory = policy.restart(memory, terminated | truncated) if remembers else memory
        record = {
            "obs": obs,
            "action": action,
            "reward": reward,
            "terminated": terminated,
            "truncated": truncated,
            "info": info,
        }
        return (next_obs, state, memory), record

    (obs, state, memory), records = jax.lax.scan(one_step, (obs, state, memory), jax.random.split(key, n_steps))
    return obs, state, {**records, "memory": memory} if remembers else records


_roll_compiled = jax.jit(_roll, static_argnums=0)
