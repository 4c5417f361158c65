"""A policy as a function: `action, memory = policy(obs, memory)`, whatever it is made of."""

import dataclasses
from pathlib import Path
from typing import Any, Protocol

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from subterra_jax.baselines.agent import shown
from subterra_jax.compiled import in_32_bits
from subterra_jax.episode import ask, in_tunnel, look
from subterra_jax.host.task_ids import MISSIONS
from subterra_jax.parts.spatial_lidar import SENSORS
from subterra_jax.policies.files import GAIT, PolicyError, read_facts
from subterra_jax.policies.loading import load
from subterra_jax.policies.opening import open_agent, policy_source, require_known
from subterra_jax.rows import for_some
from subterra_jax.state import EnvParams
from subterra_jax.tasks import MOTIONS, make
from subterra_jax.tunnel_env import TunnelEnv

Memory = Any


class Policy(Protocol):
    """A policy with memory. Every function takes one robot, or a batch of them with a leading axis."""

    def initial_memory(self, key: PRNGKeyArray | None = None, n_envs: int | None = None) -> Memory:
        """Returns the memory before an episode.

        Args:
            key: Source of the policy's own randomness; None is key 0.
            n_envs: Size of the batch; None is one robot.
        """

    def __call__(self, obs: Float[Array, "*env n_obs"], memory: Memory, state: Any = None) -> tuple[Array, Memory]:
        """Returns the action of one control period, as the environment takes it, and the memory after it.

        Args:
            memory: Memory so far.
            state: State of the environment. Only the oracle, and agents in a stack of tunnels, have to be given it.
        """

    def restart(self, memory: Memory, done: Bool[Array, "*env"]) -> Memory:
        """Returns the memory, begun anew where an episode has ended."""


@struct.dataclass
class DrivingMemory:
    """Memory of a `DrivingPolicy`."""

    key: PRNGKeyArray  # source of the agent's randomness in this episode
    steps: Int[Array, "*env"]  # steps of the episode so far
    agent: Any  # memory of the agent; its values mean nothing before the first step


@struct.dataclass(eq=False)
class DrivingPolicy:
    """An agent that drives one task, as a `Policy`; a pytree, so that it may be handed to jitted functions.

    It equals itself alone, so that it has a hash and `jax.jit(policy)` takes it, arrays inside or not.

    It draws as `subterra_jax.episode` has agents draw: with the key of an episode's agent it drives that very episode.

    Attributes:
        agent: The agent.
        params: The task, not batched: what the agent believes of its robot.
        env: The environment.
    """

    agent: Any
    params: EnvParams
    env: TunnelEnv = struct.field(pytree_node=False)

    @property
    def name(self) -> str:
        return self.agent.name

    @in_32_bits()
    def initial_memory(self, key: PRNGKeyArray | None = None, n_envs: int | None = None) -> DrivingMemory:
        """Returns the memory before an episode, of one robot or of `n_envs`; see `Policy`."""
        key = jax.random.key(0) if key is None else key
        size = () if n_envs is None else (n_envs,)
        keys = key if n_envs is None else jax.random.split(key, n_envs)
        return DrivingMemory(keys, jnp.zeros(size, jnp.int32), _blank(self, size))

    def restart(self, memory: DrivingMemory, done: Bool[Array, "*env"]) -> DrivingMemory:
        if jnp.ndim(done):
            return jax.vmap(self.restart)(memory, done)
        key = jnp.where(done, jax.random.fold_in(memory.key, 2**31 - 1), memory.key)
        return dataclasses.replace(memory, key=key, steps=jnp.where(done, 0, memory.steps))

    def __call__(
        self, obs: Float[Array, "*env n_obs"], memory: DrivingMemory, state: Any = None
    ) -> tuple[Float[Array, "*env n_action"], DrivingMemory]:
        """Returns action and memory; see `Policy`. Compiled at the first call.

        Raises:
            PolicyError: The observation has another size, there is no memory, or the agent needs the state and is not
                given it.
        """
        size, count = self.env.observation_size(self.params), self.params.tunnel.count
        if jnp.shape(obs)[-1:] != (size,):
            raise PolicyError(f"{self.name}: {self.env.id} has {size} numbers, got an array of shape {jnp.shape(obs)}")
        if not isinstance(memory, DrivingMemory):
            wrong = type(memory).__name__
            raise PolicyError(f"{self.name}: the first memory is policy.initial_memory(), got a {wrong}")
        if state is None and self.agent.privileged:
            raise PolicyError(f"{self.name}: is given the truth, so call it as policy(obs, memory, state)")
        if state is None and count > 1:
            raise PolicyError(f"{self.name}: drives in {count} tunnels, so call it as policy(obs, memory, state)")
        return _act(self, obs, memory, state)


@in_32_bits()
def _begin(driver: DrivingPolicy, key: PRNGKeyArray, obs: Any, here: EnvParams) -> Any:
    """Returns the agent's memory at the start of an episode."""
    return driver.agent.begin(jax.random.fold_in(key, 0), obs, shown(here, driver.agent.uses_map))


def _blank(driver: DrivingPolicy, size: tuple[int, ...]) -> Any:

    def begin(flat: Float[Array, "n_obs"]) -> Any:
        here = in_tunnel(driver.env, driver.params, 0)
        return _begin(driver, jax.random.key(0), look(driver.env, driver.agent, here, flat), here)

    flat = jax.ShapeDtypeStruct((driver.env.observation_size(driver.params),), jnp.float32)
    return jax.tree.map(lambda leaf: _zeros(leaf, size), jax.eval_shape(begin, flat))


def _zeros(leaf: jax.ShapeDtypeStruct, size: tuple[int, ...]) -> Array:
    """Returns zeros; keys of zeros where the leaf holds keys."""
    shape = (*size, *leaf.shape)
    if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        return jnp.broadcast_to(jax.random.key(0), shape)
    return jnp.zeros(shape, leaf.dtype)


def _as(memory: Any, like: Any) -> Any:
    return jax.tree.map(lambda new, old: jnp.asarray(new, old.dtype), memory, like)


@jax.jit
def _act(driver: DrivingPolicy, obs: Array, memory: DrivingMemory, state: Any) -> tuple[Array, DrivingMemory]:
    def one(obs: Array, memory: DrivingMemory, state: Any) -> tuple[Array, DrivingMemory]:
        env, agent = driver.env, driver.agent
        here, view = _situation(driver, obs, state)
        key = jax.random.fold_in(memory.key, memory.steps + 1)
        action, after = ask(env, agent, key, memory.agent, view, state, here)
        return action[: env.action_size], DrivingMemory(memory.key, memory.steps + 1, _as(after, memory.agent))

    memory = dataclasses.replace(memory, agent=_begin_where_new(driver, obs, memory, state))
    return (one if obs.ndim == 1 else jax.vmap(one))(obs, memory, state)


def _situation(driver: DrivingPolicy, obs: Array, state: Any) -> tuple[EnvParams, Any]:
    """Returns the task in the tunnel that a robot is in, and its observation as the agent takes it."""
    here = driver.params if state is None else in_tunnel(driver.env, driver.params, state.tunnel)
    return here, look(driver.env, driver.agent, here, obs)


def _begin_where_new(driver: DrivingPolicy, obs: Array, memory: DrivingMemory, state: Any) -> Any:
    """Returns the agents' memories, begun where an episode begins.

    Few others are computed: to begin may cost as much as a step, and in most steps few episodes begin, or none.
    """

    def begin(obs: Array, memory: DrivingMemory, state: Any) -> Any:
        here, view = _situation(driver, obs, state)
        return _as(_begin(driver, memory.key, view, here), memory.agent)

    new, robots = memory.steps == 0, (obs, memory, state)
    if obs.ndim == 1:
        return jax.lax.cond(new, begin, lambda obs, memory, state: memory.agent, *robots)
    return for_some(new, lambda pick: jax.vmap(begin)(*pick(robots)), memory.agent)


def load_policy(source: Any, env: TunnelEnv | None = None, params: EnvParams | None = None) -> Policy:
    """Loads a policy as a function of observation and memory, whatever it is made of.

    Args:
        source: Name of a released policy, as `StopAt-v1`; a `.safetensors` file; a run folder of `train`; a baseline by
            name, as `scan-matching`; `module:Class` or `FILE.py:Class`; or an agent.
        env: The environment to drive in. None is the task that the policy was trained on, in the packaged tunnel.
        params: Its params. Sizes and noises are what the policy believes of its robot.

    Returns:
        A policy: `action, memory = policy(obs, memory)`, with `memory = policy.initial_memory()` at first.

    Raises:
        PolicyError: The policy is missing or damaged, or does not fit the task; or a task must be named.
        AgentError: There is no such agent.
    """
    if (env is None) != (params is None):
        raise PolicyError("env and params belong together: give both, as `st.make` returns them, or neither")
    file = policy_source(str(source)) if isinstance(source, (str, Path)) else None
    facts = None if file is None else read_facts(file)
    if file is not None and facts is not None and facts["kind"] == GAIT:
        return _gait(file, env, params)
    if env is None or params is None:
        if facts is None:
            if isinstance(source, (str, Path)):
                require_known(str(source))
            name = source if isinstance(source, str) else getattr(source, "name", type(source).__name__)
            raise PolicyError(f"{name}: drives any task, so name one: load_policy({name!r}, env, params)")
        walks = facts.get("world", {}).get("motion") == "b2"
        world = {"sensor": SENSORS[0], "motion": MOTIONS[0], **facts.get("world", {})}
        asked = {name: world[name] for name in ("sensor", "motion")}
        env, params = make(MISSIONS[0]) if walks else make(facts["task"], **asked)
    return DrivingPolicy(open_agent(source, env, params), params, env)


def _gait(file: str, env: Any, params: Any) -> Policy:
    """Loads a policy that moves legs, and checks that it fits an environment where one is given."""
    policy, _ = load(file)
    if env is not None:
        from subterra_jax.b2.gait import check_fits  # a gait has been loaded, so MuJoCo has been too

        check_fits(policy, env.observation_space(params).shape[0], file)
    return policy
