"""Other environments, measured at the same batch sizes as ours; their packages are optional.

jaxnav: JaxNav of JaxMARL, a disc that navigates by LiDAR through random polygons.
    Source: Rutherford et al., JaxMARL (NeurIPS 2024); package `jaxmarl`, environment `jaxnav`.
gymnax: Pendulum, without sensor or map, so that it shows the limit of kernel launches and of the loop itself.
    Source: Lange, gymnax (2022); package `gymnax`, environment `Pendulum-v1`.
mujoco: the paper's route, one environment in Python; see `mujoco_route`.
"""

import contextlib
import importlib
import io
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, PRNGKeyArray

import subterra_jax as st
from benchmarks.command import BenchmarkError
from benchmarks.results import version
from benchmarks.throughput.timing import Carry, Loop, Speed, Timing, digest, measure

ROUTE = "mujoco"
_AGENT, _JAXNAV_BEAMS = "agent_0", 16


class BatchedPeer(NamedTuple):
    """An environment in JAX that can be timed like ours.

    Attributes:
        package: Package on PyPI.
        about: Description with its settings.
        n_beams: Beams cast in one step.
        loop: Builds the loop for a number of environments; raises `ImportError` where a package is missing.
    """

    package: str
    about: str
    n_beams: int
    loop: Callable[[int], Loop]


@dataclass
class Peer:
    """Measurements of one peer.

    Attributes:
        name: Short name.
        about: Description with its settings.
        n_beams: Beams cast in one step.
        version: Version of its package.
        speeds: One for each batch size.
        left_out: Reason for each batch size, or `all`, that was not measured.
    """

    name: str
    about: str
    n_beams: int
    version: str | None
    speeds: list[Speed] = field(default_factory=list)
    left_out: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Route:
    """Inputs of the paper's route: the tunnel, our params, and a scene folder or `None`."""

    plan: st.TunnelPlan
    lining: str
    params: st.EnvParams
    scene: Path | None


def jaxnav_loop(n_envs: int) -> Loop:
    """Returns JaxNav with one agent and as many beams as ours; all else at its defaults."""
    # Unused here: it imports all of brax and redirects standard output.
    sys.modules.setdefault("jaxmarl.environments.mabrax", None)  # type: ignore[arg-type]
    with _quiet():
        from jaxmarl.environments.jaxnav.jaxnav_env import JaxNav

        env = JaxNav(num_agents=1, lidar_num_beams=_JAXNAV_BEAMS)
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


def pendulum_loop(n_envs: int) -> Loop:
    """Returns gymnax' Pendulum with default parameters."""
    import gymnax

    env, params = gymnax.make("Pendulum-v1")
    space = env.action_space(params)

    def reset(key: PRNGKeyArray, params: gymnax.EnvParams) -> Carry:
        return jax.vmap(env.reset, in_axes=(0, None))(jax.random.split(key, n_envs), params)

    def step(key: PRNGKeyArray, carry: Carry, params: gymnax.EnvParams) -> tuple[Carry, Array, Array]:
        action_key, env_key = jax.random.split(key)
        action = jax.random.uniform(action_key, (n_envs, *space.shape), minval=space.low, maxval=space.high)
        keys = jax.random.split(env_key, n_envs)
        obs, state, reward, terminated, truncated, info = jax.vmap(env.step, in_axes=(0, 0, 0, None))(
            keys, carry[1], action, params
        )
        rest = digest((reward, info["final_observation"]))
        return (obs, state), rest, jnp.mean(terminated | truncated, dtype=jnp.float32)

    return Loop(reset, step, params)


BATCHED = {
    "jaxnav": BatchedPeer(
        "jaxmarl",
        "JaxNav: one agent, 16 beams of 6 m sampled every 5 cm, maps of 11 by 11 cells, its own auto-reset",
        _JAXNAV_BEAMS,
        jaxnav_loop,
    ),
    "gymnax": BatchedPeer("gymnax", "gymnax Pendulum: no sensor, its own auto-reset", 0, pendulum_loop),
}


def find_peers(choice: Sequence[str]) -> dict[str, BatchedPeer | str | None]:
    """Returns the chosen peers by name: the peer (`None` for the paper's route), or why it cannot be measured.

    Raises:
        BenchmarkError: A peer chosen by name is not installed.
    """
    every = (*BATCHED, ROUTE)
    names = [] if "none" in choice else every if "auto" in choice else [name for name in every if name in choice]
    peers: dict[str, BatchedPeer | str | None] = {}
    for name in names:
        try:
            if name == ROUTE:
                importlib.import_module("mujoco")
            else:
                BATCHED[name].loop(1)
            peers[name] = BATCHED.get(name)
        except ImportError as error:
            if "auto" not in choice:
                raise BenchmarkError(f"peer {name!r} cannot be imported ({error}); see the extra `peers`") from error
            peers[name] = f"cannot be imported ({error})"
    return peers


def measure_peer(
    name: str,
    peer: BatchedPeer | str | None,
    sizes: Sequence[int],
    route: Route,
    timing: Timing,
    report: Callable[[str], None],
) -> Peer:
    """Measures one peer.

    Args:
        name: Its name.
        peer: The peer, `None` for the paper's route, or why it cannot be measured.
        sizes: Batch sizes; the paper's route always has one environment.
        route: Inputs of the paper's route.
        timing: Number and length of calls.
        report: Receives a line of progress before each measurement.
    """
    if isinstance(peer, str):
        return Peer(name, "", 0, None, left_out={"all": peer})
    if peer is None:
        report(f"{name}: 1 environment")
        return _measure_route(name, route, timing)
    result = Peer(name, peer.about, peer.n_beams, version(peer.package))
    for n_envs in sizes:
        report(f"{name}: {n_envs:,} environments")
        try:
            result.speeds.append(measure(peer.loop(n_envs), n_envs, timing))
        except Exception as error:  # a failure in a peer must not cost our own figures
            out_of_memory = "RESOURCE_EXHAUSTED" in str(error)
            result.left_out[str(n_envs)] = "out of memory" if out_of_memory else f"{type(error).__name__}: {error}"
    return result


def _measure_route(name: str, route: Route, timing: Timing) -> Peer:
    from benchmarks.throughput import mujoco_route

    if route.scene is None:
        scene = mujoco_route.extrude_walls(route.plan, route.lining)
    else:
        scene = mujoco_route.load_scene(route.scene, route.plan, route.lining)
    env = mujoco_route.MujocoTunnel(scene, route.plan, route.params)
    about = f"{mujoco_route.ABOUT}; {scene.about}"
    return Peer(name, about, env.n_beams, version("mujoco"), [mujoco_route.measure(env, timing)])


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Hides the messages about optional parts and defaults that JaxMARL prints on import and tracing."""
    with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield
