"""Speed of the batched environment, measured together with the exactness of its LiDAR.

`python -m benchmarks.throughput --n 1024 4096 --out throughput.json`
"""

import dataclasses
import json
import os
import platform
import sys
import time
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

import subterra_jax as st
from subterra_jax import lidar, reference

# Poses scanned at a time by the exactness gate.
_GATE_BATCH = 1000


@dataclasses.dataclass(frozen=True)
class ThroughputConfig:
    """What to measure.

    Attributes:
        n: Environments in a batch; each size is measured.
        task: Id of the task.
        tunnel: Tunnel file; the packaged one if not given.
        lining: Variant of its walls.
        steps: Steps in one timed call, all within one `lax.scan`.
        repeats: Timed calls.
        poses: Random poses at which the LiDAR is compared with float64 brute force; 0 leaves the gate out.
        seed: Seed of actions, environments and poses.
        out: JSON file to write.
    """

    n: tuple[int, ...] = (1024,)
    task: str = "Subterra/Traverse-v0"
    tunnel: Path | None = None
    lining: str = "pockets"
    steps: int = 100
    repeats: int = 20
    poses: int = 10_000
    seed: int = 0
    out: Path | None = None


@dataclasses.dataclass(frozen=True)
class Speed:
    """One batch size.

    Attributes:
        n_envs: Environments in the batch.
        compile_seconds: From the first call to its end, s.
        steps_per_second: Environment steps per second of each timed call.
        share_done: Share of steps at which an episode ended.
    """

    n_envs: int
    compile_seconds: float
    steps_per_second: list[float]
    share_done: float

    @property
    def quartiles(self) -> tuple[float, float, float]:
        """Lower quartile, median and upper quartile of the steps per second."""
        lower, median, upper = np.percentile(self.steps_per_second, [25, 50, 75])
        return float(lower), float(median), float(upper)


def measure_speed(env: st.TraverseEnv, params: st.EnvParams, n_envs: int, config: ThroughputConfig) -> Speed:
    """Time `AutoReset.step` under random actions; the result is a sum over every number of every observation."""
    batch = st.AutoReset(env)
    low, high = (jnp.asarray(bound) for bound in dataclasses.astuple(env.action_space(params)))

    def one_step(carry: tuple[st.State, jax.Array], key: jax.Array) -> tuple[tuple[st.State, jax.Array], jax.Array]:
        state, total = carry
        action_key, env_key = jax.random.split(key)
        action = jax.random.uniform(action_key, (n_envs, env.action_size), minval=low, maxval=high)
        obs, state, reward, terminated, truncated, info = batch.step(env_key, state, action, params)
        total = total + jnp.sum(obs) + jnp.sum(reward) + jnp.sum(info["final_observation"])
        return (state, total), jnp.mean(terminated | truncated, dtype=jnp.float32)

    @jax.jit
    def many_steps(key: jax.Array, state: st.State) -> tuple[st.State, jax.Array, jax.Array]:
        keys = jax.random.split(key, config.steps)
        (state, total), done = jax.lax.scan(one_step, (state, jnp.zeros(())), keys)
        return state, total, jnp.mean(done)

    _, state = jax.jit(partial(batch.reset, n_envs=n_envs))(jax.random.key(config.seed), params)
    jax.block_until_ready(state)
    started = time.perf_counter()
    state, *_ = jax.block_until_ready(many_steps(jax.random.key(config.seed), state))
    compile_seconds = time.perf_counter() - started
    rates, done = [], 0.0
    for key in jax.random.split(jax.random.key(config.seed + 1), config.repeats):
        started = time.perf_counter()
        state, total, share = jax.block_until_ready(many_steps(key, state))
        rates.append(n_envs * config.steps / (time.perf_counter() - started))
        done += float(share) / config.repeats
        if not np.isfinite(float(total)):
            raise FloatingPointError(f"observations or rewards stopped being finite at n_envs={n_envs}")
    return Speed(n_envs, compile_seconds, rates, done)


def measure_exactness(plan: st.TunnelPlan, config: ThroughputConfig, params: st.EnvParams) -> reference.Agreement:
    """Compare the LiDAR on this device with float64 brute force over every segment of the same walls."""
    poses = reference.random_poses(plan, config.poses, np.random.default_rng(config.seed))
    scan = jax.jit(jax.vmap(partial(lidar.scan, params=params.lidar), in_axes=(None, 0, 0, 0)))
    ranges = [
        np.asarray(scan(params.tunnel, poses.position[rows], poses.heading[rows], poses.station[rows]))
        for rows in np.array_split(np.arange(config.poses), max(1, config.poses // _GATE_BATCH))
    ]
    return reference.agreement(plan.lining(config.lining).segments, poses, np.concatenate(ranges))


def _version(package: str) -> str | None:
    """Version of a package; None where it runs from a checkout that was not installed."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def environment_facts() -> dict[str, Any]:
    """Hardware and versions."""
    device = jax.devices()[0]
    return {
        "device": device.device_kind if device.platform != "cpu" else _processor(),
        "platform": device.platform,
        "n_devices": len(jax.devices()),
        "cpu_cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "python": platform.python_version(),
        **{name: _version(name) for name in ("jax", "jaxlib", "flax", "numpy", "subterra-jax")},
    }


def _processor() -> str:
    """Name of the processor, as well as the system tells it."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def report(speeds: list[Speed], exact: reference.Agreement | None, facts: dict[str, Any]) -> None:
    """Print what was measured."""
    table = Table(title=f"{facts['device']}, {facts['cpu_cores']} cores, jax {facts['jax']}")
    for heading in ("environments", "median steps/s", "quartiles", "ns per step", "compile, s"):
        table.add_column(heading, justify="right")
    for speed in speeds:
        lower, median, upper = speed.quartiles
        quartiles = f"{lower:,.0f} to {upper:,.0f}"
        row = (f"{speed.n_envs:,}", f"{median:,.0f}", quartiles, f"{1e9 / median:.1f}", f"{speed.compile_seconds:.1f}")
        table.add_row(*row)
    console = Console()
    console.print(table)
    if exact is not None:
        console.print(
            f"LiDAR against float64 brute force, {exact.n_rays:,} rays: largest error {exact.max_error * 1e3:.3f} mm, "
            f"{exact.n_ambiguous} at an edge within rounding, {exact.n_wrong} wrong",
            highlight=False,
        )


def main() -> int:
    """Measure, print, write; the status is 1 if the LiDAR is not exact."""
    config = tyro.cli(ThroughputConfig, description=__doc__)
    try:
        plan = st.load_tunnel(config.tunnel)
        env, params = st.make(config.task, plan, config.lining)
    except (st.SubterraError, ValueError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    # The gate looks at the whole tunnel, whichever piece of it the task uses.
    whole = st.make("Subterra/Traverse-v0", plan, config.lining)[1]
    exact = measure_exactness(plan, config, whole) if config.poses else None
    speeds = [measure_speed(env, params, n_envs, config) for n_envs in config.n]
    facts = environment_facts()
    report(speeds, exact, facts)
    if config.out is not None:
        result = {
            "schema": "subterra.throughput/1",
            "config": json.loads(json.dumps(dataclasses.asdict(config), default=str)),
            "environment": facts,
            "tunnel": {"name": plan.name, "length": plan.length, "lining": config.lining},
            "exactness": None if exact is None else dataclasses.asdict(exact),
            "speed": [
                dataclasses.asdict(s) | dict(zip(("q1", "median", "q3"), s.quartiles, strict=True)) for s in speeds
            ],
        }
        config.out.parent.mkdir(parents=True, exist_ok=True)
        partial_file = config.out.with_suffix(".partial")
        partial_file.write_text(json.dumps(result, indent=2) + "\n")
        partial_file.replace(config.out)
    return 1 if exact is not None and exact.n_wrong else 0


if __name__ == "__main__":
    sys.exit(main())
