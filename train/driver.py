"""The policy in a batch of environments: what it keeps, what its network answers, what it draws."""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from subterra_jax.baselines.agent import observed
from subterra_jax.policies.learnt import KIND, LOCALISER, NETWORK, Layout
from subterra_jax.policies.memories import Given
from subterra_jax.policies.network import Network, Outputs, init, start_memory, to_action
from subterra_jax.policies.trained import flat

_HALF_LOG_TAU = 0.5 * math.log(2.0 * math.pi)


@struct.dataclass
class Policy:
    """All that driving needs."""

    network: Any  # weights of the network
    localiser: Any = None  # weights of the localiser; None without one
    # mean and standard deviation of the observation; None where the inputs are of order 1 as they are
    statistics: Any = None


@struct.dataclass
class Seen:
    """Observations, and where they were made."""

    flat: Float[Array, "*env n_obs"]  # the observation
    tunnel: Int[Array, "*env"]  # number of the tunnel that a robot is in, of a stack

    def here(self, params: Any) -> Any:
        """Returns the params of one robot's own tunnel."""
        return params.replace(tunnel=params.tunnel.pick(self.tunnel))


class Driver:
    """Drives navigation tasks; all arrays have the environments as first axis.

    Args:
        env: The environment, not batched.
        layout: Sizes and meaning of the network's inputs and outputs.
        map: The map, for a localiser that takes one.
    """

    kind = KIND

    def __init__(self, env: Any, layout: Layout, map: Any = None) -> None:
        self.env, self.layout, self._map = env, layout, map
        self._net = Network(layout.shape)
        self._low, self._high = jnp.asarray(layout.action_low), jnp.asarray(layout.action_high)
        self._standing = layout.standing

    def init(self, key: PRNGKeyArray) -> Any:
        """Returns untrained weights of the network."""
        return init(self.layout.shape, key)

    def start_memory(self, batch: tuple[int, ...]) -> Array:
        """Returns the network's memory at the start of episodes."""
        return start_memory(self.layout.shape, batch)

    def start_statistics(self) -> Any:
        """Returns statistics of the observation; None, since the inputs are of order 1 as they are."""
        return None

    def raw(self, inputs: Any, policy: Policy) -> Array:
        """Returns the observation that had these inputs; asked for where `start_statistics` are there alone."""
        del policy
        return inputs

    def tensors(self, policy: Policy) -> dict[str, np.ndarray]:
        """Returns the arrays of a policy by name, parts of the name between dots."""
        tree = {NETWORK: policy.network, LOCALISER: policy.localiser}
        parts = {name: part for name, part in tree.items() if part is not None}
        return {name: np.asarray(leaf, np.float32) for name, leaf in flat(jax.device_get(parts)).items()}

    @property
    def n_action(self) -> int:
        """Numbers of an action of the environment."""
        return self.env.action_size

    def see(self, observation: Array, env_state: Any) -> Any:
        """Returns what `begin`, `take` and `go_on` take in of observations made in states of the environment."""
        return Seen(observation, env_state.tunnel)

    def begin(self, policy: Policy, seen: Any, params: Any) -> Any:
        """Returns what is kept at the first observation of episodes, which it has taken in."""
        fresh = self._fresh(policy, seen, params)
        return self.take(policy, fresh, jnp.zeros((seen.flat.shape[0], len(self._low))), seen, params)

    def take(self, policy: Policy, kept: Any, action: Array, seen: Any, params: Any) -> Any:
        """Returns what is kept after actions and the observations that followed."""
        given, memory = Given(policy.localiser, self._map), self.layout.memory

        def one(kept: Any, action: Array, seen: Seen) -> Any:
            here = seen.here(params)
            return memory.take(kept, action[:2], observed(self.env, here, seen.flat), here, given)

        return jax.vmap(one)(kept, action, seen)

    def go_on(self, policy: Policy, kept: Any, action: Array, seen: Any, done: Bool[Array, "env"], params: Any) -> Any:
        """As `take`, begun anew with the observation where an episode is `done`."""
        fresh = self._fresh(policy, seen, params)
        mixed = jax.tree.map(lambda new, old: _where(done, new, old), fresh, kept)
        return self.take(policy, mixed, jnp.where(done[:, None], 0.0, action), seen, params)

    def _fresh(self, policy: Policy, seen: Seen, params: Any) -> Any:
        given, memory = Given(policy.localiser, self._map), self.layout.memory

        def one(seen: Seen) -> Any:
            here = seen.here(params)
            return memory.begin(observed(self.env, here, seen.flat), here, given)

        return jax.vmap(one)(seen)

    def inputs(self, policy: Policy, kept: Any) -> Float[Array, "env n"]:
        """Returns the inputs of the network."""
        del policy
        return jax.vmap(self.layout.memory.inputs)(kept)

    def target(self, env_state: Any, kept: Any, params: Any) -> Float[Array, "env n"]:
        """Returns the auxiliary target: true less reckoned way to go, m; no numbers where nothing is asked for."""
        if self.layout.shape.way_at is None:
            return jnp.zeros((kept.seen.shape[0], 0))

        def one(state: Any, seen: Array) -> Array:
            return self.env.privileged(state, params)["to_goal"] - self.layout.reckoned_way(seen)

        return jax.vmap(one)(env_state, kept.seen)[:, None]

    def answer(self, policy: Policy, inputs: Array, memory: Array) -> tuple[Outputs, Array]:
        """Returns the network's answers to one step, and its memory."""
        return self._net.apply({"params": policy.network}, inputs, memory)  # type: ignore[return-value]

    def unroll(self, weights: Any, inputs: Array, memory: Array, first: Array) -> Outputs:
        """Returns the network's answers to every step of a rollout."""
        return self._net.apply({"params": weights}, inputs, memory, first, method="unroll")  # type: ignore[return-value]

    def sample(self, out: Outputs, key: PRNGKeyArray) -> Float[Array, "env action"]:
        """Draws before the tanh."""
        return out.mean + jnp.exp(out.log_std) * jax.random.normal(key, out.mean.shape)

    def action(self, raw: Float[Array, "env action"]) -> Float[Array, "env action"]:
        """Returns the actions of draws, m/s and rad/s."""
        return to_action(raw, self._low, self._high, self._standing)

    def act(self, raw: Float[Array, "env action"], kept: Any, params: Any) -> Float[Array, "env all"]:
        """Returns the actions of draws as the environment takes them: with the memory's estimate where one is due."""
        action = self.action(raw)
        if action.shape[-1] == self.n_action:
            return action
        report = jax.vmap(lambda kept, command: self.layout.memory.report(kept, command, None, params))
        return jnp.concatenate([action, report(kept, action[:, :2])], axis=1)[:, : self.n_action]

    @staticmethod
    def log_prob(out: Outputs, raw: Float[Array, "*batch action"]) -> Float[Array, "*batch"]:
        """Returns the log density of draws before the tanh, whose own part cancels in every ratio."""
        away = (raw - out.mean) * jnp.exp(-out.log_std)
        return jnp.sum(-0.5 * jnp.square(away) - out.log_std - _HALF_LOG_TAU, axis=-1)

    @staticmethod
    def entropy(out: Outputs) -> Float[Array, ""]:
        """Returns the entropy of the Gaussian before the tanh."""
        return jnp.sum(out.log_std + 0.5 + _HALF_LOG_TAU)


def _where(done: Array, new: Array, old: Array) -> Array:
    return jnp.where(done.reshape(-1, *[1] * (old.ndim - 1)), new, old)
