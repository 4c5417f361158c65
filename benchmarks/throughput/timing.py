"""Times loops: one `lax.scan` of steps, compiled separately, warmed up, then timed several times.

Our environment and every JAX peer use the same loop. All outputs of a step are summed and the next step reads its
observation, so that the compiler cannot drop a ray and every observation is written to memory.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
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
    # outputs of the step, and the share of environments whose episode ended
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
    share_done: float  # Share of steps at which an episode ended
    checksum: float  # Sum of all outputs of all timed steps; the same for the same seed, device and versions

    @property
    def quartiles(self) -> tuple[float, float, float]:
        """Returns lower quartile, median and upper quartile of the steps per second."""
        lower, median, upper = np.percentile(self.steps_per_second, [25, 50, 75])
        return float(lower), float(median), float(upper)


@dataclass
class Program:
    """A compiled call and the results of its timed calls so far."""

    n_envs: int  # Environments in the batch
    steps: int  # Steps in one call
    compile_seconds: float  # Time to trace and compile it, s
    _call: Callable[..., Any]
    _params: Any
    _carry: Carry
    _rates: list[float] = field(default_factory=list)
    _done: list[float] = field(default_factory=list)
    totals: list[float] = field(default_factory=list)  # Sum of the step outputs of each timed call

    def call(self, key: PRNGKeyArray, keep: bool = True) -> float:
        """Runs one call and returns its time, s.

        Raises:
            FloatingPointError: An observation or a reward is not finite.
        """
        started = perf_counter()
        carry, total, done = jax.block_until_ready(self._call(key, self._carry, self._params))
        elapsed = perf_counter() - started
        if not np.isfinite(float(total)):
            raise FloatingPointError(f"observations or rewards stopped being finite at n_envs={self.n_envs}")
        self._carry = carry
        if keep:
            self._rates.append(self.n_envs * self.steps / elapsed)
            self._done.append(float(done))
            self.totals.append(float(total))
        return elapsed

    def speed(self) -> Speed:
        """Returns the measurements of all its calls."""
        share, total = float(np.mean(self._done)), float(np.sum(self.totals))
        return Speed(self.n_envs, self.steps, self.compile_seconds, list(self._rates), share, total)


def measure(loop: Loop, n_envs: int, timing: Timing) -> Speed:
    """Times one loop."""
    program = prepare(loop, n_envs, timing)
    for key in jax.random.split(jax.random.key(timing.seed + 1), timing.repeats):
        program.call(key)
    return program.speed()


def prepare(loop: Loop, n_envs: int, timing: Timing) -> Program:
    """Compiles a call and runs it once; gives it fewer steps if the calls would take too long."""
    carry = jax.block_until_ready(jax.jit(loop.reset)(jax.random.key(timing.seed), loop.params))
    program = _compile(loop, n_envs, timing.steps, carry)
    elapsed = program.call(jax.random.key(timing.seed), keep=False)
    steps = max(1, min(timing.steps, int(timing.steps * timing.seconds / (timing.repeats * elapsed))))
    # A second compilation is worth its time if it saves a third.
    if steps < 0.7 * timing.steps:
        program = _compile(loop, n_envs, steps, carry)
        program.call(jax.random.key(timing.seed), keep=False)
    return program


def _compile(loop: Loop, n_envs: int, steps: int, carry: Carry) -> Program:
    started = perf_counter()
    call = jax.jit(_many_steps(loop, steps)).lower(jax.random.key(0), carry, loop.params).compile()
    return Program(n_envs, steps, perf_counter() - started, call, loop.params, carry)


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
