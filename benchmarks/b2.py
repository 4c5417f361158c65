"""Speed of the walking robot: `python -m benchmarks.b2 --robots 8192`.

Measures physics steps per second of MJX alone and of the whole environment (random actions, observation, reward,
resets) for each variant of solver and contacts, in one run.
"""

import dataclasses
import json
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from rich.console import Console
from rich.table import Table

import subterra_jax as st
from benchmarks.command import require_least, run_main
from subterra_jax.b2 import tasks
from subterra_jax.b2.physics import Physics
from subterra_jax.b2.track import WindowConfig
from subterra_jax.host.files import require_file

_COLUMNS = ("variant", "contacts", "rows", "MJX alone, M/s", "environment, M/s", "share", "compile, s", "falls in 20 s")
VARIANTS: dict[str, Physics] = {
    "as shipped": Physics(),
    "2 iterations": Physics(iterations=2),
    "line search 4": Physics(ls_iterations=4),
    "6 contacts": Physics(window=WindowConfig(max_contacts=6)),
    "12 contacts": Physics(window=WindowConfig(max_contacts=12)),
    "all contacts": Physics(window=WindowConfig(max_contacts=0)),
    "no rails": Physics(window=WindowConfig(rails=False)),
}


@dataclasses.dataclass(frozen=True)
class Command:
    """Measures physics steps per second of the B2 on its window of track.

    Example: python -m benchmarks.b2 --robots 8192 --variants all

    Attributes:
        robots: Robots in the batch.
        variants: Variants to measure, or `all`.
        tunnel: Tunnel file or name; its length does not change the speed.
        control_steps: Control periods of 5 physics steps in one timed call.
        repeats: Timed calls; the median is reported.
        out: JSON file for the figures.
    """

    robots: int = 8192
    variants: tuple[str, ...] = ("as shipped",)
    tunnel: str | None = None
    control_steps: int = 20
    repeats: int = 10
    out: Path | None = None


def measure(physics: Physics, command: Command) -> dict[str, Any]:
    """Measures both speeds of one variant, in physics steps per second."""
    env, params = tasks.make(tunnel=command.tunnel, physics=physics)
    batch, n = st.AutoReset(env), command.robots
    key = jax.random.key(0)
    _, state = jax.jit(batch.reset, static_argnums=2)(key, params, n)

    def alone(state: Any, key: Any) -> tuple[Any, Any]:
        del key
        surroundings = jax.vmap(env.surroundings, in_axes=(0, None))(state, params)
        targets = jnp.tile(jnp.array([0.0, 0.8, -1.4], jnp.float32), (n, 4))

        def one(body: Any, _: None) -> tuple[Any, None]:
            return jax.vmap(physics.run)(body, targets, surroundings, state.build), None

        body, _ = jax.lax.scan(one, state.body, None, length=command.control_steps)
        return dataclasses.replace(state, body=body), jnp.sum(body.qpos)

    def whole(state: Any, key: Any) -> tuple[Any, Any]:
        def one(state: Any, key: Any) -> tuple[Any, Any]:
            act_key, step_key = jax.random.split(key)
            action = 0.3 * jax.random.normal(act_key, (n, 12))
            obs, state, reward, terminated, _, _ = batch.step(step_key, state, action, params)
            return state, (jnp.sum(reward) + jnp.sum(obs), jnp.sum(terminated))

        return jax.lax.scan(one, state, jax.random.split(key, command.control_steps))

    steps = n * command.control_steps * physics.substeps
    bare, _, compile_alone = _time(alone, state, command)
    full, (outputs, ended), compile_whole = _time(whole, state, command)
    robot_seconds = n * command.control_steps * physics.period
    return {
        "contacts": int(physics.blank._impl.contact.dist.shape[0]),
        "rows": int(physics.blank._impl.nefc),
        "alone": steps / bare,
        "environment": steps / full,
        "compile": compile_alone + compile_whole,
        "falls": float(jnp.sum(ended)) / robot_seconds * 20.0,
        "finite": bool(jnp.isfinite(outputs).all()),
    }


def _time(function: Callable[..., Any], state: Any, command: Command) -> tuple[float, Any, float]:
    """Returns median seconds of a call, the last call's output, and seconds to compile."""
    started = time.perf_counter()
    compiled = jax.jit(function).lower(state, jax.random.key(0)).compile()
    compile_seconds, seconds, output = time.perf_counter() - started, [], None
    for repeat in range(command.repeats + 1):
        before = time.perf_counter()
        state, output = jax.block_until_ready(compiled(state, jax.random.key(repeat)))
        seconds.append(time.perf_counter() - before)
    return statistics.median(seconds[1:]), output, compile_seconds


def command(arguments: Command) -> int:
    """Measures and prints; returns 1 where a number is not finite.

    Raises:
        ValueError: There is no such variant.
        SubterraError: A number is too small, there is no such tunnel, or the output cannot be written.
    """
    names = tuple(VARIANTS) if arguments.variants == ("all",) else arguments.variants
    for name in names:
        if name not in VARIANTS:
            raise ValueError(f"no variant {name!r}; there are {', '.join(VARIANTS)}, all")
    require_least(arguments, robots=1, control_steps=1, repeats=1)
    if arguments.out is not None:
        require_file(arguments.out)
    device = jax.devices()[0]
    table = Table(*_COLUMNS, title=f"{arguments.robots} robots, {device.device_kind}, physics steps")
    results = {}
    for name in names:
        figures = results[name] = measure(VARIANTS[name], arguments)
        table.add_row(
            name, str(figures["contacts"]), str(figures["rows"]), f"{figures['alone'] / 1e6:.2f}",
            f"{figures['environment'] / 1e6:.2f}", f"{figures['environment'] / figures['alone']:.0%}",
            f"{figures['compile']:.0f}", f"{figures['falls']:.2f}",
        )  # fmt: skip
    Console(width=110).print(table)
    if arguments.out is not None:
        arguments.out.parent.mkdir(parents=True, exist_ok=True)
        arguments.out.write_text(json.dumps({"device": device.device_kind, "variants": results}, indent=1) + "\n")
    return 0 if all(figures["finite"] for figures in results.values()) else 1


def main(words: list[str] | None = None) -> int:
    """Runs the command line; returns 2 for a user's mistake."""
    return run_main("b2", Command, command, words=words)


if __name__ == "__main__":
    sys.exit(main())
