"""Speed of the walking robot: `python -m benchmarks.b2 --robots 8192`.

For each variant of solver and contacts, physics steps per second of MJX alone and of the whole environment (random
actions, observation, reward, resets), in the same run.
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
import tyro
from rich.console import Console
from rich.table import Table

import subterra_jax as st
from benchmarks.command import status
from scene.arguments import parse
from subterra_jax.b2 import tasks
from subterra_jax.b2.physics import Physics
from subterra_jax.b2.track import WindowConfig
from subterra_jax.outputs import require_file

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
        robots: At once.
        variants: Which to measure; `all` for all of them.
        tunnel: Tunnel file or name; a longer one costs no more.
        control_steps: Control periods of 5 physics steps in one timed call.
        repeats: Timed calls, of which the median is told.
        out: Where to write the figures as JSON.
    """

    robots: int = 8192
    variants: tuple[str, ...] = ("as shipped",)
    tunnel: str | None = None
    control_steps: int = 20
    repeats: int = 10
    out: Path | None = None


def measure(physics: Physics, command: Command) -> dict[str, Any]:
    """Both speeds of one variant, in physics steps per second."""
    env, params = tasks.make(tunnel=command.tunnel, physics=physics)
    batch, n = st.AutoReset(env), command.robots
    key = jax.random.key(0)
    _, state = jax.jit(batch.reset, static_argnums=2)(key, params, n)

    def alone(state: Any, key: Any) -> tuple[Any, Any]:
        del key
        around = jax.vmap(env.surroundings, in_axes=(0, None))(state, params)
        targets = jnp.tile(jnp.array([0.0, 0.8, -1.4], jnp.float32), (n, 4))

        def one(body: Any, _: None) -> tuple[Any, None]:
            return jax.vmap(physics.run)(body, targets, around, state.build), None

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
    bare, _, first = _time(alone, state, command)
    full, told, second = _time(whole, state, command)
    robot_seconds = n * command.control_steps * physics.period
    return {
        "contacts": int(physics.blank._impl.contact.dist.shape[0]),
        "rows": int(physics.blank._impl.nefc),
        "alone": steps / bare,
        "environment": steps / full,
        "compile": first + second,
        "falls": float(jnp.sum(told[1])) / robot_seconds * 20.0,
        "finite": bool(jnp.isfinite(told[0]).all()),
    }


def _time(function: Callable[..., Any], state: Any, command: Command) -> tuple[float, Any, float]:
    """Median seconds of a call, what the last one told, and seconds to compile."""
    began = time.perf_counter()
    compiled = jax.jit(function).lower(state, jax.random.key(0)).compile()
    spent, seconds, told = time.perf_counter() - began, [], None
    for repeat in range(command.repeats + 1):
        before = time.perf_counter()
        state, told = jax.block_until_ready(compiled(state, jax.random.key(repeat)))
        seconds.append(time.perf_counter() - before)
    return statistics.median(seconds[1:]), told, spent


def command(arguments: Command) -> int:
    """Measures and prints; the status is 1 where anything is no longer finite.

    Raises:
        ValueError: There is no such variant, or a number is out of range.
        SubterraError: There is no such tunnel, or the output cannot be written.
    """
    names = tuple(VARIANTS) if arguments.variants == ("all",) else arguments.variants
    for name in names:
        if name not in VARIANTS:
            raise ValueError(f"no variant {name!r}; there are {', '.join(VARIANTS)}, all")
    for name in ("robots", "control_steps", "repeats"):
        if getattr(arguments, name) < 1:
            raise ValueError(f"{name} must be at least 1, got {getattr(arguments, name)}")
    if arguments.out is not None:
        require_file(arguments.out)
    device = jax.devices()[0]
    table = Table(*_COLUMNS, title=f"{arguments.robots} robots, {device.device_kind}, physics steps")
    found = {}
    for name in names:
        figures = found[name] = measure(VARIANTS[name], arguments)
        table.add_row(
            name, str(figures["contacts"]), str(figures["rows"]), f"{figures['alone'] / 1e6:.2f}",
            f"{figures['environment'] / 1e6:.2f}", f"{figures['environment'] / figures['alone']:.0%}",
            f"{figures['compile']:.0f}", f"{figures['falls']:.2f}",
        )  # fmt: skip
    Console(width=110).print(table)
    if arguments.out is not None:
        arguments.out.parent.mkdir(parents=True, exist_ok=True)
        arguments.out.write_text(json.dumps({"device": device.device_kind, "variants": found}, indent=1) + "\n")
    return 0 if all(figures["finite"] for figures in found.values()) else 1


def _read(words: list[str]) -> Command:
    return tyro.cli(Command, args=words, prog="python -m benchmarks.b2")


def main() -> int:
    """Entry point of `python -m benchmarks.b2`; a user's mistake is one sentence and status 2."""
    arguments = parse(_read)
    return status(lambda: command(arguments))


if __name__ == "__main__":
    sys.exit(main())
