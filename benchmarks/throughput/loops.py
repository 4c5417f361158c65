"""Loops to time: our environment, and JaxNav of JaxMARL, a disc that navigates by LiDAR through random polygons.

Source: Rutherford et al., JaxMARL (NeurIPS 2024); package `jaxmarl`, environment `jaxnav`, which is optional.
"""

import contextlib
import dataclasses
import io
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, PRNGKeyArray

import subterra_jax as st
from benchmarks.command import BenchmarkError
from benchmarks.results import version
from benchmarks.throughput.timing import Carry, Loop, Speed, Timing, digest, measure

_AGENT, N_BEAMS = "agent_0", 16
_ABOUT = "JaxNav: one agent, 16 beams of 6 m sampled every 5 cm, maps of 11 by 11 cells, its own auto-reset"


@dataclass
class Peer:
    """Measurements of a peer."""

    name: str  # Short name
    about: str = _ABOUT  # Description with its settings
    version: str | None = None  # Version of its package
    speeds: list[Speed] = field(default_factory=list)  # One for each batch size
    # Reason for each batch size, or `all`, that was not measured
    left_out: dict[str, str] = field(default_factory=dict)


def environment_loop(env: Any, params: Any, n_envs: int) -> Loop:
    """Returns the loop of `AutoReset` under random actions, with sensors, noise, reward, contact and resets."""
    batch = st.AutoReset(env)
    low, high = (jnp.asarray(bound) for bound in dataclasses.astuple(env.action_space(params)))

    def reset(key: PRNGKeyArray, params: Any) -> Carry:
        return batch.reset(key, params, n_envs)

    def step(key: PRNGKeyArray, carry: Carry, params: Any) -> tuple[Carry, Array, Array]:
        action_key, env_key = jax.random.split(key)
        action = jax.random.uniform(action_key, (n_envs, *low.shape), minval=low, maxval=high)
        obs, state, reward, terminated, truncated, info = batch.step(env_key, carry[1], action, params)
        rest = digest((reward, info["final_observation"]))
        return (obs, state), rest, jnp.mean(terminated | truncated, dtype=jnp.float32)

    return Loop(reset, step, params)


def jaxnav_loop(n_envs: int) -> Loop:
    """Returns JaxNav with one agent and as many beams as ours; all else at its defaults.

    Raises:
        ImportError: JaxMARL is not installed.
    """
    # Unused here: it imports all of brax and redirects standard output.
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


def require_jaxnav() -> None:
    """Checks that JaxNav is installed.

    Raises:
        BenchmarkError: It cannot be imported.
    """
    try:
        jaxnav_loop(1)
    except ImportError as error:
        raise BenchmarkError(f"peer 'jaxnav' cannot be imported ({error}); see the extra `peers`") from error


def measure_jaxnav(
    sizes: Sequence[int], timing: Timing, report: Callable[[str], None], loop: Callable[[int], Loop] = jaxnav_loop
) -> Peer:
    """Measures JaxNav.

    Args:
        sizes: Batch sizes.
        timing: Number and length of calls.
        report: Receives a line of progress before each measurement.
        loop: Builds the loop for a number of environments.
    """
    peer = Peer("jaxnav", version=version("jaxmarl"))
    for n_envs in sizes:
        report(f"jaxnav: {n_envs:,} environments")
        try:
            peer.speeds.append(measure(loop(n_envs), n_envs, timing))
        except ImportError as error:
            return Peer("jaxnav", left_out={"all": f"cannot be imported ({error})"})
        except Exception as error:  # a failure in a peer must not cost our own figures
            out_of_memory = "RESOURCE_EXHAUSTED" in str(error)
            peer.left_out[str(n_envs)] = "out of memory" if out_of_memory else f"{type(error).__name__}: {error}"
    return peer


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Hides the messages about optional parts and defaults that JaxMARL prints on import and tracing."""
    with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield
