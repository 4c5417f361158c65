"""JaxNav of JaxMARL: a disc that finds its way by LiDAR through random polygons, in JAX.

Source: Rutherford et al., JaxMARL (NeurIPS 2024); package `jaxmarl`, environment `jaxnav`.
"""

import contextlib
import io
import sys
import warnings
from collections.abc import Iterator

import jax
import jax.numpy as jnp
from jaxtyping import Array, PRNGKeyArray

from benchmarks.throughput.timing import Carry, Loop, digest

PACKAGE = "jaxmarl"
ABOUT = "JaxNav: one agent, 16 beams of 6 m sampled every 5 cm, maps of 11 by 11 cells, its own auto-reset"
N_BEAMS = 16
_AGENT = "agent_0"


def loop(n_envs: int) -> Loop:
    """One agent and as many beams as ours; everything else as JaxNav has it by default.

    Raises:
        ImportError: `jaxmarl` is not installed, or lacks a package that it needs.
    """
    # A part that nobody asks for here: it imports all of brax, and takes standard output for itself.
    sys.modules.setdefault("jaxmarl.environments.mabrax", None)  # type: ignore[arg-type]
    with _quiet():
        from jaxmarl.environments.jaxnav.jaxnav_env import JaxNav

        env = JaxNav(num_agents=1, lidar_num_beams=N_BEAMS)
    space = env.action_space(_AGENT)

    def reset(key: PRNGKeyArray, _: None) -> Carry:
        with _quiet():
            return jax.vmap(env.reset)(jax.random.split(key, n_envs))

    def step(key: PRNGKeyArray, carry: Carry, _: None) -> tuple[Carry, Array, Array]:
        action_key, env_key = jax.random.split(key)
        action = {_AGENT: jax.random.uniform(action_key, (n_envs, 2), minval=space.low, maxval=space.high)}
        with _quiet():
            obs, state, reward, done, _ = jax.vmap(env.step)(jax.random.split(env_key, n_envs), carry[1], action)
        return (obs, state), digest(reward), jnp.mean(done["__all__"], dtype=jnp.float32)

    return Loop(reset, step)


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Without what it says, while it is imported and traced, about its optional parts and its own defaults."""
    with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield
