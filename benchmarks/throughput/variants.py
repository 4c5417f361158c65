"""What must not matter much: how long the tunnel is, and what its walls are like."""

from dataclasses import dataclass, replace

import numpy as np

import subterra_jax as st
from benchmarks.throughput import joined
from benchmarks.throughput.config import ThroughputConfig
from benchmarks.throughput.exactness import measure_exactness
from benchmarks.throughput.measure import environment_loop, spread_loop
from benchmarks.throughput.timing import Speed, Timing, measure_in_turn
from subterra_jax.lidar.reference import Agreement

_TASK = "Subterra/Traverse-v0"  # whose piece is the whole tunnel


@dataclass(frozen=True)
class Variant:
    """One of several tunnels, timed in turn with the others.

    Attributes:
        name: Length (m) or lining.
        n_segments: Wall segments of the tunnel.
        speed: How fast it steps.
        cost: Time of a step over the first variant's, in the same round: lower quartile, median, upper quartile.
        exactness: None where the gate was left out.
    """

    name: str
    n_segments: int
    speed: Speed
    cost: tuple[float, float, float]
    exactness: Agreement | None


def measure_lengths(plan: st.TunnelPlan, config: ThroughputConfig, timing: Timing) -> list[Variant]:
    """The cost of a step by length of tunnel, robots all along it; every call begins with them there again."""
    bare = replace(plan, linings={config.lining: plan.lining(config.lining)})  # the others take long to cut
    plans = [joined.of_length(bare, length) for length in config.lengths]
    made = [st.make(_TASK, each, config.lining) for each in plans]
    loops = [spread_loop(env, params, config.studied()) for env, params in made]
    speeds = measure_in_turn(loops, config.studied(), timing, restart=True)
    gates = [_gate(each, config.lining, params, config) for each, (_, params) in zip(plans, made, strict=True)]
    sizes = [len(each.lining(config.lining).segments) for each in plans]
    return _variants([f"{length:g} m" for length in config.lengths], sizes, speeds, gates)


def measure_linings(plan: st.TunnelPlan, config: ThroughputConfig, timing: Timing) -> list[Variant]:
    """The cost of a step by lining of the same tunnel."""
    made = [st.make(config.task, plan, lining) for lining in config.linings]
    loops = [environment_loop(env, params, config.studied()) for env, params in made]
    speeds = measure_in_turn(loops, config.studied(), timing)
    gates = [_gate(plan, name, st.make(_TASK, plan, name)[1], config) for name in config.linings]
    sizes = [len(plan.lining(name).segments) for name in config.linings]
    return _variants(list(config.linings), sizes, speeds, gates)


def _gate(plan: st.TunnelPlan, lining: str, params: st.EnvParams, config: ThroughputConfig) -> Agreement | None:
    # A tenth of the poses: brute force costs as many times more as the tunnel is longer.
    n_poses = -(-config.poses // 10)
    return measure_exactness(plan, lining, params, n_poses, config.seed) if n_poses else None


def _variants(names: list[str], sizes: list[int], speeds: list[Speed], gates: list[Agreement | None]) -> list[Variant]:
    first = np.asarray(speeds[0].steps_per_second)
    found = []
    for name, size, speed, gate in zip(names, sizes, speeds, gates, strict=True):
        lower, median, upper = np.percentile(first / np.asarray(speed.steps_per_second), [25, 50, 75])
        found.append(Variant(name, size, speed, (float(lower), float(median), float(upper)), gate))
    return found
