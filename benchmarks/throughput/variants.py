"""Cost of a step by length of tunnel and by lining."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

import subterra_jax as st
from benchmarks.rays.planar import Agreement
from benchmarks.throughput.config import ThroughputConfig
from benchmarks.throughput.measure import environment_loop, measure_exactness, spread_loop
from benchmarks.throughput.timing import Speed, Timing, measure_in_turn
from subterra_jax.procedural import open_world

_TASK = "Subterra/Traverse-v1"  # whose piece is the whole tunnel
_LONG = "open:straight:train:0"


@dataclass(frozen=True)
class Variant:
    """One of several tunnels, timed in turn with the others."""

    name: str  # Length (m) or lining
    n_segments: int  # Number of wall segments of the tunnel
    speed: Speed  # Speed of its environment
    # Step time relative to the first variant in the same round: lower quartile, median, upper quartile
    cost: tuple[float, float, float]
    exactness: Agreement | None  # Comparison of the LiDAR with the reference; `None` if skipped


def measure_lengths(config: ThroughputConfig, timing: Timing) -> list[Variant]:
    """Measures a step by length of tunnel; every call starts with robots spread along the tunnel."""
    tunnel = config.tunnel if config.tunnel and config.tunnel.startswith("open:") else _LONG
    lining = config.lining or open_world.VARIANTS[0]
    plans = [open_world.plan(tunnel, variants=(lining,), solid=False, length=length) for length in config.lengths]
    made = [st.make(_TASK, plan, lining) for plan in plans]
    loops = [spread_loop(env, params, config.study_size()) for env, params in made]
    speeds = measure_in_turn(loops, config.study_size(), timing, restart=True)
    names, each = [f"{length:g} m" for length in config.lengths], [params for _, params in made]
    return _variants(config, names, plans, [lining] * len(plans), each, speeds)


def measure_linings(plan: st.TunnelPlan, config: ThroughputConfig, timing: Timing) -> list[Variant]:
    """Measures a step by lining of the same tunnel."""
    made = [st.make(config.task, plan, lining) for lining in config.linings]
    loops = [environment_loop(env, params, config.study_size()) for env, params in made]
    speeds = measure_in_turn(loops, config.study_size(), timing)
    whole = [st.make(_TASK, plan, name)[1] for name in config.linings]
    return _variants(config, config.linings, [plan] * len(whole), config.linings, whole, speeds)


def _variants(
    config: ThroughputConfig,
    names: Sequence[str],
    plans: Sequence[st.TunnelPlan],
    linings: Sequence[str],
    params: Sequence[Any],
    speeds: Sequence[Speed],
) -> list[Variant]:
    first, variants = np.asarray(speeds[0].steps_per_second), []
    # A tenth of the poses: brute force costs as many times more as the tunnel is longer.
    n_poses = -(-config.poses // 10)
    for name, plan, lining, own, speed in zip(names, plans, linings, params, speeds, strict=True):
        gate = measure_exactness(plan, lining, own, n_poses, config.seed) if n_poses else None
        lower, median, upper = np.percentile(first / np.asarray(speed.steps_per_second), [25, 50, 75])
        cost = float(lower), float(median), float(upper)
        variants.append(Variant(name, len(plan.lining(lining).segments), speed, cost, gate))
    return variants
