"""Speed of the walking robot: `python -m benchmarks.b2 --robots 8192`.

Measures physics steps per second of MJX alone and of the whole environment (random actions, observation, reward,
resets).
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

import subterra_jax as st
from benchmarks.command import require_least, run_main
from benchmarks.results import write_file
from subterra_jax.b2 import tasks
from subterra_jax.b2.physics import Physics
from subterra_jax.host.files import require_file
from train.log import print_table


@dataclasses.dataclass(frozen=True)
class Command:
    """Measures physics steps per second of the B2 on its window of track.

    Example: python -m benchmarks.b2 --robots 8192
    """

    robots: int = 8192  # Robots in the batch.
    tunnel: str | None = None  # Tunnel file or name; its length does not change the speed.
    control_steps: int = 20  # Control periods of 5 physics steps in one timed call.
    repeats: int = 10  # Timed calls; the median is reported.
    out: Path | None = None  # JSON file for the figures.


def measure(command: Command) -> dict[str, Any]:
    """Measures both speeds, in physics steps per second."""
    physics = Physics()
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
    """Measures, prints and writes; returns 1 where a number is not finite.

    Raises:
        SubterraError: A number is too small, there is no such tunnel, or the output cannot be written.
    """
    require_least(arguments, robots=1, control_steps=1, repeats=1)
    if arguments.out is not None:
        require_file(arguments.out)
    figures = {"device": jax.devices()[0].device_kind, **measure(arguments)}
    print_table(f"{arguments.robots} robots, physics steps per second", figures)
    if arguments.out is not None:
        write_file(arguments.out, (json.dumps(figures, indent=1) + "\n").encode())
    return 0 if figures["finite"] else 1


def main(words: list[str] | None = None) -> int:
    """Runs the command line; returns 2 for a user's mistake."""
    return run_main("b2", Command, command, words=words)


if __name__ == "__main__":
    sys.exit(main())
