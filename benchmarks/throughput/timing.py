"""Times loops: one `lax.scan` of steps, compiled separately, warmed up, then timed several times.

Our environment and every JAX peer use the same loop. All outputs of a step are summed and the next step reads its
observation, so that the compiler cannot drop a ray and every observation is written to memory.
"""

from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

Carry = tuple[Any, Any]


@dataclass(frozen=True)
class Loop:
    """A batch of environments under random actions."""

    reset: Callable[[PRNGKeyArray, Any], Carry]  # Maps key and params to observations and state
    # Maps key, observations and state, and params to new observations and state, a scalar that depends on all other
    # outputs of the step, and the fraction of environments whose episode ended
    step: Callable[[PRNGKeyArray, Carry, Any], tuple[Carry, Float[Array, ""], Float[Array, ""]]]
    params: Any = None  # Constant inputs of the step; an argument of the compiled program, not a constant in it


@dataclass(frozen=True)
class Timing:
    """Number and length of timed calls."""

    steps: int = 100  # Steps in one call
    repeats: int = 20  # Timed calls
    seconds: float = 30.0  # Time limit for all calls, s; a call gets fewer steps to keep to it
    seed: int = 0  # Seed for resets and steps


@dataclass(frozen=True)
class Speed:
    """Measurements at one batch size."""

    n_envs: int  # Environments in the batch
    steps: int  # Steps in one call
    compile_seconds: float  # Time to trace and compile the call, s; not part of any other figure
    steps_per_second: list[float]  # Environment steps per second of each timed call
    share_done: float  # Fraction of steps at which an episode ended
    checksum: float  # Sum of all outputs of all timed steps; the same for the same seed, device and versions

    @property
    def quartiles(self) -> tuple[float, float, float]:
        """Returns lower quartile, median and upper quartile of the steps per second."""
        lower, median, upper = np.percentile(self.steps_per_second, [25, 50, 75])
        return float(lower), float(median), float(upper)


def measure(loop: Loop, n_envs: int, timing: Timing) -> Speed:
    """Times one loop after a call that warms it up; calls get fewer steps if they would take too long.

    Raises:
        FloatingPointError: An observation or a reward is not finite.
    """
    begin = jax.block_until_ready(jax.jit(loop.reset)(jax.random.key(timing.seed), loop.params))
    steps, fewer = 0, timing.steps
    while fewer < 0.7 * steps or not steps:  # a second compilation is worth its time if it saves a third
        steps, started = fewer, perf_counter()
        call = jax.jit(_many_steps(loop, steps)).lower(jax.random.key(0), begin, loop.params).compile()
        compile_seconds = perf_counter() - started
        elapsed, carry, *_ = _timed(call, jax.random.key(timing.seed), begin, loop.params, n_envs)
        fewer = max(1, min(steps, int(steps * timing.seconds / (timing.repeats * elapsed))))
    rates, totals, ended = [], [], []
    for key in jax.random.split(jax.random.key(timing.seed + 1), timing.repeats):
        elapsed, carry, total, done = _timed(call, key, carry, loop.params, n_envs)
        rates.append(n_envs * steps / elapsed)
        totals.append(total)
        ended.append(done)
    return Speed(n_envs, steps, compile_seconds, rates, float(np.mean(ended)), float(np.sum(totals)))


def _timed(
    call: Callable[..., Any], key: PRNGKeyArray, carry: Carry, params: Any, n_envs: int
) -> tuple[float, Carry, float, float]:
    """Returns the time of a call, s, the state after it, the sum of its outputs and the fraction of episodes ended."""
    started = perf_counter()
    carry, total, done = jax.block_until_ready(call(key, carry, params))
    elapsed = perf_counter() - started
    if not np.isfinite(float(total)):
        raise FloatingPointError(f"observations or rewards stopped being finite at n_envs={n_envs}")
    return elapsed, carry, float(total), float(done)


def _many_steps(loop: Loop, steps: int) -> Callable[..., Any]:
    def many_steps(key: PRNGKeyArray, carry: Carry, params: Any) -> tuple[Carry, Array, Array]:
        def one_step(carried: tuple[Carry, Array], key: PRNGKeyArray) -> tuple[tuple[Carry, Array], Array]:
            (obs, state), total = carried
            following, rest, done = loop.step(key, (obs, state), params)
            return (following, total + digest(obs) + rest), done

        (carry, total), done = jax.lax.scan(one_step, (carry, jnp.zeros(())), jax.random.split(key, steps))
        return carry, total + digest(carry[0]), jnp.mean(done)

    return many_steps


def digest(tree: Any) -> Float[Array, ""]:
    """Returns the sum of the means of all leaves: one number that depends on every number."""
    return sum((jnp.mean(leaf, dtype=jnp.float32) for leaf in jax.tree.leaves(tree)), jnp.zeros(()))
