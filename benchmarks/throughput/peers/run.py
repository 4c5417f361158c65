"""Measures the peers that are wanted and there, at the batch sizes of ours."""

import importlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType

import subterra_jax as st
from benchmarks.throughput.errors import ThroughputError
from benchmarks.throughput.facts import version
from benchmarks.throughput.timing import Speed, Timing, measure

BATCHED = ("jaxnav", "gymnax")
NAMES = (*BATCHED, "mujoco")


@dataclass
class Peer:
    """What was measured of one peer.

    Attributes:
        name: Short name.
        about: What it is and how it was set.
        n_beams: Beams that it casts a step.
        version: Of its package.
        speeds: One a batch size.
        left_out: Batch size, or `all`, to why it was not measured.
    """

    name: str
    about: str
    n_beams: int
    version: str | None
    speeds: list[Speed] = field(default_factory=list)
    left_out: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Route:
    """What the paper's route needs: the tunnel, our numbers, and a scene folder or None."""

    plan: st.TunnelPlan
    lining: str
    params: st.EnvParams
    scene: Path | None


def wanted(choice: Sequence[str]) -> dict[str, ModuleType | str]:
    """The peers to measure, by name: their module, or why they cannot be measured.

    Raises:
        ThroughputError: One that was asked for by name is not installed.
    """
    names = [] if "none" in choice else NAMES if "auto" in choice else [name for name in NAMES if name in choice]
    found: dict[str, ModuleType | str] = {}
    for name in names:
        try:
            module = importlib.import_module(f"benchmarks.throughput.peers.{name}")
            if name in BATCHED:
                module.loop(1)
            found[name] = module
        except ImportError as error:
            if "auto" not in choice:
                raise ThroughputError(f"peer {name!r} cannot be imported ({error}); see the extra `peers`") from error
            found[name] = f"cannot be imported ({error})"
    return found


def measure_peer(
    name: str, module: ModuleType | str, sizes: Sequence[int], route: Route, timing: Timing, say: Callable[[str], None]
) -> Peer:
    """Measures one peer.

    Args:
        name: Its name.
        module: Its module, or why there is none.
        sizes: Batch sizes; the paper's route has one environment whatever they are.
        route: What the paper's route needs.
        timing: How long to look.
        say: Told what is being measured.
    """
    if isinstance(module, str):
        return Peer(name, "", 0, None, left_out={"all": module})
    if name not in BATCHED:
        say(f"{name}: 1 environment")
        return _measure_route(name, module, route, timing)
    peer = Peer(name, module.ABOUT, module.N_BEAMS, version(module.PACKAGE))
    for n_envs in sizes:
        say(f"{name}: {n_envs:,} environments")
        try:
            peer.speeds.append(measure(module.loop(n_envs), n_envs, timing))
        except Exception as error:  # whatever goes wrong in a peer must not cost our own figures
            out_of_memory = "RESOURCE_EXHAUSTED" in str(error)
            peer.left_out[str(n_envs)] = "out of memory" if out_of_memory else f"{type(error).__name__}: {error}"
    return peer


def _measure_route(name: str, module: ModuleType, route: Route, timing: Timing) -> Peer:
    from benchmarks.throughput.peers import walls

    if route.scene is None:
        scene = walls.extruded(route.plan, route.lining)
    else:
        scene = walls.built(route.scene, route.plan, route.lining)
    env = module.MujocoTunnel(scene, route.plan, route.params)
    about = f"{module.ABOUT}; {scene.about}"
    return Peer(name, about, env.n_beams, version(module.PACKAGE), [module.measure(env, timing)])
